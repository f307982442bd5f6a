use super::*;
use crate::follow::Follower;
use crate::script::Script;
use cellpos_control::Reference;
use cellpos_runtime::{ReferenceGenerator, ReferenceInput};

const TEXT: &str = "start = \"1um\"\n[[step]]\ndo = \"sine\"\namplitude = \"2um\"\nfrequency = \"10Hz\"\ncycles = 20\n\
                    [[step]]\ndo = \"hold\"\nduration = \"100ms\"\n[[step]]\ndo = \"triangle\"\namplitude = \"1um\"\n\
                    frequency = \"5Hz\"\ncycles = 5\n";

fn plan(text: &str) -> Arc<Plan> {
    Arc::new(Plan::new(&Script::parse(text, "t.toml").unwrap()).unwrap())
}

/// Records of a loop that follows a plan, with a bead that is at `bead(reference at the exposure)`; `change` may spoil a
/// record, or drop it by giving false.
fn records(
    plan: &Arc<Plan>,
    bead: impl Fn(f64, f64) -> f64,
    change: impl FnMut(&mut TickRecord) -> bool,
) -> Vec<TickRecord> {
    records_skipping(plan, bead, change, None)
}

/// The same, but the operator skips to the next step in a tick.
fn records_skipping(
    plan: &Arc<Plan>,
    bead: impl Fn(f64, f64) -> f64,
    mut change: impl FnMut(&mut TickRecord) -> bool,
    skip_at: Option<u64>,
) -> Vec<TickRecord> {
    let mut follower = Follower::new(Arc::clone(plan), 0.0, 2);
    let mut past: Vec<f64> = Vec::new();
    let mut all = Vec::new();
    let mut preview = [0.0; 1];
    let mut seq = 0;
    while !follower.finished() {
        let exposed_um = past
            .len()
            .checked_sub(2)
            .map_or(plan.start_um(), |i| past[i]);
        let time_s = seq as f64 * 1e-3;
        let measured_um = bead(exposed_um, time_s);
        let told = ReferenceInput {
            running: true,
            frozen: false,
            skip: skip_at == Some(seq),
            tick: seq,
            sample_s: 1e-3,
            position_um: Some(measured_um),
            age_ticks: 0,
            length_um: None,
            target_um: None,
        };
        let output = follower.step(&told, &mut preview);
        past.push(output.reference_um);
        let mut record = TickRecord {
            seq,
            time_ns: seq as i64 * 1_000_000,
            frame_id: seq,
            mid_exposure_ns: seq as i64 * 1_000_000 - 2_000_000,
            measured_um,
            variance_um2: 1e-6,
            verdict: 0,
            target_um: output.reference_um,
            error_um: f64::NAN,
            plan_ns: output.plan_ns,
            stage: output.stage as u8,
            length_um: f64::NAN,
            area_um2: f64::NAN,
            length_sd_um: f64::NAN,
            area_sd_um2: f64::NAN,
            estimate_um: measured_um,
            estimate_sd_um: 0.01,
            neutral_um: 20.0,
            requested_um: 20.0,
            command_um: 20.0,
            applied_um: 20.0,
            true_um: f64::NAN,
            life: Life::Running as u8,
            request: if skip_at == Some(seq) {
                Request::Skip as u8
            } else {
                0
            },
            board: 2,
            board_fault: 0,
            partner_command_um: f64::NAN,
            partner_applied_um: f64::NAN,
            partner_effect_um: f64::NAN,
            partner: 255,
            flags: TickFlags(0),
            drained: 1,
            wake_ns: 0,
            compute_ns: 0,
            solver_status: 0,
            solver_iterations: 0,
            solver_active: 0,
            solver_ns: 0,
            track: 255,
            decision: 255,
            ..TickRecord::unknown()
        };
        seq += 1;
        if change(&mut record) {
            all.push(record);
        }
    }
    all
}

fn table(plan: &Arc<Plan>, records: &[TickRecord]) -> Vec<CycleRow> {
    let mut table = CycleTable::new(Arc::clone(plan), 1, 0, 2.0, 1000.0);
    let mut rows = Vec::new();
    for record in records {
        table.add(record);
        rows.extend(std::iter::from_fn(|| table.pop()));
    }
    rows
}

fn numbers(rows: &[CycleRow]) -> Vec<u64> {
    rows.iter().map(|row| row.cycle).collect()
}

#[test]
fn every_cycle_has_one_row_with_amplitude_lag_bias_and_errors_as_they_are() {
    let plan = plan(TEXT);
    // 3 % short of the amplitude about the centre, 50 nm off.
    let rows = table(
        &plan,
        &records(&plan, |r, _| 1.05 + 0.97 * (r - 1.0), |_| true),
    );
    assert_eq!(numbers(&rows), (0..25).collect::<Vec<u64>>());
    for row in &rows[..20] {
        assert!((row.commanded_um - 2.0).abs() < 1e-6, "{row:?}");
        assert!((row.reached_um / row.commanded_um - 0.97).abs() < 1e-9);
        assert!(row.lag_deg.abs() < 1e-6 && (row.bias_um - 0.05).abs() < 1e-6);
        // e = 0.05 - 0.03 * 2 sin: RMS of sqrt(0.05^2 + 0.06^2 / 2).
        assert!((row.rms_um - (0.0025f64 + 0.0018).sqrt()).abs() < 1e-6);
        assert!((row.peak_um - 0.11).abs() < 1e-3);
        assert_eq!((row.ticks, row.seen, row.flags.0), (100, 100, 0));
        assert!((row.stroke_um - 2.0).abs() < 0.01);
    }
    // The fundamental of a triangle of amplitude 1 is 8 / pi^2; the second-long approach comes before everything.
    let triangle = 8.0 / std::f64::consts::PI.powi(2);
    assert!((rows[22].commanded_um - triangle).abs() < 1e-3);
    assert!((rows[22].start_s - rows[21].start_s - 0.2).abs() < 1e-6);
    assert!(rows[0].start_s > 0.19, "{}", rows[0].start_s);
}

#[test]
fn the_lag_of_a_bead_behind_its_reference_is_that_of_the_delay() {
    let plan = plan(TEXT);
    let exact = records(&plan, |r, _| r, |_| true);
    // The bead is where the reference was 5 ms before.
    let late: Vec<TickRecord> = (5..exact.len())
        .map(|k| TickRecord {
            measured_um: exact[k - 5].measured_um,
            ..exact[k]
        })
        .collect();
    let rows = table(&plan, &late);
    for row in &rows[1..20] {
        assert!((row.lag_deg - 18.0).abs() < 0.01, "{row:?}");
    }
}

#[test]
fn what_disturbs_a_cycle_is_in_its_row_and_in_no_other() {
    let plan = plan(TEXT);
    let first = records(&plan, |r, _| r, |_| true)
        .iter()
        .position(|r| r.stage == Stage::Running as u8)
        .unwrap() as u64;
    // Exposures count: two ticks later than the plan. 5 lost frames in cycle 3, a gap from 7 to the middle of 9.
    let at = |cycle: u64, tick: u64| first + 2 + cycle * 100 + tick;
    let all = records(
        &plan,
        |r, _| r,
        |record| {
            if (at(3, 40)..at(3, 45)).contains(&record.seq) {
                record.flags.set(TickFlags::LOST);
                record.verdict = 1;
                record.measured_um = f64::NAN;
            }
            !(at(7, 50)..at(9, 50)).contains(&record.seq)
        },
    );
    let rows = table(&plan, &all);
    assert_eq!(numbers(&rows), (0..25).collect::<Vec<u64>>());
    for row in &rows {
        let expected = match row.cycle {
            3 => "lost+disturbed",
            7..=9 => "records-lost+disturbed",
            _ => "",
        };
        assert_eq!(row.flags.to_string(), expected, "cycle {}", row.cycle);
    }
    assert_eq!((rows[3].lost, rows[3].seen), (5, 95));
    assert!((rows[3].reached_um - rows[3].commanded_um).abs() < 1e-9);
    assert_eq!((rows[7].ticks, rows[8].ticks, rows[9].ticks), (50, 0, 50));
    assert!(rows[8].commanded_um.is_nan() && rows[8].start_s.is_nan());
}

#[test]
fn a_cycle_that_was_not_brought_to_its_end_has_no_row() {
    let plan = plan(TEXT);
    let mut all = records(&plan, |r, _| r, |_| true);
    let end = all.iter().position(|r| r.plan_ns >= 1_250_000_000).unwrap();
    all.truncate(end);
    assert_eq!(numbers(&table(&plan, &all)), (0..12).collect::<Vec<u64>>());
}

#[test]
fn the_gain_of_the_bead_against_the_pzt_is_measured_in_each_cycle() {
    let plan = plan(TEXT);
    // A bead that follows exactly needs v / K of displacement, held from tick to tick and seen two ticks later.
    let all = records(&plan, |r, _| r, |_| true);
    let mut moved = all.clone();
    for k in 0..all.len() - 1 {
        moved[k].command_um = 20.0 + (all[k + 1].target_um - all[k].target_um) * 1e3 / 400.0;
    }
    let rows = table(&plan, &moved);
    for row in &rows[1..19] {
        assert!((row.gain_per_s - 400.0).abs() < 0.5, "{row:?}");
    }
    assert!(plan.at_um(0.0) == 1.0);
}

#[test]
fn length_and_area_of_a_cell_are_each_taken_at_the_phases_of_the_cycle() {
    let plan = plan(TEXT);
    // Length and area follow the bead; the area is not measured at all in the tenth cycle.
    let (start_ns, end_ns) = bounds_ns(&plan.cycle(10).unwrap());
    let all = records(
        &plan,
        |r, _| r,
        |record| {
            record.length_um = 10.0 + record.measured_um;
            let exposed_ns = record.plan_ns - 2_000_000;
            record.area_um2 = if (start_ns..end_ns).contains(&exposed_ns) {
                f64::NAN
            } else {
                60.0 + 4.0 * record.measured_um
            };
            true
        },
    );
    for row in &table(&plan, &all)[..20] {
        let close = |value: f64, expected: f64| (value - expected).abs() < 0.05;
        // 1 um and an amplitude of 2 um: 11, 13, 11, 9, 11 um.
        assert!(close(row.length_start_um, 11.0) && close(row.length_end_um, 11.0 - 0.13));
        assert!(close(row.length_quarter_um, 13.0) && close(row.length_peak_um, 13.0));
        assert!(close(row.length_half_um, 11.0) && close(row.length_three_quarters_um, 9.0));
        let areas = [
            (row.area_start_um2, 64.0),
            (row.area_quarter_um2, 72.0),
            (row.area_half_um2, 64.0),
            (row.area_three_quarters_um2, 56.0),
            (row.area_peak_um2, 72.0),
            (row.area_end_um2, 64.0 - 0.5),
        ];
        for (value, expected) in areas {
            if row.cycle == 10 {
                assert!(value.is_nan(), "{row:?}");
            } else {
                assert!((value - expected).abs() < 0.2, "{row:?}");
            }
        }
    }
}

#[test]
fn one_lost_frame_touches_a_cycle_and_does_not_disturb_it() {
    let plan = plan(TEXT);
    let first = 2 + records(&plan, |r, _| r, |_| true)
        .iter()
        .position(|r| r.stage == Stage::Running as u8)
        .unwrap() as u64;
    let all = records(
        &plan,
        |r, _| r,
        |record| {
            // One frame in cycle 4, three (a fiftieth and more) in cycle 6; one frozen tick in cycle 8.
            let lost = [first + 440, first + 610, first + 640, first + 670];
            if lost.contains(&record.seq) {
                record.flags.set(TickFlags::LOST);
                record.verdict = 1;
            }
            if record.seq == first + 850 {
                record.flags.set(TickFlags::FREEZE);
            }
            true
        },
    );
    let rows = table(&plan, &all);
    assert_eq!(rows[4].flags.to_string(), "lost");
    assert!(!rows[4].flags.is_disturbed() && rows[4].flags.is_touched());
    assert!(rows[6].flags.is_disturbed() && rows[8].flags.is_disturbed());
    let disturbed = rows.iter().filter(|row| row.flags.is_disturbed()).count();
    assert_eq!(disturbed, 2);
}

#[test]
fn a_cycle_of_which_the_operator_skipped_a_part_says_so() {
    // Cycles of a repeat: out, stay, back, rest; the operator skips a stay.
    let plan = plan(
        "[[step]]\ndo = \"repeat\"\ntimes = 4\n[[step.step]]\ndo = \"move\"\nto = \"2um\"\nduration = \"50ms\"\n\
         [[step.step]]\ndo = \"hold\"\nduration = \"100ms\"\n[[step.step]]\ndo = \"move\"\nto = \"0um\"\n\
         duration = \"50ms\"\n[[step.step]]\ndo = \"hold\"\nduration = \"100ms\"\n",
    );
    let first = records(&plan, |r, _| r, |_| true)
        .iter()
        .position(|r| r.stage == Stage::Running as u8)
        .unwrap() as u64;
    // 80 ms into the second cycle.
    let all = records_skipping(&plan, |r, _| r, |_| true, Some(first + 380));
    let rows = table(&plan, &all);
    assert_eq!(numbers(&rows), vec![0, 1, 2, 3]);
    for row in &rows {
        assert_eq!(
            row.flags.has(CycleFlags::SKIPPED),
            row.cycle == 1,
            "{row:?}"
        );
        assert_eq!(row.flags.is_disturbed(), row.cycle == 1, "{row:?}");
    }
}

#[test]
fn cycles_of_ramps_say_so_and_the_passes_of_a_sweep_have_rows() {
    let plan = plan(
        "[[step]]\ndo = \"sine\"\namplitude = \"2um\"\nfrequency = \"10Hz\"\ncycles = 8\nramp_in = 2\nramp_out = 1\n\
         [[step]]\ndo = \"sweep\"\nname = \"to\"\nvalues = [\"1um\", \"2um\", \"3um\"]\n[[step.step]]\ndo = \"move\"\n\
         to = \"$to\"\nduration = \"100ms\"\n[[step.step]]\ndo = \"move\"\nto = \"0um\"\nduration = \"100ms\"\n",
    );
    let rows = table(&plan, &records(&plan, |r, _| r, |_| true));
    assert_eq!(numbers(&rows), (0..11).collect::<Vec<u64>>());
    for row in &rows {
        let ramp = [0, 1, 7].contains(&row.cycle);
        assert_eq!(
            row.flags.to_string(),
            if ramp { "ramp" } else { "" },
            "{row:?}"
        );
    }
    let strokes: Vec<f64> = rows[8..].iter().map(|row| row.stroke_um).collect();
    for (stroke, expected) in strokes.iter().zip([0.5, 1.0, 1.5]) {
        assert!((stroke - expected).abs() < 1e-3, "{strokes:?}");
    }
}
