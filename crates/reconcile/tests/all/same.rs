//! Measured records say the same in other units, in another order, with a hundredth of noise.

use super::measured::Set;
use super::nulls::{base, sets};
use cellpos_numeric::Random;
use cellpos_plant::Model;
use cellpos_reconcile::{Reconciliation, Verdict};

/// The set with other numbers in its columns.
fn with(s: &Set, change: impl Fn(&[f64], &[f64]) -> (Vec<f64>, Vec<f64>)) -> Set {
    let files = s.files.iter().map(|(name, u, y)| {
        let (u, y) = change(u, y);
        (name.clone(), u, y)
    });
    Set {
        files: files.collect(),
        ..*s
    }
}

fn said(r: &Reconciliation) -> (Verdict, Vec<String>) {
    (r.verdict, r.effects.iter().map(|e| e.id.clone()).collect())
}

/// Powers of ten for input and output.
const UNITS: [[i32; 2]; 5] = [[3, 0], [0, -3], [-6, 9], [12, -12], [-9, -9]];

fn in_other_units(s: &Set, model: &Model, one: &Reconciliation) {
    for powers in UNITS {
        let [input, output] = powers.map(|p| 10f64.powi(p));
        let times = |v: &[f64], factor: f64| v.iter().map(|v| v * factor).collect::<Vec<_>>();
        let other = with(s, |u, y| (times(u, input), times(y, output)));
        let model = Model {
            plant: model.plant.scaled(output / input).unwrap(),
            working_point_um: input * model.working_point_um,
            ..model.clone()
        };
        let r = other.run(&model, &other.records(|n| 0..n)).unwrap();
        assert_eq!(said(&r), said(one), "{powers:?}");
        let ratio = r.gap.before / one.gap.before / output;
        assert!((ratio - 1.0).abs() < 1e-3, "{powers:?}: {ratio}");
    }
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/measured")]
fn a_verdict_on_measured_records_does_not_change_with_units_order_or_a_hundredth_of_noise() {
    for s in &sets(2)[..3] {
        let model = base(s, 0);
        let whole = s.records(|n| 0..n);
        let one = s.run(&model, &whole).unwrap();
        in_other_units(s, &model, &one);

        let mut turned = s.records(|n| 0..n);
        turned.reverse();
        let r = s.run(&model, &turned).unwrap();
        assert_eq!(said(&r), said(&one), "turned");

        let mut random = Random::new(9);
        let mut noisy = |v: &[f64]| -> Vec<f64> {
            let n = v.len() as f64;
            let mean = v.iter().sum::<f64>() / n;
            let size = (v.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
            v.iter()
                .map(|v| v + 0.01 * size * random.normal())
                .collect()
        };
        let files = s
            .files
            .iter()
            .map(|(name, u, y)| (name.clone(), u.clone(), noisy(y)));
        let noisy = Set {
            files: files.collect(),
            ..*s
        };
        let r = noisy.run(&model, &noisy.records(|n| 0..n)).unwrap();
        assert_eq!(said(&r), said(&one), "with a hundredth of noise");
    }
}
