//! Tests of an armed, moving board: commands that it obeys, range and slew of its output.

use super::sheet::Sheet;
use super::talk::{ANSWER_MS, Talk};
use super::trial::{Trial, of, um};
use cellpos_link::{Arm, BoardState, Identity, Limits, Request, Status, ToBoard, ToHost};
use cellpos_session::Failure;

/// Limits of the test motion, pm and nm/s.
#[derive(Debug, Clone, Copy)]
pub(super) struct Range {
    pub(super) low_pm: i32,
    pub(super) base_pm: i32,
    pub(super) high_pm: i32,
    pub(super) park_pm: i32,
    /// Park of a board that knows of no session.
    pub(super) own_park_pm: i32,
    pub(super) slew_nm_per_s: u32,
    /// Rate at which the output moves to park.
    pub(super) ramp_nm_per_s: u32,
    /// One step of the converter.
    pub(super) step_pm: i32,
}

/// Watchdog of the trial's sessions, long enough that a short stop of the host is not silence. The test of silence uses a shorter
/// one.
const WATCHDOG_MS: u16 = 500;
/// An abandoned session parks automatically.
const HOLD_WATCHDOG_MS: u16 = 3000;

impl Range {
    /// Limits within the ranges of board and rig file, as near to park as there is room; `None` if there is no room.
    pub(super) fn of(identity: &Identity, trial: &Trial) -> Option<Self> {
        let pm = cellpos_link::picometres;
        let own = identity.limits;
        let [low_um, high_um, slew_um_per_s] = trial.limits_um;
        let (low, high) = (own.low_pm.max(pm(low_um)?), own.high_pm.min(pm(high_um)?));
        let amplitude = pm(trial.amplitude_um)?;
        // A part of the amplitude on each side remains free for commands that must be refused.
        let room = amplitude.checked_mul(3)? / 2;
        if low.checked_add(room)? >= high.checked_sub(room)? {
            return None;
        }
        let park_pm = pm(trial.park_um)?.clamp(own.low_pm, own.high_pm);
        let base_pm = park_pm.clamp(low + room, high - room);
        let slew = own.slew_nm_per_s.min((slew_um_per_s * 1e3) as u32);
        // From one end to the other in a tenth of a second: that gives a hundred statuses, timed by the board's own clock.
        let slow = (f64::from(amplitude) * 2e-3 / 0.1) as u32;
        let codes = (1_i64 << identity.dac_bits) - 1;
        let step = (i64::from(own.high_pm) - i64::from(own.low_pm)) / codes.max(1);
        Some(Self {
            low_pm: base_pm - amplitude,
            base_pm,
            high_pm: base_pm + amplitude,
            park_pm,
            own_park_pm: identity.park_pm,
            slew_nm_per_s: slow.clamp(1, slew.max(1)),
            ramp_nm_per_s: identity.ramp_nm_per_s,
            step_pm: i32::try_from(step).ok()?,
        })
    }

    /// A session within it.
    pub(super) fn arm(&self, session: u16) -> Arm {
        Arm {
            watchdog_ms: Some(WATCHDOG_MS),
            hold_watchdog_ms: Some(HOLD_WATCHDOG_MS),
            park_pm: Some(self.park_pm),
            limits: Some(Limits {
                low_pm: self.low_pm,
                high_pm: self.high_pm,
                slew_nm_per_s: self.slew_nm_per_s,
            }),
            ..Arm::session(session)
        }
    }

    /// Time for a distance at the session's slew or, for `park`, at the ramp, ms; with a margin for a late machine.
    pub(super) fn way_ms(&self, from_pm: i32, to_pm: i32) -> f64 {
        let rate = f64::from(self.slew_nm_per_s.min(self.ramp_nm_per_s)) * 1e3;
        1e3 * f64::from((to_pm - from_pm).abs()) / rate.max(1.0) + 500.0
    }

    /// Waits until the output is within a step and a half of a displacement; returns the last output.
    pub(super) fn settle(&self, t: &mut Talk, at_pm: i32) -> Result<Status, Failure> {
        let mut status = t.must_status()?;
        let end_ns = t.now_ns() + (self.way_ms(status.applied_pm, at_pm) * 1e6) as i64;
        while !self.is_at(&status, at_pm) && t.now_ns() < end_ns {
            t.listen(5.0)?;
            status = t.must_status()?;
        }
        Ok(status)
    }

    /// Brings the output to park by a session of its own, and ends that: a board that had none since it was switched on knows only
    /// its own park, which may be far from the rig's.
    pub(super) fn park(&self, t: &mut Talk) -> Result<(), Failure> {
        let mut armed = self.session(t, |_| {}, None)?;
        if armed.as_ref().is_err_and(|why| why == "state") {
            // After a reset it goes to its own park before anything else.
            self.settle(t, self.own_park_pm)?;
            armed = self.session(t, |_| {}, None)?;
        }
        if armed.is_ok() {
            t.request(&ToBoard::Park, Request::Park)?.ok();
            self.settle(t, self.park_pm)?;
            t.request(&ToBoard::Disarm, Request::Disarm)?.ok();
        }
        Ok(())
    }

    /// Whether the output is there, within a step and a half of the converter.
    pub(super) fn is_at(&self, status: &Status, at_pm: i32) -> bool {
        2 * (status.applied_pm - at_pm).abs() <= 3 * self.step_pm
    }

    /// Arms a new session, and sends a first command if `first` gives a displacement.
    pub(super) fn session(
        &self,
        t: &mut Talk,
        change: impl Fn(&mut Arm),
        first: Option<(i32, i32)>,
    ) -> Result<Result<(), String>, Failure> {
        t.session = t.session.wrapping_add(1);
        t.seq = 0;
        let mut arm = self.arm(t.session);
        change(&mut arm);
        let armed = t.request(&ToBoard::Arm(arm), Request::Arm)?;
        if let (Ok(()), Some((displacement_pm, neutral_pm))) = (&armed, first) {
            t.command(displacement_pm, neutral_pm)?;
        }
        Ok(armed)
    }
}

/// The lines of a moving board; false if it could not be armed.
pub(super) fn moves(sheet: &mut Sheet, t: &mut Talk, range: &Range) -> Result<bool, Failure> {
    if !arms(sheet, t, range)? {
        return Ok(false);
    }
    follows(sheet, t, range)?;
    old_ones(sheet, t, range)?;
    bounds(sheet, t, range)?;
    foreign(sheet, t, range)?;
    Ok(true)
}

fn arms(sheet: &mut Sheet, t: &mut Talk, range: &Range) -> Result<bool, Failure> {
    // Park may be outside the session; the board stays there until a command.
    let before = t.must_status()?;
    let armed = range.session(t, |_| {}, None)?;
    t.listen(50.0)?;
    let after = t.must_status()?;
    let moved_pm = (after.applied_pm - before.applied_pm).abs();
    let good = armed.is_ok()
        && after.state == BoardState::Armed
        && after.session == t.session
        && after.last_seq.is_none()
        && moved_pm <= range.step_pm;
    sheet.judge(
        of("arms and stays where it is"),
        good,
        (um(moved_pm), "um"),
        "ack (arm), state armed, the session's number, no motion",
        format!(
            "{}, state {:?}, session {}",
            armed.as_ref().err().map_or("ack", String::as_str),
            after.state,
            if after.session == t.session {
                "ours"
            } else {
                "another"
            }
        ),
    );
    if armed.is_err() {
        return Ok(false);
    }
    let command = t.command_of(t.session.wrapping_add(7), 0, range.base_pm, range.base_pm);
    t.send(&command)?;
    let now = t.must_status()?;
    sheet.judge(
        of("ignores a foreign session's command"),
        now.state == BoardState::Armed && now.ignored == after.ignored + 1,
        (f64::from(now.ignored.wrapping_sub(after.ignored)), ""),
        "state stays armed, ignored rises by 1",
        format!("state {:?}", now.state),
    );
    Ok(true)
}

/// Sends all commands, one per millisecond, and returns the statuses that arrived.
fn drive(
    t: &mut Talk,
    count: u32,
    mut to_pm: impl FnMut(u32) -> (i32, i32),
) -> Result<Vec<Status>, Failure> {
    t.pump()?;
    t.heard.clear();
    let mut due_ns = t.now_ns();
    for n in 0..count {
        t.sleep_until_ns(due_ns);
        let (displacement_pm, neutral_pm) = to_pm(n);
        t.command(displacement_pm, neutral_pm)?;
        t.pump()?;
        due_ns = (due_ns + 1_000_000).max(t.now_ns());
    }
    t.listen(30.0)?;
    Ok(t.statuses().copied().collect())
}

fn follows(sheet: &mut Sheet, t: &mut Talk, range: &Range) -> Result<(), Failure> {
    t.pump()?;
    t.heard.clear();
    let start_ns = t.now_ns();
    let seq = t.command(range.base_pm, range.base_pm)?;
    let answer = t.wait_since(start_ns, ANSWER_MS, |m| match m {
        ToHost::Status(status) if status.last_seq == Some(seq) => Some(*status),
        _ => None,
    })?;
    let ms = answer.as_ref().map_or(f64::NAN, |(_, ms)| *ms);
    let state = answer.map(|(status, _)| status.state);
    sheet.judge(
        of("answers a command"),
        state == Some(BoardState::Running) && ms < 10.0,
        (ms, "ms"),
        "status with its number, state running, within 10 ms",
        state.map_or_else(
            || "no status".to_owned(),
            |state| format!("{state:?}").to_lowercase(),
        ),
    );
    range.settle(t, range.base_pm)?;
    let from = t.seq;
    const COMMANDS: u32 = 200;
    let statuses = drive(t, COMMANDS, |_| (range.base_pm, range.base_pm))?;
    let named = (from..from + COMMANDS)
        .filter(|seq| statuses.iter().any(|status| status.last_seq == Some(*seq)))
        .count();
    sheet.judge(
        of("status after each command"),
        named as u32 == COMMANDS,
        (f64::from(COMMANDS) - named as f64, "commands"),
        "none of them unnamed",
        format!("{named} of {COMMANDS} named by a status"),
    );
    Ok(())
}

fn old_ones(sheet: &mut Sheet, t: &mut Talk, range: &Range) -> Result<(), Failure> {
    let before = t.must_status()?;
    let last = before.last_seq.unwrap_or(0);
    // The same again, an older one, and one from half the circle ahead on.
    for seq in [last, last.wrapping_sub(1), last.wrapping_add(1 << 31)] {
        let command = t.command_of(t.session, seq, range.high_pm, range.base_pm);
        t.send(&command)?;
    }
    t.listen(20.0)?;
    let after = t.must_status()?;
    let rise = after.ignored.wrapping_sub(before.ignored);
    let still = (after.applied_pm - before.applied_pm).abs() <= range.step_pm;
    sheet.judge(
        of("ignores old and doubled commands"),
        rise == 3 && still && after.last_seq == before.last_seq,
        (f64::from(rise), ""),
        "ignored rises by 3, the output stays",
        format!(
            "moved by {:.4} um",
            um(after.applied_pm - before.applied_pm)
        ),
    );
    Ok(())
}

/// Range and slew at the output, as the board reports it, from one end to the other.
fn bounds(sheet: &mut Sheet, t: &mut Talk, range: &Range) -> Result<(), Failure> {
    let amplitude_pm = range.high_pm - range.base_pm;
    let before = t.must_status()?;
    t.command(range.high_pm + amplitude_pm / 4, range.base_pm)?;
    let top = range.settle(t, range.high_pm)?;
    let mut highest_pm = top.applied_pm;
    // Hold for a while: the output may not creep beyond.
    let held = drive(t, 50, |_| (range.high_pm + amplitude_pm / 4, range.base_pm))?;
    highest_pm = held
        .iter()
        .map(|status| status.applied_pm)
        .fold(highest_pm, i32::max);
    let clipped = t.must_status()?.clipped.wrapping_sub(before.clipped);
    let beyond_pm = highest_pm - range.high_pm;
    sheet.judge(
        of("range at the output"),
        range.is_at(&top, range.high_pm) && beyond_pm <= range.step_pm && clipped == 51,
        (um(beyond_pm), "um"),
        "the output goes to the end of the session's range and not beyond; each command outside is counted",
        format!("{clipped} of 51 counted as clipped, output at {:.4} um", um(highest_pm)),
    );
    let statuses = drive(t, 300, |_| (range.low_pm, range.base_pm))?;
    let (steepest, reached) = slew(range, &statuses);
    let allowed = f64::from(range.slew_nm_per_s) * 1e-3;
    sheet.judge(
        of("slew at the output"),
        steepest <= allowed && reached >= 0.9 * allowed,
        (steepest, "um/s"),
        format!("at most {allowed:.2} um/s over any window, and reached"),
        format!(
            "from {:.3} to {:.3} um; {reached:.2} um/s over the way",
            um(range.high_pm),
            um(range.low_pm)
        ),
    );
    t.command(range.base_pm, range.base_pm)?;
    range.settle(t, range.base_pm)?;
    Ok(())
}

/// Steepest slope between any two statuses, minus a step of the converter and one update (100 us), and the slope over the middle
/// of the way, um/s.
fn slew(range: &Range, statuses: &[Status]) -> (f64, f64) {
    const UPDATE_US: f64 = 100.0;
    let slope = |a: &Status, b: &Status, slack_us: f64, slack_pm: f64| {
        let us = b.board_time_us.saturating_sub(a.board_time_us) as f64 + slack_us;
        let pm = (f64::from(b.applied_pm) - f64::from(a.applied_pm)).abs() - slack_pm;
        if us > 0.0 { (pm / us).max(0.0) } else { 0.0 }
    };
    let mut steepest = 0.0_f64;
    for (n, a) in statuses.iter().enumerate() {
        for b in statuses.iter().skip(n + 1) {
            steepest = steepest.max(slope(a, b, UPDATE_US, f64::from(range.step_pm)));
        }
    }
    let way = f64::from(range.high_pm - range.low_pm);
    let part = |status: &&Status| {
        let done = f64::from(range.high_pm - status.applied_pm) / way;
        (0.1..0.9).contains(&done)
    };
    let middle: Vec<&Status> = statuses.iter().filter(part).collect();
    let reached = match (middle.first(), middle.last()) {
        (Some(a), Some(b)) => slope(a, b, 0.0, 0.0),
        _ => 0.0,
    };
    (steepest, reached)
}

/// Another host while a session is running, and the LED.
fn foreign(sheet: &mut Sheet, t: &mut Talk, range: &Range) -> Result<(), Failure> {
    t.command(range.base_pm, range.base_pm)?;
    let other = Arm {
        session: t.session.wrapping_add(1),
        ..range.arm(0)
    };
    let answer = t.request(&ToBoard::Arm(other), Request::Arm)?;
    let status = t.must_status()?;
    sheet.judge(
        of("refuses a foreign session"),
        answer.as_ref().is_err_and(|why| why == "busy") && status.session == t.session,
        (None, ""),
        "refused (arm, busy) while commands of this one are fresh",
        answer.err().unwrap_or_else(|| "armed".to_string()),
    );
    t.command(range.base_pm, range.base_pm)?;
    let mut seen = Vec::new();
    for on in [true, false] {
        let answer = t.request(&ToBoard::Led { on }, Request::Led)?;
        seen.push(answer.is_ok() && t.must_status()?.led == on);
    }
    sheet.judge(
        of("switches the LED"),
        seen == [true, true],
        (None, ""),
        "ack (led), and the status says so, on and off",
        "",
    );
    Ok(())
}
