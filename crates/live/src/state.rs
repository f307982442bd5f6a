//! Messages in words for the page: the run, its state, its events.

use serde::Serialize;

/// Constant data of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Hello {
    /// Name of the run.
    pub name: String,
    /// The run: command, controller, rig.
    pub subtitle: String,
    /// Period of the loop, us.
    pub period_us: f64,
    /// Ends of the PZT's range, um.
    pub range_um: [f64; 2],
    /// Slew limit, um/s.
    pub slew_um_per_s: f64,
    /// Ends of the field of view along the channel, um; NaN if unknown.
    pub view_um: [f64; 2],
    /// Budget of a tick, us.
    pub budget_us: f64,
    /// Spectral density that the loop's linear model predicts for the measured error of a hold. Each entry has frequency in Hz, amplitude
    /// from Brownian motion in nm/sqrt(Hz), and amplitude per nm RMS of localisation noise. Empty without a prediction.
    pub predicted_spectrum: Vec<[f64; 3]>,
    /// Whether the operator may set the target.
    pub steered: bool,
    /// Whether the target is a displacement of the PZT, moved by hand, instead of a position that a loop holds.
    pub by_hand: bool,
    /// Whether notes are kept with the run.
    pub notes: bool,
    /// Whether a script sets the target; it can be paused, and its steps skipped.
    pub script: bool,
    /// Whether the run tracks a cell instead of a bead.
    pub cell: bool,
    /// Whether the run has pictures.
    pub pictures: bool,
    /// Whether the run is over and read from its folder.
    pub recorded: bool,
    /// First column of adaptation among the law's columns, if it adapts; the page gets words.
    #[serde(skip)]
    pub adaptation_at: Option<usize>,
}

impl Default for Hello {
    fn default() -> Self {
        Self {
            name: String::new(),
            subtitle: String::new(),
            period_us: 1000.0,
            range_um: [0.0, 40.0],
            slew_um_per_s: f64::NAN,
            view_um: [f64::NAN; 2],
            budget_us: f64::NAN,
            predicted_spectrum: vec![],
            steered: false,
            by_hand: false,
            notes: true,
            script: false,
            cell: false,
            pictures: false,
            recorded: false,
            adaptation_at: None,
        }
    }
}

impl Hello {
    /// Range of targets, um; NaN if unknown.
    pub fn targets_um(&self) -> [f64; 2] {
        if self.by_hand {
            self.range_um
        } else {
            self.view_um
        }
    }
}

/// The banner: one word and one sentence.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Banner {
    /// `armed`, `running`, `frozen`, `paused`, `safe`, `over`: it sets the banner's colour.
    pub state: &'static str,
    /// Why, in a sentence.
    pub reason: String,
}

impl Default for Banner {
    fn default() -> Self {
        Self {
            state: "armed",
            reason: "The rig is being made ready.".to_string(),
        }
    }
}

/// The final message of a run: its end, and the state of the rig. The page keeps it after the program has ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LastWord {
    /// `done`, `stopped` (by the operator), `not-kept`, `safe`, `failed`.
    pub how: &'static str,
    /// Observation, and expectation if different.
    pub seen: String,
    /// The remedy; empty if there is nothing to do.
    pub to_do: String,
    /// Where the PZT is.
    pub pzt: String,
}

/// The state of the run, sent a few times a second, with the numbers of the run's summary.
#[derive(Debug, Clone, PartialEq, Serialize, Default)]
pub struct State {
    /// The banner.
    pub banner: Banner,
    /// Time since the start of the run, s.
    pub time_s: f64,
    /// Ticks.
    pub ticks: u64,
    /// RMS of the measured error since the loop settled, nm.
    pub rms_nm: Option<f64>,
    /// Localisation noise reported by vision, nm RMS.
    pub fix_noise_nm: Option<f64>,
    /// Lowest possible RMS error of holding, nm, by Brownian motion, noise and delay of the run so far.
    pub bound_nm: Option<f64>,
    /// Lateness of the ticks' wake-ups, us: the 99.9 % quantile.
    pub wake_us: Option<f64>,
    /// Computing time of the ticks, us, with the same percentile.
    pub compute_us: Option<f64>,
    /// Ticks handed over late.
    pub late: u64,
    /// Ticks that never came.
    pub skipped: u64,
    /// Frames lost on the way.
    pub frames_lost: u64,
    /// Stale frames.
    pub stale: u64,
    /// Ticks on prediction alone.
    pub coasted: u64,
    /// Records that are not on disk.
    pub records_lost: u64,
    /// Present cycle, from 1, and their number, if the script has cycles.
    pub cycle: Option<[u64; 2]>,
    /// The present task, if there is no script.
    pub doing: Option<String>,
    /// The next step of the script.
    pub next: Option<String>,
    /// Time left, s, if known.
    pub left_s: Option<f64>,
    /// How it ended, once it has.
    pub last_word: Option<LastWord>,
}

/// One event as a sentence.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EventLine {
    /// Time since the start of the run, s.
    pub time_s: f64,
    /// `info`, `warning` or `fault`.
    pub level: &'static str,
    /// What happened.
    pub text: String,
}

/// A clip of the camera's picture that is on the disk.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClipLine {
    /// Its name.
    pub name: String,
    /// Its moment: time since the start of the run, s.
    pub time_s: f64,
    /// Its frames.
    pub frames: u64,
}

/// One finished cycle of a script.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CycleRow {
    /// Number, from 1.
    pub cycle: u64,
    /// Amplitude reached, um.
    pub amplitude_um: Option<f64>,
    /// Stretch ratio.
    pub stretch: Option<f64>,
    /// Recovery time, s.
    pub recovery_s: Option<f64>,
}
