//! Fast simulation of the plant with any of the effects at its place, for fitting.
//!
//! The equations of the effects are those of `cellpos_plant::effects`, in the same blocks. Only the order of the work differs from
//! `cellpos_plant::Chain`: a whole record goes through one block after another on an even grid. Where it is exact, a step is one
//! sample; a block that needs a finer grid gets one. So a minute of record takes about a millisecond.

mod camera;
mod input;
mod modal;
mod readout;
mod walk;

use camera::Frames;
pub(crate) use camera::{Sampling, Waits, near_whole};
use cellpos_ident::analogue::{between, means};
use cellpos_plant::TiedPlant;
use cellpos_plant::effects::{Action, Around, Block, Piece, Shown};
pub(crate) use cellpos_plant::{Effect, Place, Zpk};
pub(crate) use input::Input;
pub(crate) use input::slew;
use modal::{Modal, Trace, has_fast_pole};
use readout::Readout;
use std::cell::Cell;

/// The plant and the sampling that all records of a problem share.
#[derive(Debug, Clone)]
pub(crate) struct Base {
    pub zpk: Zpk,
    /// Displacement about which the plant acts \[um\].
    pub working_point_um: f64,
    pub sample_s: f64,
    /// The input is an analogue signal sampled with the output, not a held command: interpolate it.
    pub interpolated_input: bool,
    /// The plant need not have rested before a record: its transients are free in every record.
    pub free_start: bool,
    /// The working point is not known: the ramp from its error is free in every record.
    pub free_working_point: bool,
    /// Age of the frames for which the model's delay holds, if it is stated \[s\].
    pub frame_age_s: Option<f64>,
}

impl Base {
    /// Speed of a bead over displacement from the zero flow \[1/s\], of a plant that integrates: that at 1 Hz.
    pub(crate) fn speed_per_um(&self) -> f64 {
        let w = std::f64::consts::TAU;
        (self.zpk.at(nalgebra::Complex::new(0.0, w)).norm() * w).max(1e-12)
    }
}

/// Simulates a record: displacement from the working point \[um\] in, bead position \[um\] out.
///
/// Effects of the camera on a position (lines, pixel locking) are fitted elsewhere. They are left out here, unless the same
/// position always looks alike.
///
/// `edge`, if asked for, receives the step of the plant's input at the instant of each frame, in parts of the plant's direct path.
/// A frame that straddles the edge may already show a share of it.
///
/// Returns the amount of work, in advances of one mode by one step. It is known before the work begins, and the same on every
/// machine.
pub(crate) fn simulate(
    base: &Base,
    input: Input<'_>,
    effects: &[Effect],
    y: &mut Vec<f64>,
    edge: Option<&mut Vec<f64>>,
) -> u64 {
    // What is not known to have rested before its record is no loop's record: nobody knows its frames.
    let Input { u, flow_um, .. } = input;
    let (sampling, flow_um) = match base.free_start {
        true => (&Sampling::default(), &[][..]),
        false => (input.sampling, flow_um),
    };
    let chain = Chain::new(base, (sampling, flow_um), effects);
    let work = u.len() as u64 * chain.work_per_row();
    let late = (chain.frames.delay_s / base.sample_s).ceil();
    if !base.free_start || late < 1.0 || u.is_empty() {
        chain.run(u, y, edge);
        return work;
    }
    // A plant that need not have rested had its first command before the record too, as far back as a delay reaches. So the
    // response to the step from rest falls into the start, which is free.
    let before = late.min(MOST_BEFORE) as usize;
    let longer: Vec<f64> = std::iter::repeat_n(u[0], before)
        .chain(u.iter().copied())
        .collect();
    let mut edge = edge;
    chain.run(&longer, y, edge.as_deref_mut());
    y.drain(..before);
    if let Some(edge) = edge {
        edge.drain(..before);
    }
    work
}

/// Most rows that are put before a record.
const MOST_BEFORE: f64 = 50_000.0;

/// Work of a step that every chain has, and of a block that is not linear, in advances of one mode.
const WORK_OF_STEP: usize = 8;
const WORK_OF_BLOCK: usize = 10;

/// What a simulation writes its steps to: what enters the plant, and the motion.
#[derive(Default)]
struct Room {
    x: Vec<f64>,
    t: Trace,
}

thread_local! {
    /// Kept from one simulation of a thread to the next. A minute of record on a fine grid has twenty megabytes of steps, and fresh
    /// memory costs as much as the steps themselves.
    static KEPT: Cell<Room> = Cell::default();
}

/// What happens to the signal before the plant, in order.
enum Stage {
    Linear(Zpk),
    Clip(f64, f64),
    Slew(f64),
    Block(Box<dyn Block>),
}

/// Most steps of a plant with something tied to it between two rows.
const MOST_STEPS: f64 = 20.0;

/// Steps of a sample whose means go through a bend, behind a pole (in 1/sample).
///
/// A bend is given the mean of its input over a step. Its own mean then lacks the curvature times a 24th of the squared change in the
/// step. Where the input changes by a tenth of itself, that is less than a thousandth.
fn steps_before_a_bend(pole: f64) -> usize {
    let enough = |steps: &usize| pole <= 0.1 * *steps as f64;
    [1, 4].into_iter().find(enough).unwrap_or(10)
}

struct Chain<'a> {
    base: &'a Base,
    sampling: &'a Sampling,
    flow_um: &'a [f64],
    before: Vec<Stage>,
    /// Plant and linear blocks behind it.
    plant: Zpk,
    /// Blocks on the motion of the bead.
    motion: Vec<Box<dyn Block>>,
    bypass: Vec<Zpk>,
    /// What is tied to the plant, which then goes step by step.
    ties: Vec<Box<dyn Around>>,
    shown: Vec<Box<dyn Shown>>,
    frames: Frames,
    /// Steps of the grid per sample.
    fine: usize,
}

impl<'a> Chain<'a> {
    fn new(
        base: &'a Base,
        (sampling, flow_um): (&'a Sampling, &'a [f64]),
        effects: &[Effect],
    ) -> Self {
        let mut chain = Self {
            base,
            sampling,
            flow_um,
            before: Vec::new(),
            plant: base.zpk.clone(),
            motion: Vec::new(),
            bypass: Vec::new(),
            ties: Vec::new(),
            shown: Vec::new(),
            frames: Frames::default(),
            fine: 1,
        };
        let mut sorted: Vec<&Effect> = effects.iter().collect();
        sorted.sort_by_key(|e| e.order());
        // The fastest pole before a block \[rad/s\].
        let mut fastest = 0.0_f64;
        let mut all = base.zpk.clone();
        let mut behind = Zpk::one();
        for e in sorted {
            let spec = e.kind().spec();
            let early = spec.place < Place::Chip || spec.ahead_of_plant;
            match e.act() {
                Action::Linear(zpk) => {
                    all = all.series(&zpk);
                    if early {
                        fastest = zpk.poles.iter().fold(fastest, |f, p| f.max(p.norm()));
                        chain.before.push(Stage::Linear(zpk));
                    } else {
                        behind = behind.series(&zpk);
                    }
                }
                Action::Clip { low_um, high_um } => {
                    let w = base.working_point_um;
                    chain.before.push(Stage::Clip(low_um - w, high_um - w));
                }
                Action::Slew(rate) => {
                    chain.fine = chain.fine.max(10);
                    fastest = f64::INFINITY;
                    chain.before.push(Stage::Slew(rate));
                }
                Action::Block(block) if early => {
                    if block.bends() {
                        chain.fine = chain.fine.max(steps_before_a_bend(fastest * base.sample_s));
                    }
                    chain.before.push(Stage::Block(block));
                }
                Action::Block(block) => {
                    if spec.place == Place::Chip || block.switches() {
                        chain.fine = chain.fine.max(4);
                    }
                    chain.motion.push(block);
                }
                Action::Bypass(zpk) => chain.bypass.push(zpk),
                Action::Around(tie) => chain.ties.push(tie),
                Action::Show(shown) if shown.is_static() => chain.shown.push(shown),
                Action::Delay(s) => chain.frames.delay_s += s,
                Action::Exposure(s) => chain.frames.exposure_s = s,
                Action::Skew(e) => chain.frames.skew += e,
                Action::Drop(_) | Action::Repeat(_) | Action::Show(_) => {}
            }
        }
        // What is tied to the plant takes the plant out of the linear blocks.
        chain.plant = if chain.ties.is_empty() {
            base.zpk.clone().series(&behind)
        } else {
            behind
        };
        if base.interpolated_input {
            chain.fine = chain.fine.max(4);
        }
        let within = !chain.frames.are_plain(chain.sampling) && !chain.reads_modes();
        let slopes = chain.motion.iter().any(|b| b.needs_slopes() && b.bends());
        if (within || slopes) && has_fast_pole(&all, base.sample_s / chain.fine as f64) {
            chain.fine = chain.fine.max(4);
            if has_fast_pole(&all, base.sample_s / chain.fine as f64) {
                chain.fine = chain.fine.max(10);
            }
        }
        chain
    }

    /// Work of a row of a record, as [`simulate`] counts it.
    fn work_per_row(&self) -> u64 {
        let (mut modes, mut blocks) = (self.plant.poles.len(), self.motion.len());
        for stage in &self.before {
            match stage {
                Stage::Linear(zpk) => modes += zpk.poles.len(),
                Stage::Clip(..) | Stage::Slew(_) => {}
                Stage::Block(_) => blocks += 1,
            }
        }
        // The part next to the plant has everything before it once more.
        for zpk in &self.bypass {
            modes = 2 * modes + zpk.poles.len();
        }
        blocks += 2 * self.ties.len();
        let steps = if self.ties.is_empty() {
            self.fine
        } else {
            self.fine.max(MOST_STEPS as usize / 4)
        };
        (steps * (modes + WORK_OF_BLOCK * blocks + WORK_OF_STEP)) as u64
    }

    fn run(mut self, u: &[f64], y: &mut Vec<f64>, edge: Option<&mut Vec<f64>>) {
        let mut shown = std::mem::take(&mut self.shown);
        if self.ties.is_empty() {
            self.run_linear(u, y, edge);
        } else {
            if let Some(edge) = edge {
                edge.clear();
                edge.resize(u.len(), 0.0);
            }
            self.run_tied(u, y);
        }
        for block in &mut shown {
            for (k, y) in y.iter_mut().enumerate() {
                *y = block.show(*y, k as f64 * self.base.sample_s);
            }
        }
    }

    fn run_linear(&mut self, u: &[f64], y: &mut Vec<f64>, edge: Option<&mut Vec<f64>>) {
        let n = u.len();
        let h = self.base.sample_s / self.fine as f64;
        let Room { x, mut t } = KEPT.take();
        let (mut x, pending) = self.ahead_of_plant(u, h, x);
        if self.base.interpolated_input && self.base.zpk.zeros.len() < self.base.zpk.poles.len() {
            means(&mut x);
        }
        let modal = Modal::new(&pending.clone().series(&self.plant), h);
        if let Some(edge) = edge {
            self.edges(&x, modal.direct, n, edge);
        }
        let frames = (self.frames, self.sampling);
        if self.reads_modes() {
            y.clear();
            y.resize(n, 0.0);
            let readout = Readout::new(frames, h, self.fine);
            readout.add(&modal, &x, y);
            for zpk in &self.bypass {
                let beside = Modal::new(&pending.clone().series(zpk), h);
                readout.add(&beside, &x, y);
            }
        } else {
            modal.trace(&x, self.fine, &mut t);
            if self.base.interpolated_input {
                t.smooth(h);
            }
            let carried = self.carried(h);
            t.add(&carried, 1.0);
            self.behind_plant(&mut t, &x, &pending, h);
            t.add(&carried, -1.0);
            camera::sample(&t, frames, h, self.fine, n, y);
        }
        KEPT.set(Room { x, t });
    }

    /// Whether the frames are linear in the states of the modes, each with one age: then no grid finer than that of the input is needed.
    fn reads_modes(&self) -> bool {
        let even = self.frames.skew == 0.0 && !self.base.interpolated_input;
        let linear = self.motion.is_empty() && self.ties.is_empty();
        linear && (even || self.frames.are_plain(self.sampling))
    }

    /// Whether the bead is also carried by a flow next to the displacement, through a plant on whose motion blocks act.
    fn carried(&self, h: f64) -> Trace {
        let mut t = Trace::default();
        if !self.motion.is_empty() && !self.flow_um.is_empty() {
            let held = |&f| std::iter::repeat_n(f, self.fine);
            let fine: Vec<f64> = self.flow_um.iter().flat_map(held).collect();
            Modal::new(&self.plant, h).trace(&fine, self.fine, &mut t);
        }
        t
    }

    /// What enters the plant, step by step, without the linear blocks that come last before it.
    fn ahead_of_plant(&mut self, u: &[f64], h: f64, mut x: Vec<f64>) -> (Vec<f64>, Zpk) {
        if self.base.interpolated_input {
            x = between(u, self.fine);
        } else {
            x.clear();
            x.reserve(u.len() * self.fine);
            for &v in u {
                x.extend(std::iter::repeat_n(v, self.fine));
            }
        }
        let mut pending = Zpk::one();
        for stage in std::mem::take(&mut self.before) {
            match stage {
                Stage::Linear(zpk) => pending = pending.series(&zpk),
                Stage::Clip(low, high) => x.iter_mut().for_each(|v| *v = v.min(high).max(low)),
                Stage::Slew(rate) => slew(&mut x, rate, h, 0.0),
                Stage::Block(mut block) => {
                    if !pending.poles.is_empty() || !pending.zeros.is_empty() {
                        x = Modal::new(&pending, h).means(&x);
                    } else if pending.gain != 1.0 {
                        x.iter_mut().for_each(|v| *v *= pending.gain);
                    }
                    pending = Zpk::one();
                    for (j, v) in x.iter_mut().enumerate() {
                        let held = Piece::line(*v, *v, h);
                        *v = block.advance(j as f64 * h, h, held).integral / h;
                    }
                }
            }
        }
        (x, pending)
    }

    /// A plant with what is tied to it, step by step.
    fn run_tied(&mut self, u: &[f64], y: &mut Vec<f64>) {
        let mut tied = TiedPlant::new(&self.base.zpk, std::mem::take(&mut self.ties));
        let steps = (self.base.sample_s / tied.longest_s() - 1e-9).ceil();
        self.fine = self.fine.max(steps.clamp(1.0, MOST_STEPS) as usize);
        let n = u.len();
        let h = self.base.sample_s / self.fine as f64;
        let (mut x, pending) = self.ahead_of_plant(u, h, Vec::new());
        if !pending.poles.is_empty() {
            x = Modal::new(&pending, h).means(&x);
        } else if pending.gain != 1.0 {
            x.iter_mut().for_each(|v| *v *= pending.gain);
        }
        let mut t = Trace::default();
        let rest = tied.at_rest();
        let mut position = rest;
        for (j, &end) in x.iter().enumerate() {
            // A sampled input goes in straight lines to the value at the step's end, a held one jumps.
            let start = match j {
                _ if !self.base.interpolated_input => end,
                0 => u[0],
                _ => x[j - 1],
            };
            let out = tied.advance(j as f64 * h, h, Piece::line(start, end, h));
            t.pos.push(position);
            t.jump.push(out.start - position);
            t.start_slope.push(out.speed_start);
            t.end_slope.push(out.speed_end);
            position = out.end;
        }
        if self.plant != Zpk::one() {
            let mut means: Vec<f64> = t.pos.iter().zip(&t.jump).map(|(p, j)| p + j).collect();
            for (j, mean) in means.iter_mut().enumerate() {
                *mean = 0.5 * (*mean + t.pos.get(j + 1).copied().unwrap_or(position));
            }
            let behind = Modal::new(&self.plant, h);
            behind.trace(&means, 1, &mut t);
            // Their direct part is there before the first command.
            if let (Some(position), Some(jump)) = (t.pos.first_mut(), t.jump.first_mut()) {
                *position += behind.direct * rest;
                *jump -= behind.direct * rest;
            }
        }
        self.behind_plant(&mut t, &x, &Zpk::one(), h);
        camera::sample(&t, (self.frames, self.sampling), h, self.fine, n, y);
    }

    /// Blocks on the motion, and the part next to the plant.
    fn behind_plant(&mut self, t: &mut Trace, x: &[f64], pending: &Zpk, h: f64) {
        for block in &mut self.motion {
            camera::advance(t, block.as_mut(), h);
        }
        for zpk in &self.bypass {
            let mut beside = Trace::default();
            Modal::new(&pending.clone().series(zpk), h).trace(x, self.fine, &mut beside);
            if self.base.interpolated_input {
                beside.smooth(h);
            }
            t.add(&beside, 1.0);
        }
    }

    /// Steps of the direct path at the instants of the frames.
    fn edges(&self, x: &[f64], direct: f64, n: usize, edge: &mut Vec<f64>) {
        edge.clear();
        edge.resize(n, 0.0);
        let base = if self.base.zpk.zeros.len() == self.base.zpk.poles.len() {
            self.base.zpk.gain
        } else {
            0.0
        };
        // The window of an exposure ends with the frame: its edge is already averaged.
        let averaged = self.frames.exposure_s != 0.0 || !self.sampling.is_plain();
        if base == 0.0 || direct == 0.0 || averaged {
            return;
        }
        // Edges are on the grid of the samples: a delay between samples puts the frames between the edges.
        let Some(shift) = camera::near_whole(self.frames.delay_s / self.base.sample_s) else {
            return;
        };
        let share = direct / base;
        for (k, edge) in edge.iter_mut().enumerate().skip(shift) {
            let j = (k - shift) * self.fine;
            let before = if j == 0 { x[0] } else { x[j - 1] };
            *edge = share * (x[j] - before);
        }
    }
}
