//! What the disk refused.

/// The data that could not be written so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Faults {
    /// Rows not written.
    pub rows_lost: u64,
    /// Events not written.
    pub events_lost: u64,
    /// Refusals of the disk.
    pub io_errors: u64,
    /// The first refusal, in the system's words.
    pub first: Option<String>,
}
