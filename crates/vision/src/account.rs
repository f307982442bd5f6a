//! Account of frames by their ids and time stamps: which are new, doubled, dropped, stale or out of order.
//!
//! Camera stacks fall silently stale: neither the id nor the time stamp is believed alone. Counting is saturating and
//! nothing is allocated.

/// How a camera counts its frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IdKind {
    /// 64 bits that never wrap.
    Wide,
    /// 16 bits; after 65535 comes 1: nought is skipped (GigE Vision 1).
    Wrapping16SkippingZero,
    /// 16 bits; after 65535 comes 0.
    Wrapping16,
}

/// What a frame is, compared with the newest accepted before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameKind {
    /// The first frame, or the first after [`FrameAccount::restart`].
    First,
    /// Newer than all before; `missed` ids lie between.
    New {
        /// Frames that never came.
        missed: u64,
    },
    /// The same id as the newest.
    Doubled,
    /// An id older than the newest.
    Reordered,
    /// A new id with a time stamp that has not moved on, or one older than the age allowed: the picture is not new.
    Stale,
    /// An id the camera never gives out (nought where nought is skipped).
    Invalid,
}

impl FrameKind {
    /// Whether the frame carries a new picture.
    pub fn is_new(self) -> bool {
        matches!(self, FrameKind::First | FrameKind::New { .. })
    }
}

/// Counts, all saturating.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameCounts {
    /// Frames accepted as new.
    pub new: u64,
    /// Ids that never came. A frame that comes late is taken off again and counted as reordered.
    pub dropped: u64,
    /// Frames with the id of the newest.
    pub doubled: u64,
    /// Frames with an older id.
    pub reordered: u64,
    /// Frames whose time stamp says that the picture is not new.
    pub stale: u64,
    /// Frames with an id that does not exist.
    pub invalid: u64,
}

/// The account.
#[derive(Debug, Clone)]
pub struct FrameAccount {
    kind: IdKind,
    max_age_s: f64,
    newest: Option<(u64, f64)>,
    counts: FrameCounts,
}

/// Ids from 1 to 65535.
const PERIOD_SKIPPING_ZERO: u64 = 65_535;

impl FrameAccount {
    /// An account for a camera that counts as `kind` says; a frame older than `max_age_s` on arrival is stale.
    pub fn new(kind: IdKind, max_age_s: f64) -> Self {
        FrameAccount {
            kind,
            max_age_s,
            newest: None,
            counts: FrameCounts::default(),
        }
    }

    /// The counts so far.
    pub fn counts(&self) -> FrameCounts {
        self.counts
    }

    /// Forgets the newest frame, as after a camera's restart; the counts stay.
    pub fn restart(&mut self) {
        self.newest = None;
    }

    /// Takes note of a frame with the camera's `id`, exposed about `exposed_s`, that arrived at `arrived_s` (both on the
    /// same clock, s).
    pub fn step(&mut self, id: u64, exposed_s: f64, arrived_s: f64) -> FrameKind {
        let kind = self.classify(id, exposed_s, arrived_s);
        let c = &mut self.counts;
        let counter = match kind {
            FrameKind::First => &mut c.new,
            FrameKind::New { missed } => {
                c.dropped = c.dropped.saturating_add(missed);
                &mut c.new
            }
            FrameKind::Doubled => &mut c.doubled,
            FrameKind::Reordered => {
                c.dropped = c.dropped.saturating_sub(1);
                &mut c.reordered
            }
            FrameKind::Stale => &mut c.stale,
            FrameKind::Invalid => &mut c.invalid,
        };
        *counter = counter.saturating_add(1);
        kind
    }

    fn classify(&mut self, id: u64, exposed_s: f64, arrived_s: f64) -> FrameKind {
        let valid = match self.kind {
            IdKind::Wide => true,
            IdKind::Wrapping16SkippingZero => (1..=65_535).contains(&id),
            IdKind::Wrapping16 => id <= 65_535,
        };
        if !valid {
            return FrameKind::Invalid;
        }
        // Written so that a time stamp that is not a number is stale, and one from the future as well.
        let young = (arrived_s - exposed_s).abs() <= self.max_age_s;
        let Some((newest_id, newest_s)) = self.newest else {
            if !young {
                return FrameKind::Stale;
            }
            self.newest = Some((id, exposed_s));
            return FrameKind::First;
        };
        let ahead = self.ahead(id, newest_id);
        if ahead == 0 {
            return FrameKind::Doubled;
        }
        if ahead < 0 {
            return FrameKind::Reordered;
        }
        let moved_on = exposed_s > newest_s;
        if !moved_on || !young {
            // The id is used up all the same: the next one must not count it as dropped.
            let newest_s = if exposed_s <= arrived_s {
                newest_s.max(exposed_s)
            } else {
                newest_s
            };
            self.newest = Some((id, newest_s));
            return FrameKind::Stale;
        }
        self.newest = Some((id, exposed_s));
        FrameKind::New {
            missed: (ahead - 1).unsigned_abs(),
        }
    }

    /// How many frames `id` is ahead of `newest`; negative when behind. Wrapping ids are taken the shorter way round.
    fn ahead(&self, id: u64, newest: u64) -> i64 {
        let shorter = |period: u64| {
            let forward = (id + period - newest) % period;
            if forward <= period / 2 {
                forward as i64
            } else {
                forward as i64 - period as i64
            }
        };
        match self.kind {
            IdKind::Wide => id.wrapping_sub(newest) as i64,
            IdKind::Wrapping16SkippingZero => shorter(PERIOD_SKIPPING_ZERO),
            IdKind::Wrapping16 => shorter(65_536),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn account(kind: IdKind) -> FrameAccount {
        FrameAccount::new(kind, 0.02)
    }

    #[test]
    fn sixteen_bit_ids_that_skip_nought_wrap_without_a_drop() {
        let mut a = account(IdKind::Wrapping16SkippingZero);
        for n in 0..200_000_u64 {
            let t = n as f64 * 1e-3;
            let kind = a.step(n % 65_535 + 1, t, t + 0.002);
            assert_eq!(
                kind,
                if n == 0 {
                    FrameKind::First
                } else {
                    FrameKind::New { missed: 0 }
                }
            );
        }
        assert_eq!(
            a.counts(),
            FrameCounts {
                new: 200_000,
                ..FrameCounts::default()
            }
        );
        assert_eq!(a.step(0, 300.0, 300.0), FrameKind::Invalid);
    }

    #[test]
    fn drops_across_the_wrap_are_counted_exactly() {
        let mut a = account(IdKind::Wrapping16SkippingZero);
        a.step(65_533, 0.0, 0.0);
        assert_eq!(a.step(2, 0.004, 0.004), FrameKind::New { missed: 3 });
        let mut b = account(IdKind::Wrapping16);
        b.step(65_533, 0.0, 0.0);
        assert_eq!(b.step(2, 0.005, 0.005), FrameKind::New { missed: 4 });
    }

    #[test]
    fn doubled_reordered_and_stale_frames_are_told_apart() {
        let mut a = account(IdKind::Wide);
        assert_eq!(a.step(10, 1.000, 1.002), FrameKind::First);
        assert_eq!(a.step(10, 1.000, 1.003), FrameKind::Doubled);
        assert_eq!(a.step(12, 1.002, 1.004), FrameKind::New { missed: 1 });
        assert_eq!(a.step(11, 1.001, 1.0045), FrameKind::Reordered);
        assert_eq!(
            a.step(13, 1.002, 1.005),
            FrameKind::Stale,
            "new id, old time stamp"
        );
        assert_eq!(
            a.step(14, 1.004, 1.1),
            FrameKind::Stale,
            "older than allowed"
        );
        assert_eq!(a.step(15, f64::NAN, 1.1), FrameKind::Stale);
        assert_eq!(a.step(16, 99.0, 1.1), FrameKind::Stale, "from the future");
        assert_eq!(a.step(17, 1.2, 1.2), FrameKind::New { missed: 0 });
        let expected = FrameCounts {
            new: 3,
            dropped: 0,
            doubled: 1,
            reordered: 1,
            stale: 4,
            invalid: 0,
        };
        assert_eq!(a.counts(), expected);
    }

    #[test]
    fn a_restarted_camera_starts_a_new_count_of_ids() {
        let mut a = account(IdKind::Wide);
        a.step(1000, 1.0, 1.0);
        a.restart();
        assert_eq!(a.step(1, 2.0, 2.0), FrameKind::First);
        assert_eq!(a.counts().dropped, 0);
    }
}
