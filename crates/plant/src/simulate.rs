//! The camera's record of a [`Chain`]: delay, exposure, clock, hum, pixel locking and localisation noise.
//!
//! Delay and exposure are exact, without interpolation: the chain stops at the instants that a frame sees, and the exposure is
//! the integral of the position in closed form.

mod camera;

use crate::chain::{Chain, ChainError, in_range};
use crate::model::Model;
use camera::Camera;

/// Whether a row's position is taken before or after a command at the same instant.
///
/// Eq. (6) is biproper: the bead jumps by 0.01872 um per um of a command's step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Sampled {
    /// Just before the row's command takes effect, `y_k = C x_k + D u_(k-1)`: the convention of records.
    #[default]
    BeforeCommand,
    /// Just after, `y_k = C x_k + D u_k`: as in simulators that evaluate the output with the present input.
    AfterCommand,
}

/// How to simulate.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SimulateOptions {
    /// Whether a row's position is taken before or after its command.
    pub sampled: Sampled,
    /// With a seed: Brownian motion and localisation noise. Without: the noise-free response.
    pub seed: Option<u64>,
}

/// A record that cannot be simulated.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SimulateError {
    /// The model is refused.
    #[error(transparent)]
    Chain(#[from] ChainError),
    /// A displacement that is not finite.
    #[error("row {row}: pzt_um = {value}: displacements must be finite numbers, um")]
    NotFinite {
        /// Row, from 0.
        row: usize,
        /// The value.
        value: f64,
    },
}

/// An instant that lies `whole` samples and `part_s` before a row's time.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Ago {
    whole: usize,
    part_s: f64,
}

impl Ago {
    fn new(ago_s: f64, sample_s: f64) -> Self {
        let samples = ago_s / sample_s;
        let nearest = samples.round();
        if (samples - nearest).abs() < 1e-9 {
            Self {
                whole: nearest as usize,
                part_s: 0.0,
            }
        } else {
            let whole = samples.floor();
            Self {
                whole: whole as usize,
                part_s: ago_s - whole * sample_s,
            }
        }
    }

    /// Where in an interval the instant lies, s from its beginning.
    fn offset_s(self, sample_s: f64) -> f64 {
        if self.part_s == 0.0 {
            sample_s
        } else {
            sample_s - self.part_s
        }
    }
}

/// The note at one instant of an interval.
#[derive(Debug, Clone, Copy, Default)]
struct Note {
    bead_um: f64,
    area_um_s: f64,
}

impl Note {
    /// Note of an instant at or before the start, when everything is at rest.
    fn before(rest_um: f64, at_s: f64) -> Self {
        Self {
            bead_um: rest_um,
            area_um_s: rest_um * at_s,
        }
    }
}

/// A chain with its camera at a fixed sample time, row by row: for closed loops without frames, and for records.
///
/// For each row: [`Simulator::measure`], then [`Simulator::hold`]. Neither allocates. The clock-skew effect needs positions that
/// a running loop does not have yet, so it acts only in [`simulate`].
#[derive(Debug, Clone)]
pub struct Simulator {
    chain: Chain,
    camera: Camera,
    sample_s: f64,
    end: Ago,
    /// The instants of one interval, rising.
    first_s: f64,
    second_s: f64,
    end_is_first: bool,
    ends: Vec<Note>,
    begins: Vec<Note>,
    row: usize,
}

impl Simulator {
    /// A simulator at rest at the working point before row 0.
    ///
    /// # Errors
    /// A model with numbers out of range, a sample time outside 0.1 us..1e5 s.
    pub fn new(model: &Model, sample_s: f64, seed: Option<u64>) -> Result<Self, ChainError> {
        in_range("sample time", sample_s, "s", 1e-7, 1e5)?;
        let mut chain = match seed {
            Some(seed) => Chain::with_brownian_motion(model, seed)?,
            None => Chain::new(model)?,
        };
        let camera = Camera::new(model, seed)?;
        if camera.exposure_s > 0.0 {
            chain.keep_area();
        }
        let end = Ago::new(camera.delay_s, sample_s);
        let begin = Ago::new(camera.delay_s + camera.exposure_s, sample_s);
        in_range("delay in rows", begin.whole as f64, "", 0.0, 1e7)?;
        let (a, b) = (end.offset_s(sample_s), begin.offset_s(sample_s));
        let mut simulator = Self {
            chain,
            sample_s,
            end,
            first_s: a.min(b),
            second_s: a.max(b),
            end_is_first: a <= b,
            ends: vec![Note::default(); end.whole + 1],
            begins: vec![Note::default(); begin.whole + 1],
            camera,
            row: 0,
        };
        simulator.note_rest();
        Ok(simulator)
    }

    /// The notes of the time before the record, for the first rows.
    fn note_rest(&mut self) {
        let rest_um = self.chain.bead_um();
        for (ring, exposure_s) in [
            (&mut self.ends, 0.0),
            (&mut self.begins, self.camera.exposure_s),
        ] {
            for (row, note) in ring.iter_mut().enumerate() {
                let at_s = row as f64 * self.sample_s - self.camera.delay_s - exposure_s;
                *note = Note::before(rest_um, at_s);
            }
        }
    }

    fn note(&self) -> Note {
        Note {
            bead_um: self.chain.bead_um(),
            area_um_s: self.chain.area_um_s(),
        }
    }

    /// The position recorded in the present row, um, just before the row's command. To be called once per row.
    pub fn measure(&mut self) -> f64 {
        // The ring holds intervals row-whole-1 .. row-1; this row needs the oldest.
        let oldest = |ring: &[Note], row: usize| {
            ring.get(row % ring.len().max(1))
                .copied()
                .unwrap_or_default()
        };
        let end = oldest(&self.ends, self.row);
        let seen = if self.camera.exposure_s > 0.0 {
            let begin = oldest(&self.begins, self.row);
            (end.area_um_s - begin.area_um_s) / self.camera.exposure_s
        } else {
            end.bead_um
        };
        let time_s = self.row as f64 * self.sample_s;
        self.camera.record(seen, time_s)
    }

    /// Holds a command \[um, absolute\] until the next row.
    pub fn hold(&mut self, command_um: f64) {
        let (mut end, mut begin) = (Note::default(), Note::default());
        self.chain.advance(command_um, self.first_s);
        let note = self.note();
        if self.end_is_first {
            end = note;
        } else {
            begin = note;
        }
        if self.second_s > self.first_s {
            self.chain.advance(command_um, self.second_s - self.first_s);
        }
        let note = self.note();
        if self.end_is_first {
            begin = note;
        } else {
            end = note;
        }
        if self.sample_s > self.second_s {
            self.chain
                .advance(command_um, self.sample_s - self.second_s);
        }
        let put = |ring: &mut [Note], row: usize, note: Note| {
            let n = ring.len().max(1);
            if let Some(slot) = ring.get_mut(row % n) {
                *slot = note;
            }
        };
        put(&mut self.ends, self.row, end);
        put(&mut self.begins, self.row, begin);
        self.row += 1;
    }

    /// The row's position taken just after its command, as [`Sampled::AfterCommand`] wants it, and the command held.
    fn row_after(&mut self, command_um: f64) -> f64 {
        self.chain.advance(command_um, 0.0);
        // The side matters only for an instant that coincides with a row's time.
        let late = self.end.part_s == 0.0;
        let now = self.note();
        let n = self.ends.len();
        let seen = if self.camera.exposure_s > 0.0 || !late {
            None
        } else if self.end.whole == 0 {
            Some(now.bead_um)
        } else {
            // Notes of rows' beginnings instead of intervals' ends: the slot of row - whole.
            self.ends.get((self.row + 1) % n).map(|note| note.bead_um)
        };
        let y = match seen {
            None => self.measure(),
            Some(seen) => {
                let time_s = self.row as f64 * self.sample_s;
                self.camera.record(seen, time_s)
            }
        };
        let row = self.row;
        self.hold(command_um);
        if seen.is_some()
            && let Some(slot) = self.ends.get_mut(row % n)
        {
            *slot = now;
        }
        y
    }

    /// The response to a record that starts at row 0, written to `bead_um`; the shorter of the two lengths counts.
    pub fn run(&mut self, pzt_um: &[f64], sampled: Sampled, bead_um: &mut [f64]) {
        for (u, y) in pzt_um.iter().zip(bead_um) {
            *y = match sampled {
                Sampled::BeforeCommand => {
                    let y = self.measure();
                    self.hold(*u);
                    y
                }
                Sampled::AfterCommand => self.row_after(*u),
            };
        }
    }
}

/// The bead positions \[um\] that a model records in answer to displacements \[um\] held for `sample_s` each.
///
/// Row k of the answer belongs to row k of `pzt_um`. Before row 0 the rig is at rest at the working point, with the bead at 0 um
/// or where equations that replace the plant begin. Frames are neither dropped nor repeated here: the emulated camera does that.
///
/// # Errors
/// A model with numbers out of range, a sample time outside 0.1 us..1e5 s, displacements that are not finite.
pub fn simulate(
    model: &Model,
    pzt_um: &[f64],
    sample_s: f64,
    options: &SimulateOptions,
) -> Result<Vec<f64>, SimulateError> {
    if let Some((row, value)) = pzt_um.iter().enumerate().find(|(_, u)| !u.is_finite()) {
        return Err(SimulateError::NotFinite { row, value: *value });
    }
    let mut simulator = Simulator::new(model, sample_s, options.seed)?;
    let mut bead_um = vec![0.0; pzt_um.len()];
    if simulator.camera.skew == 0.0 {
        simulator.run(pzt_um, options.sampled, &mut bead_um);
    } else {
        skewed(simulator, sample_s, pzt_um, options.sampled, &mut bead_um);
    }
    Ok(bead_um)
}

/// Instants nearer than this to a command, s, coincide with it.
const COINCIDENT_S: f64 = 1e-9;

/// Rows of a camera whose clock is not the drive's: the chain stops at every instant that a frame sees.
fn skewed(
    simulator: Simulator,
    sample_s: f64,
    pzt_um: &[f64],
    sampled: Sampled,
    bead_um: &mut [f64],
) {
    let Simulator {
        mut chain,
        mut camera,
        ..
    } = simulator;
    let n = pzt_um.len();
    let time_s = |k: usize| k as f64 * sample_s;
    let exposure = camera.exposure_s;
    // Row k's exposure ends at end(k) and begins `exposure` before, in time since the first row.
    let end = |k: usize| (1.0 + camera.skew) * time_s(k) - camera.delay_s;
    let rest_um = chain.bead_um();
    let mut ends = vec![Note::default(); n];
    let mut begins = vec![Note::default(); n];
    let (mut next_end, mut next_begin) = (0, 0);
    let mut now = 0.0;
    for (j, &command) in pzt_um.iter().enumerate() {
        let until = if j + 1 < n {
            time_s(j + 1)
        } else {
            f64::INFINITY
        };
        if sampled == Sampled::AfterCommand {
            chain.advance(command, 0.0);
        }
        loop {
            let a = if next_end < n {
                end(next_end)
            } else {
                f64::INFINITY
            };
            let b = if exposure > 0.0 && next_begin < n {
                end(next_begin) - exposure
            } else {
                f64::INFINITY
            };
            let instant = a.min(b);
            let past = match sampled {
                Sampled::BeforeCommand => instant > until + COINCIDENT_S,
                Sampled::AfterCommand => instant > until - COINCIDENT_S,
            };
            if past || instant == f64::INFINITY {
                break;
            }
            let instant_in = instant.min(until);
            if instant_in - now > COINCIDENT_S {
                chain.advance(command, instant_in - now);
                now = instant_in;
            }
            let note = if instant < -COINCIDENT_S {
                Note::before(rest_um, instant)
            } else {
                Note {
                    bead_um: chain.bead_um(),
                    area_um_s: chain.area_um_s(),
                }
            };
            if a <= b {
                ends[next_end] = note;
                next_end += 1;
            } else {
                begins[next_begin] = note;
                next_begin += 1;
            }
        }
        if until.is_finite() && until > now {
            chain.advance(command, until - now);
            now = until;
        }
    }
    for k in 0..n {
        let seen = if exposure > 0.0 {
            (ends[k].area_um_s - begins[k].area_um_s) / exposure
        } else {
            ends[k].bead_um
        };
        bead_um[k] = camera.record(seen, time_s(k));
    }
}
