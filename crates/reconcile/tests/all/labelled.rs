//! The labelled records: made by a program of another make, with the hidden effect in the folder's name.

use cellpos_numeric::Random;
use cellpos_plant::Model;
use cellpos_reconcile::{
    Options, ReconcileError, Reconciliation, Record, Verdict, reconcile, report,
};
use std::path::{Path, PathBuf};

fn data() -> PathBuf {
    Path::new(env!("MEASURED_DATA")).join("hidden-effects")
}

fn read(path: &Path) -> Record {
    let text = std::fs::read_to_string(path).unwrap();
    let (mut t, mut u, mut y) = (Vec::new(), Vec::new(), Vec::new());
    for line in text.lines().skip(1) {
        let mut cells = line.split(',');
        t.push(cells.next().unwrap().parse().unwrap());
        u.push(cells.next().unwrap().parse().unwrap());
        y.push(cells.next().unwrap().trim().parse().unwrap_or(f64::NAN));
    }
    Record::from_rows(path.file_stem().unwrap().to_str().unwrap(), &t, &u, &y).unwrap()
}

fn case(name: &str) -> Vec<Record> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(data().join(name))
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    files.sort();
    files.iter().map(|f| read(f)).collect()
}

fn run(records: &[Record]) -> Result<Reconciliation, ReconcileError> {
    reconcile(&Model::eq6(), records, &Options::default(), &mut |_| {})
}

fn expect(name: &str, ids: &[&str]) -> Reconciliation {
    expect_with(name, ids, &Options::default())
}

fn expect_with(name: &str, ids: &[&str], options: &Options) -> Reconciliation {
    let result = reconcile(&Model::eq6(), &case(name), options, &mut |_| {}).unwrap();
    let mut named: Vec<&str> = result.effects.iter().map(|e| e.id.as_str()).collect();
    named.sort_unstable();
    assert_eq!(named, ids, "{name}: {:?}", result.places);
    let verdict = if ids.is_empty() {
        Verdict::NothingMissing
    } else {
        Verdict::Named
    };
    assert_eq!(result.verdict, verdict, "{name}");
    if !ids.is_empty() {
        assert!(
            result.gap.closure() > 0.9,
            "{name}: closure {}",
            result.gap.closure()
        );
        for id in ids {
            assert!(
                result.augmented.effect(id).is_some(),
                "{name}: {id} is in the augmented model"
            );
        }
    }
    result
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/hidden-effects")]
fn a_time_delay_is_named_and_the_report_says_so_before_anything_else() {
    // One name and no search for a second.
    let one = Options {
        max_effects: 1,
        ..Options::default()
    };
    let result = expect_with("time-delay", &["time-delay"], &one);
    let page = report(&result, "labelled").to_html();
    let text = page.split("<body").nth(1).unwrap();
    let order = [
        "The model lacks: time-delay at the camera, delay = ",
        "With that the prediction error on records that the fit had not seen falls from",
        "How sure:",
        "Prediction error by frequency band: the part of each band",
        "The effects in numbers",
        "Records and noise",
    ];
    let at: Vec<Option<usize>> = order.iter().map(|words| text.find(words)).collect();
    assert!(at.iter().all(Option::is_some) && at.is_sorted(), "{at:?}");
}

#[test]
#[ignore = "nightly: a second name is looked for as well; the fast one looks for one"]
fn a_time_delay_is_named_and_nothing_else() {
    expect("time-delay", &["time-delay"]);
}

#[test]
#[ignore = "long: run with --release -- --include-ignored; that of a measured piezo is named in measured_piezo.rs"]
fn hysteresis_of_the_piezo_is_named() {
    expect("pzt-hysteresis", &["pzt-hysteresis"]);
}

#[test]
#[cfg_attr(not(no_shared_data), ignore = "27 s of a debug build: for .ci/nightly")]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/hidden-effects")]
fn a_flow_drift_is_named_however_the_records_are_ordered_and_cut() {
    let first = expect("flow-drift", &["flow-drift"]);
    let mut other = case("flow-drift");
    other.reverse();
    let cut = other.remove(1);
    let middle = cut.rows() / 3;
    other.insert(0, cut.part(middle, cut.rows()));
    other.push(cut.part(0, middle));
    let second = run(&other).unwrap();
    assert_eq!(first.verdict, second.verdict);
    assert_eq!(first.effects, second.effects);
}

#[test]
#[ignore = "long: run with --release -- --include-ignored"]
fn adhesion_to_the_wall_is_named() {
    expect("wall-adhesion", &["wall-adhesion"]);
}

#[test]
#[ignore = "long: run with --release -- --include-ignored"]
fn averaging_over_the_exposure_is_told_from_a_delay_by_the_noise() {
    expect("exposure-averaging", &["exposure-averaging"]);
}

#[test]
#[ignore = "nightly: a quarter of a minute; the fast one names a delay"]
fn a_lag_of_the_driver_is_named_with_the_bubble_as_its_alternative() {
    expect("driver-lag", &["driver-lag"]);
}

#[test]
#[ignore = "long: run with --release -- --include-ignored"]
fn delay_and_hysteresis_together_are_both_named() {
    expect(
        "time-delay+pzt-hysteresis",
        &["pzt-hysteresis", "time-delay"],
    );
}

#[test]
#[ignore = "long: run with --release -- --include-ignored"]
fn leak_and_hum_together_are_both_named() {
    expect("leak+mains-hum", &["leak", "mains-hum"]);
}

#[test]
#[ignore = "nightly: the fast ones have records of linear models, and a loop that hides nothing"]
fn records_that_hide_nothing_get_no_name() {
    expect("none-1", &[]);
}

#[test]
#[cfg_attr(
    not(no_shared_data),
    ignore = "nightly: 6 s of a debug build; the fast ones have records of linear models, and a loop that hides nothing"
)]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/hidden-effects")]
fn other_records_that_hide_nothing_get_no_name_either() {
    expect("none-2", &[]);
}

#[test]
fn wrong_units_constant_inputs_short_and_foreign_records_get_a_message() {
    let records = case("none-1");
    let changed = |f: &dyn Fn(&mut Record)| {
        let mut all = records.clone();
        all.iter_mut().for_each(f);
        run(&all)
    };
    let nanometres = changed(&|r| r.bead_um.iter_mut().for_each(|b| *b *= 1000.0));
    assert!(
        matches!(nanometres, Err(ReconcileError::Units { ratio, .. }) if ratio > 900.0),
        "{nanometres:?}"
    );
    let volts = changed(&|r| r.pzt_um.iter_mut().for_each(|u| *u /= 4.0));
    assert!(
        matches!(volts, Err(ReconcileError::WorkingPoint { .. })),
        "{volts:?}"
    );
    let reversed = changed(&|r| r.bead_um.iter_mut().for_each(|b| *b = -*b));
    assert!(
        matches!(reversed, Err(ReconcileError::Units { what: "sign", .. })),
        "{reversed:?}"
    );
    let rest: Vec<Record> = records.iter().filter(|r| r.is_rest()).cloned().collect();
    assert_eq!(run(&rest), Err(ReconcileError::ConstantInput));
    let short = vec![records[0].part(0, 1500)];
    assert!(matches!(run(&short), Err(ReconcileError::TooShort { .. })));
    // A position that has nothing to do with the command: that of another record.
    let mut foreign = records.clone();
    for i in 0..records.len() {
        let other = &records[(i + 1) % records.len()].bead_um;
        let n = foreign[i].rows();
        foreign[i].bead_um = other.iter().copied().cycle().take(n).collect();
    }
    assert!(
        matches!(run(&foreign), Err(ReconcileError::AnotherRig { .. })),
        "{:?}",
        run(&foreign).map(|r| r.verdict)
    );
}

/// A bubble of 40 ms takes nearly all the fast motion away, which is what the innovations show. What is left goes with the command.
#[test]
fn a_bead_that_has_lost_its_fast_motion_is_not_of_another_rig() {
    // The search for what the bubble is does not matter here.
    let briefly = |records: &[Record]| {
        let options = Options {
            work: 0.002,
            max_effects: 1,
            ..Options::default()
        };
        reconcile(&Model::eq6(), records, &options, &mut |_| {})
    };
    let all = case("none-1");
    let mut records = all[..2].to_vec();
    for r in &mut records {
        let share = r.sample_s / 0.04;
        let mut slow = r.bead_um[0];
        for b in &mut r.bead_um {
            slow += share * (*b - slow);
            *b = slow;
        }
    }
    let result = briefly(&records);
    assert!(
        !matches!(result, Err(ReconcileError::AnotherRig { .. })),
        "{result:?}"
    );
    let mut still = all;
    for r in &mut still {
        let mut noise = Random::new(3);
        r.bead_um
            .iter_mut()
            .for_each(|b| *b = 0.02 * noise.normal());
    }
    let result = briefly(&still);
    assert!(
        matches!(result, Err(ReconcileError::AnotherRig { .. })),
        "{result:?}"
    );
}
