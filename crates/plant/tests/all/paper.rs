//! The paper's facts, as far as they can be recomputed from its equations.

use crate::physical::{NotIdentifiable, PhysicalParameters, SecondOrder};
use cellpos_numeric::Random;
use cellpos_plant::{
    Complex, DiscretePlant, EQ5_LITERAL_PER_S, EQ5_VELOCITY_GAIN_PER_S, Hertz, Seconds, StateSpace,
    TransferFunction, probably_per_hertz,
};
use std::f64::consts::TAU;

const TABLE: [(f64, f64, f64); 10] = [
    (2.0, 30.62, -91.04),
    (5.0, 22.55, -92.33),
    (10.0, 16.26, -93.30),
    (20.0, 9.88, -92.92),
    (50.0, 1.67, -90.85),
    (100.0, -4.40, -89.13),
    (120.0, -5.99, -88.63),
    (150.0, -7.93, -87.94),
    (200.0, -10.42, -86.90),
    (300.0, -13.92, -84.97),
];

#[test]
fn gain_and_phase_of_eq_6_are_those_of_the_table() {
    let g = TransferFunction::eq6();
    for (f, db, deg) in TABLE {
        assert!((g.gain_db(Hertz(f)).value() - db).abs() < 0.01, "{f} Hz");
        assert!((g.phase_deg(Hertz(f)).value() - deg).abs() < 0.02, "{f} Hz");
    }
}

#[test]
fn poles_and_zeros_of_eq_6_are_an_integrator_and_a_nearly_cancelling_pair() {
    let g = TransferFunction::eq6();
    let poles = g.poles();
    assert!((poles[0].re + 0.001_704).abs() < 1e-6 && poles[0].im == 0.0);
    assert!((poles[1].re + 76.30).abs() < 0.01 && poles[1].im == 0.0);
    let zeros = g.zeros();
    assert!((zeros[0].re + 86.50).abs() < 0.01 && zeros[0].im == 0.0);
    assert!((zeros[1].re + 20175.0).abs() < 0.5 && zeros[1].im == 0.0);
    // Far below and far above the pair, and below the far zero.
    let (num, den) = (g.num(), g.den());
    let (below, above) = (num[2] / den[1], num[1] / den[0]);
    assert!((below - 428.0).abs() < 0.5 && (above - 379.0).abs() < 0.5);
    assert!((20.0 * (below / above).log10() - 1.05).abs() < 0.01);
    // The velocity gain read off the response agrees far from the pair.
    assert!((g.velocity_gain_at(Hertz(0.3)) - below).abs() < 1.0);
    assert!((g.velocity_gain_at(Hertz(120.0)) - above).abs() < 1.0);
}

#[test]
fn the_63_of_eq_5_is_a_gain_at_1_hz_and_means_2_pi_63_per_second() {
    let g = TransferFunction::eq6();
    // Within 1 dB of the plant over the paper's frequencies as meant, 16 dB off as printed.
    for (f, _, _) in TABLE {
        let as_meant = TransferFunction::integrator(EQ5_VELOCITY_GAIN_PER_S).unwrap();
        let literal = TransferFunction::integrator(EQ5_LITERAL_PER_S).unwrap();
        let of = |h: &TransferFunction| {
            (h.gain_db(Hertz(f)).value() - g.gain_db(Hertz(f)).value()).abs()
        };
        assert!(of(&as_meant) < 1.0, "{f} Hz: {}", of(&as_meant));
        assert!(
            (of(&literal) - 16.0).abs() < 1.0,
            "{f} Hz: {}",
            of(&literal)
        );
    }
    assert!((EQ5_VELOCITY_GAIN_PER_S - 395.84).abs() < 0.01);
    let hint = probably_per_hertz(62.0).unwrap();
    assert!(hint.to_string().contains("390/s"), "{hint}");
    for k in [379.0, 396.0, 428.0, 10.0] {
        assert!(probably_per_hertz(k).is_none());
    }
}

fn between(random: &mut Random, low: f64, high: f64) -> f64 {
    low * (high / low).powf(random.uniform())
}

fn random_rig(random: &mut Random) -> PhysicalParameters {
    PhysicalParameters {
        a1_m2: between(random, 1e-6, 1e-3),
        a2_m2: between(random, 1e-11, 1e-9),
        ac_m2: between(random, 1e-10, 1e-5),
        wall_mass_kg: between(random, 1e-9, 1e-3),
        wall_damping_n_s_per_m: between(random, 1e-4, 1e2),
        wall_stiffness_n_per_m: between(random, 1e-2, 1e5),
        fluid_mass_kg: between(random, 1e-12, 1e-6),
        channel_damping_n_s_per_m: between(random, 1e-8, 1e-2),
        outlet_stiffness_n_per_m: between(random, 1e-8, 1e-2),
    }
}

#[test]
fn eq_4_agrees_with_a_numeric_solution_of_eq_1_to_3_for_random_rigs() {
    let mut random = Random::new(1);
    for _ in 0..500 {
        let rig = random_rig(&mut random);
        let eq4 = rig.second_order().transfer_function().unwrap();
        let a4 = rig.transfer_function().unwrap();
        for f in [1e-3, 0.3, 10.0, 300.0, 1e5] {
            let numeric = rig.solve(Hertz(f)).unwrap();
            for g in [&eq4, &a4] {
                let error = (g.response(Hertz(f)) - numeric).norm() / numeric.norm();
                assert!(error < 1e-7, "{rig:?} at {f} Hz: {error}");
            }
        }
    }
}

#[test]
fn the_limits_a5_and_a6_are_those_of_the_response() {
    let mut random = Random::new(2);
    for _ in 0..100 {
        let rig = random_rig(&mut random);
        let slow = rig.solve(Hertz(1e-9)).unwrap().norm();
        let fast = rig.solve(Hertz(1e12)).unwrap().norm();
        assert!((slow / rig.low_frequency_limit() - 1.0).abs() < 1e-5);
        assert!((fast / rig.high_frequency_limit() - 1.0).abs() < 1e-5);
        // Open outlet, no fluid mass: both limits are the ratio of the areas. Rigid outlet: nothing moves.
        let ratio = rig.a1_m2 / rig.a2_m2;
        let open = PhysicalParameters {
            outlet_stiffness_n_per_m: 0.0,
            fluid_mass_kg: 0.0,
            ..rig
        };
        assert!((open.low_frequency_limit() / ratio - 1.0).abs() < 1e-12);
        assert!((open.high_frequency_limit() / ratio - 1.0).abs() < 1e-12);
        let rigid = PhysicalParameters {
            outlet_stiffness_n_per_m: 1e30,
            ..rig
        };
        assert!(rigid.low_frequency_limit() < 1e-12 * ratio);
    }
}

#[test]
fn the_corrected_a10_is_the_magnitude_of_a9_and_the_printed_one_is_not() {
    let c = SecondOrder::from_transfer_function(&TransferFunction::eq6()).unwrap();
    for (f, _, _) in TABLE {
        let exact = TransferFunction::eq6().response(Hertz(f)).norm();
        assert!((c.gain(Hertz(f)) / exact - 1.0).abs() < 1e-10);
    }
    // As printed, (2 z^2 w)^2, at 10 Hz with the values that the paper lists.
    let p = SecondOrder::PAPER_ROUNDED;
    let w2 = (TAU * 10.0_f64).powi(2);
    let printed =
        |z: f64, w: f64| w2 * w2 + ((2.0 * z * z * w).powi(2) - 2.0 * w * w) * w2 + w.powi(4);
    let gain = p.alpha
        * (printed(p.zeta1, p.omega1_rad_per_s) / printed(p.zeta2, p.omega2_rad_per_s)).sqrt();
    let off_db = 20.0 * (gain / p.gain(Hertz(10.0))).log10();
    assert!((off_db + 24.81).abs() < 0.01, "{off_db} dB");
}

#[test]
fn the_listed_damping_ratios_are_rounded_and_eq_6_is_not_made_of_them() {
    let p = SecondOrder::PAPER_ROUNDED;
    assert!((2.0 * p.zeta1 * p.omega1_rad_per_s - 20343.0).abs() < 1.0);
    assert!((2.0 * p.zeta2 * p.omega2_rad_per_s - 75.46).abs() < 0.01);
    let rounded = p.transfer_function().unwrap();
    assert!(rounded.num()[1] / rounded.num()[0] > 20300.0);
    assert_eq!(TransferFunction::eq6().den()[1], 76.3);
}

#[test]
fn physical_parameters_come_back_once_geometry_and_one_mass_are_given() {
    let mut random = Random::new(3);
    for _ in 0..100 {
        let rig = random_rig(&mut random);
        let back = PhysicalParameters::from_second_order(
            &rig.second_order(),
            rig.a1_m2,
            rig.a2_m2,
            rig.ac_m2,
            rig.wall_mass_kg,
        )
        .unwrap();
        for (a, b) in [
            (back.wall_damping_n_s_per_m, rig.wall_damping_n_s_per_m),
            (back.wall_stiffness_n_per_m, rig.wall_stiffness_n_per_m),
        ] {
            assert!((a / b - 1.0).abs() < 1e-9);
        }
        let again = back.transfer_function().unwrap();
        let first = rig.transfer_function().unwrap();
        for f in [0.01, 10.0, 1e4] {
            let ratio = again.response(Hertz(f)) / first.response(Hertz(f));
            assert!((ratio - 1.0).norm() < 1e-6);
        }
    }
}

#[test]
fn scaling_all_forces_or_both_areas_cannot_be_seen_in_the_transfer_function() {
    let rig = random_rig(&mut Random::new(4));
    let scaled = PhysicalParameters {
        a1_m2: 2.0 * rig.a1_m2,
        a2_m2: 2.0 * rig.a2_m2,
        ac_m2: 2.0 * rig.ac_m2,
        wall_mass_kg: 7.0 * rig.wall_mass_kg,
        wall_damping_n_s_per_m: 7.0 * rig.wall_damping_n_s_per_m,
        wall_stiffness_n_per_m: 7.0 * rig.wall_stiffness_n_per_m,
        fluid_mass_kg: 7.0 * rig.fluid_mass_kg,
        channel_damping_n_s_per_m: 7.0 * rig.channel_damping_n_s_per_m,
        outlet_stiffness_n_per_m: 7.0 * rig.outlet_stiffness_n_per_m,
    };
    let (a, b) = (rig.second_order(), scaled.second_order());
    assert!((a.alpha / b.alpha - 1.0).abs() < 1e-12);
    assert!((a.zeta2 / b.zeta2 - 1.0).abs() < 1e-12);
    assert!((a.omega2_rad_per_s / b.omega2_rad_per_s - 1.0).abs() < 1e-12);
}

#[test]
fn eq_6_with_the_papers_area_ratio_is_a_passive_rig_and_with_a_smaller_one_it_is_not() {
    let c = SecondOrder::from_transfer_function(&TransferFunction::eq6()).unwrap();
    let rig =
        |ratio: f64| PhysicalParameters::from_second_order(&c, ratio * 3e-10, 3e-10, 1e-6, 1e-6);
    // "A1/A2 is in the order of 10^6".
    assert!(rig(1e6).is_ok());
    // The static gain of Eq. (6) is 251 285: an area ratio below it would need a negative outlet stiffness.
    assert!(matches!(
        rig(1e5),
        Err(NotIdentifiable::NegativeOutletStiffness { .. })
    ));
    assert!(matches!(
        rig(1e-3),
        Err(NotIdentifiable::NegativeMass { .. })
    ));
    assert!(matches!(
        rig(-1.0),
        Err(NotIdentifiable::NotPositive { name: "A1", .. })
    ));
}

#[test]
fn the_state_space_form_has_the_response_of_the_transfer_function() {
    let resonant = TransferFunction::new(vec![3.0, 1e4, 5e6], vec![1.0, 10.0, 1e6, 2e4]).unwrap();
    for g in [
        TransferFunction::eq6(),
        resonant,
        TransferFunction::integrator(396.0).unwrap(),
        TransferFunction::new(vec![5.5], vec![1.0]).unwrap(),
    ] {
        let ss = StateSpace::from_transfer_function(&g);
        assert_eq!(ss.order(), g.order());
        for f in [1e-3, 1.0, 30.0, 159.0, 3000.0] {
            let s = Complex::new(0.0, TAU * f);
            let error = (ss.at(s).unwrap() - g.at(s)).norm() / g.at(s).norm();
            assert!(error < 1e-9, "{g:?} {f} {error}");
        }
    }
}

#[test]
fn held_at_1_khz_the_recorded_form_is_minimum_phase() {
    let plant = DiscretePlant::new(&TransferFunction::eq6(), Seconds(1e-3), Seconds(0.0)).unwrap();
    // Round the unit circle the phase turns once back for each pole more than zeros within: all poles are, and of the zeros
    // only the one at infinity is not.
    let at = |k: usize| plant.response(Hertz(k as f64 * 0.05));
    let turned: f64 = (0..20_000).map(|k| (at(k + 1) / at(k)).arg()).sum();
    let outside = turned / TAU;
    assert!((outside + 1.0).abs() < 1e-9, "{outside}");
}

#[test]
fn improper_empty_and_infinite_coefficients_are_refused_with_a_reason() {
    let refuse = |num: &[f64], den: &[f64]| {
        TransferFunction::new(num.to_vec(), den.to_vec())
            .unwrap_err()
            .to_string()
    };
    assert!(refuse(&[1.0, 2.0], &[1.0]).contains("degree 1"));
    assert!(refuse(&[0.0], &[1.0]).contains("num"));
    assert!(refuse(&[1.0], &[]).contains("den"));
    assert!(refuse(&[1.0], &[1.0, f64::NAN]).contains("den[1] is NaN"));
    assert!(refuse(&[1.0], &[1.0; 20]).contains("degree 19"));
    // Leading zeros are no degrees.
    let g = TransferFunction::new(vec![0.0, 0.0, 3.0], vec![0.0, 1.0, 0.0]).unwrap();
    assert_eq!(g, TransferFunction::integrator(3.0).unwrap());
}
