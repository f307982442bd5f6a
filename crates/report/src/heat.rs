//! Heat maps.

use crate::drawing::{Anchor, Drawing, Shape};
use crate::figure::HeatMap;
use crate::svg::{self, LINE_PX, WIDTH_PX};

/// Draws a heat map with its colour bar and returns the height.
pub(crate) fn heat_map(drawing: &mut Drawing, map: &HeatMap) -> f64 {
    let widest = map
        .rows
        .iter()
        .map(|name| svg::text_width_px(name))
        .fold(40.0, f64::max);
    let left = (widest + 16.0).min(WIDTH_PX / 3.0);
    let count = map.columns.len().max(1) as f64;
    let cell_w = ((WIDTH_PX - left - 90.0) / count).min(110.0);
    let most = |names: &[String], room: f64| {
        let lines = names.iter().map(|name| svg::lines(name, room).len());
        lines.max().unwrap_or(1) as f64 * LINE_PX
    };
    let cell_h = most(&map.rows, left - 10.0) + 11.0;
    let top = most(&map.columns, cell_w - 2.0) + 15.0;
    let (low, high) = heat_range(map);
    for (column, name) in map.columns.iter().enumerate() {
        let x = left + (column as f64 + 0.5) * cell_w;
        drawing.lines_up("", (x, top - 9.0), Anchor::Middle, name, cell_w - 2.0);
    }
    for (row, name) in map.rows.iter().enumerate() {
        let y = top + row as f64 * cell_h;
        let high = LINE_PX * svg::lines(name, left - 10.0).len() as f64;
        let at = (left - 8.0, y + (cell_h - high) / 2.0 + 11.5);
        drawing.lines_down("", at, Anchor::End, name, left - 10.0);
        for column in 0..map.columns.len() {
            let x = left + column as f64 * cell_w;
            let Some(value) = map.value(row, column) else {
                drawing.rect("nil", (x + 0.5, y + 0.5), (cell_w - 1.0, cell_h - 1.0));
                continue;
            };
            let (fill, dark) = heat_color(value, low, high);
            drawing.shapes.push(Shape::Filled {
                rgb: fill,
                at: (x + 0.5, y + 0.5),
                size: (cell_w - 1.0, cell_h - 1.0),
            });
            let text = number(value);
            if svg::text_width_px(&text) < cell_w {
                let class = if dark { "cellw" } else { "cell" };
                let at = (x + cell_w / 2.0, y + cell_h / 2.0 + 4.0);
                drawing.text(class, at, Anchor::Middle, &text);
            }
        }
    }
    let bottom = top + map.rows.len() as f64 * cell_h;
    let bar_y = bottom + 14.0;
    let bar_w = (cell_w * count).min(300.0);
    for index in 0..60 {
        let share = f64::from(index) / 59.0;
        let (fill, _) = heat_color(low + share * (high - low), low, high);
        let x = left + f64::from(index) * bar_w / 60.0;
        drawing.shapes.push(Shape::Filled {
            rgb: fill,
            at: (x, bar_y),
            size: (bar_w / 60.0 + 0.3, 10.0),
        });
    }
    drawing.text("mut", (left, bar_y + 24.0), Anchor::Start, &number(low));
    drawing.text(
        "mut",
        (left + bar_w, bar_y + 24.0),
        Anchor::End,
        &number(high),
    );
    let at = (left + bar_w + 12.0, bar_y + 10.0);
    let room = WIDTH_PX - left - bar_w - 16.0;
    let high = drawing.lines_down("", at, Anchor::Start, &map.label, room);
    bar_y + high.max(30.0) + 4.0
}

fn number(value: f64) -> String {
    format!("{value:.1}").replace('-', "\u{2212}")
}

/// Ends of the colours: symmetric about zero when the values have both signs.
fn heat_range(map: &HeatMap) -> (f64, f64) {
    let finite = map.values.iter().copied().filter(|value| value.is_finite());
    let (low, high) = finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    });
    if low > high {
        (0.0, 1.0)
    } else if low < 0.0 {
        let size = low.abs().max(high.abs());
        (-size, size)
    } else if high > 0.0 {
        (0.0, high)
    } else {
        (0.0, 1.0)
    }
}

/// Colour of a value, and whether text on it should be white.
fn heat_color(value: f64, low: f64, high: f64) -> ((u8, u8, u8), bool) {
    const PALE: [f64; 3] = [247.0, 247.0, 244.0];
    const WARM: [f64; 3] = [179.0, 74.0, 0.0];
    const COLD: [f64; 3] = [0.0, 88.0, 148.0];
    let (end, share) = if low < 0.0 && value < 0.0 {
        (COLD, value / low)
    } else if low < 0.0 {
        (WARM, if high > 0.0 { value / high } else { 0.0 })
    } else {
        (WARM, (value - low) / (high - low))
    };
    let share = share.clamp(0.0, 1.0);
    let mix = |index: usize| (PALE[index] + (end[index] - PALE[index]) * share).round() as u8;
    ((mix(0), mix(1), mix(2)), share > 0.6)
}
