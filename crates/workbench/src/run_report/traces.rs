//! Traces and spectrum of a run.

use super::envelope::Envelope;
use super::ticks::Ticks;
use cellpos_record::RunMeta;
use cellpos_report::{Axis, Figure, Panel, Report, Series};

/// A column as an envelope with its median, or as it is where each point is one tick.
fn enveloped(panel: Panel, ticks: &Ticks, column: usize, name: &str, color: usize) -> Panel {
    let course = ticks.traces.course_of(column, ticks.period_rows());
    let median = Series::line(name, &course.time_s, &course.median).thin();
    if ticks.traces.is_bare() {
        return panel.series(median.color(color));
    }
    let band = Series::band("", &course.time_s, &course.low, &course.high);
    panel.series(band.color(color)).series(median.color(color))
}

/// The slow partner of the PZT.
fn partner(ticks: &Ticks) -> Panel {
    let mut panel = Panel::new(Axis::linear("time", "s"), Axis::linear("partner", "um"));
    for (column, name, color) in [(0, "displacement", 4), (1, "effect", 6)] {
        let course = ticks.partner.course(column);
        panel = panel.series(Series::line(name, &course.time_s, &course.median).color(color));
    }
    panel
}

/// Position and target over the whole run.
pub(super) fn position(ticks: &Ticks) -> Panel {
    // The target is thin and on top; of one that moves fast both are drawn by their upper and lower ends, which keep the peaks.
    let period_rows = ticks.period_rows();
    let target = ticks.traces.course_of(0, period_rows);
    let mut panel = Panel::new(Axis::linear("time", "s"), Axis::linear("position", "um"));
    let ends = ticks.motion_rms_um().is_some() && !ticks.traces.is_bare();
    if ends {
        let course = ticks.traces.course_of(1, period_rows);
        let of = |name: &str, um: &[f64]| Series::line(name, &course.time_s, um).color(0);
        panel = panel
            .series(Series::band("", &course.time_s, &course.low, &course.high).color(0))
            .series(of("measured", &course.low))
            .series(of("", &course.high));
    } else {
        panel = enveloped(panel, ticks, 1, "measured", 0);
    }
    let end = |name: &str, um: &[f64]| Series::line(name, &target.time_s, um).thin().color(1);
    let panel = panel.series(end("target", &target.low));
    match ticks.traces.is_bare() {
        true => panel,
        false => panel.series(end("", &target.high)),
    }
}

/// A quantity over the run, tick by tick or as an envelope with its median.
pub(super) fn over_time(envelope: &Envelope<1>, name: &str, unit: &str) -> Panel {
    let course = envelope.course(0);
    let mut panel = Panel::new(Axis::linear("time", "s"), Axis::linear(name, unit));
    if !envelope.is_bare() {
        let (low, high) = (&course.low, &course.high);
        let band = Series::band("smallest to largest", &course.time_s, low, high);
        panel = panel.series(band.color(0));
    }
    let median = Series::line("median", &course.time_s, &course.median);
    panel.series(median.color(0).thin())
}

/// The error over the run.
pub(super) fn error(ticks: &Ticks) -> Figure {
    let mut caption = "Error from two seconds after the loop was closed.".to_string();
    if !ticks.error.is_bare() {
        caption.push_str(
            " Area: from the smallest to the largest of each stretch of time; line: median.",
        );
    }
    Figure::new("error-over-time", &caption).panel(over_time(&ticks.error, "error", "nm"))
}

/// Position and target, PZT and zero flow over the whole run.
pub(super) fn over_the_run(ticks: &Ticks) -> Figure {
    let time = || Axis::linear("time", "s");
    let mut caption = match ticks.traces.is_bare() {
        true => "Position and target (above), PZT and zero flow (below) over the whole run.".to_string(),
        false => "Position and target (above), PZT and zero flow (below) over the whole run: area from the smallest to the largest \
                  value of each stretch of time, line: median; the target by its two ends."
            .to_string(),
    };
    let pzt = enveloped(
        Panel::new(time(), Axis::linear("PZT", "um")),
        ticks,
        2,
        "command",
        2,
    );
    let neutral = ticks.traces.course(3);
    let pzt = pzt.series(
        Series::line("zero flow", &neutral.time_s, &neutral.median)
            .thin()
            .color(3),
    );
    let mut figure = Figure::new("traces", "").panel(position(ticks)).panel(pzt);
    if ticks.has_partner {
        caption.push_str(
            " Below: displacement of the slow partner as it reports it, on its own scale, and what it does to the flow, in um of PZT.",
        );
        figure = figure.panel(partner(ticks));
    }
    figure.caption(&caption).share_x()
}

/// Adds the traces; `whole`: also those over the whole run, which are not at the top of the page.
pub(super) fn traces(page: &mut Report, ticks: &Ticks, whole: bool) {
    page.section("Traces");
    let time = || Axis::linear("time", "s");
    if whole {
        page.figure(over_the_run(ticks));
    }
    if ticks.rms_um().is_some() {
        page.figure(error(ticks));
    }
    let near = &ticks.excerpt;
    if near.time_s.is_empty() {
        page.paragraph("The loop was never closed.");
        return;
    }
    page.figure(
        Figure::new(
            "excerpt",
            "Every tick of the first two seconds of the closed loop.",
        )
        .panel(
            Panel::new(time(), Axis::linear("position", "um"))
                .series(
                    Series::line("measured", &near.time_s, &near.measured_um)
                        .thin()
                        .color(0),
                )
                .series(
                    Series::line("target", &near.time_s, &near.target_um)
                        .thin()
                        .color(1),
                ),
        )
        .panel(
            Panel::new(time(), Axis::linear("PZT", "um"))
                .series(Series::step("command", &near.time_s, &near.command_um).color(2)),
        )
        .share_x(),
    );
}

pub(super) fn spectrum(page: &mut Report, ticks: &Ticks, meta: Option<&RunMeta>) {
    page.section("Spectrum of the error");
    let Some(spectrum) = ticks.error_um.spectrum(ticks.period_s()) else {
        page.paragraph("The run is too short for a spectrum.");
        return;
    };
    let mut panel = Panel::new(
        Axis::log("frequency", "Hz"),
        Axis::log("density", "nm/rtHz"),
    )
    .series(Series::line("measured", &spectrum.hz, &spectrum.nm_per_rthz).color(0));
    let mut caption = "Amplitude density of the measured error, one-sided.".to_string();
    if let Some(predicted) = predicted(meta, ticks, &spectrum.hz) {
        panel = panel.series(
            Series::line("predicted", &spectrum.hz, &predicted)
                .dashed()
                .color(1),
        );
        caption.push_str(
            " Dashed: what the linear model of this loop predicts for a hold, from Brownian motion and the localisation noise that \
             vision stated.",
        );
    }
    page.figure(Figure::new("error-spectrum", &caption).panel(panel));
}

/// The spectrum that the run's own set-up predicts; none where it cannot be set up again, or the target moves.
fn predicted(meta: Option<&RunMeta>, ticks: &Ticks, hz: &[f64]) -> Option<Vec<f64>> {
    let meta = meta.filter(|_| !ticks.target_moves)?;
    let diffusion = cellpos_session::recorded::diffusion_of_run_um2_per_s(meta)?;
    let setup = cellpos_session::recorded::setup_of(meta, "run.toml").ok()?;
    let predicted = setup.predicted_density(diffusion, hz)?;
    Some(predicted.with_noise_nm(ticks.noise_um() * 1e3))
}
