//! What the operator asks for while the loop runs.

use crate::life::Request;
use crate::recording::RecorderFault;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};

/// What the operator asks for, shared with a signal handler or a keyboard.
#[derive(Debug, Default)]
pub struct Operator {
    asked: AtomicU8,
    recorder: AtomicU8,
    /// Complement of the bits of the target, um: 0, the complement of no finite number, while nothing was requested.
    target: AtomicU64,
}

impl Operator {
    /// Asks.
    pub fn ask(&self, request: Request) {
        self.asked.store(request as u8, Ordering::Release);
    }

    /// Says where the bead is to be from now on, um; a reference that cannot be steered does not listen.
    pub fn steer(&self, target_um: f64) {
        self.target.store(!target_um.to_bits(), Ordering::Release);
    }

    /// Where the bead is to be, um, if that was said.
    pub fn target_um(&self) -> Option<f64> {
        Some(f64::from_bits(!self.target.load(Ordering::Acquire))).filter(|um| um.is_finite())
    }

    /// What was last asked.
    pub fn asked(&self) -> Request {
        Request::from_number(self.asked.load(Ordering::Acquire))
    }

    /// Says that the run is no longer recorded: from now on the loop freezes the bead, then parks. The first cause stays.
    pub fn unrecorded(&self, fault: RecorderFault) {
        let _ = self
            .recorder
            .compare_exchange(0, fault as u8, Ordering::AcqRel, Ordering::Acquire);
    }

    /// Why the run is no longer recorded, if so.
    pub fn recorder_fault(&self) -> Option<RecorderFault> {
        RecorderFault::from_number(self.recorder.load(Ordering::Acquire))
    }

    /// What was last asked, to be acted on: asking to skip holds for one tick; a run that nobody records is stopped unless
    /// it is parked anyway.
    pub fn take(&self) -> Request {
        let asked = self.asked();
        if asked != Request::Park && self.recorder_fault().is_some() {
            return Request::Unrecorded;
        }
        if asked == Request::Skip {
            // Something asked meanwhile stays.
            let _ = self.asked.compare_exchange(
                Request::Skip as u8,
                Request::None as u8,
                Ordering::AcqRel,
                Ordering::Acquire,
            );
        }
        asked
    }

    /// Replaces one request by another, unless something else was asked meanwhile; says whether it did.
    pub fn change(&self, from: Request, to: Request) -> bool {
        self.asked
            .compare_exchange(from as u8, to as u8, Ordering::AcqRel, Ordering::Acquire)
            .is_ok()
    }

    /// The next step of stopping: first freeze, then park.
    pub fn stop(&self) -> Request {
        let next = match self.asked() {
            Request::None | Request::Skip | Request::Pause => Request::Freeze,
            Request::Freeze | Request::Park | Request::Unrecorded => Request::Park,
        };
        self.ask(next);
        next
    }
}
