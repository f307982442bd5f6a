//! Whether the board obeys its commands, judged from its reports.
//!
//! The board reports none of three troubles: another host has armed it, it takes commands and obeys none, or its output is not where the
//! commands were. A report names the newest command by its host time. The output is compared with that command and with those shortly
//! before it, however late the report comes. A trouble counts when it lasts.

use cellpos_rig::{ActuatorReport, ActuatorState};

/// What is wrong with a board that talks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BoardTrouble {
    /// It is in another session than the one it was in when the run began: another host has armed it.
    Foreign,
    /// Commands are handed over, and the last one that it obeyed stays the same.
    NotObeying,
    /// It obeys, and its output stands where no command of the last moments was.
    NotFollowing,
}

/// Commands that are remembered: a second at 1 kHz. A report under an older one says nothing.
const REMEMBERED: usize = 1024;
/// Older commands may explain an output for this long, us. A board that interpolates, or whose slew is less than the loop's, is still on
/// its way from them.
const EXPLAINS_US: u64 = 30_000;
/// An output that is off must be so for this long, ns.
const LASTS_NS: i64 = 100_000_000;
/// Commands handed over meanwhile, at least: a loop that stood still gave none to obey.
const COMMANDS: u32 = 20;
/// Distance of the output from the commands that counts, um: far above a converter's step and a tick's slew.
const OFF_UM: f64 = 0.2;

/// The watch.
#[derive(Debug, Clone)]
pub(crate) struct BoardWatch {
    session: Option<u16>,
    state: Option<ActuatorState>,
    last_seq: Option<u32>,
    moved_ns: i64,
    commands: u32,
    off_since_ns: Option<i64>,
    /// Host time of each command, us, and its displacement, um.
    given: Box<[(u64, f64); REMEMBERED]>,
    next: usize,
    /// Commands that reach nobody are the line's silence in one direction: as long is waited as for the other, ns.
    silence_ns: i64,
}

impl BoardWatch {
    pub(crate) fn new(silence_ns: i64) -> Self {
        Self {
            silence_ns,
            session: None,
            state: None,
            last_seq: None,
            moved_ns: 0,
            commands: 0,
            off_since_ns: None,
            given: Box::new([(0, f64::NAN); REMEMBERED]),
            next: 0,
        }
    }

    /// A command was handed over, with its host time, us.
    pub(crate) fn commanded(&mut self, time_us: u64, command_um: f64) {
        self.commands = self.commands.saturating_add(1);
        if let Some(slot) = self.given.get_mut(self.next) {
            *slot = (time_us, command_um);
        }
        self.next = (self.next + 1) % REMEMBERED;
    }

    /// Commands handed over before were not taken by the line: the board cannot obey them.
    pub(crate) fn not_taken(&mut self, count: u64) {
        let count = u32::try_from(count).unwrap_or(u32::MAX);
        self.commands = self.commands.saturating_sub(count);
    }

    /// The board reported.
    pub(crate) fn heard(&mut self, now_ns: i64, report: &ActuatorReport) -> Option<BoardTrouble> {
        if *self.session.get_or_insert(report.session) != report.session {
            return Some(BoardTrouble::Foreign);
        }
        // A board that begins to hold had heard nothing for its watchdog time, perhaps because this program stood still: it is
        // given as long again. Each command that reaches it ends the holding.
        let heeds = matches!(
            report.state,
            ActuatorState::Running | ActuatorState::Holding
        );
        if self.state.replace(report.state) != Some(report.state) || !heeds {
            (self.moved_ns, self.commands, self.off_since_ns) = (now_ns, 0, None);
        }
        if !heeds {
            return None;
        }
        if report.last_seq != self.last_seq {
            (self.last_seq, self.moved_ns, self.commands) = (report.last_seq, now_ns, 0);
        } else if self.commands >= COMMANDS && now_ns - self.moved_ns > self.silence_ns {
            return Some(BoardTrouble::NotObeying);
        }
        if report.state == ActuatorState::Holding || self.explains(report) {
            self.off_since_ns = None;
            return None;
        }
        let since_ns = *self.off_since_ns.get_or_insert(now_ns);
        (now_ns - since_ns > LASTS_NS).then_some(BoardTrouble::NotFollowing)
    }

    /// Whether the output that a report tells lies among the command that it names, those shortly before it and the one before those. An
    /// output counts as explained if there is no command to compare it with: none was obeyed, or it is no longer remembered.
    fn explains(&self, report: &ActuatorReport) -> bool {
        if report.last_seq.is_none() {
            return true;
        }
        let named_us = report.last_time_us;
        let mut range_um: Option<(f64, f64)> = None;
        for ago in 1..=REMEMBERED {
            let at = (self.next + REMEMBERED - ago) % REMEMBERED;
            let Some(&(us, um)) = self.given.get(at).filter(|(_, um)| um.is_finite()) else {
                break;
            };
            if range_um.is_none() && us > named_us {
                continue;
            }
            let (low_um, high_um) = range_um.unwrap_or((um, um));
            range_um = Some((low_um.min(um), high_um.max(um)));
            if us.saturating_add(EXPLAINS_US) < named_us {
                break;
            }
        }
        range_um.is_none_or(|(low_um, high_um)| {
            (low_um - OFF_UM..=high_um + OFF_UM).contains(&report.applied_um)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_rig::ActuatorFault;

    const MS: i64 = 1_000_000;

    /// Displacement commanded in a millisecond, um.
    fn command_um(k: i64) -> f64 {
        20.0 + 5.0 * (k.max(0) as f64 * 0.03).sin()
    }

    /// A second of a slow sine at a board that answers with a report each millisecond; the first trouble and when, ms.
    fn watch(answer: impl Fn(i64, &mut ActuatorReport)) -> Option<(BoardTrouble, i64)> {
        let mut watch = BoardWatch::new(200 * MS);
        for k in 0..1000_i64 {
            watch.commanded(1000 * k.unsigned_abs(), command_um(k));
            let mut report = ActuatorReport {
                session: 7,
                state: ActuatorState::Running,
                fault: ActuatorFault::None,
                applied_um: 0.0,
                last_seq: None,
                last_time_us: 0,
                device_time_us: 0,
                bad_frames: 0,
                ignored: 0,
                holds: 0,
                read_ns: k * MS,
            };
            under(k, &mut report);
            answer(k, &mut report);
            if let Some(trouble) = watch.heard(k * MS, &report) {
                return Some((trouble, k));
            }
        }
        None
    }

    /// A report under the command of a millisecond.
    fn under(k: i64, report: &mut ActuatorReport) {
        report.applied_um = command_um(k);
        report.last_seq = u32::try_from(k).ok();
        report.last_time_us = 1000 * k.max(0).unsigned_abs();
    }

    #[test]
    fn a_board_that_follows_late_or_rests_is_no_trouble() {
        assert_eq!(watch(|_, _| ()), None);
        // Its reports come late by a line's delay, 80 ms and more, and name the commands that they were made under.
        for late in [20, 80, 300] {
            let answer = |k: i64, report: &mut ActuatorReport| {
                under(k - late, report);
                if k < late {
                    report.state = ActuatorState::Armed;
                }
            };
            assert_eq!(watch(answer), None, "{late} ms");
        }
        // Every fiftieth command gets through, and it goes there with 20 ms of lag.
        let lags = |k: i64, report: &mut ActuatorReport| {
            let named = k / 50 * 50;
            under(named, report);
            report.applied_um = command_um(named - 20);
        };
        assert_eq!(watch(lags), None);
        // Commands reach it again within 100 ms, and it holds no more; or nothing of what is commanded ever reaches it.
        let rests = |until: i64| {
            move |k: i64, report: &mut ActuatorReport| {
                if (200..until).contains(&k) {
                    under(199, report);
                    report.state = ActuatorState::Holding;
                    report.applied_um = 20.0;
                }
            }
        };
        assert_eq!(watch(rests(300)), None);
        assert_eq!(watch(rests(600)), Some((BoardTrouble::NotObeying, 401)));
    }

    #[test]
    fn another_session_a_sequence_that_stands_and_an_output_elsewhere_are_told_apart() {
        let foreign = |k: i64, report: &mut ActuatorReport| {
            report.session = if k < 300 { 7 } else { 8 };
        };
        assert_eq!(watch(foreign), Some((BoardTrouble::Foreign, 300)));
        let deaf = |k: i64, report: &mut ActuatorReport| under(k.min(300), report);
        assert_eq!(watch(deaf), Some((BoardTrouble::NotObeying, 501)));
        let elsewhere = |k: i64, report: &mut ActuatorReport| {
            if k >= 300 {
                report.applied_um = 31.0;
            }
        };
        assert_eq!(watch(elsewhere), Some((BoardTrouble::NotFollowing, 401)));
        // Late or not: an output that is not where the command that it names was.
        let late = |k: i64, report: &mut ActuatorReport| {
            under(k - 80, report);
            if k >= 380 {
                report.applied_um = 31.0;
            }
        };
        assert_eq!(watch(late), Some((BoardTrouble::NotFollowing, 481)));
        let nowhere = |_: i64, report: &mut ActuatorReport| report.applied_um = f64::NAN;
        assert_eq!(
            watch(nowhere).map(|t| t.0),
            Some(BoardTrouble::NotFollowing)
        );
    }
}
