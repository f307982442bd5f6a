//! Whether the board does what it is told: judged from its reports, beside the loop.
//!
//! Three things go wrong without a word from the board: another host has armed it, it takes commands and obeys none, or
//! its output is not where the commands were. A report that is late by the line is none of these: each must last.

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

/// Commands that are remembered, and for how long they may explain where the output stands, ns.
const REMEMBERED: usize = 64;
const EXPLAINS_NS: i64 = 30_000_000;
/// Trouble must last for so long, ns.
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
    /// When and where to, newest last.
    given: [(i64, f64); REMEMBERED],
    next: usize,
}

impl BoardWatch {
    pub(crate) fn new() -> Self {
        Self {
            session: None,
            state: None,
            last_seq: None,
            moved_ns: 0,
            commands: 0,
            off_since_ns: None,
            given: [(i64::MIN, f64::NAN); REMEMBERED],
            next: 0,
        }
    }

    /// A command was handed over.
    pub(crate) fn commanded(&mut self, now_ns: i64, command_um: f64) {
        self.commands = self.commands.saturating_add(1);
        if let Some(slot) = self.given.get_mut(self.next) {
            *slot = (now_ns, command_um);
        }
        self.next = (self.next + 1) % REMEMBERED;
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
        } else if self.commands >= COMMANDS && now_ns - self.moved_ns > LASTS_NS {
            return Some(BoardTrouble::NotObeying);
        }
        if report.state == ActuatorState::Holding || self.explains(now_ns, report.applied_um) {
            self.off_since_ns = None;
            return None;
        }
        let since_ns = *self.off_since_ns.get_or_insert(now_ns);
        (now_ns - since_ns > LASTS_NS).then_some(BoardTrouble::NotFollowing)
    }

    /// Whether a displacement lies among the commands of the last moments and the one before them.
    fn explains(&self, now_ns: i64, applied_um: f64) -> bool {
        let (mut low_um, mut high_um) = (f64::INFINITY, f64::NEG_INFINITY);
        for ago in 1..=REMEMBERED {
            let at = (self.next + REMEMBERED - ago) % REMEMBERED;
            let Some(&(ns, um)) = self.given.get(at).filter(|(_, um)| um.is_finite()) else {
                break;
            };
            (low_um, high_um) = (low_um.min(um), high_um.max(um));
            if ns < now_ns - EXPLAINS_NS {
                break;
            }
        }
        // Nothing was commanded yet, or a report is not a number that could be compared.
        low_um > high_um || (low_um - OFF_UM..=high_um + OFF_UM).contains(&applied_um)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_rig::ActuatorFault;

    const MS: i64 = 1_000_000;

    /// A second of a slow sine at a board that answers with a report each millisecond; the first trouble and when, ms.
    fn watch(answer: impl Fn(i64, f64, &mut ActuatorReport)) -> Option<(BoardTrouble, i64)> {
        let mut watch = BoardWatch::new();
        for k in 0..1000 {
            let command_um = 20.0 + 5.0 * (k as f64 * 0.03).sin();
            watch.commanded(k * MS, command_um);
            let mut report = ActuatorReport {
                session: 7,
                state: ActuatorState::Running,
                fault: ActuatorFault::None,
                applied_um: command_um,
                last_seq: u32::try_from(k).ok(),
                last_time_us: 0,
                device_time_us: 0,
                bad_frames: 0,
                ignored: 0,
                holds: 0,
                read_ns: k * MS,
            };
            answer(k, command_um, &mut report);
            if let Some(trouble) = watch.heard(k * MS, &report) {
                return Some((trouble, k));
            }
        }
        None
    }

    #[test]
    fn a_board_that_follows_late_or_rests_is_no_trouble() {
        assert_eq!(watch(|_, _, _| ()), None);
        let late = |k: i64, _: f64, report: &mut ActuatorReport| {
            report.applied_um = 20.0 + 5.0 * ((k - 20).max(0) as f64 * 0.03).sin();
            report.last_seq = u32::try_from(k / 50).ok();
        };
        assert_eq!(watch(late), None);
        // Commands reach it again within 100 ms, and it holds no more; or nothing of what is commanded ever reaches it.
        let rests = |until: i64| {
            move |k: i64, _: f64, report: &mut ActuatorReport| {
                if (200..until).contains(&k) {
                    report.state = ActuatorState::Holding;
                    report.applied_um = 20.0;
                    report.last_seq = Some(199);
                }
            }
        };
        assert_eq!(watch(rests(300)), None);
        assert_eq!(watch(rests(600)), Some((BoardTrouble::NotObeying, 301)));
    }

    #[test]
    fn another_session_a_sequence_that_stands_and_an_output_elsewhere_are_told_apart() {
        let foreign = |k: i64, _: f64, report: &mut ActuatorReport| {
            report.session = if k < 300 { 7 } else { 8 };
        };
        assert_eq!(watch(foreign), Some((BoardTrouble::Foreign, 300)));
        let deaf = |k: i64, _: f64, report: &mut ActuatorReport| {
            report.last_seq = u32::try_from(k.min(300)).ok();
        };
        assert_eq!(watch(deaf), Some((BoardTrouble::NotObeying, 401)));
        let elsewhere = |k: i64, um: f64, report: &mut ActuatorReport| {
            report.applied_um = if k < 300 { um } else { 31.0 };
        };
        assert_eq!(watch(elsewhere), Some((BoardTrouble::NotFollowing, 401)));
        let nowhere = |_: i64, _: f64, report: &mut ActuatorReport| report.applied_um = f64::NAN;
        assert_eq!(
            watch(nowhere).map(|t| t.0),
            Some(BoardTrouble::NotFollowing)
        );
    }
}
