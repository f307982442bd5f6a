//! The circle on one page: what was found, margins predicted and true, tracking errors, before and after.

use super::answer::{RUNS, delays_differ, error, rms, sentence, verdict_and_names};
use crate::experiment::circle::Circle;
use crate::experiment::circle::margins::{AMPLITUDES_UM, LoopMargins, Response};
use crate::experiment::circle::stage::Stage;
use cellpos_report::{Axis, Column, Emphasis, Figure, Panel, Report, Series, Table};
use cellpos_session::provenance::command_text;
use std::path::Path;

fn effects(stage: &Stage) -> String {
    stage.effects.join(", ")
}

fn figure(of: Option<LoopMargins>, f: impl Fn(&LoopMargins) -> Option<f64>, unit: &str) -> String {
    of.as_ref()
        .and_then(f)
        .map_or_else(|| "-".to_owned(), |v| format!("{v:.2}{unit}"))
}

/// One line of the table of margins.
struct Line {
    name: &'static str,
    unit: &'static str,
    value: fn(&LoopMargins) -> Option<f64>,
}

const LINES: [Line; 5] = [
    Line {
        name: "peak of S",
        unit: "",
        value: |m| Some(m.ms),
    },
    Line {
        name: "peak of T",
        unit: "",
        value: |m| Some(m.mt),
    },
    Line {
        name: "phase margin",
        unit: " deg",
        value: |m| Some(m.pm_deg),
    },
    Line {
        name: "gain margin",
        unit: " dB",
        value: |m| m.gm_db,
    },
    Line {
        name: "delay margin",
        unit: " ms",
        value: |m| Some(m.delay_margin_ms),
    },
];

fn bode(circle: &Circle) -> Figure {
    let mut plot = Figure::bode(
        "responses",
        "Bead over command as a record shows it (hold and delay included), for motion of the size of holding: each model, and \
         the rig's own.",
    );
    let mut add = |name: &str, response: &Response, number: usize| {
        let db: Vec<f64> = response
            .value
            .iter()
            .map(|v| 20.0 * v.norm().log10())
            .collect();
        let mut last = 0.0;
        let deg: Vec<f64> = response
            .value
            .iter()
            .map(|v| {
                let turn = ((v.arg() - last) / std::f64::consts::TAU).round();
                last = v.arg() - turn * std::f64::consts::TAU;
                last.to_degrees()
            })
            .collect();
        let (mut magnitude, mut phase) = (
            Series::line(name, &response.hz, &db).color(number),
            Series::line(name, &response.hz, &deg).color(number),
        );
        if name == "the rig" {
            (magnitude, phase) = (magnitude.dashed(), phase.dashed());
        }
        plot = std::mem::replace(&mut plot, Figure::new("", "")).bode_series(magnitude, phase);
    };
    for (i, stage) in circle.stages.iter().enumerate() {
        // An unstable model has no response to show.
        if stage.problem.is_none() {
            add(stage.name, &stage.response, i);
        }
    }
    if let Some(response) = circle
        .truth
        .as_ref()
        .and_then(|truth| Response::of(truth, AMPLITUDES_UM[0], circle.sample_s).ok())
    {
        add("the rig", &response, circle.stages.len());
    }
    plot
}

/// The error of each controller in both runs.
fn errors(circle: &Circle) -> Figure {
    let mut plot = Figure::new(
        "errors",
        "RMS error with the controller designed on each model, with its 95 % interval where that is larger than the point.",
    )
    .columns(2);
    let names: Vec<&str> = circle.stages.iter().map(|stage| stage.name).collect();
    let at: Vec<f64> = (0..names.len()).map(|n| n as f64).collect();
    for (title, of) in RUNS {
        let found: Vec<(f64, f64)> = (circle.stages.iter())
            .map(|stage| of(stage).and_then(error).unwrap_or((f64::NAN, f64::NAN)))
            .collect();
        let of =
            |sign: f64| -> Vec<f64> { found.iter().map(|(nm, half)| nm + sign * half).collect() };
        let axis = Axis::categories("controller designed on the model", &names);
        plot = plot.panel(
            Panel::new(axis, Axis::linear("error", "nm RMS"))
                .title(title)
                .series(Series::intervals("", &at, &of(0.0), &of(-1.0), &of(1.0)).color(0)),
        );
    }
    plot
}

fn traces(circle: &Circle) -> Figure {
    let mut plot = Figure::new(
        "tracking-errors",
        "Position less reference in the last half second: holding still, and following the sine. On the emulated rig every controller meets \
         the same noise.",
    )
    .share_x();
    for (title, of) in RUNS {
        let mut panel = Panel::new(Axis::linear("time", "s"), Axis::linear("error", "um"))
            .title(title)
            .height_px(180.0);
        for (i, stage) in circle.stages.iter().enumerate() {
            let Some((time_s, error_um)) = of(stage).map(|t| &t.trace) else {
                continue;
            };
            panel = panel.series(Series::line(stage.name, time_s, error_um).color(i).thin());
        }
        plot = plot.panel(panel);
    }
    plot
}

/// The page.
pub fn report(circle: &Circle, gap: &Path) -> Report {
    let mut r = Report::new("Closed circle: identify, reconcile, design again, track");
    let m = circle.motion;
    r.lead(&format!(
        "Task: measure how the bead follows the piezo of {}, find what the model lacks, design the controller again on the corrected model, \
         and compare. With each controller the bead was held for {} s, then moved on a sine of {} um to each side at {} Hz for {} s.",
        match circle.truth {
            Some(_) => "the emulated rig (a simulation)",
            None => "the rig",
        },
        m.duration_s,
        m.amplitude_um,
        m.frequency_hz,
        m.duration_s
    ));
    let (status, sentence) = sentence(circle);
    r.result(status, &sentence);
    r.certainty(&format!(
        "\u{b1} is the 95 % interval that one run of each gives, from the scatter of its error over tenths of a second; the first two seconds \
         are left out. Before: the controller of the given model; after: that of the corrected one. Intervals of a delay: 95 % of the fit{}.",
        match delays_differ(circle) {
            true => ", which hold if the model is right; they exclude each other, so one of the two models is not",
            false => "",
        }
    ));
    r.figure(errors(circle));

    r.section("Identified");
    let judged = &circle.identified.result.judged;
    let model = &judged.model;
    r.paragraph(&format!(
        "K = {:.1} /s, delay {:.3} ms. The model that reconcile extended is the one {}: {}.",
        model.gain_per_s,
        judged
            .parameter("effective_delay_ms")
            .map_or(model.delay_s * 1e3, |delay| delay.value),
        circle.base.0,
        circle.base.1
    ));
    if !circle.identified.result.warnings.is_empty() {
        r.list(&circle.identified.result.warnings);
    }

    reconciled(&mut r, circle, gap);
    margins(&mut r, circle);
    tracking(&mut r, circle);
    r.command(&command_text());
    r
}

fn reconciled(r: &mut Report, circle: &Circle, gap: &Path) {
    r.section("Reconciled");
    let mut t = Table::new([
        Column::left("effect"),
        Column::left("place"),
        Column::left("parameters (95 % interval)"),
        Column::left("or"),
    ]);
    for e in &circle.reconciled.effects {
        let parameters: Vec<String> = e
            .parameters
            .iter()
            .map(|(n, p)| {
                format!(
                    "{n} = {:.5} {} [{:.5}, {:.5}]",
                    p.value, p.unit, p.ci95[0], p.ci95[1]
                )
            })
            .collect();
        t.row([
            e.id.clone(),
            e.place.to_owned(),
            parameters.join("; "),
            e.alternatives.join(", "),
        ]);
    }
    if circle
        .reconciled
        .effects
        .iter()
        .any(|e| e.id == "time-delay")
    {
        t.caption("The delay in the table is that of the effect alone; the sentence above counts from the middle of an exposure and has half of it more.");
    }
    r.table(t);
    let g = &circle.reconciled.gap;
    r.paragraph(&format!(
        "Gap on held-out records: {:.1} nm before, {:.1} nm after, floor {:.1} nm RMS of innovation; the whole of it is in {}.",
        1e3 * g.before,
        1e3 * g.after,
        1e3 * g.floor,
        gap.display()
    ));
    let mut t = Table::new([
        Column::left("recorded"),
        Column::right("rows"),
        Column::left("because"),
        Column::left("verdict then"),
    ]);
    for c in &circle.collected {
        t.row([
            format!("{}: {}", c.experiment, c.what),
            c.rows.to_string(),
            c.why.clone(),
            c.verdict.clone(),
        ]);
    }
    r.table(t);
}

fn margins(r: &mut Report, circle: &Circle) {
    r.section("Margins, predicted and true");
    r.paragraph(
        "A controller is designed on each model. Predicted: on that model. True: the same controller on the rig's own model, \
         with the delay that its frames had. Both for motion of the size of holding, nonlinear effects included; where a dead zone \
         swallows such motion, for the next larger that has a crossover.",
    );
    r.table(margins_table(circle));
    for s in &circle.stages {
        for (which, m) in [("model it was designed on", s.predicted), ("rig", s.real)] {
            if m.is_some_and(|m| !m.stable) {
                r.note(
                    Emphasis::Bad,
                    &format!(
                        "{}: unstable on the {which}; the figures describe its open loop only",
                        s.name
                    ),
                );
            }
        }
        if let Some(why) = &s.problem {
            r.note(
                Emphasis::Warning,
                &format!("{}: no controller on this model: {why}", s.name),
            );
        }
    }
    r.figure(bode(circle));
}

fn tracking(r: &mut Report, circle: &Circle) {
    r.section("Tracking, before and after");
    let mut t = Table::new([
        Column::left("controller designed on the model"),
        Column::left("effects"),
        Column::right("kp"),
        Column::right("ki, 1/s"),
        Column::right("hold, RMS"),
        Column::right("sine, RMS"),
    ]);
    let number = |v: Option<f64>| v.map_or_else(|| "-".to_owned(), |v| format!("{v:.3}"));
    for s in &circle.stages {
        t.row([
            s.name.to_owned(),
            effects(s),
            number(s.kp_um_per_um),
            number(s.ki_per_s),
            rms(s.hold.as_ref()),
            rms(s.sine.as_ref()),
        ]);
    }
    let m = circle.motion;
    t.caption(&format!(
        "Hold: 0 um for {} s. Sine: {} um (half of peak to peak) at {} Hz. Error of the true position where it is known, the \
         first 2 s left out.",
        m.duration_s, m.amplitude_um, m.frequency_hz
    ));
    r.table(t);
    r.figure(traces(circle));
}

fn margins_table(circle: &Circle) -> Table {
    let mut columns = vec![Column::left("")];
    for s in &circle.stages {
        columns.push(Column::right(&format!("{}: predicted", s.name)));
        columns.push(Column::right("true"));
    }
    let mut t = Table::with_columns(columns);
    for line in &LINES {
        let mut cells = vec![line.name.to_owned()];
        for s in &circle.stages {
            cells.push(figure(s.predicted, line.value, line.unit));
            cells.push(figure(s.real, line.value, line.unit));
        }
        t.row(cells);
    }
    let mut cells = vec!["for bead motion of".to_owned()];
    for s in &circle.stages {
        cells.push(format!("{} um", s.margins_at_um));
        cells.push(String::new());
    }
    t.row(cells);
    t
}

/// The same for a terminal.
pub fn text(circle: &Circle, out: &Path, html: &Path) -> String {
    use std::fmt::Write as _;
    let mut s = String::new();
    let _ = writeln!(s, "verdict: {}", verdict_and_names(circle));
    for e in &circle.reconciled.effects {
        for (name, p) in &e.parameters {
            let _ = writeln!(
                s,
                "  {} {name} = {:.5} {} (95 %: {:.5} .. {:.5})",
                e.id, p.value, p.unit, p.ci95[0], p.ci95[1]
            );
        }
    }
    for stage in &circle.stages {
        let _ = writeln!(s, "{}: {}", stage.name, effects(stage));
        for line in &LINES {
            let _ = writeln!(
                s,
                "  {:<14}{:>12} predicted{:>12} true",
                line.name,
                figure(stage.predicted, line.value, line.unit),
                figure(stage.real, line.value, line.unit)
            );
        }
        let _ = writeln!(
            s,
            "  hold {}, sine {}",
            rms(stage.hold.as_ref()),
            rms(stage.sine.as_ref())
        );
        if let Some(why) = &stage.problem {
            let _ = writeln!(s, "  no controller on this model: {why}");
        }
    }
    let _ = writeln!(s, "model   {}\nreport  {}", out.display(), html.display());
    s
}
