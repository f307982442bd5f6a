//! Series to SVG: lines, points, bands, bars.

use crate::axis::Placed;
use crate::drawing::{Drawing, Join, Shape};
use crate::series::{Kind, Series};
use crate::thin;

/// A point.
pub(crate) fn dot(drawing: &mut Drawing, color: usize, at: (f64, f64), radius: f64) {
    drawing.shapes.push(Shape::Circle {
        class: format!("dot f{color}"),
        at,
        radius,
    });
}

/// The data of one series.
pub(crate) fn draw_series(
    drawing: &mut Drawing,
    series: &Series,
    color: usize,
    x: &Placed,
    y: &Placed,
) {
    let height = y.length_px;
    match &series.kind {
        Kind::Line { .. } | Kind::Step { .. } => {
            let step = matches!(series.kind, Kind::Step { .. });
            let mut class = format!("ln s{color}");
            if series.dashed {
                class.push_str(" dsh");
            }
            if series.thin {
                class.push_str(" thn");
            }
            for run in runs(series, x, y) {
                let mut points = thin::line(if step { stairs(run) } else { run });
                // A line of one point would be invisible; round ends make it a dot.
                if let [only] = points.as_slice() {
                    points.push(*only);
                }
                drawing.path(&class, points, Join::Open);
            }
        }
        Kind::Points { interval, .. } => {
            let all: thin::Run = runs(series, x, y).into_iter().flatten().collect();
            let radius = match (all.len() > 400, series.thin) {
                (true, _) => 1.3,
                (false, true) => 1.8,
                (false, false) => 3.0,
            };
            if interval.is_some() {
                for index in 0..series.len() {
                    let (_, low, high) = series.values(index);
                    let place = |value: Option<f64>| value.and_then(|value| y.at(value));
                    let at = series.x.get(index).and_then(|value| x.at(*value));
                    // An interval smaller than its point is invisible.
                    if let (Some(at), Some(low), Some(high)) = (at, place(low), place(high))
                        && (high - low).abs() > 2.0 * radius
                    {
                        let class = format!("ln s{color}");
                        drawing.line(&class, (at, height - low), (at, height - high));
                        for end in [low, high] {
                            drawing.line(
                                &class,
                                (at - 3.0, height - end),
                                (at + 3.0, height - end),
                            );
                        }
                    }
                }
            }
            if radius > 1.5 {
                all.iter().for_each(|at| dot(drawing, color, *at, radius));
            } else {
                let class = format!("ln spk s{color}");
                drawing.path(&class, thin::points(all), Join::Specks);
            }
        }
        Kind::Band { .. } => {
            for run in band_runs(series, x, y) {
                let run = thin::band(run);
                let mut ring: thin::Run = run.iter().map(|(at, low, _)| (*at, *low)).collect();
                ring.extend(run.iter().rev().map(|(at, _, high)| (*at, *high)));
                drawing.path(&format!("bnd f{color}"), ring, Join::Closed);
            }
        }
        Kind::Bars { y: heights, width } => {
            let zero = y.at(0.0).unwrap_or(0.0);
            for (centre, value) in series.x.iter().zip(heights) {
                let ends = (x.at(centre - width / 2.0), x.at(centre + width / 2.0));
                if let ((Some(from), Some(to)), Some(end)) = (ends, y.at(*value)) {
                    // A narrow gap keeps the bars apart.
                    let gap = if to - from > 4.0 { 0.5 } else { 0.0 };
                    drawing.rect(
                        &format!("bar f{color}"),
                        (from + gap, height - end.max(zero)),
                        (to - from - 2.0 * gap, (end - zero).abs()),
                    );
                }
            }
        }
    }
}

/// The points of a series in pixels, broken at points without a place.
fn runs(series: &Series, x: &Placed, y: &Placed) -> Vec<thin::Run> {
    let mut all = vec![thin::Run::new()];
    for index in 0..series.len() {
        let at_x = series.x.get(index).and_then(|value| x.at(*value));
        let at_y = series.values(index).0.and_then(|value| y.at(value));
        match (at_x, at_y, all.last_mut()) {
            (Some(at_x), Some(at_y), Some(run)) => run.push((at_x, y.length_px - at_y)),
            _ => all.push(thin::Run::new()),
        }
    }
    all.retain(|run| !run.is_empty());
    all
}

/// The pairs of a band in pixels, broken at pairs without a place.
fn band_runs(series: &Series, x: &Placed, y: &Placed) -> Vec<Vec<(f64, f64, f64)>> {
    let mut all = vec![Vec::new()];
    for index in 0..series.len() {
        let (_, low, high) = series.values(index);
        let at = series.x.get(index).and_then(|value| x.at(*value));
        let low = low.and_then(|value| y.at(value));
        let high = high.and_then(|value| y.at(value));
        match (at, low, high, all.last_mut()) {
            (Some(at), Some(low), Some(high), Some(run)) => {
                run.push((at, y.length_px - low, y.length_px - high));
            }
            _ => all.push(Vec::new()),
        }
    }
    all.retain(|run| !run.is_empty());
    all
}

/// Each value held until the next.
fn stairs(run: thin::Run) -> thin::Run {
    let mut out = thin::Run::with_capacity(run.len() * 2);
    for (x, y) in run {
        if let Some((_, before)) = out.last().copied() {
            out.push((x, before));
        }
        out.push((x, y));
    }
    out
}
