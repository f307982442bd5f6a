//! Feed-forward from the inverse of the strictly proper plant: the command that makes the model follow the reference.
//!
//! Where the sampled plant `y_(k+1) = C A s_k + C B u_k` has all its zeros inside the unit circle, `u_k` follows from the next
//! reference. A zero outside (two lags: regulator and tube) would make that command grow from tick to tick; then the command is that
//! of the smallest sum of squared errors, which reaches a reference later. (The biproper form of Eq. (6) has a zero at z = -19.3 and
//! must never be inverted.)

use crate::deviation::{DEVIATION, Deviation};
use crate::error::{BuildError, check};
use crate::limits::Limits;
use crate::loop_model::{LoopModel, MODES};
use crate::riccati::lq_feedback;

/// State of the inverse: the model's state on the reference.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FeedForwardState {
    /// Integrator part on the reference, um.
    pub integrator_um: f64,
    /// Modes on the reference, um s.
    pub modes: [f64; MODES],
    /// Displacement from neutral in force before, um.
    pub last_um: f64,
}

impl FeedForwardState {
    /// Every number is one that a bead and a PZT can have.
    fn is_sound(&self) -> bool {
        self.integrator_um.abs() < 1e7
            && self.last_um.abs() < 1e7
            && self.modes.iter().all(|x| x.abs() < 1e7)
    }
}

/// Displacements that a tick can have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Reach {
    /// Ends of the range, um.
    pub low_um: f64,
    pub high_um: f64,
    /// Largest move of a tick, um.
    pub move_um: f64,
}

impl Reach {
    /// Range and slew of a loop, in um of the command.
    pub(crate) fn of(limits: &Limits, sample_time_s: f64) -> Self {
        Self {
            low_um: limits.low_um,
            high_um: limits.high_um,
            move_um: limits.slew_um_per_s * sample_time_s,
        }
    }

    /// The same from neutral, in the units of the gain in force.
    pub(crate) fn about_neutral(&self, neutral_um: f64, gain: f64) -> Self {
        Self {
            low_um: self.low_um * gain - neutral_um,
            high_um: self.high_um * gain - neutral_um,
            move_um: self.move_um * gain,
        }
    }

    /// The same with a move in a tick that is smaller by so much, um, and by a twentieth at most.
    pub(crate) fn with_reserve(self, reserve_um: f64) -> Self {
        Self {
            move_um: self.move_um - reserve_um.min(0.05 * self.move_um),
            ..self
        }
    }

    /// The nearest to `wanted` after `last`. Never panics, whatever the numbers are.
    pub(crate) fn clamp(&self, wanted: f64, last: f64) -> f64 {
        (wanted.max(last - self.move_um).min(last + self.move_um))
            .max(self.low_um)
            .min(self.high_um)
    }
}

/// Ticks within which a move must be slowed down: references that are looked at ahead.
pub(crate) const BRAKING_TICKS: usize = 24;
/// Displacement by which a move may end beyond what is wanted, um: 10 nm of bead in a tick.
const OVERRUN_UM: f64 = 0.025;
/// Motion in a sample below which its inverse is rounding, um for 1 um of command.
const LEAST_MOTION_UM: f64 = 1e-12;
/// Halvings of the interval in which the largest displacement is looked for: a thousandth of the range.
const HALVINGS: usize = 12;

/// Inverse of one model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FeedForward {
    a: [f64; MODES],
    b: [f64; MODES],
    c: [f64; MODES],
    gain: f64,
    feedthrough: f64,
    direct: f64,
    /// Motion that is still to come of the modes, in um of the next tick.
    to_come: [f64; MODES],
}

impl FeedForward {
    /// # Errors
    /// [`BuildError`] where a command moves the bead by so little in a sample that its inverse is rounding.
    pub(crate) fn new(model: &LoopModel) -> Result<Self, BuildError> {
        let d = Deviation::new(model);
        let moved_um = d.moved_um();
        check(
            "motion of the bead one sample after 1 um of command",
            "um",
            moved_um,
            moved_um.abs() >= LEAST_MOTION_UM,
            "at least 1e-12 um, or no command follows a reference",
        )?;
        let (direct, to_come) = inverse(&d);
        Ok(Self {
            direct,
            to_come,
            a: std::array::from_fn(|i| d.a[(i + 1, i + 1)]),
            b: std::array::from_fn(|i| d.b[i + 1]),
            c: std::array::from_fn(|i| d.c[i + 1]),
            gain: d.b[0],
            feedthrough: d.c[DEVIATION - 1],
        })
    }

    /// At rest at a reference.
    pub(crate) fn rest(reference_um: f64) -> FeedForwardState {
        FeedForwardState {
            integrator_um: reference_um,
            modes: [0.0; MODES],
            last_um: 0.0,
        }
    }

    /// Displacement from neutral that takes the model from its state to the next reference, um.
    pub(crate) fn wanted(&self, state: &FeedForwardState, next_um: f64) -> f64 {
        let modes: f64 = (0..MODES).map(|i| self.to_come[i] * state.modes[i]).sum();
        (next_um - state.integrator_um - modes) / self.direct
    }

    /// The displacement from neutral within reach that takes the model to the references of the coming ticks, the next one first:
    /// as fast as range and slew allow, and no faster than it can be slowed down again, so that a jump that asks for more is
    /// made in a few ticks without going past its end.
    pub(crate) fn within(
        &self,
        state: &FeedForwardState,
        next_um: impl Fn(usize) -> f64,
        reach: &Reach,
    ) -> f64 {
        let last = state.last_um;
        let first = reach.clamp(self.wanted(state, next_um(0)), last);
        // Which way the model travels, against the reference.
        let own = (next_um(1) - next_um(0)) / self.direct;
        let way = (first - own).signum();
        if !self.overruns(state, first, &next_um, reach, way) {
            return first;
        }
        // The fastest from which it can still be slowed down.
        let mut sure = reach.clamp(last - way * reach.move_um, last);
        let mut too_much = first;
        for _ in 0..HALVINGS {
            let middle = 0.5 * (sure + too_much);
            if self.overruns(state, middle, &next_um, reach, way) {
                too_much = middle;
            } else {
                sure = middle;
            }
        }
        sure
    }

    /// Whether the model, slowed down as fast as the slew allows after this displacement, goes past a reference on its
    /// way (1 or -1).
    fn overruns(
        &self,
        state: &FeedForwardState,
        displacement_um: f64,
        next_um: &impl Fn(usize) -> f64,
        reach: &Reach,
        way: f64,
    ) -> bool {
        let mut on = *state;
        self.drive(&mut on, displacement_um);
        for ahead in 1..BRAKING_TICKS {
            let wanted = self.wanted(&on, next_um(ahead));
            // Slow enough: no faster than the reference itself.
            let own = (next_um(ahead) - next_um(ahead - 1)) / self.direct;
            if (on.last_um - own) * way <= 0.0 {
                return false;
            }
            // A reference that jumps is met when it has jumped, and not before.
            if own.abs() > on.last_um.abs() + reach.move_um {
                return false;
            }
            let slowest = reach.clamp(on.last_um - way * reach.move_um, on.last_um);
            if (slowest - wanted) * way > OVERRUN_UM {
                return true;
            }
            self.drive(&mut on, slowest);
        }
        false
    }

    /// Drives the model for one tick with a displacement from neutral.
    pub(crate) fn drive(&self, state: &mut FeedForwardState, displacement_um: f64) {
        state.integrator_um += self.gain * displacement_um;
        state.last_um = displacement_um;
        for i in 0..MODES {
            state.modes[i] = self.a[i] * state.modes[i] + self.b[i] * displacement_um;
        }
    }

    /// Both: the displacement, and the model driven with it.
    pub(crate) fn step(&self, state: &mut FeedForwardState, next_um: f64) -> f64 {
        let displacement_um = self.wanted(state, next_um);
        self.drive(state, displacement_um);
        displacement_um
    }

    /// The position of the state, um.
    pub(crate) fn position(&self, state: &FeedForwardState) -> f64 {
        let modes: f64 = (0..MODES).map(|i| self.c[i] * state.modes[i]).sum();
        state.integrator_um + modes + self.feedthrough * state.last_um
    }

    /// The same where the reference of this tick was announced by the tick before: the model that range and slew keep back goes
    /// on towards it.
    pub(crate) fn meet_announced(
        &self,
        state: &mut FeedForwardState,
        reference_um: f64,
        announced_um: Option<f64>,
    ) {
        /// Below this it is rounding, um.
        const SAME_UM: f64 = 1e-9;
        let announced = announced_um.is_some_and(|um| (um - reference_um).abs() < SAME_UM);
        let behind = (reference_um - self.position(state)).abs() > SAME_UM;
        if !(announced && behind && state.is_sound()) {
            self.meet(state, reference_um);
        }
    }

    /// Puts the state on the reference of this tick: a jump that no preview announced moves the integrator part. A state
    /// that nothing can have is put at rest.
    pub(crate) fn meet(&self, state: &mut FeedForwardState, reference_um: f64) {
        state.integrator_um += reference_um - self.position(state);
        if !state.is_sound() {
            *state = Self::rest(reference_um);
        }
    }
}

/// Motion by the next tick for 1 um, and for 1 um s of each mode, of which the command follows.
fn inverse(d: &Deviation) -> (f64, [f64; MODES]) {
    /// Cost of a command over that of the motion that it causes, for the equation to have a solution.
    const NEXT_TO_NONE: f64 = 1e-6;
    let direct = (&d.c * &d.b)[0];
    let exact = (
        direct,
        std::array::from_fn(|i| d.c[i + 1] * d.a[(i + 1, i + 1)]),
    );
    if zeros_are_inside(d) {
        return exact;
    }
    let weight = NEXT_TO_NONE * direct * direct;
    lq_feedback(&d.a, &d.b, &(d.c.transpose() * &d.c), weight).map_or(exact, |(f, _)| {
        (1.0 / f[0], std::array::from_fn(|i| f[i + 1] / f[0]))
    })
}

/// Whether the command that reaches each next reference stays bounded: the eigenvalues of the plant under it are 0 and the zeros.
fn zeros_are_inside(d: &Deviation) -> bool {
    let direct = (&d.c * &d.b)[0];
    let under = &d.a - &d.b * (&d.c * &d.a / direct);
    (under.complex_eigenvalues().iter()).all(|zero| zero.norm() < 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loop_model::LoopMode;
    use cellpos_plant::{DiscretePlant, Seconds, TransferFunction};

    #[test]
    fn the_feed_forward_command_makes_eq6_follow_any_reference() {
        let forward = FeedForward::new(&LoopModel::eq6(2e-3)).unwrap();
        let plant =
            DiscretePlant::new(&TransferFunction::eq6(), Seconds(1e-3), Seconds(0.0)).unwrap();
        let reference = |k: usize| {
            if k < 3 {
                0.0
            } else {
                (0.9 * k as f64).sin() + 0.5 * (0.07 * k as f64).cos()
            }
        };
        let (mut state, mut x) = (FeedForward::rest(0.0), plant.state(0.0));
        let mut largest: f64 = 0.0;
        for k in 0..2000 {
            assert!(
                (plant.output_um(&x) - reference(k)).abs() < 2e-3,
                "tick {k}: the 587 s pole only"
            );
            let u = forward.step(&mut state, reference(k + 1));
            assert!((forward.position(&state) - reference(k + 1)).abs() < 1e-9);
            largest = largest.max(u.abs());
            plant.step(&mut x, u);
        }
        assert!(largest < 20.0, "the inverse is stable: {largest}");
    }

    #[test]
    fn behind_two_lags_the_command_is_bounded_and_the_bead_arrives() {
        // Regulator and tube of 50 and 20 ms: a zero at -2.68.
        let (k, one, two) = (428.0, 0.05, 0.02);
        let mode = |own: f64, other: f64| LoopMode {
            pole_rad_per_s: -1.0 / own,
            residue_per_s: -k * own / (own - other),
        };
        let model = LoopModel {
            modes: [mode(one, two), mode(two, one)],
            sample_time_s: 0.02,
            ..LoopModel::integrator(k, 2e-3)
        };
        let forward = FeedForward::new(&model).unwrap();
        let mut state = FeedForward::rest(0.0);
        let mut largest: f64 = 0.0;
        for tick in 0..400 {
            largest = largest.max(forward.step(&mut state, 1.0).abs());
            let left = forward.position(&state) - 1.0;
            assert!(tick < 20 || left.abs() < 1e-3, "tick {tick}: {left}");
        }
        assert!(largest < 2.0, "{largest}");
    }
}
