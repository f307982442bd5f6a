//! Records of ticks that came at the wrong time.

use super::*;
use cellpos_ident::candidate_model::CandidateModel;
use cellpos_ident::excitation::{Signal, Tone};
use cellpos_ident::experiment::{Plan, PlannedSegment};
use cellpos_ident::frequency_response::Settings;
use cellpos_ident::sampled::{Hold, Sampling};
use cellpos_runtime::life::Life;
use cellpos_vision::FixQuality;
use std::f64::consts::TAU;

const PERIOD_NS: i64 = 1_000_000;
const GAIN_PER_S: f64 = 428.0;
/// From a command to its effect, ns.
const LINE_NS: i64 = 300_000;
/// From the middle of an exposure to its tick if that is on time, ns.
const AGE_NS: i64 = 2_100_000;

/// Faults of a machine and a camera.
struct Lateness {
    /// Largest delay of a tick, of which one in some fifty is near it, ns.
    most_ns: f64,
    /// Largest delay of any tick, all being as likely, ns.
    often_ns: f64,
    /// Lateness that repeats every tenth tick, as vision takes longer for a bead that goes faster, ns.
    in_step_ns: f64,
    /// Share of ticks that never came.
    skipped: f64,
    /// Camera's clock against the loop's.
    drift: f64,
    /// The command answers the position by this much, um/um: a loop that goes without a position commands something else.
    feedback: f64,
}

const CALM: Lateness = Lateness {
    most_ns: 0.0,
    often_ns: 0.0,
    in_step_ns: 0.0,
    skipped: 0.0,
    drift: 0.0,
    feedback: 0.0,
};

const SPAN: Span = Span {
    index: 0,
    start: 0,
    settle: 100,
    rows: 800,
};

/// Numbers between 0 and 1 without a pattern, by the multiples of an irrational one.
fn spread(k: i64, step: f64) -> f64 {
    (k as f64 * step).fract()
}

/// Ticks of an integrator that is driven by a sine of the loop's clock.
fn ticks(frequency_hz: f64, count: i64, late: &Lateness) -> Vec<TickRecord> {
    let mut ticks: Vec<TickRecord> = Vec::new();
    // Position and drive, up to `done_ns`.
    let (mut position_um, mut done_ns) = (0.0, i64::MIN / 2);
    let mut at = 0;
    for k in 0..count {
        let due_ns = k * PERIOD_NS;
        let delay_ns = late.most_ns * spread(k, 0.618_033_988_75).powi(80)
            + late.in_step_ns
                * [0.1, 0.0, 0.9, 0.7, 0.4, 0.2, 1.0, 0.0, 0.1, 0.8][k.rem_euclid(10) as usize]
            + late.often_ns * (43_758.545_3 * (12.989_8 * k as f64).sin()).rem_euclid(1.0);
        if spread(k, 0.414_213_562_37) < late.skipped
            || ticks.last().is_some_and(|last| due_ns < last.time_ns)
        {
            continue;
        }
        let time_ns = due_ns + delay_ns as i64;
        // The newest frame that has come.
        let frame =
            ((due_ns - AGE_NS) as f64 * (1.0 + late.drift) / PERIOD_NS as f64).round() as i64;
        let exposure_ns = (frame as f64 * PERIOD_NS as f64 / (1.0 + late.drift)) as i64;
        // The commands that have acted by the middle of its exposure.
        let until_ns = exposure_ns - LINE_NS;
        while at < ticks.len() {
            let since_ns = ticks[at].time_ns.max(done_ns);
            let next_ns = ticks.get(at + 1).map_or(i64::MAX, |next| next.time_ns);
            let to_ns = next_ns.min(until_ns);
            if to_ns > since_ns {
                position_um += GAIN_PER_S * 1e-9 * ticks[at].command_um * (to_ns - since_ns) as f64;
                done_ns = to_ns;
            }
            if next_ns > until_ns {
                break;
            }
            at += 1;
        }
        ticks.push(TickRecord {
            seq: k as u64,
            time_ns,
            frame_id: (frame + 10) as u64,
            mid_exposure_ns: exposure_ns,
            measured_um: position_um,
            verdict: 0,
            command_um: (TAU * frequency_hz * 1e-9 * due_ns as f64).sin()
                - late.feedback * position_um,
            life: Life::Running as u8,
            flags: TickFlags::default(),
            wake_ns: delay_ns as u32,
            compute_ns: 20_000,
            ..TickRecord::unknown()
        });
    }
    ticks
}

const FREQUENCIES_HZ: [f64; 5] = [5.0, 20.0, 50.0, 100.0, 300.0];

/// Responses at [`FREQUENCIES_HZ`] over those of the integrator with the delay that the records have: gain, phase in deg, and the standard
/// deviation by the scatter of the blocks.
fn over_the_true(late: &Lateness) -> Vec<(f64, f64, f64)> {
    let period_s = 1e-9 * PERIOD_NS as f64;
    let (mut records, mut segments) = (Vec::new(), Vec::new());
    for (index, frequency_hz) in FREQUENCIES_HZ.into_iter().enumerate() {
        let rows = Rows::of(&ticks(frequency_hz, 8000, late), PERIOD_NS);
        let span = Span {
            index,
            start: 0,
            settle: 200,
            rows: 7000,
        };
        records.push(rows.segment(&span, 50).unwrap());
        segments.push(PlannedSegment {
            label: format!("{frequency_hz} Hz"),
            signal: Signal::Tones {
                tones: vec![Tone {
                    frequency_hz,
                    amplitude_um: 1.0,
                    phase_rad: 0.0,
                }],
                fade_in_s: 0.0,
            },
            lines_hz: vec![frequency_hz],
            detection_hz: vec![],
            settle_s: 0.2,
            measure_s: 6.8,
        });
    }
    let plan = Plan {
        period_s,
        segments,
        lost_frames: 50,
    };
    let sampling = Sampling {
        period_s,
        exposure_s: 0.0,
        hold: Hold::ZeroOrder,
    };
    let measured = plan
        .analyse_with_noise(&records, &Settings::default(), sampling, false)
        .unwrap();
    let points = measured.points.iter().zip(&records);
    points
        .map(|(point, record)| {
            let delay_s = record.age_s.unwrap() + 1e-9 * LINE_NS as f64;
            let truth = CandidateModel::integrator(GAIN_PER_S, delay_s);
            let ratio = point.response / truth.sampled_response(point.frequency_hz, sampling);
            let sd = point.scatter_variance.sqrt() / point.response.norm();
            (ratio.norm(), ratio.arg().to_degrees(), sd)
        })
        .collect()
}

#[test]
fn commands_that_are_all_late_by_chance_leave_the_response_and_little_scatter() {
    let late = Lateness {
        often_ns: 0.9e6,
        ..CALM
    };
    for (frequency_hz, (gain, phase_deg, sd)) in FREQUENCIES_HZ.iter().zip(over_the_true(&late)) {
        println!("{frequency_hz} Hz: {gain:.4}, {phase_deg:+.3} deg, scatter {sd:.5}");
        // What is left of lateness grows with the frequency, and no further than the scatter says.
        let bias = (gain - 1.0).abs().max(phase_deg.to_radians().abs());
        assert!(
            sd < 2e-5 * frequency_hz && bias < 2.0 * sd,
            "{frequency_hz} Hz"
        );
    }
}

#[test]
fn ticks_that_are_late_or_skipped_and_a_camera_that_drifts_bend_neither_gain_nor_phase() {
    let late = [
        Lateness {
            most_ns: 0.9e6,
            ..CALM
        },
        Lateness {
            most_ns: 4e6,
            ..CALM
        },
        Lateness {
            skipped: 0.05,
            ..CALM
        },
        Lateness {
            drift: 40e-6,
            ..CALM
        },
        Lateness {
            most_ns: 0.9e6,
            skipped: 0.02,
            drift: -15e-6,
            ..CALM
        },
        Lateness {
            in_step_ns: 0.3e6,
            ..CALM
        },
        CALM,
        Lateness {
            skipped: 0.05,
            feedback: 0.1,
            ..CALM
        },
        Lateness {
            most_ns: 4e6,
            often_ns: 0.3e6,
            feedback: 0.1,
            ..CALM
        },
    ];
    for (case, late) in late.iter().enumerate() {
        for (frequency_hz, (gain, phase_deg, _)) in FREQUENCIES_HZ.iter().zip(over_the_true(late)) {
            println!(
                "{frequency_hz} Hz, case {case}: gain {gain:.4} of the true one, phase {phase_deg:+.3} deg"
            );
            assert!((gain - 1.0).abs() < 1e-3, "{frequency_hz} Hz, case {case}");
            assert!(phase_deg.abs() < 0.1, "{frequency_hz} Hz, case {case}");
        }
    }
}

#[test]
fn frames_that_a_stall_kept_back_are_late_and_not_dropped() {
    let mut ticks = ticks(10.0, 200, &CALM);
    let (stalled, dropped) = (50..60, 120);
    // A timer replaces the camera while it stalls. Then all frames come at once.
    for tick in &mut ticks[stalled.clone()] {
        tick.flags.set(TickFlags::TIMER);
        tick.verdict = 255;
        tick.measured_um = f64::NAN;
    }
    ticks[stalled.end].drained = 1 + stalled.len() as u8;
    ticks.remove(dropped);
    let rows = Rows::of(&ticks, PERIOD_NS);
    let missing = |k: usize| rows.output[k].is_nan() && !rows.unseen[k];
    assert!(stalled.clone().all(|k| rows.output[k].is_nan()));
    assert_eq!(
        (0..200).filter(|&k| missing(k)).collect::<Vec<_>>(),
        [dropped]
    );
}

#[test]
fn a_picture_that_came_twice_repeats_its_position_for_who_counts_faults_of_the_camera_only() {
    let mut ticks = ticks(10.0, 200, &CALM);
    let twice = [50, 51, 120];
    for k in twice {
        let tick = &mut ticks[k];
        tick.flags.set(TickFlags::STALE);
        tick.verdict = FixQuality::NoSignal as u8;
        tick.decision = Decision::Stale as u8;
        tick.measured_um = f64::NAN;
    }
    let rows = Rows::of(&ticks, PERIOD_NS);
    // No measurement: the bead has moved on.
    assert!(twice.iter().all(|&k| rows.output[k].is_nan()));
    let delivered_um = rows.delivered().bead_um;
    // Nothing has moved in the first rows.
    let repeats = (10..200).filter(|&k| delivered_um[k] == delivered_um[k - 1]);
    assert_eq!(repeats.collect::<Vec<_>>(), twice);
}

#[test]
fn a_record_of_an_experiment_begins_when_the_bead_was_caught() {
    let all = Rows::of(&ticks(10.0, 2000, &CALM), PERIOD_NS).delivered();
    let since = all.since_caught();
    assert_eq!(since.pzt_um[..], all.pzt_um[250..]);
    assert_eq!(since.bead_um.len(), 1750);
    assert_eq!(
        since.late_motion_um.is_empty(),
        all.late_motion_um.is_empty()
    );
}

#[test]
fn a_segment_that_lost_half_of_its_steps_is_measured_again_and_one_that_lost_a_tenth_is_not() {
    for (every, is_whole) in [(20, true), (4, false)] {
        let mut ticks = ticks(10.0, 2000, &CALM);
        for tick in ticks.iter_mut().step_by(every) {
            tick.measured_um = f64::NAN;
        }
        let segment = Rows::of(&ticks, PERIOD_NS).segment(&SPAN, 50);
        assert_eq!(segment.is_ok(), is_whole, "{segment:?}");
        let why = segment.err().map(|spoilt| spoilt.words(1e-3));
        assert!(
            why.as_deref()
                .is_none_or(|why| why.starts_with("50 % of its frames"))
        );
        // How late is late depends on the rate: at 1 kHz half a millisecond.
        assert!(
            why.as_deref()
                .is_none_or(|why| why.contains("0.50 ms late"))
        );
    }
}

#[test]
fn a_stall_is_no_reason_to_move_the_bead_less_and_a_bead_out_of_view_is() {
    let spoilt = |change: &dyn Fn(&mut Vec<TickRecord>)| {
        let mut ticks = ticks(10.0, 2000, &CALM);
        change(&mut ticks);
        let spoilt = Rows::of(&ticks, PERIOD_NS).segment(&SPAN, 50).unwrap_err();
        spoilt.is_out_of_view()
    };
    let gone = 600..680;
    assert!(spoilt(&|ticks| {
        for tick in &mut ticks[gone.clone()] {
            tick.measured_um = f64::NAN;
        }
    }));
    let frozen = |ticks: &mut Vec<TickRecord>| {
        for tick in &mut ticks[gone.end..gone.end + 60] {
            tick.flags.set(TickFlags::FREEZE);
        }
    };
    assert!(spoilt(&|ticks| {
        for tick in &mut ticks[gone.end - 20..gone.end] {
            tick.measured_um = f64::NAN;
        }
        frozen(ticks);
    }));
    assert!(!spoilt(&frozen), "an operator froze it");
    // A timer replaces the camera while it stalls.
    let stalled = |ticks: &mut Vec<TickRecord>| {
        for tick in &mut ticks[gone.clone()] {
            tick.flags.set(TickFlags::TIMER);
            tick.verdict = 255;
            tick.measured_um = f64::NAN;
        }
    };
    assert!(!spoilt(&stalled));
    assert!(!spoilt(&|ticks| {
        ticks.drain(gone.clone());
    }));
    assert!(!spoilt(&|ticks| {
        stalled(ticks);
        frozen(ticks);
    }));
}

#[test]
fn a_short_freeze_is_a_gap_in_a_segment_and_a_long_one_spoils_it() {
    for (rows, is_whole) in [(49, true), (50, false)] {
        let mut ticks = ticks(10.0, 2000, &CALM);
        for tick in &mut ticks[600..600 + rows] {
            tick.flags.set(TickFlags::FREEZE);
        }
        let segment = Rows::of(&ticks, PERIOD_NS).segment(&SPAN, 50);
        assert_eq!(segment.is_ok(), is_whole, "{segment:?}");
        let missing = segment.map(|s| s.output.iter().filter(|um| um.is_nan()).count());
        assert!(missing.is_ok_and(|missing| missing == rows) == is_whole);
    }
}

/// A tick that never came leaves its frame's row without a position and its motion open. It shifts no other row.
#[test]
fn a_run_with_skipped_ticks_is_a_record_by_its_frames() {
    let late = Lateness {
        skipped: 0.02,
        ..CALM
    };
    let ticks = ticks(7.0, 2000, &late);
    let record = crate::experiment::collect::of_ticks("run", &ticks, 1e-3).unwrap();
    let closed: Vec<&TickRecord> = ticks.iter().filter(|tick| tick.is_running()).collect();
    let row = |tick: &TickRecord| (tick.frame_id - closed[0].frame_id) as usize;
    let mut skipped = 0;
    for pair in closed.windows(2) {
        let (before, at) = (row(pair[0]), row(pair[1]));
        assert_eq!(record.pzt_um[at], pair[1].command_um, "row {at}");
        for missing in before + 1..at {
            skipped += 1;
            assert!(record.late_command[missing], "row {missing}");
            assert!(record.bead_um[missing].is_nan(), "row {missing}");
        }
    }
    assert!(skipped > 20, "{skipped}");
    assert_eq!(record.rows(), row(closed[closed.len() - 1]) + 1);
}

/// A command more than half a period late stands nearer to another row. When the board had it nobody here knows.
#[test]
fn the_motion_of_a_command_that_is_over_half_a_period_late_is_open() {
    let mut ticks = ticks(7.0, 2000, &CALM);
    let first = ticks.iter().position(TickRecord::is_running).unwrap();
    for (row, part) in [(300, 0.3), (600, 0.7), (900, 1.4)] {
        ticks[first + row].compute_ns += (part * PERIOD_NS as f64) as u32;
    }
    let record = crate::experiment::collect::of_ticks("run", &ticks, 1e-3).unwrap();
    let open: Vec<usize> = (0..record.rows())
        .filter(|row| record.late_command[*row])
        .collect();
    assert_eq!(open, [600, 900]);
}
