//! How a search may try an effect: its free numbers, their starts, and the usual range.

/// A free number of a candidate as the fit sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitParameter {
    /// Name in model files and results.
    pub name: &'static str,
    /// Fitted as a logarithm.
    pub log: bool,
    /// Smallest value of the search: a smaller one has no meaning or no relevant effect.
    pub lower: f64,
    /// Largest value of the search.
    pub upper: f64,
    /// Step of the numeric derivative in the fit's coordinate.
    pub step: f64,
}

/// A positive number, spread over decades.
pub const fn log(name: &'static str, lower: f64, upper: f64) -> FitParameter {
    FitParameter {
        name,
        log: true,
        lower,
        upper,
        step: 1e-3,
    }
}

/// Any number, with the step of its numeric derivative.
pub const fn lin(name: &'static str, lower: f64, upper: f64, step: f64) -> FitParameter {
    FitParameter {
        name,
        log: false,
        lower,
        upper,
        step,
    }
}

impl FitParameter {
    /// Natural value from the fit's coordinate, kept inside the bounds.
    pub fn natural(&self, x: f64) -> f64 {
        let v = if self.log { x.exp() } else { x };
        v.clamp(self.lower, self.upper)
    }

    /// Fit coordinate of a natural value.
    pub fn coordinate(&self, v: f64) -> f64 {
        let v = v.clamp(self.lower, self.upper);
        if self.log { v.ln() } else { v }
    }
}

/// Ranges of starting values that the records allow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scope {
    /// Working point: displacement about which the plant acts \[um\].
    pub working_point_um: f64,
    /// Smallest command \[um\].
    pub low_um: f64,
    /// Largest command \[um\].
    pub high_um: f64,
    /// Largest excursion from the working point \[um\].
    pub stroke_um: f64,
    /// Largest excursion of the position from its start \[um\].
    pub travel_um: f64,
    /// Sample time \[s\].
    pub sample_s: f64,
    /// Length of the longest record \[s\].
    pub length_s: f64,
    /// The command is an analogue signal sampled with the output, not held between rows: nothing above half the sampling rate is
    /// visible.
    pub sampled_input: bool,
    /// Size of the units of command and position \[um\]: a user-defined effect has these units.
    pub per_unit: [f64; 2],
}

/// How a candidate enters the fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// In the chain, its numbers common to all records.
    Chain,
    /// A line and its multiples, each with amplitude and phase per record; amplitudes that differ from record to record cost. The first
    /// parameter is the frequency of the line, Hz.
    Line {
        /// How many, the line itself among them.
        harmonics: usize,
    },
    /// Periodic in position, sine and cosine common to all records; the first parameter is the period, um.
    Position,
}

/// One form in which to search for an effect. Most have one; hysteresis and saturation have several.
#[derive(Debug, Clone, Copy)]
pub struct Candidate {
    /// Name among the forms of its effect; empty where there is one.
    pub name: &'static str,
    /// Its free numbers.
    pub params: &'static [FitParameter],
    /// Range of the first number on real rigs. Outside it, another effect is likelier if two fits are equal.
    pub typical: (f64, f64),
    /// Its signature cannot come from the response to the command, so no misfit of a response resembles it.
    pub off_response: bool,
    /// How it enters the fit.
    pub role: Role,
    /// The smallest relevant size: index of a number, and its least size.
    pub smallest: Option<(usize, f64)>,
    /// Reference of that size: 1 for a factor.
    pub neutral: f64,
    /// A rich form, tried only after a simple form has found the effect.
    pub late: bool,
}

impl Candidate {
    /// A simple form in the chain without a usual range.
    pub const fn chain(params: &'static [FitParameter]) -> Self {
        Self {
            name: "",
            params,
            typical: (f64::NEG_INFINITY, f64::INFINITY),
            off_response: false,
            role: Role::Chain,
            smallest: None,
            neutral: 0.0,
            late: false,
        }
    }

    /// The same for a model with the gain of slow motion and one with that of fast motion, see [`super::Form::anchored`].
    pub const fn anchored(self) -> [Self; 2] {
        [
            Self {
                name: "slow-gain",
                ..self
            },
            Self {
                name: "fast-gain",
                ..self
            },
        ]
    }

    /// The same with the range of its first number on real rigs.
    pub const fn typical(self, low: f64, high: f64) -> Self {
        Self {
            typical: (low, high),
            ..self
        }
    }

    /// The same with the smallest relevant size of a number.
    pub const fn smallest(self, index: usize, size: f64) -> Self {
        Self {
            smallest: Some((index, size)),
            ..self
        }
    }

    /// The same with the value of that number that changes nothing.
    pub const fn about(self, neutral: f64) -> Self {
        Self { neutral, ..self }
    }

    /// Whether its numbers include a gain of the whole chain.
    pub fn holds_gain(&self) -> bool {
        self.params
            .iter()
            .any(|p| p.name == "weights" || p.name == "factor")
    }
}

/// Kind of record that separates an effect from similar ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Experiment {
    /// Many lines at once, up to high frequencies.
    Band,
    /// The same motion at several amplitudes.
    Amplitudes,
    /// Steps with long holds, and slow sines.
    Slow,
    /// The same amplitude at several frequencies.
    Rates,
    /// One long record.
    Long,
    /// No record of command and position: another instrument.
    Elsewhere,
}

/// Starts of one number.
pub(crate) fn one<const N: usize>(values: [f64; N]) -> Vec<Vec<f64>> {
    values.iter().map(|v| vec![*v]).collect()
}

/// Starts of two numbers, every pair.
pub(crate) fn grid(a: &[f64], b: &[f64]) -> Vec<Vec<f64>> {
    a.iter()
        .flat_map(|x| b.iter().map(move |y| vec![*x, *y]))
        .collect()
}
