//! What was added from outside, in use: a bead held, a record simulated, an effect found.

use cellpos_control::{Controller, LoopParts};
use cellpos_drivers::{CommandedFlow, FlowTap, VisionSource};
use cellpos_plant::{Model, SimulateOptions, effects, simulate};
use cellpos_reconcile::{Options as Search, Record, Verdict, reconcile};
use cellpos_rig::Clock;
use cellpos_runtime::{EndRule, NoSink};
use cellpos_session::setup::ReferenceSpec;
use cellpos_session::{Options, Rig, RigFile};
use cellpos_vision::{Localiser, LocaliserConfig, ProfileSpec, Tracker, TrackerConfig};
use extend::actuator::AnalogOutput;
use extend::bench::{Bench, GAIN_PER_S};
use extend::camera::{PIXEL_UM, SIGMA_PX, SpotCamera, calibration};
use extend::effect::{self, soft_coupling};
use extend::law::DeadBand;
use std::f64::consts::TAU;

#[test]
fn a_bead_is_held_with_a_camera_an_actuator_and_a_law_from_outside() {
    let clock = Clock::virtual_at(0);
    let bench = Bench::new(clock.clone());
    let profile = ProfileSpec::Gaussian { sigma_px: SIGMA_PX };
    let localiser = Localiser::new(LocaliserConfig::new(profile)).expect("a profile");
    let tracker =
        Tracker::new(localiser, TrackerConfig::for_pixel_um(PIXEL_UM)).expect("a tracker");
    let camera = SpotCamera(bench.clone());
    let source = VisionSource::new(camera, tracker, calibration(), clock.clone());
    // The commands move the bead further than diffusion does, so the tracker must know them.
    let flow = CommandedFlow::new(GAIN_PER_S);
    let source = source.with_flow(flow.clone());
    let actuator = FlowTap::new(AnalogOutput::new(bench), flow, clock.clone());
    let options = Options::rehearsal();
    let (source, actuator) = (Box::new(source), Box::new(actuator));
    let mut rig =
        Rig::with_devices(RigFile::default(), options, source, actuator, clock).expect("devices");

    let prepared = rig.prepare("eq6", "pi").expect("limits and estimator");
    let hold = ReferenceSpec::Hold { position_um: -1.0 };
    let setup = rig.set_up(prepared, hold).expect("the PZT stands");
    let parts = setup.controller.loop_config(&setup.model).expect("a loop");
    let law = DeadBand {
        kp_um_per_um: 0.3,
        rest_um: 0.1,
    };
    let controller = Controller::with_law(LoopParts {
        model: parts.model,
        estimator: parts.estimator,
        controller: law,
        limits: parts.limits,
    });
    let core = setup.core_with(controller.expect("a law")).expect("a core");
    let end = EndRule {
        ticks: Some(4000),
        ..EndRule::default()
    };
    let armed = rig.arm(&setup, core, NoSink, end).ok().expect("armed");
    let finished = armed.start().and_then(|run| run.wait()).expect("a run");
    assert!(finished.ended.as_asked(), "{}", finished.ended);
    let rms_nm = finished.summary.rms_measured_nm.expect("positions");
    println!("held to {rms_nm:.1} nm RMS");
    assert!(rms_nm < 120.0, "{rms_nm} nm with a dead band of 100 nm");
}

/// Sines of two amplitudes about the working point, um of PZT; a record with the drive of another tells nothing new.
fn commands(record: u64) -> Vec<f64> {
    let row = |k: usize| {
        let t = k as f64 * 1e-3;
        let amplitude_um = if t < 4.0 { 2.0 } else { 0.5 };
        let fast = (TAU * 11.0 * t + record as f64).sin();
        4.0 + amplitude_um * (0.6 * fast + 0.4 * (TAU * 3.0 * t).sin())
    };
    (0..8000).map(row).collect()
}

#[test]
fn an_effect_from_outside_is_simulated_and_the_search_names_it() {
    effects::register(&effect::KIND).expect("a new id");
    let given = Model {
        working_point_um: 4.0,
        ..Model::eq6()
    };
    let hidden = given.clone().with_effect(soft_coupling(0.2));
    let text = hidden.to_toml_string();
    let read = Model::from_toml_str(&text, "hidden.toml").expect("it is known by its id");
    assert_eq!(read, hidden);

    let pzt_um = commands(0);
    let noise_free = SimulateOptions::default();
    let plain = simulate(&given, &pzt_um, 1e-3, &noise_free).expect("a model");
    let soft = simulate(&hidden, &pzt_um, 1e-3, &noise_free).expect("a model");
    let apart = plain.iter().zip(&soft).map(|(a, b)| (a - b).abs());
    assert!(apart.fold(0.0, f64::max) > 0.2, "the effect acts");

    let records: Vec<Record> = (1..=3)
        .map(|seed| {
            let noisy = SimulateOptions {
                seed: Some(seed),
                ..SimulateOptions::default()
            };
            let pzt_um = commands(seed);
            let bead_um = simulate(&hidden, &pzt_um, 1e-3, &noisy).expect("a model");
            let time_s: Vec<f64> = (0..pzt_um.len()).map(|k| k as f64 * 1e-3).collect();
            Record::from_rows(&format!("record {seed}"), &time_s, &pzt_um, &bead_um)
                .expect("an even record")
        })
        .collect();
    let result = reconcile(&given, &records, &Search::default(), &mut |_| {}).expect("a verdict");
    let names: Vec<&str> = result.effects.iter().map(|e| e.id.as_str()).collect();
    assert_eq!(
        (result.verdict, names),
        (Verdict::Named, vec!["soft-coupling"])
    );
    let found = &result.effects[0].parameters["give"];
    println!("{} ({:?})", found.value, found.ci95);
    assert!((found.value / 0.2 - 1.0).abs() < 0.1, "{found:?}");
}
