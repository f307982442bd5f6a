//! Tests whether a board conforms to docs/board.md: identity, line, refusals. Motion is in `moves`, silence in
//! `silence`.

use super::moves::Range;
use super::sheet::Sheet;
use super::talk::{ANSWER_MS, Talk};
pub use super::trial::Trial;
use super::trial::{of, um};
use crate::line_test::Quantiles;
use cellpos_link::{Arm, Identity, Limits, PROTOCOL_VERSION, Request, ToBoard, ToHost};
use cellpos_rig::Clock;
use cellpos_session::Failure;

/// The lines of a board, in the order of the test.
pub const LINES: [&str; 29] = [
    "answers hello",
    "refuses another protocol",
    "round trip",
    "pings lost",
    "jitter on its own clock",
    "drops damaged frames",
    "status unasked",
    "refuses limits wider than its own",
    "refuses park outside its range",
    "refuses impossible watchdogs",
    "arms and stays where it is",
    "ignores a foreign session's command",
    "answers a command",
    "status after each command",
    "ignores old and doubled commands",
    "range at the output",
    "slew at the output",
    "refuses a foreign session",
    "switches the LED",
    "holds on silence",
    "takes up again",
    "parks on silence",
    "safe is latched",
    "freezes",
    "parks",
    "disarms",
    "clock rate",
    "messages unsent",
    "reset in mid-flight",
];

/// Runs every test; after a broken line the rest counts as not tried. Leaves the board parked and disarmed.
pub fn board(sheet: &mut Sheet, talk: Talk, trial: &mut Trial) {
    let mut talk = Some(talk);
    if let Err(failure) = tried(sheet, &mut talk, trial) {
        let words = cellpos_session::connect::describe(&failure);
        sheet.judge(
            of("conversation"),
            false,
            (None, ""),
            "continues to the end",
            words,
        );
        if let Some(talk) = &mut talk {
            // Park the PZT, whatever broke the line.
            let _ = talk.send(&ToBoard::Disarm);
        }
    }
    sheet.complete("board", &LINES, "not reached: a line above says why");
}

fn tried(sheet: &mut Sheet, talk: &mut Option<Talk>, trial: &mut Trial) -> Result<(), Failure> {
    let Some(t) = talk else { return Ok(()) };
    let Some(identity) = hello(sheet, t)? else {
        return Ok(());
    };
    let first = t.ping(ANSWER_MS)?.map(|(trip, us)| (t.now_ns(), trip, us));
    line(sheet, t)?;
    damage(sheet, t)?;
    unasked(sheet, t)?;
    let Some(range) = Range::of(&identity, trial) else {
        sheet.complete(
            "board",
            &LINES,
            "the range of board and rig file is less than three times --amplitude: give a smaller one",
        );
        return Ok(());
    };
    range.park(t)?;
    refusals(sheet, t, &identity, &range)?;
    if super::moves::moves(sheet, t, &range)? {
        super::silence::silence(sheet, t, &range)?;
    }
    clock_rate(sheet, t, first)?;
    let status = t.must_status()?;
    sheet.judge(
        of("messages unsent"),
        status.unsent == 0,
        (f64::from(status.unsent), ""),
        "0: the line carries what the board says",
        "since the board was switched on",
    );
    super::reset::reset(sheet, talk, &range, trial)
}

fn hello(sheet: &mut Sheet, t: &mut Talk) -> Result<Option<Identity>, Failure> {
    let Some((identity, ms)) = t.hello()? else {
        sheet.judge(
            of("answers hello"),
            false,
            (None, "ms"),
            "identity within 3000 ms",
            "no identity came: port, baud rate, protocol?",
        );
        return Ok(None);
    };
    let [major, minor, patch] = identity.firmware;
    let sound = identity.protocol == PROTOCOL_VERSION
        && identity.limits.low_pm < identity.limits.high_pm
        && identity.limits.slew_nm_per_s > 0
        && identity.ramp_nm_per_s > 0
        && (8..=16).contains(&identity.dac_bits)
        && (identity.limits.low_pm..=identity.limits.high_pm).contains(&identity.park_pm)
        && identity.watchdog_ms > 0
        && identity.hold_watchdog_ms > 0;
    sheet.judge(
        of("answers hello"),
        sound,
        (ms, "ms"),
        format!("identity of protocol {PROTOCOL_VERSION} within 3000 ms, each value possible"),
        format!(
            "serial {}, firmware {major}.{minor}.{patch}, {:.3} to {:.3} um, {:.0} um/s, {} bits, watchdogs {} and {} ms",
            identity.serial,
            um(identity.limits.low_pm),
            um(identity.limits.high_pm),
            f64::from(identity.limits.slew_nm_per_s) * 1e-3,
            identity.dac_bits,
            identity.watchdog_ms,
            identity.hold_watchdog_ms
        ),
    );
    let other = ToBoard::Hello {
        protocol: PROTOCOL_VERSION + 1000,
    };
    let refused = t.request(&other, Request::Hello)?;
    let identities = t
        .heard
        .iter()
        .filter(|(_, m)| matches!(m, ToHost::Identity(_)));
    let answered = identities.count();
    sheet.judge(
        of("refuses another protocol"),
        refused.as_ref().is_err_and(|why| why == "protocol") && answered == 1,
        (None, ""),
        "identity, then refused (hello, protocol)",
        format!(
            "{answered} identity, then {}",
            refused.err().unwrap_or_else(|| "ack".to_string())
        ),
    );
    // The conversation continues in its version.
    t.hello()?;
    Ok(sound.then_some(identity))
}

fn line(sheet: &mut Sheet, t: &mut Talk) -> Result<(), Failure> {
    const PINGS: usize = 500;
    let (mut trips_ms, mut times_us, mut lost) = (Vec::new(), Vec::new(), 0);
    let mut due_ns = t.now_ns();
    for n in 0..PINGS {
        t.sleep_until_ns(due_ns);
        match t.ping(50.0)? {
            Some((ms, board_us)) => {
                trips_ms.push(ms);
                times_us.push((n, board_us));
            }
            None => lost += 1,
        }
        due_ns = (due_ns + 1_000_000).max(t.now_ns());
    }
    let trip = Quantiles::of(&trips_ms);
    // The protocol promises a status within 10 ms of its command.
    sheet.judge(
        of("round trip"),
        lost < PINGS && trip.p99 < 10.0,
        (trip.p99, "ms"),
        "99 of 100 below 10 ms",
        format!("median {:.3} ms, largest {:.3} ms", trip.p50, trip.max),
    );
    sheet.judge(
        of("pings lost"),
        lost == 0,
        (lost as f64, ""),
        "0",
        format!("of {PINGS}"),
    );
    let spacing: Vec<f64> = times_us
        .windows(2)
        .filter_map(|pair| match pair {
            [(a, before_us), (b, after_us)] if b - a == 1 => {
                Some(((*after_us as f64 - *before_us as f64) * 1e-3 - 1.0).abs())
            }
            _ => None,
        })
        .collect();
    let jitter = Quantiles::of(&spacing);
    sheet.judge(
        of("jitter on its own clock"),
        jitter.p50 < 0.5,
        (jitter.p50, "ms"),
        "median below 0.5 ms: half a period of a loop at 1 kHz",
        format!(
            "spacing of messages sent each ms; 99 of 100 below {:.3} ms, largest {:.3} ms: of machine and line together",
            jitter.p99, jitter.max
        ),
    );
    Ok(())
}

/// Invalid frames: the board must drop and count each as a whole, and read the frame after it.
fn damage(sheet: &mut Sheet, t: &mut Talk) -> Result<(), Failure> {
    let before = t.must_status()?.bad_frames;
    let ping = Talk::wire(&ToBoard::Ping { token: 0xdead })?;
    let mut flipped = ping.clone();
    // The last byte of the checksum, before the delimiter. It must not become zero, which would end the frame.
    if let Some(place) = flipped.len().checked_sub(2)
        && let Some(byte) = flipped.get_mut(place)
    {
        *byte = if *byte == 0x55 { 0x2a } else { 0x55 };
    }
    let mut echo = [0; cellpos_link::MAX_FRAME];
    let pong = ToHost::Pong {
        token: 0xdead,
        board_time_us: 1,
    };
    let length = cellpos_link::encode(&pong, &mut echo).map_err(Failure::failed)?;
    let long = [&[0][..], &[0x11; 200], &[0]].concat();
    let cut = [ping.get(..ping.len() / 2).unwrap_or(&[]), &[0]].concat();
    let damaged = [&flipped[..], echo.get(..length).unwrap_or(&[]), &long, &cut];
    for bytes in damaged {
        t.send_bytes(bytes)?;
    }
    let after = t.must_status()?.bad_frames;
    let answered = t
        .heard
        .iter()
        .any(|(_, m)| matches!(m, ToHost::Pong { token: 0xdead, .. }));
    let rise = after.wrapping_sub(before);
    sheet.judge(
        of("drops damaged frames"),
        rise as usize >= damaged.len() && !answered,
        (f64::from(rise), ""),
        format!("bad_frames rises by {} and none is answered", damaged.len()),
        "a wrong check sum, an echo of the host's own direction, 200 bytes, half a frame",
    );
    Ok(())
}

/// Unasked statuses after a hello.
fn unasked(sheet: &mut Sheet, t: &mut Talk) -> Result<(), Failure> {
    const LISTEN_MS: f64 = 300.0;
    t.pump()?;
    t.heard.clear();
    t.listen(LISTEN_MS)?;
    let times: Vec<u64> = t.statuses().map(|status| status.board_time_us).collect();
    let gaps = times.windows(2).map(|pair| match pair {
        [a, b] => b.saturating_sub(*a) as f64 * 1e-3,
        _ => 0.0,
    });
    let longest_ms = gaps.fold(0.0, f64::max);
    sheet.judge(
        of("status unasked"),
        times.len() >= (0.7 * LISTEN_MS / 10.0) as usize && longest_ms <= 15.0,
        (
            if times.len() > 1 {
                longest_ms
            } else {
                f64::NAN
            },
            "ms",
        ),
        "each 10 ms by the board's clock, no gap above 15 ms",
        format!("{} in {LISTEN_MS} ms", times.len()),
    );
    Ok(())
}

/// Sessions that the board must refuse.
fn refusals(sheet: &mut Sheet, t: &mut Talk, own: &Identity, range: &Range) -> Result<(), Failure> {
    let session = t.session;
    let mut refused = |name: &'static str, arms: &[Arm], why: &str| -> Result<(), Failure> {
        let mut answers = Vec::new();
        for arm in arms {
            let answer = t.request(&ToBoard::Arm(*arm), Request::Arm)?;
            answers.push(answer.err().unwrap_or_else(|| "armed".to_string()));
        }
        sheet.judge(
            of(name),
            answers.iter().all(|answer| answer == why),
            (None, ""),
            format!("refused (arm, {why})"),
            answers.join(", "),
        );
        Ok(())
    };
    let with = |change: &dyn Fn(&mut Arm)| {
        let mut arm = range.arm(session);
        change(&mut arm);
        arm
    };
    let limits = |low_pm, high_pm, slew_nm_per_s| Limits {
        low_pm,
        high_pm,
        slew_nm_per_s,
    };
    let Limits {
        low_pm,
        high_pm,
        slew_nm_per_s,
    } = own.limits;
    refused(
        "refuses limits wider than its own",
        &[
            with(&|arm| arm.limits = Some(limits(low_pm - 1_000_000, high_pm, slew_nm_per_s))),
            with(&|arm| {
                arm.limits = Some(limits(
                    low_pm,
                    high_pm.saturating_add(1_000_000),
                    slew_nm_per_s,
                ))
            }),
            with(&|arm| {
                arm.limits = Some(limits(low_pm, high_pm, slew_nm_per_s.saturating_add(1000)))
            }),
            with(&|arm| arm.limits = Some(limits(high_pm, low_pm, slew_nm_per_s))),
            with(&|arm| arm.limits = Some(limits(low_pm, high_pm, 0))),
        ],
        "limits",
    )?;
    refused(
        "refuses park outside its range",
        &[with(&|arm| {
            arm.park_pm = Some(high_pm.saturating_add(1_000_000))
        })],
        "park",
    )?;
    refused(
        "refuses impossible watchdogs",
        &[
            with(&|arm| arm.watchdog_ms = Some(0)),
            with(&|arm| arm.watchdog_ms = Some(10_001)),
            with(&|arm| arm.hold_watchdog_ms = Some(0)),
            with(&|arm| arm.hold_watchdog_ms = Some(10_001)),
        ],
        "watchdog",
    )
}

/// The board's clock against the machine's, from two pings: one at the beginning and one at the end of the trial.
fn clock_rate(
    sheet: &mut Sheet,
    t: &mut Talk,
    first: Option<(i64, f64, u64)>,
) -> Result<(), Failure> {
    // The shortest round trip gives the time of the board's answer most precisely.
    let mut last: Option<(i64, f64, u64)> = None;
    for _ in 0..50 {
        if let Some((trip, us)) = t.ping(50.0)?
            && last.is_none_or(|(_, least, _)| trip < least)
        {
            last = Some((Clock::Real.now_ns(), trip, us));
        }
    }
    let rate = first
        .zip(last)
        .map(|((a_ns, a_trip, a_us), (b_ns, b_trip, b_us))| {
            let host_us = (b_ns - a_ns) as f64 * 1e-3;
            let ppm = 1e6 * ((b_us as f64 - a_us as f64) / host_us - 1.0);
            // The board answered somewhere within each round trip.
            (ppm, 1e6 * 0.5e3 * (a_trip + b_trip) / host_us.max(1.0))
        });
    let (ppm, uncertain) = rate.unwrap_or((f64::NAN, f64::NAN));
    sheet.judge(
        of("clock rate"),
        ppm.abs() < 200.0 + uncertain,
        (ppm, "ppm"),
        "within 200 ppm of the machine's",
        format!("known to {uncertain:.0} ppm by the round trips"),
    );
    Ok(())
}
