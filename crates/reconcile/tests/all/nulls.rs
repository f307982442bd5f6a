//! Records that a linear model and noise made on measured inputs: nothing is missing, and that is what is said.

use super::measured::{Set, free_response, rough, set};
use cellpos_ident::base::{Series, choose};
use cellpos_ident::sampled::Hold;
use cellpos_numeric::Random;
use cellpos_plant::{Model, TransferFunction, effects};
use cellpos_reconcile::Verdict;

/// The records of a set made again by a linear model fitted to one of them: its input, its order, and noise of the size of its residual,
/// half of it white and half of it slow.
fn made_again(s: &Set, model: &Model, of: usize, seed: u64) -> Set {
    let (name, u, y) = &s.files[of];
    let response = free_response(model, s.hold, s.sample_s, u);
    let rms = |values: &[f64]| {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()
    };
    let residual: Vec<f64> = y.iter().zip(&response).map(|(y, s)| y - s).collect();
    // A tenth of the motion at most: what a poor base leaves is no noise.
    let size = rms(&residual).min(0.1 * rms(&response));
    let mut random = Random::new(seed);
    let keep = (-1.0 / 8.0_f64).exp();
    let mut slow = random.normal();
    let noisy = response.iter().map(|s| {
        slow = keep * slow + (1.0 - keep * keep).sqrt() * random.normal();
        s + size * std::f64::consts::FRAC_1_SQRT_2 * (slow + random.normal())
    });
    Set {
        sample_s: s.sample_s,
        order: s.order,
        hold: s.hold,
        files: vec![(name.clone(), u.clone(), noisy.collect())],
    }
}

/// The base that the command fits to a record, of an order at most.
pub(super) fn base(s: &Set, of: usize) -> Model {
    let (_, u, y) = &s.files[of];
    let series = Series {
        input: u.clone(),
        output: y.clone(),
    };
    let fit = choose(&[series], 1.0 / s.sample_s, s.hold, None, s.order)
        .unwrap()
        .remove(0);
    let mean = u.iter().sum::<f64>() / u.len() as f64;
    let mut model = Model {
        plant: TransferFunction::new(fit.model.numerator, fit.model.denominator).unwrap(),
        ..rough(1.0, &[1.0], fit.rest_input.unwrap_or(mean))
    };
    if fit.form.delay && fit.model.delay_s > 0.0 {
        model = model.with_effect(effects::time_delay(fit.model.delay_s));
    }
    println!("base {}: {:?}", fit.form, model.plant);
    model
}

/// Verdicts of the sets made again, with the models that are fitted to them: nothing missing, unknown, and names.
fn verdicts(sets: &[Set], seeds: std::ops::Range<u64>) -> [usize; 3] {
    let mut counts = [0; 3];
    for s in sets {
        for of in 0..s.files.len() {
            let model = base(s, of);
            for seed in seeds.clone() {
                let null = made_again(s, &model, of, seed);
                let r = null.run(&base(&null, 0), &null.records(|n| 0..n)).unwrap();
                let kind = match r.verdict {
                    Verdict::NothingMissing => 0,
                    Verdict::Unknown => 1,
                    _ => 2,
                };
                counts[kind] += 1;
                if kind > 0 {
                    println!(
                        "ROW {} order {} seed {seed}: {:?}",
                        s.files[of].0, s.order, r.verdict
                    );
                }
            }
        }
    }
    println!("nothing missing, unknown, named: {counts:?}");
    counts
}

/// Every set of measured records, with linear models of an order.
pub(super) fn sets(order: usize) -> Vec<Set> {
    let held = Hold::ZeroOrder;
    vec![
        set("hair-dryer", &["dryer"], ("u_V", "y_V"), 0.08, order, held),
        set(
            "coupled-drives",
            &["drive1", "drive2", "drive3"],
            ("u_V", "z_V"),
            0.02,
            order,
            held,
        ),
        set(
            "cascaded-tanks",
            &["tanks_Est", "tanks_Val"],
            ("u_V", "y_V"),
            4.0,
            order,
            held,
        ),
        set(
            "silverbox",
            &["sb_sch", "sb_ms10"],
            ("V1", "V2"),
            1.0 / 610.35,
            order,
            Hold::None,
        ),
    ]
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/measured")]
fn nothing_is_missing_where_a_linear_model_made_the_record() {
    let [nothing, unknown, named] = verdicts(&sets(2)[..1], 1..5);
    assert!(named == 0 && nothing >= 3, "{nothing} {unknown} {named}");
}

/// `ONLY=silverbox` takes one set, `SEEDS=5 FIRST=100` the seeds 100 to 104 (1 to 4 without them).
#[test]
#[ignore = "a table, minutes: cargo test --release -p cellpos-reconcile --test all nulls -- --ignored --nocapture"]
fn table_of_nulls_on_measured_inputs() {
    let number = |name: &str, or: u64| std::env::var(name).map_or(or, |s| s.parse().unwrap());
    let only = std::env::var("ONLY").ok();
    let (seeds, first) = (number("SEEDS", 4), number("FIRST", 1));
    let mut total = [0; 3];
    for order in 1..=3 {
        for s in sets(order) {
            if only
                .as_ref()
                .is_some_and(|only| !s.files[0].0.contains(only.as_str()))
            {
                continue;
            }
            println!("{} order {order}", s.files[0].0);
            let counts = verdicts(&[s], first..first + seeds);
            total.iter_mut().zip(counts).for_each(|(t, c)| *t += c);
        }
    }
    let runs: usize = total.iter().sum();
    println!("of {runs}: nothing missing, unknown, named: {total:?}");
    assert!(100 * total[2] <= runs, "{} false names", total[2]);
    assert!(100 * total[0] >= 95 * runs, "{} unknown", total[1]);
}
