//! A measured piezo (PI PICMA P-885.91, voltage to displacement, 200 Hz): hysteresis and a delay, not a lag of the driver.

use cellpos_plant::{Model, Noise, SimulateOptions, TransferFunction};
use cellpos_reconcile::{Options, Record, Verdict, constant_gain, reconcile};
use std::path::Path;

/// Columns 1 (V) and 5 (um) of a file.
fn columns(path: &Path) -> (Vec<f64>, Vec<f64>) {
    std::fs::read_to_string(path)
        .unwrap()
        .lines()
        .map(|l| {
            let cells: Vec<f64> = l.split_whitespace().map(|c| c.parse().unwrap()).collect();
            (cells[0], cells[4])
        })
        .unzip()
}

#[test]
#[ignore = "25 s of a debug build: for .ci/nightly"]
fn hysteresis_and_a_delay_are_named_and_hold_on_an_amplitude_ramp_that_was_not_fitted() {
    let folder = Path::new(env!("MEASURED_DATA")).join("piezo-picma");
    const FITTED: usize = 5051;
    let files = ["Model_Vi_Do.dat", "Test_Vi_Do_Di.dat"].map(|f| columns(&folder.join(f)));
    let records: Vec<Record> = files
        .iter()
        .zip(["model", "test"])
        .map(|((u, y), name)| {
            let t: Vec<f64> = (0..FITTED).map(|k| k as f64 * 0.005).collect();
            Record::from_rows(name, &t, &u[..FITTED], &y[..FITTED]).unwrap()
        })
        .collect();
    let (gain, working_point_um) = constant_gain(&records).unwrap();
    let model = Model {
        name: "fit".to_owned(),
        plant: TransferFunction::new(vec![gain], vec![1.0]).unwrap(),
        working_point_um,
        noise: Noise::NONE,
        ..Model::eq6()
    };
    let options = Options {
        interpolated_input: true,
        free_gain: true,
        ..Options::default()
    };
    let result = reconcile(&model, &records, &options, &mut |_| {}).unwrap();
    assert_eq!(result.verdict, Verdict::Named, "{:?}", result.places);
    let mut named: Vec<&str> = result.effects.iter().map(|e| e.id.as_str()).collect();
    named.sort_unstable();
    assert_eq!(named, ["pzt-hysteresis", "time-delay"]);

    // Each file predicted from the other alone, which knows one amplitude or another wave form: the fit of a fold goes on until it
    // rests. Four rounds from the fit of both files gave 0.20 um, and had seen the file that they predicted.
    let crossed = result.gap.free_run_after;
    println!("each file from the other: {crossed:.3} um");
    assert!((0.22..0.30).contains(&crossed), "{crossed} um");

    // By the program's own simulator, on the voltage interpolated tenfold; the sensor's zero from the fitted rows.
    const FINE: usize = 10;
    let (u, y) = &files[1];
    let fine: Vec<f64> = (0..6051 * FINE)
        .map(|j| {
            let (k, f) = (j / FINE, (j % FINE) as f64 / FINE as f64);
            u[k] + f * (u[k + 1] - u[k])
        })
        .collect();
    let rms = |m: &Model| {
        let simulated =
            cellpos_plant::simulate(m, &fine, 0.005 / FINE as f64, &SimulateOptions::default())
                .unwrap();
        let error: Vec<f64> = (0..6051).map(|k| simulated[k * FINE] - y[k]).collect();
        let zero = error[100..FITTED].iter().sum::<f64>() / (FITTED - 100) as f64;
        let held_out = &error[FITTED..];
        (held_out.iter().map(|e| (e - zero).powi(2)).sum::<f64>() / held_out.len() as f64).sqrt()
    };
    let (before, after) = (rms(&model), rms(&result.augmented));
    println!("rows {FITTED}..6051: {before:.3} um linear, {after:.4} um augmented");
    assert!(after <= 0.15, "{after} um");
    assert!(before > 1.2, "{before} um");
}
