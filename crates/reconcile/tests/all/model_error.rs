//! A model that was identified is off by what its own covariance allows. That is no effect, and hides none.

use crate::closed_loop::{DELAY_S, Flow, Hidden, WORKING_POINT_UM, closed_loop, survey};
use cellpos_plant::{Covariance, Model, Noise, effects};
use cellpos_reconcile::{Options, Reconciliation, Verdict, reconcile};

/// By how much the model's delay is wrong, and the standard deviation that it may state \[s\].
const OFF_S: f64 = 2.5e-4;
const STATED_S: f64 = 1.5e-4;

/// Reconciles a survey with a model whose delay is too long.
fn beside_a_long_delay(
    hidden: Hidden,
    stated: bool,
    max_effects: usize,
    seed: u64,
) -> Reconciliation {
    let flow = Flow {
        wander_um: 0.006,
        time_s: 20.0,
        drift_um_per_s: 0.001,
    };
    let mut model = Model {
        working_point_um: WORKING_POINT_UM,
        noise: Noise {
            diffusion_um2_per_s: 0.33,
            localisation_um: 0.012,
        },
        ..Model::eq6()
    }
    .with_effect(effects::time_delay(DELAY_S + OFF_S));
    model.covariance = stated.then(|| Covariance {
        parameters: vec!["time-delay.delay_s".to_owned()],
        matrix: vec![vec![STATED_S * STATED_S]],
    });
    let options = Options {
        free_working_point: true,
        max_effects,
        ..Options::default()
    };
    let record = closed_loop(flow, hidden, survey, seed);
    reconcile(&model, &[record], &options, &mut |_| {}).unwrap()
}

fn ids(r: &Reconciliation) -> Vec<&str> {
    r.effects.iter().map(|e| e.id.as_str()).collect()
}

#[test]
fn an_error_that_the_model_states_is_no_effect() {
    let r = beside_a_long_delay(Hidden::Nothing, true, 4, 81);
    assert_eq!(r.verdict, Verdict::NothingMissing, "{:?}", r.places);
    // The same error is a disagreement where the model states none, whatever would be named after the first.
    let r = beside_a_long_delay(Hidden::Nothing, false, 1, 81);
    assert_ne!(r.verdict, Verdict::NothingMissing, "{:?}", r.places);
}

#[test]
#[ignore = "18 s of a debug build: for .ci/nightly"]
fn an_effect_beside_it_has_its_name_and_an_interval_with_that_error_in_it() {
    let r = beside_a_long_delay(Hidden::Lag(120.0), true, 4, 82);
    assert_eq!(ids(&r), ["driver-lag"], "{:?}", r.places);
    let hz = &r.effects[0].parameters["bandwidth_hz"];
    let half = 0.5 * (hz.ci95[1] - hz.ci95[0]);
    assert!((hz.value - 120.0).abs() < 1.5 * half, "{hz:?}");
}
