//! The discrepancy workflow on records of the truth simulator: what is not in the vocabulary gets no name, what cannot be
//! separated gets all its names, and how the files are cut and ordered changes nothing.

use cellpos_plant::Model;
use cellpos_reconcile::{Options, ReconcileError, Reconciliation, Record, Verdict, reconcile};
use cellpos_tests::truth::cases::Case;
use cellpos_tests::truth::table::records;
use cellpos_tests::truth::{Hidden, threshold::above_threshold};

fn hiding(hidden: Hidden, seed: u64) -> Vec<Record> {
    let case = Case {
        group: "single",
        level: "",
        hidden: vec![hidden],
    };
    records(&case, seed)
}

fn run(records: &[Record]) -> Result<Reconciliation, ReconcileError> {
    reconcile(&Model::eq6(), records, &Options::default(), &mut |_| {})
}

#[test]
#[ignore = "long: run with --release -- --include-ignored"]
fn jumps_of_the_bead_are_unknown_and_it_says_where() {
    let result = run(&hiding(Hidden::Jumps(1.5), 11)).unwrap();
    assert_eq!(result.verdict, Verdict::Unknown);
    assert!(result.effects.is_empty());
    assert!(
        result.places.iter().any(|p| p.contains("in single rows")),
        "{:?}",
        result.places
    );
}

#[test]
fn a_line_off_the_mains_is_unknown_with_a_formula_that_holds_on_held_out_data() {
    let result = run(&hiding(Hidden::Line(37.0, 0.15), 12)).unwrap();
    assert_eq!(result.verdict, Verdict::Unknown);
    let hypothesis = result.hypothesis.as_ref().unwrap();
    assert!(
        hypothesis.formula.contains("37.0"),
        "{}",
        hypothesis.formula
    );
    assert!(
        hypothesis.held_out_worth > 0.95,
        "{}",
        hypothesis.held_out_worth
    );
    let amplitude_um = hypothesis.terms[0].coefficient;
    assert!((amplitude_um / 0.15 - 1.0).abs() < 0.05, "{amplitude_um}");
    let json = result.to_json();
    assert_eq!(json["verdict"], "unknown");
    assert_eq!(json["effects"], serde_json::json!([]));
    assert!(!json["where"].as_array().unwrap().is_empty());
}

#[test]
fn a_leak_twice_above_the_threshold_is_named_however_the_records_are_ordered_and_cut() {
    let weak = Hidden::Leak(0.08);
    let times = above_threshold(&[weak], 13);
    assert!((1.8..2.4).contains(&times), "{times} times the threshold");
    let mut files = hiding(weak, 13);
    let whole = run(&files).unwrap();
    assert_eq!(whole.verdict, Verdict::Named);
    let named: Vec<&str> = whole.effects.iter().map(|e| e.id.as_str()).collect();
    assert_eq!(named, ["leak"]);
    let corner = &whole.effects[0].parameters["corner_rad_per_s"];
    assert!(
        corner.ci95[0] <= 0.08 && 0.08 <= corner.ci95[1],
        "{corner:?}"
    );
    files.reverse();
    let again = run(&files).unwrap();
    assert_eq!(again.to_json(), whole.to_json(), "to the last digit");
}

#[test]
fn a_lag_too_short_to_tell_its_kind_is_ambiguous_with_every_kind_and_the_experiment_that_would_tell()
 {
    let result = run(&hiding(Hidden::Delay(1.05e-5), 14)).unwrap();
    assert_eq!(result.verdict, Verdict::Ambiguous);
    let [effect] = result.effects.as_slice() else {
        panic!("one effect, not {:?}", result.effects);
    };
    let inside = |id: &str| effect.id == id || effect.alternatives.iter().any(|a| a == id);
    for id in ["time-delay", "driver-lag", "exposure-averaging", "bubble"] {
        assert!(
            inside(id),
            "{id}: {} or {:?}",
            effect.id,
            effect.alternatives
        );
    }
    assert!(effect.separate_by.as_ref().unwrap().contains("300 Hz"));
}
