//! The page of a design: whether it holds, by how much, and what error it leads one to expect.

use cellpos_control::ControllerConfig;
use cellpos_control::design::{
    DesignReport, DesignRequest, loop_response, predicted_density_um, step_response,
};
use cellpos_plant::PlantError;
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table};
use cellpos_session::provenance::command_text;

/// Points of a curve over frequency.
const POINTS: usize = 400;

/// The page.
///
/// # Errors
/// A plant that cannot be discretised: it was, a moment ago.
pub(super) fn page(
    model: &str,
    request: &DesignRequest,
    report: &DesignReport,
) -> Result<Report, PlantError> {
    let mut page = Report::new(&format!("Controller for {model}"));
    let law = match &report.controller {
        ControllerConfig::Pi(pi) if pi.lead.is_some() => "PI with lead",
        ControllerConfig::Pi(_) => "PI",
        ControllerConfig::Lqg(_) => "LQG",
        ControllerConfig::Mpc(..) => "MPC",
    };
    let of_model = match model {
        "eq6" => "the built-in model eq6 of a bead that follows the piezo".to_owned(),
        other => format!("the model {other} of how a bead follows the piezo"),
    };
    let gains = match &report.controller {
        ControllerConfig::Pi(pi) => {
            format!(", kp = {:.3}, ki = {:.1} /s", pi.kp, pi.ki_per_s)
        }
        _ => String::new(),
    };
    page.lead(&format!(
        "Task: design a controller ({law}{gains}) that holds a bead, for {of_model}: a frame each {} ms, and {:.2} ms from its exposure to the \
         middle of the command that follows from it. All figures are calculated from the model; nothing was measured.",
        request.plant.sample_time_s * 1e3,
        request.plant.loop_delay_s() * 1e3
    ));
    let (status, sentence) = sentence(request, report);
    page.result(status, &sentence);
    page.certainty(&format!(
        "calculated, so as sure as the model, whose own error is not in these figures; the margins say how wrong it may be before the loop is \
         unstable: by {:.1} dB in gain or {:.2} ms in delay, one at a time. Lowest possible: what the noise of a fix and Brownian motion do to the bead within the \
         delay, under any controller.",
        report.margins.gm_db,
        report.margins.delay_margin_s * 1e3
    ));
    let Some(law) = report.law(&request.plant) else {
        page.command(&command_text());
        return Ok(page);
    };
    let end_hz = 0.5 / request.plant.sample_time_s;
    let hz: Vec<f64> = (0..POINTS)
        .map(|n| end_hz * 1e-3_f64.powf(1.0 - n as f64 / POINTS as f64))
        .collect();
    let response = loop_response(&request.plant, &law, &hz)?;
    let sensitivity: Vec<f64> = (response.iter())
        .map(|[re, im]| 1.0 / (re + 1.0).hypot(*im))
        .collect();
    let density = predicted_density_um(&request.plant, &law, &hz)?;
    let density: Vec<f64> = density.iter().map(|um| um * 1e3).collect();
    page.figure(first(
        &hz,
        &of_the_bead(request, &density, &response),
        &response,
        report,
    ));
    page.section("Margins");
    page.table(margins(report));
    page.figure(bode(&hz, &response, report));
    let db: Vec<f64> = sensitivity.iter().map(|s| 20.0 * s.log10()).collect();
    page.figure(
        Figure::new(
            "sensitivity",
            "Sensitivity |S|: disturbances are reduced where it is below 0 dB and enlarged where it is above.",
        )
        .panel(
            Panel::new(Axis::log("frequency", "Hz"), Axis::linear("|S|", "dB"))
                .series(Series::line("|S|", &hz, &db))
                .horizontal(0.0, ""),
        ),
    );
    step(&mut page, request, report);
    page.section("Error to be expected while holding");
    page.figure(
        Figure::new(
            "predicted-spectrum",
            "Amplitude density of the measured error that the linear loop predicts, from Brownian motion and localisation noise.",
        )
        .panel(
            Panel::new(Axis::log("frequency", "Hz"), Axis::log("density", "nm/rtHz"))
                .series(Series::line("predicted", &hz, &density)),
        ),
    );
    spread(&mut page, report);
    for warning in &report.warnings {
        page.note(Emphasis::Warning, &warning.to_string());
    }
    page.command(&command_text());
    Ok(page)
}

fn sentence(request: &DesignRequest, report: &DesignReport) -> (Emphasis, String) {
    let m = &report.margins;
    let delay_ms = request.plant.loop_delay_s() * 1e3;
    if !m.stable {
        return (
            Emphasis::Bad,
            format!("With a loop delay of {delay_ms:.2} ms this loop is unstable."),
        );
    }
    let error = report.noise.as_ref().map_or_else(String::new, |noise| {
        format!(
            " Predicted error of a hold: {:.0} nm RMS; with the model's noise of a fix, {:.0} nm, the lowest possible is {:.0}.",
            noise.rms_um * 1e3,
            request.plant.fix_noise_um * 1e3,
            report.bound_rms_um * 1e3
        )
    });
    let unstable = report
        .spread
        .iter()
        .filter(|row| !row.margins.stable)
        .count();
    let spread = match unstable {
        0 => format!(
            " It stays stable for gains from half to twice the model's and for {} ms more delay.",
            request.plant.sample_time_s * 1e3
        ),
        some => format!(
            " It is unstable in {some} of {} cases of another gain (half to twice) or {} ms more delay.",
            report.spread.len(),
            request.plant.sample_time_s * 1e3
        ),
    };
    let broken: Vec<String> = (report.limits_broken.iter())
        .map(ToString::to_string)
        .collect();
    let limits = match broken.is_empty() {
        true => String::new(),
        false => format!(" Limits broken: {}.", broken.join("; ")),
    };
    let status = match (broken.is_empty(), unstable) {
        (false, _) => Emphasis::Bad,
        (true, 0) => Emphasis::Good,
        (true, _) => Emphasis::Warning,
    };
    let text = format!(
        "The loop is stable: phase margin {:.0} deg, gain margin {:.1} dB, delay margin {:.2} ms.\
         {error}{spread}{limits}",
        m.pm_deg,
        m.gm_db,
        m.delay_margin_s * 1e3
    );
    (status, text)
}

/// The error to be expected, summed up over frequency, and the Nyquist curve with its margins.
fn first(hz: &[f64], density_nm: &[f64], response: &[[f64; 2]], report: &DesignReport) -> Figure {
    let caption = format!(
        "Left: RMS error while holding, of all frequencies up to each; at the right end it is the whole. Right: Nyquist curve of the loop gain, \
         from low frequencies (below, out of the frame) to high ones (at 0). The loop is stable as the curve passes the point -1 on its right. \
         Phase margin: angle from -1 to where the curve enters the unit circle; gain margin: what the gain may grow by until the crossing of the \
         axis reaches -1. Its least distance from -1 is {:.2} (a sensitivity of at most {:.2}).",
        1.0 / report.margins.ms,
        report.margins.ms
    );
    let mut figure = Figure::new("nyquist", &caption).columns(2);
    if let Some(noise) = &report.noise {
        let (at, rms) = summed(hz, density_nm, noise.rms_um * 1e3);
        let bound = 1e3 * report.bound_rms_um;
        let (Some(first), Some(last)) = (at.first(), at.last()) else {
            return figure.panel(nyquist(response, report));
        };
        figure = figure.panel(
            Panel::new(
                Axis::log("up to this frequency", "Hz"),
                Axis::linear("error", "nm RMS"),
            )
            .height_px(300.0)
            .series(
                Series::line(
                    &format!("predicted, in all {:.0} nm", noise.rms_um * 1e3),
                    &at,
                    &rms,
                )
                .color(0),
            )
            .series(
                Series::line(
                    &format!("lowest possible, in all {bound:.0} nm"),
                    &[*first, *last],
                    &[bound; 2],
                )
                .dashed()
                .color(1),
            ),
        );
    }
    figure.panel(nyquist(response, report))
}

/// The density of the bead's own error: that of the measured one without the noise of the fixes, with what the controller makes of it.
fn of_the_bead(request: &DesignRequest, measured_nm: &[f64], response: &[[f64; 2]]) -> Vec<f64> {
    let plant = &request.plant;
    let white = 2.0 * plant.sample_time_s * (1e3 * plant.fix_noise_um).powi(2);
    (measured_nm.iter().zip(response))
        .map(|(nm, [re, im])| {
            let closed = (re + 1.0).hypot(*im).powi(2);
            // |S|^2 of the noise is in the measured position, |T|^2 of it in the bead's.
            (nm * nm - white * (1.0 - re * re - im * im) / closed)
                .max(0.0)
                .sqrt()
        })
        .collect()
}

/// RMS of a density up to each frequency. The curve begins with what is below its first frequency, so that it ends at the whole.
fn summed(hz: &[f64], density_nm: &[f64], whole_nm: f64) -> (Vec<f64>, Vec<f64>) {
    let mut sums = vec![0.0];
    for (f, d) in hz.windows(2).zip(density_nm.windows(2)) {
        let step = 0.5 * (d[0] * d[0] + d[1] * d[1]) * (f[1] - f[0]);
        sums.push(sums.last().copied().unwrap_or(0.0) + step);
    }
    let below = (whole_nm * whole_nm - sums.last().copied().unwrap_or(0.0)).max(0.0);
    let rms = sums.iter().map(|sum| (sum + below).sqrt()).collect();
    (hz.to_vec(), rms)
}

fn nyquist(response: &[[f64; 2]], report: &DesignReport) -> Panel {
    let m = &report.margins;
    let (re, im): (Vec<f64>, Vec<f64>) = response.iter().map(|[re, im]| (*re, *im)).unzip();
    let circle: Vec<f64> = (0..=90)
        .map(|n| f64::from(n) * std::f64::consts::TAU / 90.0)
        .collect();
    let cos: Vec<f64> = circle.iter().map(|a| a.cos()).collect();
    let sin: Vec<f64> = circle.iter().map(|a| a.sin()).collect();
    let crossover = (m.pm_deg - 180.0).to_radians();
    let crossing = -(10f64.powf(-m.gm_db / 20.0));
    Panel::new(
        Axis::linear("real part", "").range(-2.0, 1.2),
        Axis::linear("imaginary part", "").range(-2.0, 1.2),
    )
    .equal_axes()
    .height_px(300.0)
    .series(Series::line("unit circle", &cos, &sin).thin().color(7))
    .series(Series::line("loop gain", &re, &im).color(0))
    .series(Series::points("\u{2212}1", &[-1.0], &[0.0]).color(7))
    .series(
        Series::points(
            &format!("phase margin {:.0} deg", m.pm_deg),
            &[crossover.cos()],
            &[crossover.sin()],
        )
        .color(1),
    )
    .series(
        Series::points(
            &format!("gain margin {:.1} dB", m.gm_db),
            &[crossing],
            &[0.0],
        )
        .color(2),
    )
}

fn bode(hz: &[f64], response: &[[f64; 2]], report: &DesignReport) -> Figure {
    let db: Vec<f64> = (response.iter())
        .map(|[re, im]| 20.0 * re.hypot(*im).log10())
        .collect();
    let mut turns = 0.0;
    let mut last: Option<f64> = None;
    let phase: Vec<f64> = (response.iter())
        .map(|[re, im]| {
            let deg = im.atan2(*re).to_degrees();
            if let Some(before) = last {
                turns -= ((deg - before) / 360.0).round() * 360.0;
            }
            last = Some(deg);
            deg + turns
        })
        .collect();
    // The first phase is between -180 and 0 deg.
    let lift = if phase.first().is_some_and(|first| *first > 0.0) {
        -360.0
    } else {
        0.0
    };
    let phase: Vec<f64> = phase.iter().map(|deg| deg + lift).collect();
    Figure::bode(
        "bode",
        "Loop gain: magnitude and phase; the phase margin is the distance from -180 deg at the marked crossover.",
    )
    .bode_series(
        Series::line("loop gain", hz, &db),
        Series::line("", hz, &phase),
    )
    .bode_frequency(report.margins.crossover_hz, "crossover")
}

fn margins(report: &DesignReport) -> Table {
    let m = &report.margins;
    Table::key_values(&[
        (
            "phase margin",
            format!("{:.1} deg at {:.1} Hz", m.pm_deg, m.crossover_hz),
        ),
        ("gain margin", format!("{:.1} dB", m.gm_db)),
        ("delay margin", format!("{:.2} ms", m.delay_margin_s * 1e3)),
        (
            "peak of S (Ms)",
            format!("{:.2} at {:.1} Hz", m.ms, m.ms_hz),
        ),
        (
            "peak of T (Mt)",
            format!("{:.2} at {:.1} Hz", m.mt, m.mt_hz),
        ),
        (
            "disturbances are reduced below",
            format!("{:.1} Hz", m.s_below_1_hz),
        ),
    ])
}

fn step(page: &mut Report, request: &DesignRequest, report: &DesignReport) {
    const SIZE_UM: f64 = 10.0;
    let (Some(config), Some(figures)) = (&report.config, &report.step) else {
        return;
    };
    let Ok(y) = step_response(&request.plant, config, SIZE_UM) else {
        return;
    };
    let ts = request.plant.sample_time_s;
    // Until it has settled, and as long again.
    let shown_s = (4.0 * figures.settling_2_percent_s).clamp(40.0 * ts, 1000.0 * ts);
    let shown = y.iter().take((shown_s / ts) as usize).copied();
    let y: Vec<f64> = shown.collect();
    let t: Vec<f64> = (0..y.len()).map(|k| k as f64 * ts * 1e3).collect();
    page.section("Step");
    page.figure(
        Figure::new(
            "step",
            &format!(
                "Step of {SIZE_UM} um without noise, through the limits of the command: within 5 % after {:.0} ms, overshoot {:.1} %.",
                figures.settling_5_percent_s * 1e3,
                figures.overshoot_percent
            ),
        )
        .panel(
            Panel::new(Axis::linear("time", "ms"), Axis::linear("position", "um"))
                .series(Series::line("position", &t, &y))
                .horizontal(SIZE_UM, "target"),
        ),
    );
}

fn spread(page: &mut Report, report: &DesignReport) {
    page.section("Another plant than the model");
    let mut table = Table::new([
        Column::right("gain, of the model's"),
        Column::right("more samples of delay"),
        Column::left("stable"),
        Column::right("phase margin (deg)"),
        Column::right("Ms"),
    ]);
    for row in &report.spread {
        let status = if row.margins.stable {
            Emphasis::Plain
        } else {
            Emphasis::Bad
        };
        table.row_with(
            status,
            [
                format!("{:.2}", row.gain_factor),
                row.extra_samples.to_string(),
                (if row.margins.stable { "yes" } else { "no" }).to_string(),
                format!("{:.0}", row.margins.pm_deg),
                format!("{:.2}", row.margins.ms),
            ],
        );
    }
    table.caption("The gain depends on the height of bead or cell in the channel, by up to 1.8, and jumps in a constriction.");
    page.table(table);
}
