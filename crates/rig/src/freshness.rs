//! Classifies frames by their ids and time stamps: new, doubled, late, lost, stale, or from the future.
//!
//! Only a [`FrameAccount`] decides this: drivers that unwrap a camera's ids, vision and the loop all use one. Camera stacks go
//! stale silently, restart their count, and stamp with their own clocks. So it trusts neither the id nor the time stamp alone.
//! Times are nanoseconds of the run's monotonic clock, which does not show a change of the calendar clock. Counts saturate, and
//! nothing is allocated.

/// How a camera counts its frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IdKind {
    /// 64 bits that never wrap.
    Wide,
    /// 16 bits; after 65535 comes 1: zero is skipped (GigE Vision 1).
    Wrapping16SkippingZero,
    /// 16 bits; after 65535 comes 0.
    Wrapping16,
}

/// Kind of a frame, compared with those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameKind {
    /// The first frame.
    First,
    /// Newer than all before; `missed` ids are skipped.
    New {
        /// Missing frames (a late one is subtracted again, see [`FrameKind::Late`]).
        missed: u64,
    },
    /// Newer than all before, from a camera that restarted its count: its ids continue from the last one. The number of frames
    /// lost meanwhile is unknown.
    Restarted,
    /// An id that has come already.
    Doubled,
    /// A frame that comes after its successor: counted as missed before; it is not lost, but useless.
    Late,
    /// A new id whose time stamp has not advanced, or an older id with a newer stamp: the picture is unreliable.
    Stale,
    /// Its time stamp is in the future, by this many ns.
    Future {
        /// By how much.
        ahead_ns: i64,
    },
    /// Older than allowed when it arrived.
    Old {
        /// Its age.
        age_ns: i64,
    },
    /// An id that the camera never gives (zero, if it skips zero).
    Invalid,
}

impl FrameKind {
    /// Whether the frame carries a new picture.
    pub fn is_new(self) -> bool {
        matches!(self, Self::First | Self::New { .. } | Self::Restarted)
    }
}

/// A frame as it was judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Judged {
    /// Its kind.
    pub kind: FrameKind,
    /// Its id, unwrapped and continued over restarts of the camera; the newest frame's id if this one is not new.
    pub id: u64,
}

/// Counts, all saturating.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameCounts {
    /// Frames accepted as new.
    pub new: u64,
    /// Frames that never came, each counted once.
    pub lost: u64,
    /// Frames that came more than once.
    pub doubled: u64,
    /// Frames that came after their successor.
    pub late: u64,
    /// Frames whose time stamp says that the picture is not new, or too old.
    pub stale: u64,
    /// Frames stamped with a future time.
    pub future: u64,
    /// Number of restarts of the camera's count.
    pub restarts: u64,
    /// Frames with an id that does not exist.
    pub invalid: u64,
}

/// Newest frame accepted, or used up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Newest {
    raw: u64,
    id: u64,
    exposed_ns: i64,
    /// Which of the ids before it have come: bit `k` is the one `k + 1` before.
    come: u64,
}

/// The account.
#[derive(Debug, Clone)]
pub struct FrameAccount {
    kind: IdKind,
    period_ns: i64,
    oldest_ns: i64,
    newest: Option<Newest>,
    /// An older id with a newer stamp: with its successor, the sign of a restart.
    suspect: Option<(u64, i64)>,
    counts: FrameCounts,
}

/// Ids from 1 to 65535.
const PERIOD_SKIPPING_ZERO: u64 = 65_535;
/// Ids that are remembered one by one.
const REMEMBERED: u64 = 64;
/// Largest number of frames in a period of the loop; ids that rise faster belong to a new count.
const MOST_PER_PERIOD: i64 = 16;

impl FrameAccount {
    /// An account for a camera that counts as `kind` says and gives about a frame in `period_ns` (within a factor of 16). A frame
    /// older than `oldest_ns` on arrival is too old; `i64::MAX` if other code judges that.
    pub fn new(kind: IdKind, period_ns: i64, oldest_ns: i64) -> Self {
        Self {
            kind,
            period_ns: period_ns.max(1),
            oldest_ns,
            newest: None,
            suspect: None,
            counts: FrameCounts::default(),
        }
    }

    /// The counts so far.
    pub fn counts(&self) -> FrameCounts {
        self.counts
    }

    /// Takes note of a frame with the camera's `id`, exposed about `exposed_ns`, that arrived at `now_ns`.
    pub fn step(&mut self, id: u64, exposed_ns: i64, now_ns: i64) -> Judged {
        let kind = self.judge(id, exposed_ns, now_ns);
        if kind.is_new() {
            self.suspect = None;
        }
        let c = &mut self.counts;
        let counter = match kind {
            FrameKind::First => &mut c.new,
            FrameKind::New { missed } => {
                c.lost = c.lost.saturating_add(missed);
                &mut c.new
            }
            FrameKind::Restarted => {
                c.restarts = c.restarts.saturating_add(1);
                &mut c.new
            }
            FrameKind::Doubled => &mut c.doubled,
            FrameKind::Late => {
                c.lost = c.lost.saturating_sub(1);
                &mut c.late
            }
            FrameKind::Stale | FrameKind::Old { .. } => &mut c.stale,
            FrameKind::Future { .. } => &mut c.future,
            FrameKind::Invalid => &mut c.invalid,
        };
        *counter = counter.saturating_add(1);
        Judged {
            kind,
            id: self.newest.map_or(id, |newest| newest.id),
        }
    }

    fn judge(&mut self, raw: u64, exposed_ns: i64, now_ns: i64) -> FrameKind {
        let valid = match self.kind {
            IdKind::Wide => true,
            IdKind::Wrapping16SkippingZero => (1..=65_535).contains(&raw),
            IdKind::Wrapping16 => raw <= 65_535,
        };
        if !valid {
            return FrameKind::Invalid;
        }
        let age_ns = now_ns.saturating_sub(exposed_ns);
        let Some(newest) = self.newest else {
            let kind = self.of_age(age_ns).unwrap_or(FrameKind::First);
            if kind == FrameKind::First {
                self.newest = Some(Newest {
                    raw,
                    id: raw,
                    exposed_ns,
                    come: u64::MAX,
                });
            }
            return kind;
        };
        let ahead = self.ahead(raw, newest.raw);
        let newer = exposed_ns > newest.exposed_ns;
        if ahead <= 0 {
            return self.behind(newest, raw, ahead.unsigned_abs(), newer, exposed_ns, age_ns);
        }
        let since_ns = exposed_ns.saturating_sub(newest.exposed_ns);
        let possible = MOST_PER_PERIOD.saturating_add(
            since_ns
                .max(now_ns.saturating_sub(newest.exposed_ns))
                .max(0)
                / self.period_ns
                * MOST_PER_PERIOD,
        );
        if ahead > possible {
            return self.restart(newest, raw, exposed_ns, age_ns, newer);
        }
        let missed = ahead.unsigned_abs() - 1;
        let bad = self.of_age(age_ns).or((!newer).then_some(FrameKind::Stale));
        self.newest = Some(Newest {
            raw,
            id: newest.id.saturating_add(missed + 1),
            // Mark the id of a bad frame as used, so that the next frame does not count it as lost; ignore its stamp.
            exposed_ns: if bad.is_some() {
                newest.exposed_ns
            } else {
                exposed_ns
            },
            come: if missed + 1 < REMEMBERED {
                newest.come << (missed + 1) | 1 << missed
            } else {
                0
            },
        });
        match bad {
            Some(kind) => {
                self.counts.lost = self.counts.lost.saturating_add(missed);
                kind
            }
            None => FrameKind::New { missed },
        }
    }

    /// An id that is not above the newest.
    fn behind(
        &mut self,
        newest: Newest,
        raw: u64,
        by: u64,
        newer: bool,
        exposed_ns: i64,
        age_ns: i64,
    ) -> FrameKind {
        if by == 0 {
            return FrameKind::Doubled;
        }
        if !newer {
            if by > REMEMBERED || newest.come >> (by - 1) & 1 == 1 {
                return FrameKind::Doubled;
            }
            if let Some(newest) = &mut self.newest {
                newest.come |= 1 << (by - 1);
            }
            return FrameKind::Late;
        }
        self.restart(newest, raw, exposed_ns, age_ns, newer)
    }

    /// Takes an id that does not fit the count: two such ids in succession begin a new count.
    fn restart(
        &mut self,
        newest: Newest,
        raw: u64,
        exposed_ns: i64,
        age_ns: i64,
        newer: bool,
    ) -> FrameKind {
        if let Some(kind) = self.of_age(age_ns) {
            return kind;
        }
        if !newer {
            return FrameKind::Stale;
        }
        let follows = self.suspect.is_some_and(|(id, ns)| {
            (1..=MOST_PER_PERIOD).contains(&self.ahead(raw, id)) && exposed_ns > ns
        });
        if !follows {
            self.suspect = Some((raw, exposed_ns));
            return FrameKind::Stale;
        }
        self.newest = Some(Newest {
            raw,
            id: newest.id.saturating_add(1),
            exposed_ns,
            come: u64::MAX,
        });
        FrameKind::Restarted
    }

    /// The fault of an age, if any.
    fn of_age(&self, age_ns: i64) -> Option<FrameKind> {
        // Stamps of another clock, translated, may be early by the noise of the translation.
        if age_ns < -self.period_ns / 2 {
            Some(FrameKind::Future {
                ahead_ns: age_ns.saturating_neg(),
            })
        } else if age_ns > self.oldest_ns {
            Some(FrameKind::Old { age_ns })
        } else {
            None
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

    const MS: i64 = 1_000_000;

    fn account(kind: IdKind) -> FrameAccount {
        FrameAccount::new(kind, MS, 20 * MS)
    }

    #[test]
    fn sixteen_bit_ids_that_skip_zero_wrap_without_a_loss_and_come_out_unwrapped() {
        let mut a = account(IdKind::Wrapping16SkippingZero);
        for n in 0..200_000_u64 {
            let t = n as i64 * MS;
            let judged = a.step(n % 65_535 + 1, t, t + 2 * MS);
            assert!(judged.kind.is_new());
            assert_eq!(judged.id, n + 1);
        }
        let expected = FrameCounts {
            new: 200_000,
            ..FrameCounts::default()
        };
        assert_eq!(a.counts(), expected);
        assert_eq!(a.step(0, 0, 0).kind, FrameKind::Invalid);
    }

    #[test]
    fn losses_across_the_wrap_are_counted_exactly() {
        let mut a = account(IdKind::Wrapping16SkippingZero);
        a.step(65_533, 0, 0);
        assert_eq!(a.step(2, 4 * MS, 4 * MS).kind, FrameKind::New { missed: 3 });
        let mut b = account(IdKind::Wrapping16);
        b.step(65_533, 0, 0);
        assert_eq!(b.step(2, 5 * MS, 5 * MS).kind, FrameKind::New { missed: 4 });
    }

    #[test]
    fn doubled_late_stale_old_and_future_frames_are_told_apart() {
        let mut a = account(IdKind::Wide);
        let mut kind = |id, at: f64, now: f64| {
            let ns = |ms: f64| (ms * 1e6) as i64;
            a.step(id, ns(at), ns(now)).kind
        };
        assert_eq!(kind(10, 1000.0, 1002.0), FrameKind::First);
        assert_eq!(kind(10, 1000.0, 1003.0), FrameKind::Doubled);
        assert_eq!(kind(12, 1002.0, 1004.0), FrameKind::New { missed: 1 });
        assert_eq!(kind(11, 1001.0, 1004.5), FrameKind::Late);
        assert_eq!(kind(11, 1001.0, 1004.6), FrameKind::Doubled);
        assert_eq!(kind(13, 1002.0, 1005.0), FrameKind::Stale);
        assert_eq!(kind(14, 1004.0, 1100.0), FrameKind::Old { age_ns: 96 * MS });
        for (id, ahead_ms) in [(15, 10.0), (16, 3_600_000.0)] {
            let ahead_ns = ahead_ms as i64 * MS;
            let future = FrameKind::Future { ahead_ns };
            assert_eq!(kind(id, 1100.0 + ahead_ms, 1100.0), future);
        }
        // Their stamps are not trusted: the next one is newer than the last good one.
        assert_eq!(kind(18, 1200.0, 1200.0), FrameKind::New { missed: 1 });
        let expected = FrameCounts {
            new: 3,
            lost: 1,
            doubled: 2,
            late: 1,
            stale: 2,
            future: 2,
            restarts: 0,
            invalid: 0,
        };
        assert_eq!(a.counts(), expected);
    }

    #[test]
    fn a_lost_frame_is_counted_once_though_stale_ones_follow_it() {
        let mut a = FrameAccount::new(IdKind::Wide, MS, 5 * MS);
        let mut lost = 0;
        for id in 0..9000_i64 {
            // Every 30th frame is lost; the 20 after it are too old.
            let (gone, old) = (id % 30 == 7, (8..28).contains(&(id % 30)));
            if gone {
                lost += 1;
            } else {
                let age = if old { 9 } else { 2 };
                a.step(id as u64, id * MS, (id + age) * MS);
            }
        }
        assert_eq!(a.counts().lost, lost);
    }

    #[test]
    fn a_camera_that_restarts_goes_on_counting_from_where_it_was() {
        let mut a = account(IdKind::Wide);
        for n in 0..1000_i64 {
            a.step(5000 + n as u64, n * MS, (n + 2) * MS);
        }
        // Silent for half a second, then from 0: one frame is spent on finding out.
        let kinds: Vec<_> = (0..4_i64)
            .map(|n| a.step(n as u64, (1500 + n) * MS, (1502 + n) * MS))
            .collect();
        assert_eq!(kinds[0].kind, FrameKind::Stale);
        assert_eq!(kinds[1].kind, FrameKind::Restarted);
        assert_eq!(kinds[1].id, 6000);
        assert_eq!(kinds[3].kind, FrameKind::New { missed: 0 });
        assert_eq!(kinds[3].id, 6002);
        // And to a number far above: no thousands of lost frames.
        let far: Vec<_> = (0..3_i64)
            .map(|n| a.step(9_000_000 + n as u64, (1510 + n) * MS, (1512 + n) * MS))
            .collect();
        assert_eq!(far[1].kind, FrameKind::Restarted);
        assert_eq!(far[2].kind, FrameKind::New { missed: 0 });
        assert_eq!((a.counts().restarts, a.counts().lost), (2, 0));
    }

    #[test]
    fn one_old_buffer_with_a_new_stamp_is_no_restart() {
        let mut a = account(IdKind::Wide);
        for n in 0..100_i64 {
            let id = if n % 10 == 9 { n - 5 } else { n };
            let kind = a.step(id as u64, n * MS, (n + 2) * MS).kind;
            assert_eq!(kind.is_new(), n % 10 != 9, "{n}: {kind:?}");
        }
        assert_eq!(a.counts().restarts, 0);
    }

    #[test]
    fn ids_and_times_at_their_ends_are_no_trouble() {
        let mut a = account(IdKind::Wide);
        for (id, ns) in [
            (u64::MAX - 1, i64::MAX - 3),
            (u64::MAX, i64::MAX - 2),
            (0, i64::MAX - 1),
            (1, i64::MIN),
            (u64::MAX / 2, i64::MAX),
        ] {
            a.step(id, ns, i64::MAX);
            a.step(id, ns, i64::MIN);
        }
    }
}
