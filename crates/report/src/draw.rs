//! Figures to SVG.

use crate::figure::{Content, Figure, Panel};
use crate::heat::heat_map;
use crate::panel::{Frame, LEFT_PX, RIGHT_PX, data_range, draw_panel, entries};
use crate::svg::{self, STYLE, Svg, WIDTH_PX, px};
use std::fmt::Write;

impl Figure {
    /// The figure as an SVG document that stands alone (no script, no external font).
    pub fn to_svg(&self) -> String {
        figure(self, true)
    }
}

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
