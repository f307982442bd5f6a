//! One panel to SVG: title, legend, axes, data, markers.

use crate::axis::{Placed, Scale};
use crate::drawing::{Anchor, Drawing, Shape};
use crate::figure::Panel;
use crate::marks::{dot, draw_series};
use crate::series::{Kind, Series};
use crate::svg::{self, LINE_PX, PALETTE};

/// Room for the numbers and the title of the y axis, px.
pub(crate) const LEFT_PX: f64 = 82.0;
/// Room to the right of the axes, px.
pub(crate) const RIGHT_PX: f64 = 16.0;
/// Height of a line of title or legend, px.
const HEAD_LINE_PX: f64 = 18.0;
/// Least distance of the numbers at the y axis, px.
const Y_SPACING_PX: f64 = 34.0;

/// Where a panel goes.
pub(crate) struct Frame<'a> {
    pub(crate) left: f64,
    /// Room to the left of the axes, px.
    pub(crate) left_px: f64,
    pub(crate) top: f64,
    pub(crate) width: f64,
    pub(crate) x_range: Option<(f64, f64)>,
    /// Whether the x axis has its numbers and title (only the lowest of panels that share it).
    pub(crate) show_x: bool,
    /// Room for title and legend, at least: panels of one row have their axes at one height.
    pub(crate) head_px: f64,
    /// Entries of the legends above.
    pub(crate) told: &'a [Entry<'a>],
}

/// The stroke of a legend's entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mark {
    Line,
    Dot,
    Area,
    Bar,
}

impl Mark {
    fn of(kind: &Kind) -> Self {
        match kind {
            Kind::Line { .. } | Kind::Step { .. } => Self::Line,
            Kind::Points { .. } => Self::Dot,
            Kind::Band { .. } => Self::Area,
            Kind::Bars { .. } => Self::Bar,
        }
    }
}

/// A name, a colour, whether the stroke is dashed, and what it is: a point is not explained by a line of its name.
pub(crate) type Entry<'a> = (&'a str, usize, bool, Mark);

fn entry(series: &Series, color: usize) -> Entry<'_> {
    let mark = Mark::of(&series.kind);
    (series.label.as_str(), color, series.dashed, mark)
}

/// Entries of a panel's legend: names, colours and strokes.
pub(crate) fn entries(panel: &Panel) -> Vec<Entry<'_>> {
    panel
        .series
        .iter()
        .zip(colors(panel))
        .filter(|(series, _)| !series.label.is_empty())
        .map(|(series, color)| entry(series, color))
        .collect()
}

/// Range of a panel's data along one axis, marker lines included.
pub(crate) fn data_range(panel: &Panel, along_x: bool) -> Option<(f64, f64)> {
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
                    // A place without a point must not extend the axis.
                    Kind::Points { .. } if !series.values(index).0.is_some_and(f64::is_finite) => {}
                    _ => take(x),
                }
                continue;
            }
            // Points outside a fixed range of x must not extend y.
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

/// The y axis of a panel on its height, px.
fn placed_y(panel: &Panel) -> Placed<'_> {
    let range = data_range(panel, false);
    let mut y = Placed::new(&panel.y, range, 0.06, panel.height_px);
    let bars_up = panel
        .series
        .iter()
        .any(|s| matches!(s.kind, Kind::Bars { .. }));
    if bars_up && panel.y.range.is_none() && range.is_some_and(|(low, _)| low >= 0.0) {
        y.low = if panel.y.scale == Scale::Log {
            y.low
        } else {
            0.0
        };
    }
    y
}

/// Room that the numbers and the title of a panel's y axis need to the left of it, px.
pub(crate) fn left_px(panel: &Panel) -> f64 {
    /// From the edge over the title to the numbers, and from these to the axis.
    const AROUND_PX: f64 = 34.0;
    let ticks = placed_y(panel).ticks(Y_SPACING_PX);
    let labels = ticks.iter().filter_map(|tick| tick.label.as_deref());
    let widest = labels.map(svg::text_width_px).fold(0.0, f64::max);
    LEFT_PX.max(widest + AROUND_PX) + LINE_PX * (y_title(panel).len() - 1) as f64
}

/// The title of a panel's y axis in lines.
fn y_title(panel: &Panel) -> Vec<String> {
    svg::lines(&panel.y.title(), panel.height_px + 20.0)
}

/// Height of title and legend of a panel, px.
pub(crate) fn head_px(panel: &Panel, told: &[Entry<'_>], width: f64) -> f64 {
    title_px(panel, width) + legend(&mut Drawing::default(), panel, told, (0.0, 0.0), width)
}

/// Height of the title of a panel, px.
fn title_px(panel: &Panel, width: f64) -> f64 {
    match panel.title.as_str() {
        "" => 0.0,
        title => HEAD_LINE_PX + LINE_PX * (svg::lines(title, width).len() - 1) as f64,
    }
}

/// Draws one panel and returns its height with title, legend and axis texts.
pub(crate) fn draw_panel(drawing: &mut Drawing, panel: &Panel, frame: &Frame<'_>) -> f64 {
    let mut top = frame.top;
    let at = (frame.left, top + 13.0);
    drawing.lines_down("ttl", at, Anchor::Start, &panel.title, frame.width);
    top += title_px(panel, frame.width);
    top += legend(drawing, panel, frame.told, (frame.left, top), frame.width);
    top = top.max(frame.top + frame.head_px) + 4.0;

    let (mut width, mut height) = (frame.width, panel.height_px);
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
    let mut y = placed_y(panel);
    if panel.equal && panel.x.scale == Scale::Linear && panel.y.scale == Scale::Linear {
        (width, height) = equalise(&mut x, &mut y, frame.width, height);
    }
    let (left, bottom) = (frame.left, top + height);
    let area = Area {
        left,
        top,
        width,
        height,
    };
    let numbers_px = grid(drawing, panel, frame, &area, &x, &y);

    drawing.shapes.push(Shape::Enter {
        at: (left, top),
        size: (width, height),
    });
    let empty = panel.series.iter().all(Series::is_empty);
    if empty {
        drawing.text(
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
                draw_series(drawing, series, *color, &x, &y);
            }
        }
    }
    draw_markers(drawing, panel, (width, height), &x, &y);
    drawing.shapes.push(Shape::Leave);
    drawing.rect("frm", (left, top), (width, height));

    let mut end = bottom + 10.0;
    if frame.show_x {
        let at = (left + width / 2.0, bottom + numbers_px + 18.0);
        let high = drawing.lines_down("", at, Anchor::Middle, &panel.x.title(), width + RIGHT_PX);
        end = bottom + numbers_px + high + 14.0;
    }
    for (n, line) in y_title(panel).iter().enumerate() {
        let x = left - frame.left_px + 16.0 + LINE_PX * n as f64;
        drawing.upright("", (x, top + height / 2.0), Anchor::Middle, line);
    }
    end - frame.top
}

/// The rectangle between the axes of a panel, px.
struct Area {
    left: f64,
    top: f64,
    width: f64,
    height: f64,
}

/// Draws grid lines and the numbers or names at them; returns the height of those at the x axis.
fn grid(
    drawing: &mut Drawing,
    panel: &Panel,
    frame: &Frame<'_>,
    area: &Area,
    x: &Placed,
    y: &Placed,
) -> f64 {
    let Area {
        left,
        top,
        width,
        height,
    } = *area;
    let bottom = top + height;
    let mut numbers_px = LINE_PX;
    let room = match &panel.x.scale {
        Scale::Categories(_) => x.at(1.0).unwrap_or(width) - x.at(0.0).unwrap_or(0.0) - 4.0,
        _ => f64::INFINITY,
    };
    let ticks = x.ticks(if frame.width < 320.0 { 52.0 } else { 72.0 });
    // Names with a part too wide for their place are turned, all of them.
    let labels = ticks.iter().filter_map(|tick| tick.label.as_deref());
    let turned = labels.map(svg::part_width_px).any(|wide| wide > room);
    for tick in ticks {
        let Some(at) = x.at(tick.value) else { continue };
        let class = if tick.label.is_some() { "grd" } else { "grm" };
        if panel.x.scale == Scale::Linear || panel.x.scale == Scale::Log {
            drawing.line(class, (left + at, top), (left + at, bottom));
        }
        let (true, Some(label)) = (frame.show_x, &tick.label) else {
            continue;
        };
        if turned {
            let at = (left + at + 4.0, bottom + 6.0);
            drawing.upright("mut", at, Anchor::End, label);
            numbers_px = numbers_px.max(svg::text_width_px(label) + 6.0);
        } else {
            // Long numbers at the end of an axis stay within the figure.
            let half = svg::text_width_px(label).min(room) / 2.0;
            let at = (left + at).min(left + width + RIGHT_PX - half);
            let at = (at, bottom + 15.0);
            numbers_px = numbers_px.max(drawing.lines_down("mut", at, Anchor::Middle, label, room));
        }
    }
    for tick in y.ticks(Y_SPACING_PX) {
        let Some(at) = y.at(tick.value) else { continue };
        let class = if tick.label.is_some() { "grd" } else { "grm" };
        drawing.line(class, (left, bottom - at), (left + width, bottom - at));
        if let Some(label) = &tick.label {
            drawing.text("mut", (left - 7.0, bottom - at + 4.0), Anchor::End, label);
        }
    }
    numbers_px
}

/// Marker lines across the data, in its own coordinates.
fn draw_markers(
    drawing: &mut Drawing,
    panel: &Panel,
    (width, height): (f64, f64),
    x: &Placed,
    y: &Placed,
) {
    for marker in &panel.markers {
        let axis = if marker.vertical { x } else { y };
        let Some(at) = axis.at(marker.value) else {
            continue;
        };
        if marker.vertical {
            drawing.line("mrk", (at, 0.0), (at, height));
            let wide = svg::text_width_px(&marker.label);
            let (before, behind) = (at - 8.0, width - at - 8.0);
            if wide <= behind || behind >= before {
                let at = (at + 4.0, 13.0);
                drawing.lines_down("mut", at, Anchor::Start, &marker.label, behind);
            } else {
                let at = (at - 4.0, 13.0);
                drawing.lines_down("mut", at, Anchor::End, &marker.label, before);
            }
        } else {
            drawing.line("mrk", (0.0, height - at), (width, height - at));
            let (label, room) = (&marker.label, width - 10.0);
            let high = LINE_PX * svg::lines(label, room).len() as f64;
            let below = height - at < high + 1.0;
            let at = if below {
                height - at + 13.0
            } else {
                height - at - 4.0
            };
            let at = (width - 5.0, at);
            if below {
                drawing.lines_down("mut", at, Anchor::End, label, room);
            } else {
                drawing.lines_up("mut", at, Anchor::End, label, room);
            }
        }
    }
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
            color % PALETTE.len()
        })
        .collect()
}

/// Draws the new entries of the legend in lines above the panel, and returns their height.
pub(crate) fn legend(
    drawing: &mut Drawing,
    panel: &Panel,
    told: &[Entry<'_>],
    (left, top): (f64, f64),
    width: f64,
) -> f64 {
    let named: Vec<_> = panel
        .series
        .iter()
        .zip(colors(panel))
        .filter(|(series, color)| {
            !series.label.is_empty() && !told.contains(&entry(series, *color))
        })
        .collect();
    if named.is_empty() {
        return 0.0;
    }
    let (mut x, mut y) = (left, top);
    let mut line_px = HEAD_LINE_PX;
    for (series, color) in named {
        let (label, room) = (&series.label, width - 30.0);
        let wide = svg::text_width_px(label).min(room) + 42.0;
        if x > left && x + wide - 16.0 > left + width {
            x = left;
            y += line_px;
            line_px = HEAD_LINE_PX;
        }
        let middle = y + 9.0;
        match &series.kind {
            Kind::Line { .. } | Kind::Step { .. } => {
                let dash = if series.dashed { " dsh" } else { "" };
                drawing.line(
                    &format!("ln s{color}{dash}"),
                    (x, middle),
                    (x + 20.0, middle),
                );
            }
            Kind::Points { .. } => dot(drawing, color, (x + 10.0, middle), 3.2),
            Kind::Band { .. } => {
                drawing.rect(&format!("bnd f{color}"), (x, middle - 5.0), (20.0, 10.0));
            }
            Kind::Bars { .. } => {
                drawing.rect(
                    &format!("bar f{color}"),
                    (x + 4.0, middle - 5.0),
                    (12.0, 10.0),
                );
            }
        }
        let at = (x + 25.0, middle + 4.0);
        let high = drawing.lines_down("", at, Anchor::Start, label, room);
        line_px = line_px.max(HEAD_LINE_PX + high - LINE_PX);
        x += wide;
    }
    y - top + line_px
}
