//! A state handed over to another delay, or counted in other units, between two ticks.

use super::{Estimator, EstimatorState};

impl Estimator {
    /// Between two ticks: hands a state over to an estimator that differs from this one in the delay. The fixes used so far
    /// are taken to be of the times that the other says: what they show stays, the modes are those of its time.
    pub(crate) fn retime(&self, state: &mut EstimatorState, other: &Self) {
        // The next tick has its command at 1 in the history.
        let back = self.delay_ticks + usize::from(state.lag) + 1;
        let mut m = self.filter_state_at(state, back);
        let shown = self.position_measured(&m, Self::command(state, back));
        let (mut at, to) = (back, other.delay_ticks + usize::from(state.lag) + 1);
        while at < to && !state.stuck {
            at += 1;
            m = self.tick.retreat(&m, Self::command(state, at));
        }
        while at > to && !state.stuck {
            m = self.tick.advance(&m, Self::command(state, at));
            at -= 1;
        }
        m.last_um = other.filter_state_at(state, to).last_um;
        let shows = other.position_measured(&m, Self::command(state, to));
        state.integrator_um = m.q + shown - shows;
        state.modes = m.modes;
        state.lag = state.lag.min(other.longest_lag as u8);
    }

    /// Between two ticks: counts displacements in another unit. What the filter says of the bead's position stays.
    pub(crate) fn rescale(&self, state: &mut EstimatorState, ratio: f64) {
        let back = self.delay_ticks + usize::from(state.lag) + 1;
        let position = |state: &EstimatorState| {
            let m = self.filter_state_at(state, back);
            self.position_measured(&m, Self::command(state, back))
        };
        let before = position(state);
        state.neutral_um *= ratio;
        state.modes.iter_mut().for_each(|x| *x *= ratio);
        state.history_um.iter_mut().for_each(|u| *u *= ratio);
        for covariance_um2 in [&mut state.covariance_um2, &mut state.stated_um2] {
            covariance_um2[1] *= ratio;
            covariance_um2[2] *= ratio * ratio;
        }
        state.integrator_um += before - position(state);
    }
}
