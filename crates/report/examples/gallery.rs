//! Writes a report with every kind of figure, for looking at: `cargo run -p cellpos-report --example gallery -- DIR`.

use cellpos_report::{Axis, Column, Emphasis, Figure, HeatMap, Panel, Report, Series, Table};
use std::path::PathBuf;

fn main() -> Result<(), cellpos_report::ReportError> {
    let folder = PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| "gallery".into()));
    let mut report = Report::new("Gallery: every kind of figure");
    report.paragraph("Made-up data, to judge how figures look.");
    report.note(Emphasis::Good, "Holds within its limits.");
    report.note(Emphasis::Warning, "DEGRADED: no real-time priority.");
    report.note(Emphasis::Bad, "The bead was lost for 40 ms.");
    report.section("Table");
    let mut table = Table::new([
        Column::left("parameter"),
        Column::right("value"),
        Column::right("95 % interval"),
        Column::left("verdict"),
    ]);
    table.row(["K (1/s)", "428.1", "427.0 .. 429.2", "identified"]);
    table.row_with(
        Emphasis::Warning,
        [
            "slow pole (rad/s)",
            "-0.0017",
            "-9 .. 9",
            "not identifiable",
        ],
    );
    table.caption("Parameters of the fit.");
    report.table(table);

    bode(&mut report);
    traces(&mut report);
    histogram(&mut report);
    map(&mut report);
    report.write_with_figures(&folder.join("report.html"))
}

fn bode(report: &mut Report) {
    report.section("Bode");
    let f: Vec<f64> = (0..200).map(|k| 10f64.powf(f64::from(k) / 80.0)).collect();
    let gain: Vec<f64> = f.iter().map(|f| 20.0 * (63.0 / f).log10()).collect();
    let phase: Vec<f64> = f.iter().map(|f| -90.0 - 0.72 * f).collect();
    let shift = |values: &[f64], by: f64| values.iter().map(|v| v + by).collect::<Vec<_>>();
    let tens = [
        2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 120.0, 150.0, 200.0, 300.0,
    ];
    let at = |g: fn(f64) -> f64| tens.iter().map(|f| g(*f)).collect::<Vec<_>>();
    let measured = at(|f| 20.0 * (63.0 / f).log10() + 0.3 * (f * 7.0).sin());
    let lag = at(|f| -90.0 - 0.72 * f + 4.0 * (f * 3.0).sin());
    report.figure(
        Figure::bode("bode", "Frequency response with its confidence band.")
            .bode_series(
                Series::band("95 % band", &f, &shift(&gain, -1.0), &shift(&gain, 1.0)),
                Series::band("", &f, &shift(&phase, -8.0), &shift(&phase, 8.0)),
            )
            .bode_series(
                Series::line("fit", &f, &gain).color(0),
                Series::line("", &f, &phase),
            )
            .bode_series(
                Series::intervals(
                    "measured",
                    &tens,
                    &measured,
                    &shift(&measured, -1.0),
                    &shift(&measured, 1.0),
                )
                .color(1),
                Series::points("", &tens, &lag),
            )
            .bode_frequency(67.0, "1/(6T)"),
    );
    let turn: Vec<f64> = (0..300).map(|k| 0.2 + f64::from(k) / 60.0).collect();
    let re: Vec<f64> = turn.iter().map(|w| -(w * 0.6).sin() / w).collect();
    let im: Vec<f64> = turn.iter().map(|w| -(w * 0.6).cos() / w).collect();
    report.figure(
        Figure::nyquist("nyquist", "Open loop in the complex plane.")
            .series(Series::line("L(jw)", &re, &im)),
    );
}

/// Even noise within half a unit, the same every time.
fn noise() -> impl FnMut() -> f64 {
    let mut state = 1u64;
    move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        ((state >> 40) as f64) / (1u64 << 24) as f64 - 0.5
    }
}

fn traces(report: &mut Report) {
    report.section("Traces");
    let mut noise = noise();
    let t: Vec<f64> = (0..60_000).map(|k| f64::from(k) / 1000.0).collect();
    let target: Vec<f64> = t
        .iter()
        .map(|t| if t % 20.0 < 10.0 { 0.0 } else { 10.0 })
        .collect();
    let bead: Vec<f64> = target.iter().map(|x| x + 0.6 * noise()).collect();
    let pzt: Vec<f64> = t
        .iter()
        .map(|t| 20.0 + 3.0 * (t * 0.7).sin() + 0.4 * noise())
        .collect();
    report.figure(
        Figure::new("traces", "A minute at 1 kHz, thinned to the screen.")
            .panel(
                Panel::new(Axis::linear("time", "s"), Axis::linear("position", "um"))
                    .title("Bead")
                    .series(Series::line("measured", &t, &bead).thin())
                    .series(Series::step("target", &t, &target).dashed()),
            )
            .panel(
                Panel::new(Axis::linear("time", "s"), Axis::linear("PZT", "um"))
                    .height_px(140.0)
                    .series(Series::line("command", &t, &pzt).color(2).thin())
                    .horizontal(40.0, "upper limit")
                    .horizontal(0.0, "lower limit"),
            )
            .share_x(),
    );
}

fn histogram(report: &mut Report) {
    let mut noise = noise();
    let error: Vec<f64> = (0..60_000).map(|_| 600.0 * noise()).collect();
    report.figure(
        Figure::new("histogram", "Errors, and their tail.")
            .columns(2)
            .panel(
                Panel::new(Axis::linear("error", "nm"), Axis::linear("ticks", ""))
                    .series(Series::histogram("", &error, 40)),
            )
            .panel(
                Panel::new(
                    Axis::categories("", &["before", "+ delay", "+ hysteresis", "floor"]),
                    Axis::log("gap", "um"),
                )
                .series(Series::bars(
                    "",
                    &[0.0, 1.0, 2.0, 3.0],
                    &[1.87, 0.46, 0.12, 0.1],
                    0.7,
                )),
            ),
    );
}

fn map(report: &mut Report) {
    report.section("Map");
    let values: Vec<f64> = (0..24).map(|k| f64::from(k % 7) * 1.4 - 4.0).collect();
    report.figure(Figure::heat_map(
        "map",
        "Where the model fails.",
        HeatMap::new(
            "z-score",
            &["gain", "phase", "third harmonic", "at rest"],
            &["2 Hz", "10 Hz", "50 Hz", "100 Hz", "200 Hz", "300 Hz"],
            &values,
        ),
    ));
}
