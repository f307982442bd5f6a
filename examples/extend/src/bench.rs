//! The bench that camera and actuator of this example share: a bead in a channel, moved by the displacement of a PZT.

use cellpos_rig::Clock;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Velocity of the bead per displacement from zero flow, 1/s: that of Eq. (6) at low frequencies.
pub const GAIN_PER_S: f64 = 428.0;
/// From one exposure to the next, ns.
pub const PERIOD_NS: i64 = 1_000_000;
/// Displacement at which nothing flows, um.
pub const ZERO_FLOW_UM: f64 = 20.0;

/// An exposure that waits for the camera to be read.
#[derive(Debug, Clone, Copy)]
pub struct Exposed {
    /// Number of the frame.
    pub id: u64,
    /// When, ns.
    pub at_ns: i64,
    /// Where the bead was, um.
    pub bead_um: f64,
}

/// The bench at a time.
#[derive(Debug)]
pub struct State {
    /// Time, ns.
    pub now_ns: i64,
    /// Displacement of the PZT, um.
    pub pzt_um: f64,
    /// Position of the bead, um.
    pub bead_um: f64,
    /// Exposures that nobody has read.
    pub exposed: VecDeque<Exposed>,
    next_id: u64,
}

/// The bench, shared.
#[derive(Debug, Clone)]
pub struct Bench {
    clock: Clock,
    state: Arc<Mutex<State>>,
}

impl Bench {
    /// A bench with a bead 1 um off the middle.
    pub fn new(clock: Clock) -> Self {
        let now_ns = clock.now_ns();
        Self {
            clock,
            state: Arc::new(Mutex::new(State {
                now_ns,
                pzt_um: ZERO_FLOW_UM,
                bead_um: 1.0,
                exposed: VecDeque::new(),
                next_id: 0,
            })),
        }
    }

    /// Its clock.
    pub fn clock(&self) -> &Clock {
        &self.clock
    }

    /// The bench, brought up to the present.
    pub fn now(&self) -> MutexGuard<'_, State> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let now_ns = self.clock.now_ns();
        while state.now_ns < now_ns {
            let step_ns =
                (PERIOD_NS - state.now_ns.rem_euclid(PERIOD_NS)).min(now_ns - state.now_ns);
            state.now_ns += step_ns;
            state.bead_um += GAIN_PER_S * (state.pzt_um - ZERO_FLOW_UM) * step_ns as f64 * 1e-9;
            if state.now_ns % PERIOD_NS == 0 {
                let exposed = Exposed {
                    id: state.next_id,
                    at_ns: state.now_ns,
                    bead_um: state.bead_um,
                };
                state.next_id += 1;
                state.exposed.push_back(exposed);
            }
        }
        state
    }
}
