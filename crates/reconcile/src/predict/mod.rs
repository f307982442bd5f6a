//! Fast simulation of the plant with any of the effects at its place, for fitting.
//!
//! Not the simulator of the program (that is `cellpos_plant::Model`, which this agrees with): it runs the same chain
//! with the same equations, one step per sample where that is exact and a finer grid only where a block needs it, so
//! that a minute of record takes about a millisecond.

#[cfg(test)]
mod agreement;
pub(crate) mod block;
mod camera;
mod modal;
mod piezo;

pub(crate) use block::{Block, PLAY_LEVELS, domains};
pub(crate) use camera::near_whole;
pub(crate) use modal::Zpk;
use modal::{Modal, Trace};

/// The plant and the sampling that all records of a problem share.
#[derive(Debug, Clone)]
pub(crate) struct Base {
    pub zpk: Zpk,
    /// Displacement about which the plant acts \[um\].
    pub working_point_um: f64,
    pub sample_s: f64,
    /// The input is an analogue signal sampled with the output, not a held command: interpolate it.
    pub interpolated_input: bool,
}

/// Simulates a record: displacement from the working point \[um\] in, bead position \[um\] out.
///
/// `blocks` must be sorted by rank. Lines and pixel locking are additive and fitted elsewhere: ignored here.
///
/// `edge`, where asked for, receives the step of the plant's input that acts at the instant of each frame, in parts of
/// the plant's direct path: what a frame that straddles the edge may already show.
pub(crate) fn simulate(
    base: &Base,
    u: &[f64],
    blocks: &[Block],
    y: &mut Vec<f64>,
    edge: Option<&mut Vec<f64>>,
) {
    let chain = Chain::new(base, blocks);
    chain.run(u, y, edge);
}

struct Chain<'a> {
    base: &'a Base,
    blocks: &'a [Block],
    /// Steps of the grid per sample.
    fine: usize,
}

fn is_motion(b: &Block) -> bool {
    matches!(
        b,
        Block::Adhesion { .. }
            | Block::ClockSkew { .. }
            | Block::Delay { .. }
            | Block::Exposure { .. }
    )
}

impl<'a> Chain<'a> {
    fn new(base: &'a Base, blocks: &'a [Block]) -> Self {
        let mut dynamic_before = false;
        let mut fine = 1;
        let mut zpk = base.zpk.clone();
        for b in blocks {
            match b {
                Block::SlewLimit { .. } => {
                    fine = fine.max(10);
                    dynamic_before = true;
                }
                Block::DriverLag { .. } | Block::Creep { .. } | Block::Resonance { .. } => {
                    dynamic_before = true;
                    piezo::append_linear(b, &mut zpk);
                }
                Block::BoucWen { .. }
                | Block::Play { .. }
                | Block::Domains { .. }
                | Block::Backlash { .. } => {
                    if dynamic_before {
                        fine = fine.max(10);
                    }
                }
                Block::Bubble { dissolution, .. } if *dissolution != 0.0 => fine = fine.max(4),
                _ => piezo::append_linear(b, &mut zpk),
            }
        }
        if base.interpolated_input {
            fine = fine.max(4);
        }
        if blocks.iter().any(is_motion) && zpk.has_fast_pole(base.sample_s / fine as f64) {
            fine = fine.max(4);
            if zpk.has_fast_pole(base.sample_s / fine as f64) {
                fine = fine.max(10);
            }
        }
        Self { base, blocks, fine }
    }

    fn run(&self, u: &[f64], y: &mut Vec<f64>, edge: Option<&mut Vec<f64>>) {
        let n = u.len();
        let h = self.base.sample_s / self.fine as f64;
        let mut x: Vec<f64> = if self.base.interpolated_input {
            interpolate(u, self.fine)
        } else if self.fine == 1 {
            u.to_vec()
        } else {
            u.iter()
                .flat_map(|&v| std::iter::repeat_n(v, self.fine))
                .collect()
        };
        let mut pending = Zpk::unity();
        for b in self.blocks {
            match *b {
                Block::Saturation { low_um, high_um } => {
                    let (low, high) = (
                        low_um - self.base.working_point_um,
                        high_um - self.base.working_point_um,
                    );
                    x.iter_mut().for_each(|v| *v = v.min(high).max(low));
                }
                Block::SlewLimit { rate } => piezo::slew(&mut x, rate, h),
                Block::BoucWen {
                    fraction,
                    beta,
                    gamma,
                } => {
                    flush(&mut pending, &mut x, h);
                    piezo::bouc_wen(&mut x, fraction, beta, gamma);
                }
                Block::Play {
                    stroke_um,
                    ref weights,
                    quadratic,
                } => {
                    flush(&mut pending, &mut x, h);
                    piezo::play(&mut x, stroke_um, weights, quadratic);
                }
                Block::Domains { fraction, width_um } => {
                    flush(&mut pending, &mut x, h);
                    piezo::domains(&mut x, fraction, width_um);
                }
                Block::Backlash { width_um } => {
                    flush(&mut pending, &mut x, h);
                    piezo::backlash(&mut x, width_um);
                }
                Block::Bubble { lag_s, dissolution } if dissolution != 0.0 => {
                    piezo::dissolving_lag(&mut x, lag_s, dissolution, h);
                }
                _ => piezo::append_linear(b, &mut pending),
            }
        }
        pending.times(&self.base.zpk);
        let modal = Modal::new(&pending, h);
        if let Some(edge) = edge {
            self.edges(&x, modal.direct, n, edge);
        }
        if self.blocks.iter().any(is_motion) {
            let mut t = Trace::default();
            modal.trace(&x, &mut t);
            if self.base.interpolated_input {
                t.straighten(h);
            }
            camera::bead(&mut t, self.blocks, h);
            camera::sample(&t, self.blocks, h, self.fine, n, y);
        } else {
            let mut pos = Vec::new();
            modal.run(&x, &mut pos);
            camera::bead_without_motion(&mut pos, self.blocks, h);
            y.clear();
            y.extend(pos.into_iter().step_by(self.fine));
        }
    }
}

impl Chain<'_> {
    /// Steps of the direct path at the instants of the frames.
    fn edges(&self, x: &[f64], direct: f64, n: usize, edge: &mut Vec<f64>) {
        edge.clear();
        edge.resize(n, 0.0);
        let base = if self.base.zpk.zeros.len() == self.base.zpk.poles.len() {
            self.base.zpk.gain
        } else {
            0.0
        };
        if base == 0.0 || direct == 0.0 {
            return;
        }
        let mut delay = 0.0;
        for b in self.blocks {
            match *b {
                Block::Delay { s } => delay = s / self.base.sample_s,
                // The window of an exposure ends with the frame: its edge is already averaged.
                Block::Exposure { .. } => return,
                _ => {}
            }
        }
        // Edges lie on the grid of the samples: a delay between samples puts the frames between the edges.
        let Some(shift) = camera::near_whole(delay) else {
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

/// Runs the linear blocks gathered so far, because what follows is not linear.
fn flush(pending: &mut Zpk, x: &mut Vec<f64>, h: f64) {
    if !pending.poles.is_empty() || !pending.zeros.is_empty() {
        *x = Modal::new(pending, h).means(x);
    }
    *pending = Zpk::unity();
}

/// Straight lines between the samples; each step of the grid holds the value at its end, so that a plant without dynamics
/// is exact at the samples.
fn interpolate(u: &[f64], fine: usize) -> Vec<f64> {
    let mut x = Vec::with_capacity(u.len() * fine);
    for k in 0..u.len() {
        let next = u.get(k + 1).copied().unwrap_or(u[k]);
        for i in 0..fine {
            let f = (i as f64 + 1.0) / fine as f64;
            x.push(u[k] + f * (next - u[k]));
        }
    }
    x
}
