//! The sheet of a board: one that keeps the protocol passes every line, one that breaks a rule fails that rule's line.

use crate::board_line::{Desk, DeskPort, Tamper};
use cellpos_link::{Arm, Command, Refusal, Request, Status, ToBoard, ToHost};
use cellpos_session::Failure;
use cellpos_workbench::prove::board::{LINES, Trial, board};
use cellpos_workbench::prove::{Sheet, Talk, Verdict};
use std::time::Duration;

/// Lines that a machine under load may fail for the board: its own lateness is in them.
const OF_THE_MACHINE: [&str; 4] = [
    "round trip",
    "jitter on its own clock",
    "answers a command",
    "clock rate",
];

fn trial() -> Trial<'static> {
    Trial {
        limits_um: [0.0, 40.0, 20_000.0],
        park_um: 20.0,
        amplitude_um: 2.0,
        reset: None,
    }
}

fn failed(sheet: &Sheet) -> Vec<&'static str> {
    let lines = sheet.lines.iter();
    lines
        .filter(|line| line.verdict == Verdict::Failed && !OF_THE_MACHINE.contains(&line.name))
        .map(|line| line.name)
        .collect()
}

fn sheet_of(to_board: Option<Tamper<ToBoard>>, to_host: Option<Tamper<ToHost>>) -> Sheet {
    let mut port = DeskPort::new(&Desk::new());
    if let Some(tamper) = to_board {
        port = port.changing_orders(tamper);
    }
    if let Some(tamper) = to_host {
        port = port.changing_answers(tamper);
    }
    let mut sheet = Sheet::default();
    board(&mut sheet, Talk::on(Box::new(port)), &mut trial());
    sheet
}

#[test]
fn a_board_that_keeps_the_protocol_passes_every_line_and_is_left_parked() {
    let desk = Desk::new();
    let mut sheet = Sheet::default();
    let mut reset = |_: Talk| -> Result<Talk, Failure> {
        desk.lock().unwrap().reset(false);
        Ok(Talk::on(Box::new(DeskPort::new(&desk))))
    };
    let mut trial = Trial {
        reset: Some(&mut reset),
        ..trial()
    };
    let talk = Talk::on(Box::new(DeskPort::new(&desk)));
    board(&mut sheet, talk, &mut trial);
    assert_eq!(failed(&sheet), [""; 0], "{sheet:#?}");
    let names: Vec<&str> = sheet.lines.iter().map(|line| line.name).collect();
    assert_eq!(names, LINES, "every line was tried, in this order");
    assert!(
        sheet
            .lines
            .iter()
            .all(|line| line.verdict != Verdict::NotTried)
    );
    let measured = |name: &str| {
        sheet
            .line("board", name)
            .and_then(|line| line.value)
            .unwrap()
    };
    assert!((measured("holds on silence") - 100.0).abs() < 1.0);
    assert!((measured("parks on silence") - 400.0).abs() < 2.0);
    // 4 um in a tenth of a second.
    assert!((measured("slew at the output") - 40.0).abs() < 1.0);
}

#[test]
fn a_board_that_stays_where_it_stood_after_a_reset_fails_that_line() {
    let desk = Desk::new();
    let mut sheet = Sheet::default();
    let mut reset = |_: Talk| -> Result<Talk, Failure> {
        desk.lock().unwrap().reset(true);
        Ok(Talk::on(Box::new(DeskPort::new(&desk))))
    };
    let mut trial = Trial {
        reset: Some(&mut reset),
        ..trial()
    };
    let talk = Talk::on(Box::new(DeskPort::new(&desk)));
    board(&mut sheet, talk, &mut trial);
    assert_eq!(failed(&sheet), ["reset in mid-flight"], "{sheet:#?}");
}

/// A board that breaks one rule, and the line that must say so.
#[test]
fn each_broken_rule_fails_its_own_line() {
    fn arm(message: ToBoard, change: impl Fn(&mut Arm)) -> ToBoard {
        match message {
            ToBoard::Arm(mut arm) => {
                change(&mut arm);
                ToBoard::Arm(arm)
            }
            other => other,
        }
    }
    let on_its_way_in: [(&str, Tamper<ToBoard>); 6] = [
        ("range at the output", |m| {
            Some(arm(m, |arm| {
                if let Some(limits) = arm.limits.as_mut().filter(|l| l.high_pm < 30_000_000) {
                    limits.high_pm += 1_000_000;
                }
            }))
        }),
        ("slew at the output", |m| {
            Some(arm(m, |arm| {
                if let Some(limits) = arm.limits.as_mut().filter(|l| l.slew_nm_per_s < 1_000_000) {
                    limits.slew_nm_per_s = limits.slew_nm_per_s * 5 / 4;
                }
            }))
        }),
        ("holds on silence", |m| {
            Some(arm(m, |arm| {
                arm.watchdog_ms = arm.watchdog_ms.map(|ms| if ms == 100 { 105 } else { ms });
            }))
        }),
        ("parks on silence", |m| {
            Some(arm(m, |arm| {
                arm.hold_watchdog_ms = arm
                    .hold_watchdog_ms
                    .map(|ms| if ms == 300 { 320 } else { ms });
            }))
        }),
        ("freezes", |m| match m {
            ToBoard::Command(command) => Some(ToBoard::Command(Command {
                neutral_pm: command.displacement_pm,
                ..command
            })),
            other => Some(other),
        }),
        ("switches the LED", |m| match m {
            ToBoard::Led { .. } => Some(ToBoard::Led { on: true }),
            other => Some(other),
        }),
    ];
    let on_its_way_out: [(&str, Tamper<ToHost>); 4] = [
        ("refuses a foreign session", |m| match m {
            ToHost::Refused {
                request: Request::Arm,
                refusal: Refusal::Busy,
            } => Some(ToHost::Ack {
                request: Request::Arm,
            }),
            other => Some(other),
        }),
        ("refuses another protocol", |m| match m {
            ToHost::Refused {
                request: Request::Hello,
                ..
            } => None,
            other => Some(other),
        }),
        ("status after each command", |m| match m {
            ToHost::Status(Status {
                last_seq: Some(seq),
                ..
            }) if seq % 10 == 7 => None,
            other => Some(other),
        }),
        ("drops damaged frames", |m| match m {
            ToHost::Status(status) => Some(ToHost::Status(Status {
                bad_frames: 0,
                ..status
            })),
            other => Some(other),
        }),
    ];
    let sheets = std::thread::scope(|scope| {
        let inward = on_its_way_in
            .iter()
            .map(|(name, tamper)| (*name, scope.spawn(|| sheet_of(Some(*tamper), None))));
        let outward = on_its_way_out
            .iter()
            .map(|(name, tamper)| (*name, scope.spawn(|| sheet_of(None, Some(*tamper)))));
        let running: Vec<_> = inward.chain(outward).collect();
        running
            .into_iter()
            .map(|(name, running)| (name, running.join().unwrap()))
            .collect::<Vec<_>>()
    });
    for (name, sheet) in sheets {
        assert!(
            failed(&sheet).contains(&name),
            "{name}: {:?}",
            failed(&sheet)
        );
    }
}

#[test]
fn the_time_of_an_answer_begins_before_the_message_is_written() {
    let port = DeskPort::new(&Desk::new()).with_slow_writes(Duration::from_millis(2));
    let mut sheet = Sheet::default();
    board(&mut sheet, Talk::on(Box::new(port)), &mut trial());
    for name in ["round trip", "answers a command"] {
        let ms = sheet.line("board", name).and_then(|line| line.value);
        assert!(ms.is_some_and(|ms| ms >= 2.0), "{name}: {ms:?} ms");
    }
    let median = &sheet.line("board", "round trip").unwrap().note;
    assert!(median.starts_with("median 2."), "{median}");
}

#[test]
fn a_line_on_which_nobody_answers_leaves_the_rest_untried() {
    let sheet = sheet_of(Some(|_| None), None);
    assert_eq!(failed(&sheet), ["answers hello"]);
    assert_eq!(sheet.counts(), [0, 1, LINES.len() - 1]);
}
