//! Tests of mid-ranging.

use super::*;

const CONFIG: PartnerConfig = PartnerConfig {
    period_ms: 20.0,
    low_um: 0.0,
    high_um: 1000.0,
    slew_um_per_s: 50.0,
    gain: -0.5,
    gain_ci95: 0.01,
    lag_ms: 50.0,
    delay_ms: 7.0,
    step_um: 0.0,
    mid_um: 20.0,
    probe: None,
};

fn partner(config: PartnerConfig) -> Partner {
    Partner::new(config, &Limits::default(), 1e-3).expect("sound")
}

/// A PZT that follows the zero flow exactly while the partner moves it; the partner reports each period.
fn run(
    partner: &Partner,
    seconds: f64,
    drift_um_per_s: f64,
    told: impl Fn(u64) -> bool,
) -> Vec<(f64, PartnerState)> {
    let mut state = PartnerState::default();
    let (mut zero_um, mut out) = (20.0, Vec::new());
    for k in 0..(seconds * 1e3) as u64 {
        zero_um += drift_um_per_s * 1e-3;
        let stands_um = if state.command_um().is_finite() {
            state.command_um()
        } else {
            500.0
        };
        let report = (k % 20 == 0 && told(k)).then_some((stands_um, true));
        let given = PartnerInput {
            steps: 1,
            report,
            pzt_um: zero_um,
            held: true,
        };
        zero_um += partner.step(&mut state, &given).shift_um;
        out.push((zero_um, state));
    }
    out
}

#[test]
fn a_drift_of_many_strokes_is_taken_up_and_the_pzt_stays_at_the_middle() {
    let partner = partner(CONFIG);
    let path = run(&partner, 2000.0, 0.1, |_| true);
    let worst = path
        .iter()
        .map(|(um, _)| (um - 20.0).abs())
        .fold(0.0, f64::max);
    // In the steady state it is off by the drift in the time constant: 0.1 um/s x 0.67 s, and what it is late by.
    assert!(worst < 0.15, "{worst}");
    let stands_um = path.last().expect("ticks").1.command_um();
    assert!(
        (stands_um - (500.0 - 200.0 / 0.5)).abs() < 1.0,
        "{stands_um}"
    );
}

#[test]
fn moves_keep_rate_and_acceleration_and_settle_without_overshoot() {
    let partner = partner(CONFIG);
    let mut state = PartnerState::default();
    let (mut zero_um, mut last, mut last_move) = (26.0, 500.0, 0.0);
    for k in 0..60_000_u64 {
        let report =
            (k % 20 == 0).then_some((if k == 0 { 500.0 } else { state.command_um() }, true));
        let out = partner.step(
            &mut state,
            &PartnerInput {
                steps: 1,
                report,
                pzt_um: zero_um,
                held: true,
            },
        );
        zero_um += out.shift_um;
        if let Some(um) = out.command_um {
            let moved = um - last;
            assert!(moved.abs() <= partner.most_um + 1e-9);
            assert!((moved - last_move).abs() <= partner.more_um + 1e-9);
            (last, last_move) = (um, moved);
        }
        assert!(zero_um > 20.0 - 0.01, "{zero_um}");
    }
    assert!((zero_um - 20.0).abs() < 1e-3, "{zero_um}");
}

#[test]
fn its_effect_is_that_of_a_lag_behind_a_delay() {
    let probe = Probe {
        amplitude_um: 0.5,
        half_period_s: 1.0,
    };
    let partner = partner(PartnerConfig {
        probe: Some(probe),
        ..CONFIG
    });
    let path = run(&partner, 1.5, 0.0, |_| true);
    // The step is in tick 999; the middle of the tick 107 ms later is 100.5 ms into the lag.
    let at = path[1106].1.effect_um() - path[999].1.effect_um();
    let expected = -0.5 * 0.5 * (1.0 - (-0.1005_f64 / 0.05).exp());
    assert!((at - expected).abs() < 1e-9, "{at} {expected}");
    assert!(
        path.iter().all(|(um, _)| *um == 20.0),
        "the loop is not told of a probe"
    );
}

#[test]
fn a_silent_partner_is_lost_after_five_periods_and_taken_up_again() {
    let partner = partner(CONFIG);
    let path = run(&partner, 3.0, 0.05, |k| !(1000..2000).contains(&k));
    assert_eq!(path[1070].1.status(), PartnerStatus::Follows);
    assert_eq!(path[1120].1.status(), PartnerStatus::Lost);
    assert_eq!(path[1121].1.command_um(), path[1999].1.command_um());
    assert_eq!(path[2010].1.status(), PartnerStatus::Follows);
    assert!(path[2999].1.command_um() < path[1999].1.command_um());
}

#[test]
fn values_that_cannot_be_are_named() {
    let limits = Limits::default();
    let of = |change: fn(&mut PartnerConfig)| {
        let mut config = CONFIG;
        change(&mut config);
        Partner::new(config, &limits, 1e-3)
            .expect_err("wrong")
            .to_string()
    };
    assert!(of(|c| c.gain = 0.0).contains("gain"));
    assert!(of(|c| c.mid_um = 90.0).contains("mid_um"));
    assert!(of(|c| c.period_ms = 0.1).contains("period_ms"));
    assert!(of(|c| c.delay_ms = 5000.0).contains("delay_ms"));
}

#[test]
fn commands_are_on_the_steps_of_the_converter_and_the_flow_is_taken_up_all_the_same() {
    let partner = partner(PartnerConfig {
        step_um: 0.0125,
        ..CONFIG
    });
    let path = run(&partner, 200.0, 0.01, |_| true);
    for (_, state) in &path {
        let steps = state.command_um() / 0.0125;
        assert!(!steps.is_finite() || (steps - steps.round()).abs() < 1e-6);
    }
    let worst = path
        .iter()
        .map(|(um, _)| (um - 20.0).abs())
        .fold(0.0, f64::max);
    assert!(worst < 0.05, "{worst}");
}
