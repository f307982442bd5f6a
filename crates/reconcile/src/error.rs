//! Errors in the input of the workflow.

/// Why no verdict was reached.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ReconcileError {
    /// A record that cannot be read as one.
    #[error("record `{record}`, row {row}: {message}")]
    Record {
        /// Name of the record.
        record: String,
        /// Row, counted from 0 without the header.
        row: usize,
        /// What is wrong, and what would be right.
        message: String,
    },
    /// No record at all.
    #[error("no records: give at least one CSV file or run folder with time_s, pzt_um and bead_um")]
    NoRecords,
    /// Records of different sample times.
    #[error(
        "record `{record}` is sampled every {found_s} s, the others every {expected_s} s: resample or run them apart"
    )]
    SampleTime {
        /// The record that differs.
        record: String,
        /// Its sample time \[s\].
        found_s: f64,
        /// That of the first record \[s\].
        expected_s: f64,
    },
    /// Nothing moves: nothing can be said about the response.
    #[error(
        "the command never changes in any record: a constant input shows drift and noise, but no effect of the chain can be told; record sines or a multisine (0.5..300 Hz, two amplitudes), steps and a rest"
    )]
    ConstantInput,
    /// Too little data.
    #[error(
        "only {seconds:.1} s of record with a changing command, {rows} rows with a position in all: at least {needed} are needed to tell effects apart"
    )]
    TooShort {
        /// Length of all records with a changing command \[s\].
        seconds: f64,
        /// Rows with a position.
        rows: usize,
        /// The limit that is not met.
        needed: String,
    },
    /// Looks like other units.
    #[error("{what}: the measured motion is {ratio:.3} times the model's; {hint}")]
    Units {
        /// What looks wrong.
        what: &'static str,
        /// Measured over simulated gain.
        ratio: f64,
        /// What to do.
        hint: &'static str,
    },
    /// Commands that never come near the model's working point.
    #[error(
        "pzt_um runs from {low_um:.2} to {high_um:.2}, but the model's working point is {working_point_um} um: {hint}"
    )]
    WorkingPoint {
        /// Smallest command.
        low_um: f64,
        /// Largest command.
        high_um: f64,
        /// Working point of the model \[um\].
        working_point_um: f64,
        /// What to do.
        hint: &'static str,
    },
    /// The output comes before the input.
    #[error(
        "the output leads the input by about {lead_s:.4} s: swapped columns, or two clocks; nothing that is driven moves before its drive"
    )]
    Leads {
        /// By how much \[s\].
        lead_s: f64,
    },
    /// Does not follow the model at all.
    #[error(
        "these records do not follow this model: only {explained_percent:.0} % of the measured motion goes with the command as the model says (at any gain, at delays up to 20 samples){detail}; a record of another rig, swapped columns, or the wrong model file"
    )]
    AnotherRig {
        /// Part of the motion explained by the best gain and delay, percent.
        explained_percent: f64,
        /// More about it.
        detail: String,
    },
    /// The model file asks for something that this workflow cannot do.
    #[error("model: {0}")]
    Model(String),
}
