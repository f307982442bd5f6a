//! A design of whatever a model file may hold comes to an end: with figures, or with a sentence.

use cellpos_control::design::{
    DesignLimits, DesignPlant, DesignReport, DesignRequest, DesignWarning, PiSearch, Requested,
    default_lead, design,
};
use cellpos_control::{ControllerConfig, Limits, Lqg, Mpc, Pi};
use cellpos_plant::TransferFunction;
use proptest::prelude::*;
use std::sync::mpsc::channel;
use std::time::Duration;

/// Far beyond what any of them takes: what does not end is told from what is slow on a busy machine.
const ENDLESS: Duration = Duration::from_secs(120);

/// A number of any size that a file may hold, of either sign, zero and no number among them.
fn any_size() -> impl Strategy<Value = f64> {
    let sized = (-12.0..12.0_f64, any::<bool>())
        .prop_map(|(power, negative)| 10_f64.powf(power) * if negative { -1.0 } else { 1.0 });
    prop_oneof![
        20 => sized,
        1 => Just(0.0),
        1 => Just(f64::NAN),
        1 => Just(f64::INFINITY),
        1 => Just(f64::MIN_POSITIVE),
        1 => Just(1e300),
    ]
}

fn any_law() -> impl Strategy<Value = Requested> {
    let search = |lead| {
        Requested::SearchPi(PiSearch {
            max_ms: 1.6,
            max_mt: 1.3,
            lead,
        })
    };
    prop_oneof![
        Just(search(None)),
        (1e-4..1e-2_f64).prop_map(move |delay_s| search(Some(default_lead(delay_s)))),
        (any_size(), any_size()).prop_map(|(kp, ki)| Requested::Pi(Pi::new(kp, ki))),
        Just(Requested::Given(ControllerConfig::Lqg(Lqg::default()))),
        Just(Requested::Given(ControllerConfig::Mpc(
            Mpc::default(),
            Pi::new(0.46, 19.5)
        ))),
    ]
}

/// A design on a thread of its own; nothing where it does not end, or panics.
fn ends(request: DesignRequest) -> Option<Result<DesignReport, String>> {
    let (done, result) = channel();
    std::thread::spawn(move || {
        let _ = done.send(design(&request).map_err(|error| error.to_string()));
    });
    result.recv_timeout(ENDLESS).ok()
}

fn request(plant: DesignPlant, controller: Requested) -> DesignRequest {
    DesignRequest {
        plant,
        controller,
        setpoint_weight: None,
        command_limits: Limits::default(),
        estimator: None,
        limits: DesignLimits::default(),
    }
}

proptest! {
    // A debug build draws fewer: the nightly run, a release build, draws all, and others each night.
    #![proptest_config(ProptestConfig { cases: if cfg!(debug_assertions) { 50 } else { 200 }, ..ProptestConfig::default() })]

    #[test]
    fn a_badly_scaled_model_ends_in_a_design_or_a_sentence(
        num in proptest::collection::vec(any_size(), 1..4),
        den in proptest::collection::vec(any_size(), 2..5),
        integrates in any::<bool>(),
        delay_s in prop_oneof![4 => 0.0..0.03_f64, 1 => 0.0..10.0_f64, 1 => any_size()],
        sample_time_s in prop_oneof![8 => Just(1e-3), 1 => 1e-6..1.0_f64],
        noise in (any_size(), any_size()),
        controller in any_law(),
    ) {
        let mut den = den;
        if integrates {
            // Lowest power last: a pole at the origin, as the rig's plant has.
            let last = den.len() - 1;
            den[last] = 0.0;
        }
        let Ok(plant) = TransferFunction::new(num.clone(), den.clone()) else {
            return Ok(());
        };
        let plant = DesignPlant {
            plant,
            delay_s,
            sample_time_s,
            diffusion_um2_per_s: noise.0,
            fix_noise_um: noise.1,
            ..DesignPlant::eq6(2.5e-3)
        };
        let ended = ends(request(plant, controller));
        prop_assert!(ended.is_some(), "panics or does not end: {num:?} / {den:?}, {delay_s} s at {sample_time_s} s");
        if let Some(Err(sentence)) = ended {
            prop_assert!(sentence.len() > 20, "{sentence:?}");
        }
    }
}

#[test]
fn poles_that_rounding_tears_apart_end_in_a_design_or_a_sentence() {
    let plant = DesignPlant {
        plant: TransferFunction::new(vec![1.0], vec![1e300, 1.0, 1.0, 1.0]).unwrap(),
        ..DesignPlant::eq6(2.5e-3)
    };
    let ended = ends(request(
        plant,
        Requested::Given(ControllerConfig::Lqg(Lqg::default())),
    ));
    assert!(ended.is_some());
}

/// What a fit makes of a delay that it has no other place for: a zero to the right, and a pole and a zero beyond every band.
#[test]
fn a_pole_beyond_every_band_is_settled_at_once_and_gets_a_loop() {
    let (gain, zero) = (396.0, 4200.0);
    for pole in [1e7, 1e9, 4.7e11] {
        let num = vec![-1e-4 * gain / zero, -gain / zero * pole, gain * pole];
        let plant = DesignPlant {
            plant: TransferFunction::new(num, vec![1.0, pole, 0.0]).unwrap(),
            ..DesignPlant::eq6(2.2e-3)
        };
        let model = plant.loop_model().unwrap();
        assert!((model.gain_per_s / gain - 1.0).abs() < 1e-6, "{model:?}");
        assert!((model.feedthrough + gain / zero).abs() < 2e-4, "{model:?}");
        assert!((model.fast_gain_per_s() / gain - 1.0).abs() < 1e-6);
        let lqg = Requested::Given(ControllerConfig::Lqg(Lqg::default()));
        let report = ends(request(plant, lqg))
            .expect("it ends")
            .expect("margins");
        assert!(report.config.is_some(), "{:?}", report.warnings);
    }
}

#[test]
fn a_gain_that_no_stroke_can_use_gets_no_loop_and_its_value_is_named() {
    let pi = Pi::new(1.0, 1.0);
    for (num, den) in [
        (vec![1.0, 1.0], vec![1e300, 1.0]),
        (vec![1e-9], vec![1.0, 0.0]),
    ] {
        let plant = DesignPlant {
            plant: TransferFunction::new(num, den).unwrap(),
            ..DesignPlant::eq6(2.5e-3)
        };
        let report = ends(request(plant, Requested::Given(ControllerConfig::Pi(pi))))
            .expect("it ends")
            .expect("margins");
        assert!(report.config.is_none(), "no loop runs with it");
        assert!(
            matches!(&report.warnings[..], [DesignWarning::NoLoop(error), ..] if error.to_string().contains("gain_per_s")),
            "{:?}",
            report.warnings
        );
    }
}

#[test]
fn a_delay_of_seconds_is_refused_by_its_length() {
    for delay_s in [0.05, 0.9, 10.0, 1e9, f64::INFINITY] {
        let plant = DesignPlant {
            delay_s,
            ..DesignPlant::eq6(2.5e-3)
        };
        let search = PiSearch {
            max_ms: 1.6,
            max_mt: 1.3,
            lead: None,
        };
        let sentence = ends(request(plant, Requested::SearchPi(search)))
            .expect("it ends")
            .expect_err("no loop reaches back so far");
        assert!(sentence.contains("32 samples"), "{sentence}");
    }
}

#[test]
fn a_plant_without_gain_is_refused_in_a_sentence() {
    let ended = TransferFunction::new(vec![0.0], vec![1.0, 0.0])
        .map_err(|error| error.to_string())
        .and_then(|plant| {
            let plant = DesignPlant {
                plant,
                ..DesignPlant::eq6(2.5e-3)
            };
            let search = PiSearch {
                max_ms: 1.6,
                max_mt: 1.3,
                lead: None,
            };
            ends(request(plant, Requested::SearchPi(search))).expect("it ends")
        });
    let sentence = ended.expect_err("nothing moves the bead");
    assert!(sentence.len() > 20, "{sentence}");
}
