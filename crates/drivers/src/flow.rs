//! The commanded flow, from which vision predicts the bead's position.
//!
//! The PZT sets the bead's velocity: `v = K (x1 - neutral)`. This records the commands to the board with their times. One camera
//! delay later the tracker asks for the flow commanded between two exposures. Written by the actuator thread
//! and read by the camera thread, behind a lock that either holds for less than a microsecond; never used in a tick.

use cellpos_rig::actuator::{
    Actuator, ActuatorError, ActuatorInfo, ActuatorReport, ArmRequest, CommandAccount,
};
use cellpos_rig::clock::Clock;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Commands remembered: at 1 kHz a quarter of a second, longer than any camera's delay.
const REMEMBERED: usize = 256;

#[derive(Debug)]
struct History {
    gain_per_s: f64,
    /// Time and commanded displacement from neutral (um) from then on; a ring.
    changes: [(i64, f64); REMEMBERED],
    count: usize,
}

/// The commanded flow, shared by actuator and camera.
#[derive(Debug, Clone)]
pub struct CommandedFlow(Arc<Mutex<History>>);

impl CommandedFlow {
    /// No flow so far. `gain_per_s` is the bead velocity (um/s) per um of PZT displacement from neutral.
    pub fn new(gain_per_s: f64) -> Self {
        Self(Arc::new(Mutex::new(History {
            gain_per_s,
            changes: [(i64::MIN, 0.0); REMEMBERED],
            count: 0,
        })))
    }

    fn history(&self) -> MutexGuard<'_, History> {
        // The data are valid even if a thread panicked while it held the lock.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets another gain, also for earlier commands.
    pub fn set_gain_per_s(&self, gain_per_s: f64) {
        self.history().gain_per_s = gain_per_s;
    }

    /// Notes that from `time_ns` on the PZT is `offset_um` from neutral. NaN counts as no flow.
    pub fn note(&self, time_ns: i64, offset_um: f64) {
        let mut history = self.history();
        let at = history.count % REMEMBERED;
        let offset_um = if offset_um.is_finite() {
            offset_um
        } else {
            0.0
        };
        if let Some(slot) = history.changes.get_mut(at) {
            *slot = (time_ns, offset_um);
            history.count = history.count.wrapping_add(1);
        }
    }

    /// Mean velocity commanded from `from_ns` to `to_ns`, um/s; 0 for times before the oldest command remembered.
    pub fn mean_um_per_s(&self, from_ns: i64, to_ns: i64) -> f64 {
        if to_ns <= from_ns {
            return 0.0;
        }
        let history = self.history();
        let (mut sum_um_ns, mut until_ns) = (0.0, to_ns);
        for back in 1..=history.count.min(REMEMBERED) {
            let at = history.count.wrapping_sub(back) % REMEMBERED;
            let Some(&(since_ns, offset_um)) = history.changes.get(at) else {
                break;
            };
            let start_ns = since_ns.max(from_ns);
            if start_ns < until_ns {
                sum_um_ns += offset_um * (until_ns - start_ns) as f64;
                until_ns = start_ns;
            }
            if since_ns <= from_ns {
                break;
            }
        }
        history.gain_per_s * sum_um_ns / (to_ns - from_ns) as f64
    }
}

/// An actuator that notes its commands in a [`CommandedFlow`].
#[derive(Debug)]
pub struct FlowTap<A> {
    inner: A,
    flow: CommandedFlow,
    clock: Clock,
    /// Displacement that counts as no flow, um, and its time, ns.
    reference: Option<(f64, i64)>,
}

/// Time in which the reference of the flow follows the loop's zero flow, s. The tracker has a velocity state for motion that no
/// command explains; a zero flow that the loop corrects within a few ticks must not count twice.
const REFERENCE_S: f64 = 1.0;

impl<A> FlowTap<A> {
    /// Puts the tap in front of an actuator; `clock` is the one of the camera's time stamps.
    pub fn new(inner: A, flow: CommandedFlow, clock: Clock) -> Self {
        Self {
            inner,
            flow,
            clock,
            reference: None,
        }
    }

    /// The actuator behind the tap.
    pub fn inner_mut(&mut self) -> &mut A {
        &mut self.inner
    }

    fn rest(&mut self) {
        self.reference = None;
        self.flow.note(self.clock.now_ns(), 0.0);
    }

    /// The displacement that counts as no flow at `now_ns`, um, when the loop's zero flow is `neutral_um`.
    fn reference_um(&mut self, neutral_um: f64, now_ns: i64) -> f64 {
        let moved_um = self.reference.map_or(neutral_um, |(um, at_ns)| {
            let share = -(-((now_ns - at_ns) as f64 * 1e-9) / REFERENCE_S).exp_m1();
            um + share * (neutral_um - um)
        });
        // If the zero flow is NaN, keep the last one.
        if moved_um.is_finite() {
            self.reference = Some((moved_um, now_ns));
        }
        self.reference.map_or(f64::NAN, |(um, _)| um)
    }
}

impl<A: Actuator> Actuator for FlowTap<A> {
    fn info(&self) -> ActuatorInfo {
        self.inner.info()
    }

    fn arm(&mut self, request: &ArmRequest) -> Result<ActuatorReport, ActuatorError> {
        self.inner.arm(request)
    }

    fn account(&self) -> Option<CommandAccount> {
        self.inner.account()
    }

    fn command(
        &mut self,
        command_um: f64,
        neutral_um: f64,
        time_us: u64,
    ) -> Result<(), ActuatorError> {
        let now_ns = self.clock.now_ns();
        let reference_um = self.reference_um(neutral_um, now_ns);
        self.flow.note(now_ns, command_um - reference_um);
        self.inner.command(command_um, neutral_um, time_us)
    }

    fn freeze(&mut self) -> Result<(), ActuatorError> {
        self.rest();
        self.inner.freeze()
    }

    // The state of the board's ramp to park is unknown here; the bead is abandoned.
    fn park(&mut self) -> Result<(), ActuatorError> {
        self.rest();
        self.inner.park()
    }

    fn disarm(&mut self) -> Result<(), ActuatorError> {
        self.rest();
        self.inner.disarm()
    }

    fn poll(&mut self) -> Result<Option<ActuatorReport>, ActuatorError> {
        self.inner.poll()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_flow_is_the_time_average_of_what_was_held() {
        let flow = CommandedFlow::new(400.0);
        assert_eq!(flow.mean_um_per_s(0, 10), 0.0);
        flow.note(100, 1.0);
        flow.note(200, -2.0);
        flow.note(300, 0.5);
        assert_eq!(flow.mean_um_per_s(100, 200), 400.0);
        assert_eq!(flow.mean_um_per_s(150, 250), 400.0 * (0.5 - 1.0));
        // Before the first command the flow is zero; after the last one it is held.
        assert_eq!(flow.mean_um_per_s(0, 200), 200.0);
        assert_eq!(flow.mean_um_per_s(300, 900), 200.0);
        assert_eq!(flow.mean_um_per_s(500, 500), 0.0);
        flow.set_gain_per_s(100.0);
        flow.note(400, f64::NAN);
        assert_eq!(flow.mean_um_per_s(300, 500), 25.0);
    }

    #[test]
    fn old_commands_are_forgotten_and_new_ones_are_not() {
        let flow = CommandedFlow::new(1.0);
        for k in 0..1000 {
            flow.note(k, k as f64);
        }
        assert_eq!(flow.mean_um_per_s(990, 991), 990.0);
        assert_eq!(flow.mean_um_per_s(10, 20), 0.0);
    }
}
