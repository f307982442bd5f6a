//! Faults of the rig, at random or at a given time.

use crate::error::WorldError;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Kinds of scheduled faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FaultKind {
    /// The bead is invisible.
    LoseBead,
    /// A second bead moves with the first.
    SecondBead,
    /// The bead sticks to the wall; the flow continues.
    StickBead,
    /// The camera delivers nothing; the frames exposed meanwhile come in one burst afterwards.
    StallCamera,
    /// Frames are exposed and never delivered; their ids are missing.
    DropFrames,
    /// The camera delivers old buffers: picture and time stamp of five frames before, with the present id.
    StaleFrames,
    /// Every frame is delivered twice, half a period apart.
    DoubleFrames,
    /// Frames come in the wrong order: each even one after its successor.
    ReorderFrames,
    /// The same picture under new ids and new time stamps: a frame grabber that hangs.
    FrozenPicture,
    /// The zero flow is off by [`Faults::flow_step_um`] while it lasts: a tap on the syringe.
    FlowStep,
    /// The PZT moves the bead the wrong way: its sign is flipped about the zero flow.
    GainFlip,
    /// The PZT stands where the bead stands still at the time at which it began, the steady flow counted in: the best that anything can do
    /// for a bead that nobody sees.
    HoldZeroFlow,
    /// The amplifier gives no displacement beyond [`Faults::clip_um`].
    ClipAmplifier,
    /// Random bytes on the line to the board and from it, one burst per millisecond.
    LinkGarbage,
    /// No byte passes the line to the board or from it.
    LinkLoss,
    /// No byte passes the line to the slow partner or from it.
    PartnerLoss,
    /// The optimiser gives no plan in time. It does not affect the world; the program applies it to its loop.
    SlowSolver,
    /// The recorder accepts nothing, as if its disk hung. The program applies it too, because on the virtual clock no disk hangs.
    StallRecorder,
}

/// A fault from a time on, for a time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FaultEvent {
    /// What.
    pub kind: FaultKind,
    /// Start, s from the start of the world.
    pub at_s: f64,
    /// Duration, s. Left out: for good.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub for_s: Option<f64>,
}

/// All faults: rates per frame (or second), and scheduled events. The default is no fault.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Faults {
    /// Probability that a frame is not delivered.
    pub drop_rate: f64,
    /// Probability that a frame is an old buffer under a new id.
    pub stale_rate: f64,
    /// Probability that a frame is delivered twice.
    pub double_rate: f64,
    /// Probability that a frame comes after its successor.
    pub reorder_rate: f64,
    /// Bursts of random bytes on the line per second.
    pub garbage_per_s: f64,
    /// Distance of a second bead from the first, um.
    pub second_bead_um: f64,
    /// Step of the zero flow, um.
    pub flow_step_um: f64,
    /// Largest displacement of an amplifier that clips, um.
    pub clip_um: f64,
    /// Scheduled faults.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub event: Vec<FaultEvent>,
}

impl Default for Faults {
    fn default() -> Self {
        Self {
            drop_rate: 0.0,
            stale_rate: 0.0,
            double_rate: 0.0,
            reorder_rate: 0.0,
            garbage_per_s: 0.0,
            second_bead_um: 3.0,
            flow_step_um: 0.3,
            clip_um: 20.5,
            event: Vec::new(),
        }
    }
}

impl Faults {
    /// Whether a scheduled fault of this kind is in force `elapsed_ns` after the start.
    pub fn active(&self, kind: FaultKind, elapsed_ns: i64) -> bool {
        self.event.iter().any(|event| {
            event.kind == kind && {
                let from_ns = (event.at_s * 1e9) as i64;
                let until_ns = event.for_s.map_or(i64::MAX, |for_s| {
                    from_ns.saturating_add((for_s * 1e9) as i64)
                });
                (from_ns..until_ns).contains(&elapsed_ns)
            }
        })
    }

    /// End of the scheduled fault of this kind that is in force; `i64::MAX` if it does not end.
    pub fn end_ns(&self, kind: FaultKind, elapsed_ns: i64) -> Option<i64> {
        self.event
            .iter()
            .filter(|event| event.kind == kind && (event.at_s * 1e9) as i64 <= elapsed_ns)
            .map(|event| {
                event.for_s.map_or(i64::MAX, |for_s| {
                    ((event.at_s * 1e9) as i64).saturating_add((for_s * 1e9) as i64)
                })
            })
            .filter(|&end_ns| end_ns > elapsed_ns)
            .max()
    }

    /// Times at which the scheduled faults of a kind are in force, ns from the start.
    pub fn spans_ns(&self, kind: FaultKind) -> Vec<Range<i64>> {
        let ns = |s: f64| (s * 1e9) as i64;
        let spans = self.event.iter().filter(|event| event.kind == kind);
        spans
            .map(|event| {
                let from_ns = ns(event.at_s);
                from_ns
                    ..event
                        .for_s
                        .map_or(i64::MAX, |for_s| from_ns.saturating_add(ns(for_s)))
            })
            .collect()
    }

    /// Adds a scheduled fault.
    pub fn with(mut self, kind: FaultKind, at_s: f64, for_s: Option<f64>) -> Self {
        self.event.push(FaultEvent { kind, at_s, for_s });
        self
    }

    pub(crate) fn validate(&self) -> Result<(), WorldError> {
        let check = |good: bool, key, value, must| {
            if good {
                Ok(())
            } else {
                Err(WorldError::Value { key, value, must })
            }
        };
        for (key, rate) in [
            ("faults.drop_rate", self.drop_rate),
            ("faults.stale_rate", self.stale_rate),
            ("faults.double_rate", self.double_rate),
            ("faults.reorder_rate", self.reorder_rate),
        ] {
            check(
                (0.0..=1.0).contains(&rate),
                key,
                rate,
                "a probability, 0..1",
            )?;
        }
        check(
            (0.0..=1000.0).contains(&self.garbage_per_s),
            "faults.garbage_per_s",
            self.garbage_per_s,
            "0..1000 per second",
        )?;
        check(
            self.second_bead_um.abs() <= 1e4,
            "faults.second_bead_um",
            self.second_bead_um,
            "finite, within +-10000 um",
        )?;
        check(
            self.flow_step_um.abs() <= 1e3,
            "faults.flow_step_um",
            self.flow_step_um,
            "finite, within +-1000 um",
        )?;
        check(
            self.clip_um.abs() <= 1e4,
            "faults.clip_um",
            self.clip_um,
            "finite, within +-10000 um",
        )?;
        for event in &self.event {
            check(
                (0.0..=1e9).contains(&event.at_s),
                "faults.event.at_s",
                event.at_s,
                "0 s or later",
            )?;
            if let Some(for_s) = event.for_s {
                check(
                    for_s > 0.0 && for_s <= 1e9,
                    "faults.event.for_s",
                    for_s,
                    "above 0 s",
                )?;
            }
        }
        Ok(())
    }
}
