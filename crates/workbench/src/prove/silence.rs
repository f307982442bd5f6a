//! Tests of a board in silence, and of requested stops.

use super::moves::Range;
use super::sheet::Sheet;
use super::talk::Talk;
use super::trial::{of, um};
use cellpos_link::{BoardState, Fault, Request, ToBoard, ToHost};
use cellpos_session::Failure;

/// Watchdogs of the trial, ms: long enough that a machine under load can feed the first one, short enough to wait for.
const WATCHDOG_MS: u16 = 100;
const HOLD_MS: u16 = 300;
/// Time that the board's own step and its message may add to a watchdog, ms.
const LATE_MS: f64 = 2.0;

/// The lines of silence and of stops; the board is left disarmed and at park.
pub(super) fn silence(sheet: &mut Sheet, t: &mut Talk, range: &Range) -> Result<(), Failure> {
    let amplitude_pm = range.high_pm - range.base_pm;
    // Away from zero flow, so that the motion to it is visible.
    let (at_pm, neutral_pm) = (
        range.base_pm + amplitude_pm / 2,
        range.base_pm - amplitude_pm / 4,
    );
    holds(sheet, t, range, (at_pm, neutral_pm))?;
    parks_alone(sheet, t, range, (at_pm, neutral_pm))?;
    freezes(sheet, t, range, (at_pm, neutral_pm))?;
    stops(sheet, t, range, (at_pm, neutral_pm))
}

/// Arms with the short watchdogs and moves to a place while it feeds the watchdog; returns the reason if it is not
/// armed.
fn go(
    t: &mut Talk,
    range: &Range,
    hold_ms: u16,
    (at_pm, neutral_pm): (i32, i32),
) -> Result<Result<(), String>, Failure> {
    // A new session releases a board that an earlier one left; it parks first if moving.
    t.request(&ToBoard::Disarm, Request::Disarm)?.ok();
    range.settle(t, range.park_pm)?;
    let change = |arm: &mut cellpos_link::Arm| {
        arm.watchdog_ms = Some(WATCHDOG_MS);
        arm.hold_watchdog_ms = Some(hold_ms);
    };
    let armed = range.session(t, change, Some((at_pm, neutral_pm)))?;
    let end_ns = t.now_ns() + (range.way_ms(range.park_pm, at_pm) * 1e6) as i64;
    let mut status = t.must_status()?;
    while armed.is_ok() && !range.is_at(&status, at_pm) && t.now_ns() < end_ns {
        t.command(at_pm, neutral_pm)?;
        t.listen(2.0)?;
        status = t.must_status()?;
    }
    Ok(armed)
}

/// Board time at which the newest command was obeyed, and time of the first status in a later state, us.
fn turned(t: &Talk, seq: u32, state: BoardState) -> Option<(u64, u64)> {
    let obeyed = t
        .statuses()
        .find(|s| s.last_seq == Some(seq) && s.state == BoardState::Running)?
        .board_time_us;
    let turned = t
        .statuses()
        .find(|s| s.state == state && s.board_time_us >= obeyed)?
        .board_time_us;
    Some((obeyed, turned))
}

fn holds(
    sheet: &mut Sheet,
    t: &mut Talk,
    range: &Range,
    (at_pm, neutral_pm): (i32, i32),
) -> Result<(), Failure> {
    // A long hold, during which it must not park.
    let armed = go(t, range, 5000, (at_pm, neutral_pm))?;
    t.pump()?;
    t.heard.clear();
    let seq = t.command(at_pm, neutral_pm)?;
    t.listen(f64::from(WATCHDOG_MS) + 100.0)?;
    let ms = turned(t, seq, BoardState::Holding)
        .map_or(f64::NAN, |(from, to)| (to - from) as f64 * 1e-3);
    let told = t.heard.iter().any(|(_, m)| {
        matches!(
            m,
            ToHost::Fault {
                fault: Fault::CommandTimeout,
                ..
            }
        )
    });
    let rest = range.settle(t, neutral_pm)?;
    let wanted = f64::from(WATCHDOG_MS);
    let in_time = (wanted - 0.5..wanted + LATE_MS).contains(&ms);
    sheet.judge(
        of("holds on silence"),
        in_time && told && range.is_at(&rest, neutral_pm) && rest.state == BoardState::Holding,
        (ms, "ms"),
        format!(
            "{wanted} to {} ms after the last command, by its own clock: holding, at the last zero flow, with a fault message",
            wanted + LATE_MS
        ),
        format!(
            "{}; fault message: {}; at {:.4} um, zero flow {:.4} um",
            armed.err().unwrap_or_else(|| format!("state {:?}", rest.state).to_lowercase()),
            if told { "came" } else { "none" },
            um(rest.applied_pm),
            um(neutral_pm)
        ),
    );
    t.command(at_pm, neutral_pm)?;
    let again = t.must_status()?;
    sheet.judge(
        of("takes up again"),
        again.state == BoardState::Running && again.holds >= 1 && again.fault == Fault::None,
        (f64::from(again.holds), "holds"),
        "running with the next fresh command, no fault in force, the hold counted",
        format!("state {:?}, fault {:?}", again.state, again.fault).to_lowercase(),
    );
    Ok(())
}

fn parks_alone(
    sheet: &mut Sheet,
    t: &mut Talk,
    range: &Range,
    places: (i32, i32),
) -> Result<(), Failure> {
    go(t, range, HOLD_MS, places)?.ok();
    t.pump()?;
    t.heard.clear();
    let seq = t.command(places.0, places.1)?;
    t.listen(f64::from(WATCHDOG_MS + HOLD_MS) + 100.0)?;
    let ms =
        turned(t, seq, BoardState::Safe).map_or(f64::NAN, |(from, to)| (to - from) as f64 * 1e-3);
    let rest = range.settle(t, range.park_pm)?;
    let wanted = f64::from(WATCHDOG_MS + HOLD_MS);
    sheet.judge(
        of("parks on silence"),
        (wanted - 0.5..wanted + 2.0 * LATE_MS).contains(&ms)
            && rest.state == BoardState::Safe
            && range.is_at(&rest, range.park_pm),
        (ms, "ms"),
        format!("{wanted} ms after the last command, by its own clock: safe, and the output goes to park"),
        format!("at {:.4} um, park {:.4} um", um(rest.applied_pm), um(range.park_pm)),
    );
    t.command(places.0, places.1)?;
    let freeze = t.request(&ToBoard::Freeze, Request::Freeze)?;
    let after = t.must_status()?;
    sheet.judge(
        of("safe is latched"),
        after.state == BoardState::Safe
            && after.ignored == rest.ignored.wrapping_add(1)
            && freeze.as_ref().is_err_and(|why| why == "state"),
        (None, ""),
        "a command is ignored and counted, freeze is refused (state)",
        format!("state {:?}", after.state).to_lowercase(),
    );
    Ok(())
}

fn freezes(
    sheet: &mut Sheet,
    t: &mut Talk,
    range: &Range,
    (at_pm, neutral_pm): (i32, i32),
) -> Result<(), Failure> {
    go(t, range, 1500, (at_pm, neutral_pm))?.ok();
    let asked = t.request(&ToBoard::Freeze, Request::Freeze)?;
    let rest = range.settle(t, neutral_pm)?;
    let before = rest.ignored;
    t.command(at_pm, neutral_pm)?;
    let after = t.must_status()?;
    sheet.judge(
        of("freezes"),
        asked.is_ok()
            && after.state == BoardState::Frozen
            && range.is_at(&rest, neutral_pm)
            && after.ignored == before.wrapping_add(1),
        (um((rest.applied_pm - neutral_pm).abs()), "um"),
        "ack (freeze), at the last zero flow, and commands are ignored",
        format!(
            "{}, state {:?}",
            asked.err().unwrap_or_else(|| "ack".to_string()),
            after.state
        )
        .to_lowercase(),
    );
    Ok(())
}

fn stops(
    sheet: &mut Sheet,
    t: &mut Talk,
    range: &Range,
    places: (i32, i32),
) -> Result<(), Failure> {
    for (name, message, request, state) in [
        ("parks", ToBoard::Park, Request::Park, BoardState::Safe),
        (
            "disarms",
            ToBoard::Disarm,
            Request::Disarm,
            BoardState::Disarmed,
        ),
    ] {
        go(t, range, HOLD_MS, places)?.ok();
        let asked = t.request(&message, request)?;
        let rest = range.settle(t, range.park_pm)?;
        sheet.judge(
            of(name),
            asked.is_ok() && rest.state == state && range.is_at(&rest, range.park_pm),
            (um((rest.applied_pm - range.park_pm).abs()), "um"),
            format!("ack, state {state:?}, at park").to_lowercase(),
            format!(
                "{}, state {:?}",
                asked.err().unwrap_or_else(|| "ack".to_string()),
                rest.state
            )
            .to_lowercase(),
        );
    }
    Ok(())
}
