//! Feed-forward from the inverse of the strictly proper plant: the command that makes the model follow the reference.
//!
//! The sampled plant `y_(k+1) = C A s_k + C B u_k` has all its zeros inside the unit circle, so `u_k` follows from the
//! next reference. (The biproper form of Eq. (6) has a zero at z = -19.3 and must never be inverted.)

use crate::deviation::{DEVIATION, Deviation};
use crate::loop_model::{LoopModel, MODES};

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

/// Inverse of one model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FeedForward {
    a: [f64; MODES],
    b: [f64; MODES],
    c: [f64; MODES],
    gain: f64,
    feedthrough: f64,
    direct: f64,
}

impl FeedForward {
    pub(crate) fn new(model: &LoopModel) -> Self {
        let d = Deviation::new(model);
        Self {
            a: std::array::from_fn(|i| d.a[(i + 1, i + 1)]),
            b: std::array::from_fn(|i| d.b[i + 1]),
            c: std::array::from_fn(|i| d.c[i + 1]),
            gain: d.b[0],
            feedthrough: d.c[DEVIATION - 1],
            direct: (&d.c * &d.b)[0],
        }
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
        let modes: f64 = (0..MODES)
            .map(|i| self.c[i] * self.a[i] * state.modes[i])
            .sum();
        (next_um - state.integrator_um - modes) / self.direct
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

    /// Puts the state on the reference of this tick: a jump that no preview announced moves the integrator part. A state
    /// that nothing can have is put at rest.
    pub(crate) fn meet(&self, state: &mut FeedForwardState, reference_um: f64) {
        state.integrator_um += reference_um - self.position(state);
        if !state.is_sound() {
            *state = Self::rest(reference_um);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_plant::{DiscretePlant, Seconds, TransferFunction};

    #[test]
    fn the_feed_forward_command_makes_eq6_follow_any_reference() {
        let forward = FeedForward::new(&LoopModel::eq6(2e-3));
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
}
