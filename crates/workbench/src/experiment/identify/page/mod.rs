//! The report of an identification: Bode with bands, Nyquist, residuals, traces, delay test, parameters.

mod bode;
mod tables;

use crate::experiment::identify::Done;
pub use bode::{Shown, bode};
use cellpos_ident::frequency_response::FrequencyPoint;
use cellpos_ident::identifiability::{Identifiability, IdentifiedParameter};
use cellpos_ident::summary::Identification;
use cellpos_numeric::statistics::Z95;
use cellpos_report::{Axis, Emphasis, Figure, Panel, Report, Series, log_grid, number};
use tables::interval;
pub use tables::{candidates, lines, parameters};

/// Nyquist plot of the record and the fitted model with hold and delay.
pub fn nyquist(result: &Identification) -> Figure {
    let (re, im): (Vec<f64>, Vec<f64>) = result
        .measured
        .points
        .iter()
        .filter(|p| p.response.norm() < 12.0)
        .map(|p| (p.response.re, p.response.im))
        .unzip();
    let lowest = result
        .measured
        .points
        .iter()
        .map(|p| p.frequency_hz)
        .fold(f64::INFINITY, f64::min);
    let grid = log_grid(lowest, 0.45 / result.sampling.period_s, 300);
    let (mre, mim): (Vec<f64>, Vec<f64>) = grid
        .iter()
        .map(|&f| result.judged.model.sampled_response(f, result.sampling))
        .filter(|c| c.norm() < 12.0)
        .map(|c| (c.re, c.im))
        .unzip();
    Figure::nyquist("nyquist", "What the record shows of the plant in the complex plane, hold and delay included; lines below 12 um/um.")
        .series(Series::line("model with hold and delay", &mre, &mim))
        .series(Series::points("measured", &re, &im))
}

/// Residuals of the fit over their standard deviations.
pub fn residuals(result: &Identification) -> Figure {
    let mut f = Vec::new();
    let (mut re, mut im) = (Vec::new(), Vec::new());
    for p in &result.measured.points {
        let model = result
            .selection
            .best()
            .model
            .sampled_response(p.frequency_hz, result.sampling);
        // Along the response: gain; across it: phase.
        let e = (p.response - model) / (p.response / p.response.norm()) / (0.5 * p.variance).sqrt();
        f.push(p.frequency_hz);
        re.push(e.re);
        im.push(e.im);
    }
    Figure::new("residuals", "Residuals of the chosen order over their standard deviations; 95 % of them belong between the lines.").panel(
        Panel::new(Axis::log("frequency", "Hz"), Axis::linear("residual", "standard deviations"))
            .series(Series::points("gain", &f, &re))
            .series(Series::points("phase", &f, &im))
            .horizontal(-Z95, "")
            .horizontal(Z95, ""),
    )
}

/// Time traces: command about its mean and bead, the last part of each segment.
pub fn traces(done: &Done) -> Figure {
    let mut figure = Figure::new(
        "traces",
        "Commanded displacement (times 4) and bead position of each segment, about their means: three periods, 50 ms at least.",
    )
    .columns(2);
    let period_s = done.plan.period_s;
    for record in &done.records {
        let planned = &done.plan.segments[record.index];
        let lowest = planned
            .lines_hz
            .iter()
            .copied()
            .fold(f64::INFINITY, f64::min);
        let rows = ((3.0 / lowest).max(0.05) / period_s) as usize;
        let from = record.input.len().saturating_sub(rows);
        let mean = |x: &[f64]| {
            let finite: Vec<f64> = x.iter().copied().filter(|v| v.is_finite()).collect();
            finite.iter().sum::<f64>() / finite.len().max(1) as f64
        };
        let (u, y) = (&record.input[from..], &record.output[from..]);
        let (mu, my) = (mean(u), mean(y));
        let t: Vec<f64> = (0..u.len()).map(|k| k as f64 * period_s * 1e3).collect();
        figure = figure.panel(
            Panel::new(Axis::linear("time", "ms"), Axis::linear("", "um"))
                .title(&planned.label)
                .height_px(140.0)
                .series(Series::step(
                    "4 x PZT",
                    &t,
                    &u.iter().map(|v| 4.0 * (v - mu)).collect::<Vec<_>>(),
                ))
                .series(Series::points(
                    "bead",
                    &t,
                    &y.iter().map(|v| v - my).collect::<Vec<_>>(),
                )),
        );
    }
    figure
}

/// The delay test: light sent and seen, and the intervals that the edges leave for the delay.
pub fn delay_test(
    name: &str,
    caption: &str,
    led: &crate::experiment::identify::led::DelayTest,
) -> Figure {
    let first = led.switched_s.first().copied().unwrap_or(0.0);
    let until = led.switched_s.get(4).copied().unwrap_or(first) + 0.006;
    let (mut t, mut grey) = (Vec::new(), Vec::new());
    for (s, g) in led.frame_s.iter().zip(&led.grey) {
        if *s > first - 0.004 && *s < until {
            t.push((s - first) * 1e3);
            grey.push(*g);
        }
    }
    let low = grey.iter().copied().fold(f64::INFINITY, f64::min);
    let high = grey.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut sent_t = vec![-4.0];
    let mut sent = vec![low];
    for (i, s) in led
        .switched_s
        .iter()
        .take_while(|s| **s < until)
        .enumerate()
    {
        sent_t.push((s - first) * 1e3);
        sent.push(if i % 2 == 0 { high } else { low });
    }
    sent_t.push((until - first) * 1e3);
    sent.push(*sent.last().unwrap_or(&low));
    let middle: Vec<f64> = led
        .seen
        .iter()
        .map(|e| (0.5 * (e.before_s + e.after_s) - e.sent_s) * 1e3)
        .collect();
    let low_ms: Vec<f64> = led
        .seen
        .iter()
        .map(|e| (e.before_s - e.sent_s) * 1e3)
        .collect();
    let high_ms: Vec<f64> = led
        .seen
        .iter()
        .map(|e| (e.after_s - e.sent_s) * 1e3)
        .collect();
    let number: Vec<f64> = (1..=led.seen.len()).map(|i| i as f64).collect();
    Figure::new(name, caption)
        .panel(
            Panel::new(
                Axis::linear("time after the first edge", "ms"),
                Axis::linear("mean grey level", "grey"),
            )
            .series(Series::step("light sent", &sent_t, &sent))
            .series(Series::points("frames as they arrive", &t, &grey)),
        )
        .panel(
            Panel::new(
                Axis::linear("edge", ""),
                Axis::linear("delay that the edge allows", "ms"),
            )
            .series(Series::intervals(
                "each edge",
                &number,
                &middle,
                &low_ms,
                &high_ms,
            ))
            .series(
                Series::line(
                    &format!("all together: {:.3} ms", led.estimate.delay_s * 1e3),
                    &[0.0, number.last().copied().unwrap_or(0.0)],
                    &[led.estimate.delay_s * 1e3; 2],
                )
                .dashed(),
            ),
        )
}

/// The result in a sentence: gain and delay with their intervals.
fn sentence(done: &Done) -> (Emphasis, String) {
    let result = &done.result;
    let known: Vec<&IdentifiedParameter> = (result.judged.parameters.iter())
        .filter(|p| matches!(p.verdict, Identifiability::Identified))
        .collect();
    let unknown = result.judged.parameters.len() - known.len();
    let told = |p: &IdentifiedParameter| {
        let unit = if p.unit.is_empty() {
            String::new()
        } else {
            format!(" {}", p.unit)
        };
        let name = match p.meaning.split_once(": ") {
            Some((name, what)) => format!("{name} ({what})"),
            None => p.meaning.to_string(),
        };
        let interval = interval(p.ci95).replace(" .. ", " to ");
        format!("{name} = {}{unit} (95 %: {interval})", number(p.value))
    };
    // Gain and delay limit a loop; the other parameters are in the table.
    let delay = known.iter().skip(1).rfind(|p| p.meaning.contains("delay"));
    let parts: Vec<String> = known
        .first()
        .into_iter()
        .chain(delay)
        .map(|p| told(p))
        .collect();
    let mut text = match parts.is_empty() {
        true => "No parameter of the plant is identified from this band.".to_owned(),
        false => format!("{}.", parts.join("; ")),
    };
    if let (Some(first), false) = (text.get(..1), parts.is_empty()) {
        text = format!("{}{}", first.to_uppercase(), &text[1..]);
    }
    if unknown > 0 && !known.is_empty() {
        let all = result.judged.parameters.len();
        text.push_str(&format!(
            " Of the model's {all} parameters these frequencies determine {}; {unknown} stay unknown.",
            known.len()
        ));
    }
    let status = match (known.is_empty(), result.warnings.is_empty()) {
        (true, _) => Emphasis::Bad,
        (false, false) => Emphasis::Warning,
        (false, true) if unknown > 0 => Emphasis::Plain,
        (false, true) => Emphasis::Good,
    };
    (status, text)
}

/// The whole report.
pub fn report(done: &Done, rig: &str, command_line: &str, eq6: bool) -> Report {
    let result = &done.result;
    let mut report = Report::new("Identification");
    let points = &result.measured.points;
    let hz = |end: Option<&FrequencyPoint>| end.map_or(f64::NAN, |point| point.frequency_hz);
    let record_s: f64 = (done.plan.segments.iter())
        .map(|segment| segment.settle_s + segment.measure_s)
        .sum();
    report.lead(&format!(
        "Task: measure how the bead follows the piezo (PZT), and fit a model to it. The PZT was driven at {} frequencies from {} to {} Hz \
         while a loop held the bead in view, {record_s:.0} s in all. Rig: {rig}.",
        points.len(),
        hz(points.first()),
        hz(points.last()),
    ));
    let (status, sentence) = sentence(done);
    report.result(status, &sentence);
    report.certainty(
        "intervals are 95 %, of this one record, from the scatter of the measured response between its periods. They hold if the plant has \
         the form of the fitted model; the residuals on the right of the figure show whether it has.",
    );
    report.figure(bode(
        "bode",
        "Left: gain (motion of the bead over that of the piezo) and phase of the plant, with hold, exposure and delay of the record taken \
         off. Right: the same less the fit, with the 95 % intervals of the points and the 95 % band of the fit.",
        result,
        Shown { high_hz: hz(points.last()), eq6, delayed: false },
    ));
    for warning in &result.warnings {
        report.note(Emphasis::Warning, warning);
    }
    report
        .section("Parameters")
        .table(parameters(&result.judged.parameters));
    if let Some(noise) = result.measured.noise {
        report.paragraph(&format!(
            "Noise, from what the fit leaves of the record between the lines: diffusion {:.3} +- {:.3} um^2/s, localisation {:.1} nm RMS, times of the commands {:.3} ms RMS (p = {:.2}{}).",
            noise.diffusion_um2_per_s,
            noise.diffusion_ci95_um2_per_s,
            noise.localisation_um * 1e3,
            noise.timing_s * 1e3,
            noise.p_value,
            if noise.used { ", used for the weights" } else { ", not used: the scatter of each line weighs it" }
        ));
    }
    report
        .section("Frequency response")
        .table(lines(result, eq6))
        .figure(nyquist(result))
        .figure(residuals(result));
    report
        .section("Choice of the model")
        .table(candidates(result));
    report.section("Delay");
    let phase = result.judged.phase_delay95_s;
    report.paragraph(&format!(
        "From the phase slope, any far zero included: {} ms.",
        interval([phase[0] * 1e3, phase[1] * 1e3])
    ));
    if let Some(led) = &done.led {
        let e = &led.estimate;
        report.paragraph(&format!(
            "From {} dithered edges of the LED: {:.4} ms, 95 % {:.4} .. {:.4} ms.",
            e.edges,
            e.delay_s * 1e3,
            e.ci95_s[0] * 1e3,
            e.ci95_s[1] * 1e3
        ));
        report.figure(delay_test("delay-test", "Light sent by the board and seen by the camera, and what each edge allows the delay to be.", led));
    }
    report.section("Traces").figure(traces(done));
    report.paragraph(&format!(
        "{} rows of record.",
        done.records.iter().map(|r| r.input.len()).sum::<usize>()
    ));
    report.command(command_line);
    report
}
