//! The HTML report: verdict, map, response before and after, traces, and the shrinking gap.

use crate::map::{BAND_EDGES_HZ, DiscrepancyMap, band_labels};
use crate::result::{Reconciliation, Verdict};
use cellpos_report::{Axis, Column, Figure, HeatMap, Panel, Report, Series, Status, Table};

/// Makes the report of a result; `title` names the data.
pub fn report(result: &Reconciliation, title: &str) -> Report {
    let mut r = Report::new(&format!("Reconcile: {title}"));
    verdict(&mut r, result);
    r.section("Where");
    r.list(&result.places);
    heat(
        &mut r,
        "map-before",
        "Innovations beyond the noise floor, standard deviations: null model",
        &result.before,
    );
    heat(
        &mut r,
        "map-after",
        "The same with the effects added",
        &result.after,
    );
    response(&mut r, result);
    gap(&mut r, result);
    traces(&mut r, result);
    r.section("Records and noise");
    let mut t = Table::new([
        Column::left("record"),
        Column::right("rows"),
        Column::right("frames with a bead"),
    ]);
    for (name, rows, frames) in &result.records {
        t.row([name.clone(), rows.to_string(), frames.to_string()]);
    }
    r.table(t);
    r.paragraph(&format!(
        "Noise of these records: Brownian motion of {:.3} um^2/s, localisation noise of {:.1} nm RMS; together an innovation of {:.1} nm RMS, which is the floor of every figure here.",
        result.noise.diffusion_um2_per_s(result.sample_s),
        1e3 * result.noise.localisation_um(),
        1e3 * result.noise.innovation_um()
    ));
    r
}

fn verdict(r: &mut Report, result: &Reconciliation) {
    let names = result
        .effects
        .iter()
        .map(|e| e.id.as_str())
        .collect::<Vec<_>>()
        .join(" + ");
    match result.verdict {
        Verdict::Named => r.note(Status::Good, &format!("named: {names}")),
        Verdict::Ambiguous => r.note(
            Status::Warning,
            &format!("ambiguous: {names}, or what stands beside it below"),
        ),
        Verdict::Unknown => r.note(
            Status::Bad,
            "unknown: beyond the noise floor, and nothing in the catalogue closes enough of it",
        ),
        Verdict::NothingMissing => r.note(
            Status::Good,
            "nothing missing: the model is at the noise floor",
        ),
    };
    if !result.effects.is_empty() {
        let mut t = Table::new([
            Column::left("effect"),
            Column::left("place"),
            Column::left("parameters (95 % interval)"),
            Column::right("explains"),
            Column::right("p"),
            Column::left("or"),
        ]);
        for e in &result.effects {
            let p = e
                .parameters
                .iter()
                .map(|(n, v)| {
                    format!(
                        "{n} = {:.5} {} [{:.5}, {:.5}]",
                        v.value, v.unit, v.ci95[0], v.ci95[1]
                    )
                })
                .collect::<Vec<_>>()
                .join("; ");
            t.row([
                e.id.clone(),
                e.place.to_owned(),
                p,
                format!("{:.1} %", 100.0 * e.explained),
                format!("{:.1e}", e.p_value),
                e.alternatives.join(", "),
            ]);
        }
        r.table(t);
        for e in &result.effects {
            if let Some(s) = &e.separate_by {
                r.note(Status::Warning, &format!("{}: {s}", e.id));
            }
        }
    }
    if let Some(h) = &result.hypothesis {
        r.note(
            Status::Warning,
            &format!(
                "Hypothesis, worth {:.0} % of the excess on held-out data: {}",
                100.0 * h.held_out_worth,
                h.formula
            ),
        );
    }
}

fn heat(r: &mut Report, name: &str, caption: &str, map: &DiscrepancyMap) {
    let n = BAND_EDGES_HZ.len();
    let rows: Vec<&crate::map::MapRow> =
        map.rows.iter().filter(|row| row.cells.len() == n).collect();
    let names: Vec<&str> = rows.iter().map(|row| row.name.as_str()).collect();
    let values: Vec<f64> = rows
        .iter()
        .flat_map(|row| row.cells.iter().map(|c| c.z.clamp(-5.0, 50.0)))
        .collect();
    r.figure(Figure::heat_map(
        name,
        caption,
        HeatMap::new(
            "excess, standard deviations",
            &names,
            &band_labels(),
            &values,
        ),
    ));
}

fn response(r: &mut Report, result: &Reconciliation) {
    r.section("Response: measured over simulated");
    r.paragraph("0 dB and 0 deg mean that the model is right at that frequency.");
    let split = |m: &DiscrepancyMap| {
        let hz: Vec<f64> = m.ratios.iter().map(|b| b.hz).collect();
        let gain: Vec<f64> = m.ratios.iter().map(|b| b.gain_db).collect();
        let phase: Vec<f64> = m.ratios.iter().map(|b| b.phase_deg).collect();
        (hz, gain, phase)
    };
    let (h0, g0, p0) = split(&result.before);
    let (h1, g1, p1) = split(&result.after);
    if h0.is_empty() {
        return;
    }
    r.figure(
        Figure::bode("response", "Measured over simulated, before and after")
            .bode_series(
                Series::line("before", &h0, &g0),
                Series::line("before", &h0, &p0),
            )
            .bode_series(
                Series::line("after", &h1, &g1),
                Series::line("after", &h1, &p1),
            ),
    );
}

fn gap(r: &mut Report, result: &Reconciliation) {
    r.section("The gap");
    let g = &result.gap;
    r.paragraph(&format!(
        "On held-out records: {:.1} nm before, {:.1} nm after, floor {:.1} nm RMS of innovation; closure {:.1} %.",
        1e3 * g.before,
        1e3 * g.after,
        1e3 * g.floor,
        100.0 * g.closure()
    ));
    let mut t = Table::new([
        Column::left("model, as the search went on"),
        Column::right("RMS innovation [nm]"),
    ]);
    for s in &g.steps {
        let name = if s.effects.is_empty() {
            match s.base_gain {
                Some(gain) => format!("null model, base gain free ({gain:.4})"),
                None => "null model".to_owned(),
            }
        } else {
            s.effects.join(" + ")
        };
        t.row([name, format!("{:.2}", 1e3 * s.rms)]);
    }
    r.table(t);
    let mut t = Table::new([
        Column::left("held-out record"),
        Column::right("before [nm]"),
        Column::right("after [nm]"),
    ]);
    for p in &g.per_record {
        t.row([
            p.record.clone(),
            format!("{:.2}", 1e3 * p.before),
            format!("{:.2}", 1e3 * p.after),
        ]);
    }
    r.table(t);
    let x: Vec<f64> = g
        .bands
        .iter()
        .map(|b| (b.low_hz.max(0.3) * b.high_hz).sqrt())
        .collect();
    let pick = |f: fn(&crate::result::BandGap) -> f64| {
        g.bands.iter().map(|b| 1e3 * f(b)).collect::<Vec<f64>>()
    };
    r.figure(
        Figure::new("spectrum", "Innovations by band").panel(
            Panel::new(
                Axis::log("frequency", "Hz"),
                Axis::log("innovation", "nm RMS"),
            )
            .series(Series::line("before", &x, &pick(|b| b.before)))
            .series(Series::line("after", &x, &pick(|b| b.after)))
            .series(Series::line("floor", &x, &pick(|b| b.floor)).dashed()),
        ),
    );
}

fn traces(r: &mut Report, result: &Reconciliation) {
    r.section("Traces");
    r.paragraph(
        "Free runs of both models from the start of each record. A perfect model's residual wanders like a Brownian path.",
    );
    for t in &result.traces.0 {
        r.figure(
            Figure::new(
                &format!("trace-{}", t.record),
                &format!("{}: position and free-run residual", t.record),
            )
            .panel(
                Panel::new(Axis::linear("time", "s"), Axis::linear("position", "um"))
                    .series(Series::line("measured", &t.time_s, &t.measured_um))
                    .series(Series::line("before", &t.time_s, &t.before_um).thin())
                    .series(Series::line("after", &t.time_s, &t.after_um).thin()),
            )
            .panel(
                Panel::new(Axis::linear("time", "s"), Axis::linear("residual", "um"))
                    .series(
                        Series::line("before", &t.time_s, &t.residual_before_um)
                            .thin()
                            .color(1),
                    )
                    .series(
                        Series::line("after", &t.time_s, &t.residual_after_um)
                            .thin()
                            .color(2),
                    ),
            )
            .share_x(),
        );
    }
}
