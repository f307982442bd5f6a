//! The paper's figures that `cellpos identify` does not have: 4, 5 and A1.

use super::Drifting;
use crate::experiment::identify::Done;
use cellpos_ident::bare_fft;
use cellpos_ident::excitation::PAPER_FREQUENCIES_HZ;
use cellpos_numeric::Random;
use cellpos_report::{Axis, Figure, Panel, Series};

const TWO_PI: f64 = 2.0 * std::f64::consts::PI;
/// Sampling time of the paper's computer, s, and of its function generator.
const RECORD_S: f64 = 1e-3;
const GENERATOR_S: f64 = 1e-5;

/// Fig. 4: each input over its own amplitude; each output over input amplitude and the gain at 2 Hz.
pub(super) fn fig4(done: &Done) -> Figure {
    let mut figure = Figure::new(
        "fig4-traces",
        "Input over its own amplitude, output over input amplitude times the gain at 2 Hz, drift taken off: 0 to 500 ms below \
         50 Hz, 0 to 50 ms from there.",
    )
    .columns(2);
    let period_s = done.plan.period_s;
    let points = &done.result.measured.points;
    let gain_2hz = points.first().map_or(1.0, |p| p.response.norm());
    for record in &done.records {
        let planned = &done.plan.segments[record.index];
        let f = planned.lines_hz[0];
        let Some(point) = points.iter().find(|p| p.frequency_hz == f) else {
            continue;
        };
        let amplitude = point.input.norm();
        let rows = ((if f < 50.0 { 0.5 } else { 0.05 }) / period_s) as usize;
        let to = (record.from + rows).min(record.input.len());
        let centre = |x: &[f64]| -> Vec<f64> {
            let finite: Vec<f64> = x.iter().copied().filter(|v| v.is_finite()).collect();
            let mean = finite.iter().sum::<f64>() / finite.len().max(1) as f64;
            x.iter().map(|v| v - mean).collect()
        };
        let input = centre(&record.input[record.from..to]);
        let output = centre(&record.output[record.from..to]);
        let t: Vec<f64> = (0..input.len())
            .map(|k| k as f64 * period_s * 1e3)
            .collect();
        figure = figure.panel(
            Panel::new(Axis::linear("time", "ms"), Axis::linear("", "a.u."))
                .title(&planned.label)
                .height_px(140.0)
                .series(Series::step(
                    "PZT",
                    &t,
                    &input.iter().map(|v| v / amplitude).collect::<Vec<_>>(),
                ))
                .series(Series::line(
                    "bead",
                    &t,
                    &output
                        .iter()
                        .map(|v| v / amplitude / gain_2hz)
                        .collect::<Vec<_>>(),
                )),
        );
    }
    figure
}

/// Fig. 5a: 300 Hz as generated and as recorded at 1 kHz.
pub(super) fn fig5a() -> Figure {
    let f = 300.0;
    let fine: Vec<f64> = (0..1200).map(|i| i as f64 * GENERATOR_S * 1e3).collect();
    let generated: Vec<f64> = fine.iter().map(|t| (TWO_PI * f * t * 1e-3).sin()).collect();
    let coarse: Vec<f64> = (0..13).map(f64::from).collect();
    let held: Vec<f64> = coarse
        .iter()
        .map(|t| (TWO_PI * f * t * 1e-3).sin())
        .collect();
    Figure::new(
        "fig5a-record",
        "A 300 Hz drive as generated at 100 kHz and as recorded at 1 kHz, each sample held.",
    )
    .panel(
        Panel::new(Axis::linear("time", "ms"), Axis::linear("signal", "a.u."))
            .series(Series::line("generated", &fine, &generated))
            .series(Series::step("recorded", &coarse, &held))
            .series(Series::points("samples", &coarse, &held)),
    )
}

/// What different ways of reading an amplitude make of a 1 kHz record, per frequency.
pub(super) struct Recorded {
    /// Frequency, Hz.
    pub frequency_hz: Vec<f64>,
    /// Amplitude of the signal averaged over (or held for) 1 ms, over the true one.
    pub averaged: Vec<f64>,
    /// Mean over cycles of half the difference of largest and smallest point sample.
    pub peaks: Vec<f64>,
    /// Amplitude of point samples by least squares (a DFT bin).
    pub dft: Vec<f64>,
}

/// Simulates the record of a generator at 100 kHz through a 1 kHz computer with random phases.
pub(super) fn recorded_amplitudes() -> Recorded {
    let mut random = Random::new(5);
    let mut out = Recorded {
        frequency_hz: Vec::new(),
        averaged: Vec::new(),
        peaks: Vec::new(),
        dft: Vec::new(),
    };
    let per_sample = (RECORD_S / GENERATOR_S).round() as usize;
    let rows = 1000usize;
    for f in PAPER_FREQUENCIES_HZ {
        let runs = 20;
        let (mut averaged, mut peaks, mut dft) = (0.0, 0.0, 0.0);
        for _ in 0..runs {
            let phase = TWO_PI * random.uniform();
            let at = |t: f64| (TWO_PI * f * t + phase).sin();
            let point: Vec<f64> = (0..rows).map(|k| at(k as f64 * RECORD_S)).collect();
            let mean: Vec<f64> = (0..rows)
                .map(|k| {
                    let sum: f64 = (0..per_sample)
                        .map(|i| at(k as f64 * RECORD_S + i as f64 * GENERATOR_S))
                        .sum();
                    sum / per_sample as f64
                })
                .collect();
            let bin = |x: &[f64]| bare_fft::spectrum(x, RECORD_S).phasor[f.round() as usize].norm();
            averaged += bin(&mean) / f64::from(runs);
            dft += bin(&point) / f64::from(runs);
            peaks += peak_amplitude(&point, f) / f64::from(runs);
        }
        out.frequency_hz.push(f);
        out.averaged.push(averaged);
        out.peaks.push(peaks);
        out.dft.push(dft);
    }
    out
}

/// Mean over cycles of the largest sample of each cycle and of the smallest, halved difference: reading peaks off a plot.
fn peak_amplitude(samples: &[f64], frequency_hz: f64) -> f64 {
    let per_cycle = 1.0 / (frequency_hz * RECORD_S);
    let cycles = (samples.len() as f64 / per_cycle) as usize;
    let sum: f64 = (0..cycles)
        .map(|c| {
            let from = (c as f64 * per_cycle).ceil() as usize;
            let to = (((c + 1) as f64 * per_cycle).ceil() as usize).min(samples.len());
            let cycle = &samples[from..to];
            let high = cycle.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let low = cycle.iter().copied().fold(f64::INFINITY, f64::min);
            0.5 * (high - low)
        })
        .sum();
    sum / cycles.max(1) as f64
}

/// Fig. 5b: amplitude on the computer over that on the PZT.
pub(super) fn fig5b(r: &Recorded) -> Figure {
    Figure::new(
        "fig5b-amplitude",
        "Amplitude on a 1 kHz record over the true one. Averaging or holding for 1 ms and picking peaks of perfect samples both \
         lose about 15 % at 300 Hz, but they call for different corrections; the DFT of perfect samples loses nothing.",
    )
    .panel(
        Panel::new(Axis::log("frequency", "Hz"), Axis::linear("amplitude ratio", ""))
            .series(Series::line("1 ms hold or average: sinc(f T)", &r.frequency_hz, &r.averaged))
            .series(Series::line("peaks of point samples", &r.frequency_hz, &r.peaks))
            .series(Series::line("DFT of point samples", &r.frequency_hz, &r.dft))
            .series(Series::points("paper, 300 Hz", &[300.0], &[0.856])),
    )
}

/// Fig. A1: the spectrum of the bead's motion over the input phasor, in the complex plane.
pub(super) fn fig_a1(d: &Drifting) -> Figure {
    let rows = d.record.from..d.record.input.len();
    let spectrum = bare_fft::spectrum(&d.record.output[rows.clone()], 1e-3);
    let input = bare_fft::spectrum(&d.record.input[rows], 1e-3);
    let bin = 5; // 10 Hz in half a second
    let turn = input.phasor.get(bin).map_or(1.0.into(), |u| u / u.norm());
    let (re, im): (Vec<f64>, Vec<f64>) = spectrum
        .phasor
        .iter()
        .skip(1)
        .take(25)
        .map(|y| y / turn)
        .map(|y| (y.re, y.im))
        .unzip();
    let at = |i: usize| {
        (
            re.get(i - 1).copied().unwrap_or(f64::NAN),
            im.get(i - 1).copied().unwrap_or(f64::NAN),
        )
    };
    let ten = at(bin);
    Figure::new(
        "fig-a1-complex-plane",
        &format!(
            "Bins 2 to 50 Hz of the bead's motion, turned so that the input's 10 Hz bin is real. Drift of {} um/s fills the low \
             bins and leaks into 10 Hz.",
            d.drift_um_per_s
        ),
    )
    .panel(
        Panel::new(Axis::linear("real part", "um"), Axis::linear("imaginary part", "um"))
            .equal_axes()
            .series(Series::line("bins in order", &re, &im).thin())
            .series(Series::points("bins", &re, &im))
            .series(Series::points("10 Hz", &[ten.0], &[ten.1])),
    )
}
