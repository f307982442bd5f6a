//! Frames on their way into a tick: the newest new one, and an account of the rest.

use cellpos_rig::{FrameAccount, FrameKind, IdKind, Measurement};

/// What came since the previous tick, as [`FrameAccount`] judged it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameTally {
    /// Frames that came.
    pub arrived: u32,
    /// New frames that were not used because a newer one came with them.
    pub superseded: u32,
    /// Frames that have not come.
    pub missed: u32,
    /// Frames that came after their successor, and had been counted as missed.
    pub late: u32,
    /// Frames that came twice.
    pub doubled: u32,
    /// Frames with a time stamp that had not moved on, or older than allowed.
    pub stale: u32,
    /// Frames older than allowed of a backlog that is being worked off: the ones after them are younger by far.
    pub backlog: u32,
    /// Frames stamped with a time that has not come.
    pub future: u32,
    /// How often the camera restarted its count.
    pub restarts: u32,
    /// Age of the oldest stale frame, ns.
    pub oldest_ns: i64,
    /// By how much the worst stamp is in the future, ns.
    pub ahead_ns: i64,
    /// Id of the newest frame that came twice or too late.
    pub repeated_id: u64,
}

impl FrameTally {
    /// Frames that show that the camera, or its driver, hands over old pictures as new ones: repeated, stale, from the future. Frames that
    /// only overtook each other do not.
    pub fn refused(&self) -> u32 {
        self.doubled
            .saturating_add(self.stale)
            .saturating_add(self.future)
    }
}

/// Judges frames as they come out of the ring.
#[derive(Debug)]
pub(crate) struct FrameWatch {
    account: FrameAccount,
    /// From frame to frame.
    period_ns: i64,
    oldest_ns: i64,
    /// Exposure of the last frame that was too old, while no other has come.
    old_ns: Option<i64>,
    /// Frames of this tick that were too old, and the last one's exposure.
    too_old: Option<(u32, i64)>,
    newest: Option<Measurement>,
    tally: FrameTally,
}

impl FrameWatch {
    pub(crate) fn new(period_ns: i64, oldest_ns: i64) -> Self {
        Self {
            // Of a burst only the newest is used: whether it is too old is asked of that one.
            account: FrameAccount::new(IdKind::Wide, period_ns, i64::MAX),
            period_ns,
            oldest_ns,
            old_ns: None,
            too_old: None,
            newest: None,
            tally: FrameTally::default(),
        }
    }

    /// Takes note of a frame.
    pub(crate) fn add(&mut self, measurement: &Measurement, now_ns: i64) {
        let tally = &mut self.tally;
        let more = |count: &mut u32, by: u64| {
            *count = count.saturating_add(u32::try_from(by).unwrap_or(u32::MAX));
        };
        more(&mut tally.arrived, 1);
        let lost_before = self.account.counts().lost;
        let exposed_ns = measurement.mid_exposure_ns;
        let judged = self.account.step(measurement.frame_id, exposed_ns, now_ns);
        more(
            &mut tally.missed,
            self.account.counts().lost.saturating_sub(lost_before),
        );
        match judged.kind {
            FrameKind::First | FrameKind::New { .. } | FrameKind::Restarted => {
                more(
                    &mut tally.restarts,
                    u64::from(judged.kind == FrameKind::Restarted),
                );
                more(&mut tally.superseded, u64::from(self.newest.is_some()));
                self.newest = Some(Measurement {
                    frame_id: judged.id,
                    ..*measurement
                });
            }
            FrameKind::Doubled => {
                more(&mut tally.doubled, 1);
                tally.repeated_id = measurement.frame_id;
            }
            FrameKind::Late => {
                more(&mut tally.late, 1);
                tally.repeated_id = measurement.frame_id;
            }
            FrameKind::Stale | FrameKind::Old { .. } | FrameKind::Invalid => {
                more(&mut tally.stale, 1);
                tally.oldest_ns = tally.oldest_ns.max(now_ns.saturating_sub(exposed_ns));
            }
            FrameKind::Future { ahead_ns } => {
                more(&mut tally.future, 1);
                tally.ahead_ns = tally.ahead_ns.max(ahead_ns);
            }
        }
    }

    /// The newest frame that may be used now.
    pub(crate) fn newest(&mut self, now_ns: i64) -> Option<&Measurement> {
        let exposed_ns = self.newest?.mid_exposure_ns;
        let age_ns = now_ns.saturating_sub(exposed_ns);
        if age_ns > self.oldest_ns {
            self.newest = None;
            let before = self.too_old.map_or(0, |(count, _)| count);
            self.too_old = Some((before.saturating_add(1), exposed_ns));
            self.tally.oldest_ns = self.tally.oldest_ns.max(age_ns);
        }
        self.newest.as_ref()
    }

    /// Whether the frames of a tick that were too old make a backlog shorter. Asked once a tick: in between control may look at
    /// each frame of a burst as it comes.
    fn judge_old(&mut self) {
        /// Periods by which the newest frame of a tick must be ahead of the one before for the backlog to become shorter.
        const WORKED_OFF: i64 = 2;
        let Some((number, exposed_ns)) = self.too_old.take() else {
            return;
        };
        let gained = |old_ns: i64| exposed_ns - old_ns >= WORKED_OFF * self.period_ns;
        let count = if self.old_ns.is_none_or(gained) {
            &mut self.tally.backlog
        } else {
            &mut self.tally.stale
        };
        *count = count.saturating_add(number);
        self.old_ns = Some(exposed_ns);
    }

    /// Returns the counts so far and starts again from zero.
    pub(crate) fn take(&mut self, now_ns: i64) -> (Option<Measurement>, FrameTally) {
        let newest = self.newest(now_ns).copied();
        self.newest = None;
        self.judge_old();
        if newest.is_some() {
            self.old_ns = None;
        }
        (newest, std::mem::take(&mut self.tally))
    }
}
