//! The page of a design: whether it holds, by how much, and what error it leads one to expect.

use crate::output::command_line;
use cellpos_control::ControllerConfig;
use cellpos_control::design::{
    DesignReport, DesignRequest, loop_response, predicted_density_um, step_response,
};
use cellpos_plant::PlantError;
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table};

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
    page.lead(&format!(
        "Task: design a controller ({law}) that holds a bead on the plant {model}, with {:.2} ms from the exposure of a frame to the middle \
         of the command that follows from it. All figures are calculated from the model; nothing was measured.",
        request.plant.loop_delay_s() * 1e3
    ));
    let (status, sentence) = sentence(request, report);
    page.result(status, &sentence);
    let Some(law) = report.law(&request.plant) else {
        page.command(&command_line());
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
    page.figure(nyquist(&response, report));
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
    let density = predicted_density_um(&request.plant, &law, &hz)?;
    let density: Vec<f64> = density.iter().map(|um| um * 1e3).collect();
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
    page.command(&command_line());
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
            " Predicted error of a hold: {:.0} nm RMS; the lowest possible is {:.0} nm.",
            noise.rms_um * 1e3,
            report.bound_rms_um * 1e3
        )
    });
    let unstable = report
        .spread
        .iter()
        .filter(|row| !row.margins.stable)
        .count();
    let spread = match unstable {
        0 => " It stays stable for gains from half to twice the model's and for one more sample of delay.".to_string(),
        some => format!(
            " It is unstable in {some} of {} cases of another gain (half to twice) or one more sample of delay.",
            report.spread.len()
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

fn nyquist(response: &[[f64; 2]], report: &DesignReport) -> Figure {
    // The integrator goes to infinity at low frequencies; what decides is near -1.
    let near = response.iter().filter(|[re, im]| re.hypot(*im) < 4.0);
    let (re, im): (Vec<f64>, Vec<f64>) = near.map(|[re, im]| (*re, *im)).unzip();
    let closest = 1.0 / report.margins.ms;
    let circle: Vec<f64> = (0..=90)
        .map(|n| f64::from(n) * std::f64::consts::TAU / 90.0)
        .collect();
    let circle_x: Vec<f64> = circle.iter().map(|a| -1.0 + closest * a.cos()).collect();
    let circle_y: Vec<f64> = circle.iter().map(|a| closest * a.sin()).collect();
    Figure::nyquist(
        "nyquist",
        &format!(
            "Nyquist curve of the loop gain. It passes the point -1 at a distance of {closest:.2} (dashed circle, 1/Ms with Ms = {:.2}); \
             a curve that went round it would be an unstable loop.",
            report.margins.ms
        ),
    )
    .series(Series::line("loop gain", &re, &im).color(0))
    .series(Series::line("1/Ms", &circle_x, &circle_y).dashed().color(1))
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
