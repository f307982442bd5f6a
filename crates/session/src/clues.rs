//! The events of a run that explain its end.

use crate::words::is_odd;
use cellpos_rig::{ActuatorFault as Fault, ActuatorState as State};
use cellpos_runtime::Event;
use cellpos_runtime::life::{EventKind, FreezeReason, Refusal, SafeReason};
use cellpos_runtime::realtime::Conditions;

/// The last event of each kind that explains the end of a run.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Clues {
    pub(crate) arming: Option<(Refusal, f64, f64)>,
    /// Gain over the model's, and half its 95 % interval, from an accepted pulse.
    pub(crate) passed: Option<(f64, f64)>,
    pub(crate) board: Option<(State, Fault)>,
    pub(crate) late_us: Option<f64>,
    pub(crate) stale_ms: Option<f64>,
    /// The bead is frozen because the camera repeats one picture.
    pub(crate) picture_frozen: bool,
    pub(crate) vision_ms: Option<[f64; 2]>,
    /// Displacement beyond which the bead does not follow, um.
    pub(crate) clipped_um: Option<f64>,
    /// Time of the last skipped tick, and of Safe, ns since the start of the run.
    skipped_ns: Option<i64>,
    safe_ns: Option<i64>,
}

impl Clues {
    pub(crate) fn note(&mut self, event: &Event) {
        match event.kind {
            EventKind::ArmingRefused {
                refusal,
                gain_ratio,
                ci95,
            } => {
                self.arming = Some((refusal, gain_ratio, ci95));
            }
            EventKind::ArmingPassed { gain_ratio, ci95 } => self.passed = Some((gain_ratio, ci95)),
            EventKind::ActuatorClipped { level_um } => self.clipped_um = Some(level_um),
            EventKind::BoardChanged { state, fault } => self.board = Some((state, fault)),
            EventKind::LateTick { compute_us } => self.late_us = Some(compute_us),
            EventKind::FrameStale { age_ms } => self.stale_ms = Some(age_ms),
            EventKind::FreezeStarted {
                reason: FreezeReason::PictureFrozen,
            } => self.picture_frozen = true,
            EventKind::FreezeEnded { .. } => self.picture_frozen = false,
            EventKind::VisionSlowStarted {
                vision_ms,
                period_ms,
            } => self.vision_ms = Some([vision_ms, period_ms]),
            EventKind::TicksSkipped { .. } => self.skipped_ns = Some(event.time_ns),
            EventKind::SafeLatched { .. } => self.safe_ns = Some(event.time_ns),
            _ => {}
        }
    }

    /// Gain over the model's, if the arming pulse was accepted but the gain differs from the model's.
    pub(crate) fn odd_gain(&self) -> Option<f64> {
        (self.passed)
            .filter(|(ratio, ci95)| is_odd(*ratio, *ci95))
            .map(|(ratio, _)| ratio)
    }

    /// Advice that comes first if a fault of times is this machine's own: ticks were skipped in the last second, or the loop had no
    /// real-time priority.
    pub(crate) fn machine(
        &self,
        reason: Option<SafeReason>,
        conditions: &Conditions,
    ) -> Option<String> {
        const RECENT_NS: i64 = 1_000_000_000;
        let of_times = matches!(
            reason,
            Some(SafeReason::StaleFrames | SafeReason::VisionSlow | SafeReason::LinkLost)
        ) && !self.picture_frozen;
        let skipped = (self.skipped_ns.zip(self.safe_ns))
            .is_some_and(|(skipped, safe)| safe - skipped < RECENT_NS);
        let policy = conditions.policy.as_str();
        // A cable is pulled at any priority.
        let ordinary = reason != Some(SafeReason::LinkLost)
            && !matches!(policy, "SCHED_FIFO" | "virtual clock");
        let signs = [
            (skipped, "ticks were skipped just before"),
            (ordinary, "the loop had no real-time priority"),
        ];
        let seen: Vec<&str> = (signs.iter().filter(|sign| sign.0))
            .map(|sign| sign.1)
            .collect();
        (of_times && !seen.is_empty()).then(|| {
            let seen = seen.join(", and ");
            format!("this machine may have been busy ({seen}): run cellpos doctor and close other programs; if that changes nothing, ")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_that_is_silent_after_skipped_ticks_may_be_the_machine_and_one_that_is_cut_is_not() {
        let conditions = Conditions::default();
        let said = |reason, skipped_ns| {
            let clues = Clues {
                skipped_ns,
                safe_ns: Some(3_000_000_000),
                ..Clues::default()
            };
            clues.machine(Some(reason), &conditions)
        };
        let busy = said(SafeReason::LinkLost, Some(2_500_000_000)).expect("a clue");
        assert!(busy.contains("ticks were skipped"), "{busy}");
        assert!(!busy.contains("priority"), "{busy}");
        assert_eq!(said(SafeReason::LinkLost, Some(1_000_000_000)), None);
        assert_eq!(said(SafeReason::LinkLost, None), None);
        let late = said(SafeReason::StaleFrames, None).expect("a clue");
        assert!(late.contains("no real-time priority"), "{late}");
        assert_eq!(said(SafeReason::BeadLost, Some(2_500_000_000)), None);
    }
}
