//! Figures to SVG.

use crate::axis::{Placed, Scale};
use crate::figure::{Content, Figure, Panel};
use crate::heat::heat_map;
use crate::series::{Kind, Series};
use crate::svg::{self, Anchor, COLORS, STYLE, Svg, px};
use crate::thin;
use std::fmt::Write;

pub(crate) const WIDTH_PX: f64 = 820.0;
const LEFT_PX: f64 = 74.0;
const RIGHT_PX: f64 = 16.0;
const LINE_PX: f64 = 18.0;

/// The figure as SVG; `alone` adds the style sheet and the background that a page gives to inline figures.
pub(crate) fn figure(figure: &Figure, alone: bool) -> String {
    let mut body = Svg { out: String::new() };
    let height_px = match &figure.content {
        Content::Panels(panels) => panels_grid(&mut body, figure, panels),
        Content::HeatMap(map) => heat_map(&mut body, map),
    };
    let (w, h) = (px(WIDTH_PX), px(height_px));
    let mut out = String::new();
    let _ = write!(
        out,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"fg\" viewBox=\"0 0 {w} {h}\" width=\"{w}\" height=\"{h}\" role=\"img\"><title>{}</title>",
        svg::escape(&figure.caption)
    );
    if alone {
        let _ = write!(
            out,
            "<style>{STYLE}</style><rect class=\"bg\" width=\"{w}\" height=\"{h}\"/>"
        );
    }
    out.push_str(&body.out);
    out.push_str("</svg>\n");
    out
}

/// Draws the panels and returns the height of all.
fn panels_grid(svg: &mut Svg, figure: &Figure, panels: &[Panel]) -> f64 {
    let shared = figure.share_x.then(|| {
        panels
            .iter()
            .filter_map(|panel| data_range(panel, true))
            .reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    });
    let columns = figure.columns.min(panels.len().max(1));
    let width = WIDTH_PX / columns as f64;
    let mut top = 4.0;
    for (row_index, row) in panels.chunks(columns).enumerate() {
        let last_row = (row_index + 1) * columns >= panels.len();
        let mut tallest: f64 = 0.0;
        for (column, panel) in row.iter().enumerate() {
            let frame = Frame {
                left: column as f64 * width + LEFT_PX,
                top,
                width: width - LEFT_PX - RIGHT_PX,
                x_range: shared.unwrap_or_else(|| data_range(panel, true)),
                show_x: !(figure.share_x && columns == 1) || last_row,
                // Panels below each other that show the same series need one legend, above the first.
                show_legend: columns > 1
                    || row_index == 0
                    || panels
                        .get(row_index - 1)
                        .is_none_or(|above| entries(above) != entries(panel)),
            };
            tallest = tallest.max(draw_panel(svg, panel, &frame));
        }
        top += tallest;
    }
    top + 2.0
}

/// Where a panel goes.
struct Frame {
    left: f64,
    top: f64,
    width: f64,
    x_range: Option<(f64, f64)>,
    /// Whether the x axis has its numbers and title (only the lowest of panels that share it).
    show_x: bool,
    /// Whether its legend is drawn.
    show_legend: bool,
}

/// What a panel's legend says: names, colours and strokes.
fn entries(panel: &Panel) -> Vec<(&str, usize, bool)> {
    panel
        .series
        .iter()
        .zip(colors(panel))
        .filter(|(series, _)| !series.label.is_empty())
        .map(|(series, color)| (series.label.as_str(), color, series.dashed))
        .collect()
}

/// Range of a panel's data along one axis, marker lines included.
fn data_range(panel: &Panel, along_x: bool) -> Option<(f64, f64)> {
    let axis = if along_x { &panel.x } else { &panel.y };
    let mut range: Option<(f64, f64)> = None;
    let mut take = |value: f64| {
        if axis.places(value) {
            let (low, high) = range.unwrap_or((value, value));
            range = Some((low.min(value), high.max(value)));
        }
    };
    for series in &panel.series {
        for index in 0..series.len() {
            let x = series.x.get(index).copied().unwrap_or(f64::NAN);
            if along_x {
                match &series.kind {
                    Kind::Bars { width, .. } => {
                        take(x - width / 2.0);
                        take(x + width / 2.0);
                    }
                    _ => take(x),
                }
                continue;
            }
            // What lies outside a fixed range of x must not stretch y.
            if panel.x.range.is_some_and(|(a, b)| x < a || x > b) {
                continue;
            }
            let (y, low, high) = series.values(index);
            [y, low, high].into_iter().flatten().for_each(&mut take);
        }
        if !along_x && matches!(series.kind, Kind::Bars { .. }) && !series.is_empty() {
            take(0.0);
        }
    }
    for marker in panel.markers.iter().filter(|m| m.vertical == along_x) {
        take(marker.value);
    }
    range
}

/// Draws one panel and returns its height with title, legend and axis texts.
fn draw_panel(svg: &mut Svg, panel: &Panel, frame: &Frame) -> f64 {
    let mut top = frame.top;
    if !panel.title.is_empty() {
        svg.text(
            "ttl",
            (frame.left, top + 13.0),
            Anchor::Start,
            &svg::fit(&panel.title, frame.width),
        );
        top += LINE_PX;
    }
    if frame.show_legend {
        top += legend(svg, panel, frame.left, top, frame.width);
    }
    top += 4.0;

    let (mut width, mut height) = (frame.width, panel.height_px);
    let y_range = data_range(panel, false);
    let pad_x = if panel
        .series
        .iter()
        .all(|s| matches!(s.kind, Kind::Points { .. }))
    {
        0.04
    } else {
        0.0
    };
    let mut x = Placed::new(&panel.x, frame.x_range, pad_x, width);
    let mut y = Placed::new(&panel.y, y_range, 0.06, height);
    let bars_up = panel
        .series
        .iter()
        .any(|s| matches!(s.kind, Kind::Bars { .. }));
    if bars_up && panel.y.range.is_none() && y_range.is_some_and(|(low, _)| low >= 0.0) {
        y.low = if panel.y.scale == Scale::Log {
            y.low
        } else {
            0.0
        };
    }
    if panel.equal && panel.x.scale == Scale::Linear && panel.y.scale == Scale::Linear {
        (width, height) = equalise(&mut x, &mut y, frame.width, height);
    }
    let left = frame.left;
    let bottom = top + height;

    for tick in x.ticks(if frame.width < 320.0 { 52.0 } else { 72.0 }) {
        let Some(at) = x.at(tick.value) else { continue };
        let class = if tick.label.is_some() { "grd" } else { "grm" };
        if panel.x.scale == Scale::Linear || panel.x.scale == Scale::Log {
            svg.line(class, (left + at, top), (left + at, bottom));
        }
        if let (true, Some(label)) = (frame.show_x, &tick.label) {
            let room = match &panel.x.scale {
                Scale::Categories(names) => width / names.len().max(1) as f64,
                _ => f64::INFINITY,
            };
            svg.text(
                "mut",
                (left + at, bottom + 15.0),
                Anchor::Middle,
                &svg::fit(label, room),
            );
        }
    }
    for tick in y.ticks(34.0) {
        let Some(at) = y.at(tick.value) else { continue };
        let class = if tick.label.is_some() { "grd" } else { "grm" };
        svg.line(class, (left, bottom - at), (left + width, bottom - at));
        if let Some(label) = &tick.label {
            svg.text("mut", (left - 7.0, bottom - at + 4.0), Anchor::End, label);
        }
    }

    // A nested svg clips what is drawn in it and needs no identifier, which would have to be unique in a page.
    let _ = write!(
        svg.out,
        "<svg x=\"{}\" y=\"{}\" width=\"{w}\" height=\"{h}\" viewBox=\"0 0 {w} {h}\">",
        px(left),
        px(top),
        w = px(width),
        h = px(height)
    );
    let empty = panel.series.iter().all(Series::is_empty);
    if empty {
        svg.text(
            "mut",
            (width / 2.0, height / 2.0),
            Anchor::Middle,
            "no data",
        );
    }
    let colors = colors(panel);
    for below in [true, false] {
        for (series, color) in panel.series.iter().zip(&colors) {
            if below == matches!(series.kind, Kind::Band { .. } | Kind::Bars { .. }) {
                draw_series(svg, series, *color, &x, &y);
            }
        }
    }
    for marker in &panel.markers {
        let axis = if marker.vertical { &x } else { &y };
        let Some(at) = axis.at(marker.value) else {
            continue;
        };
        if marker.vertical {
            svg.line("mrk", (at, 0.0), (at, height));
            let wide = svg::text_width_px(&marker.label);
            if at + wide + 8.0 > width {
                svg.text("mut", (at - 4.0, 13.0), Anchor::End, &marker.label);
            } else {
                svg.text("mut", (at + 4.0, 13.0), Anchor::Start, &marker.label);
            }
        } else {
            svg.line("mrk", (0.0, height - at), (width, height - at));
            let y_text = if height - at < 16.0 {
                height - at + 13.0
            } else {
                height - at - 4.0
            };
            svg.text("mut", (width - 5.0, y_text), Anchor::End, &marker.label);
        }
    }
    svg.out.push_str("</svg>");
    svg.rect("frm", (left, top), (width, height));

    let mut end = bottom + 10.0;
    if frame.show_x {
        svg.text(
            "",
            (left + width / 2.0, bottom + 33.0),
            Anchor::Middle,
            &panel.x.title(),
        );
        end = bottom + 44.0;
    }
    svg.upright(
        "",
        (left - LEFT_PX + 16.0, top + height / 2.0),
        &svg::fit(&panel.y.title(), height + 20.0),
    );
    end - frame.top
}

/// Widens one range so that both axes have the same number of pixels per unit; returns width and height.
fn equalise<'a>(
    x: &mut Placed<'a>,
    y: &mut Placed<'a>,
    width_px: f64,
    height_px: f64,
) -> (f64, f64) {
    let width = width_px.min(height_px * 1.25);
    x.length_px = width;
    let pad = (x.high - x.low) * 0.06;
    if x.axis.range.is_none() {
        (x.low, x.high) = (x.low - pad, x.high + pad);
    }
    let per_px = ((x.high - x.low) / width).max((y.high - y.low) / height_px);
    for (axis, length) in [(x, width), (y, height_px)] {
        let middle = (axis.low + axis.high) / 2.0;
        axis.low = middle - per_px * length / 2.0;
        axis.high = middle + per_px * length / 2.0;
    }
    (width, height_px)
}

/// Palette number of each series.
fn colors(panel: &Panel) -> Vec<usize> {
    let mut next = 0;
    panel
        .series
        .iter()
        .map(|series| {
            let color = series.color.unwrap_or(next);
            if series.color.is_none() {
                next += 1;
            }
            color % COLORS
        })
        .collect()
}

/// Draws the legend in lines above the panel and returns its height.
fn legend(svg: &mut Svg, panel: &Panel, left: f64, top: f64, width: f64) -> f64 {
    let named: Vec<_> = panel
        .series
        .iter()
        .zip(colors(panel))
        .filter(|(series, _)| !series.label.is_empty())
        .collect();
    if named.is_empty() {
        return 0.0;
    }
    let (mut x, mut y) = (left, top);
    for (series, color) in named {
        let label = svg::fit(&series.label, width - 30.0);
        let wide = svg::text_width_px(&label) + 42.0;
        if x > left && x + wide - 16.0 > left + width {
            x = left;
            y += LINE_PX;
        }
        let middle = y + 9.0;
        match &series.kind {
            Kind::Line { .. } | Kind::Step { .. } => {
                let dash = if series.dashed { " dsh" } else { "" };
                svg.line(
                    &format!("ln s{color}{dash}"),
                    (x, middle),
                    (x + 20.0, middle),
                );
            }
            Kind::Points { .. } => dot(svg, color, (x + 10.0, middle), 3.2),
            Kind::Band { .. } => {
                svg.rect(&format!("bnd f{color}"), (x, middle - 5.0), (20.0, 10.0));
            }
            Kind::Bars { .. } => {
                svg.rect(
                    &format!("bar f{color}"),
                    (x + 4.0, middle - 5.0),
                    (12.0, 10.0),
                );
            }
        }
        svg.text("", (x + 25.0, middle + 4.0), Anchor::Start, &label);
        x += wide;
    }
    y - top + LINE_PX
}

fn dot(svg: &mut Svg, color: usize, at: (f64, f64), radius: f64) {
    let _ = write!(
        svg.out,
        "<circle class=\"dot f{color}\" cx=\"{}\" cy=\"{}\" r=\"{}\"/>",
        px(at.0),
        px(at.1),
        px(radius)
    );
}

/// Many points as one path of zero-length strokes with round ends: a tenth of the bytes of circles.
fn specks(svg: &mut Svg, color: usize, points: &[(f64, f64)]) {
    let _ = write!(svg.out, "<path class=\"ln spk s{color}\" d=\"");
    for (x, y) in points {
        let _ = write!(svg.out, "M{} {}h0", px(*x), px(*y));
    }
    svg.out.push_str("\"/>");
}

fn draw_series(svg: &mut Svg, series: &Series, color: usize, x: &Placed, y: &Placed) {
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
                path(
                    svg,
                    &class,
                    &thin::line(if step { stairs(run) } else { run }),
                );
            }
        }
        Kind::Points { interval, .. } => {
            let all: thin::Run = runs(series, x, y).into_iter().flatten().collect();
            let radius = if all.len() > 400 { 1.3 } else { 3.0 };
            if interval.is_some() {
                for index in 0..series.len() {
                    let (_, low, high) = series.values(index);
                    let place = |value: Option<f64>| value.and_then(|value| y.at(value));
                    let at = series.x.get(index).and_then(|value| x.at(*value));
                    if let (Some(at), Some(low), Some(high)) = (at, place(low), place(high)) {
                        let class = format!("ln s{color}");
                        svg.line(&class, (at, height - low), (at, height - high));
                        for end in [low, high] {
                            svg.line(&class, (at - 3.0, height - end), (at + 3.0, height - end));
                        }
                    }
                }
            }
            if radius > 2.0 {
                all.iter().for_each(|at| dot(svg, color, *at, radius));
            } else {
                specks(svg, color, &thin::points(all));
            }
        }
        Kind::Band { .. } => {
            for run in band_runs(series, x, y) {
                let run = thin::band(run);
                let mut ring: thin::Run = run.iter().map(|(at, low, _)| (*at, *low)).collect();
                ring.extend(run.iter().rev().map(|(at, _, high)| (*at, *high)));
                path(svg, &format!("bnd f{color}"), &ring);
            }
        }
        Kind::Bars { y: heights, width } => {
            let zero = y.at(0.0).unwrap_or(0.0);
            for (centre, value) in series.x.iter().zip(heights) {
                let ends = (x.at(centre - width / 2.0), x.at(centre + width / 2.0));
                if let ((Some(from), Some(to)), Some(end)) = (ends, y.at(*value)) {
                    // A sliver between neighbours keeps the bars apart.
                    let gap = if to - from > 4.0 { 0.5 } else { 0.0 };
                    svg.rect(
                        &format!("bar f{color}"),
                        (from + gap, height - end.max(zero)),
                        (to - from - 2.0 * gap, (end - zero).abs()),
                    );
                }
            }
        }
    }
}

/// The points of a series in pixels, broken where one has no place.
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

/// The pairs of a band in pixels, broken where one has no place.
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

fn path(svg: &mut Svg, class: &str, points: &[(f64, f64)]) {
    let _ = write!(svg.out, "<path class=\"{class}\" d=\"");
    for (index, (x, y)) in points.iter().enumerate() {
        svg.out.push(if index == 0 { 'M' } else { 'L' });
        svg.out.push_str(&px(*x));
        svg.out.push(' ');
        svg.out.push_str(&px(*y));
    }
    if let [(x, y)] = points {
        // A line of one point would not show; round ends make it a dot.
        let _ = write!(svg.out, "L{} {}", px(*x), px(*y));
    }
    if class.starts_with("bnd") {
        svg.out.push('Z');
    }
    svg.out.push_str("\"/>");
}
