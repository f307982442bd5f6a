//! The state of a loop, and its exact packing into 16 numbers for the records.

use crate::estimator::{EVIDENCE_GRID, EstimatorState, HISTORY};
use crate::feedforward::FeedForwardState;
use crate::limits::{GRID_STEPS, Limits};
use crate::loop_model::MODES;
use crate::pi::PiState;

/// Numbers in a packed state.
pub const STATE_LEN: usize = 16;

/// Bits of the packed flags below the evidence.
const FLAG_BITS: f64 = 4_294_967_296.0;

/// Estimator and controller state of one loop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopState {
    /// Estimator.
    pub estimator: EstimatorState,
    /// PI controller (unused by the others, but kept tracking so that a fallback is bumpless).
    pub pi: PiState,
    /// Model on the reference (state feedback only).
    pub feed_forward: FeedForwardState,
    /// Part of the previous tick's command that was learned and that the estimator was not told of, um; not part of the
    /// packed state.
    pub learned_um: f64,
}

impl LoopState {
    /// Command of the previous tick, um.
    pub fn previous_command_um(&self) -> f64 {
        self.estimator.history_um[0] + self.learned_um
    }

    /// The state as 16 numbers, exactly. Past commands lie on the grid of `limits`, so that two of them are the digits
    /// of one integer; evidence and flags are another. One number is the lead's memory under PI and the feed-forward's
    /// last displacement under state feedback, which needs no lead.
    pub(crate) fn pack(&self, limits: &Limits, state_feedback: bool) -> [f64; STATE_LEN] {
        let e = &self.estimator;
        let flags = u32::from(e.lag)
            | u32::from(e.gated) << 8
            | u32::from(e.seen) << 16
            | u32::from(e.stuck) << 17
            | u32::from(e.spread_level) << 18
            | u32::from(e.released_ticks) << 26;
        let mut out = [0.0; STATE_LEN];
        out[0] = e.integrator_um;
        out[1] = e.neutral_um;
        out[2..5].copy_from_slice(&e.covariance_um2);
        out[5..5 + MODES].copy_from_slice(&e.modes);
        out[7] = self.pi.integral_um;
        out[8] = if state_feedback {
            self.feed_forward.last_um
        } else {
            self.pi.lead_um
        };
        out[9] = self.feed_forward.integrator_um;
        out[10..10 + MODES].copy_from_slice(&self.feed_forward.modes);
        out[12] = f64::from(flags) + FLAG_BITS * (e.stuck_evidence * EVIDENCE_GRID);
        for (slot, pair) in out[13..].iter_mut().zip(e.history_um.chunks_exact(2)) {
            *slot = limits.index(pair[0]) * (GRID_STEPS + 1.0) + limits.index(pair[1]);
        }
        out
    }

    /// The state of [`LoopState::pack`].
    pub(crate) fn unpack(packed: &[f64; STATE_LEN], limits: &Limits, state_feedback: bool) -> Self {
        let evidence = (packed[12] / FLAG_BITS).floor();
        let flags = (packed[12] - evidence * FLAG_BITS) as u32;
        let mut history_um = [0.0; HISTORY];
        for (pair, slot) in history_um.chunks_exact_mut(2).zip(&packed[13..]) {
            let high = (slot / (GRID_STEPS + 1.0)).floor();
            pair[0] = limits.at_index(high);
            pair[1] = limits.at_index(slot - high * (GRID_STEPS + 1.0));
        }
        Self {
            estimator: EstimatorState {
                integrator_um: packed[0],
                neutral_um: packed[1],
                covariance_um2: [packed[2], packed[3], packed[4]],
                modes: [packed[5], packed[6]],
                history_um,
                stuck_evidence: evidence / EVIDENCE_GRID,
                lag: flags as u8,
                gated: (flags >> 8) as u8,
                seen: flags & 1 << 16 != 0,
                stuck: flags & 1 << 17 != 0,
                spread_level: (flags >> 18) as u8,
                released_ticks: (flags >> 26) as u8,
            },
            pi: PiState {
                integral_um: packed[7],
                lead_um: if state_feedback { 0.0 } else { packed[8] },
            },
            learned_um: 0.0,
            feed_forward: FeedForwardState {
                integrator_um: packed[9],
                modes: [packed[10], packed[11]],
                last_um: if state_feedback { packed[8] } else { 0.0 },
            },
        }
    }
}
