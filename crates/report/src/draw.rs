//! Figures to SVG.

use crate::drawing::Drawing;
use crate::figure::{Content, Figure, Panel};
use crate::heat::heat_map;
use crate::mosaic::mosaic;
use crate::panel::{
    Entry, Frame, LEFT_PX, RIGHT_PX, data_range, draw_panel, entries, head_px, left_px, legend,
};
use crate::svg::{self, SLIM_PX, STYLE, WIDTH_PX, px};
use std::fmt::Write;

impl Figure {
    /// The figure as a self-contained SVG document (no script, no external font).
    pub fn to_svg(&self) -> String {
        figure(self, true, WIDTH_PX)
    }
}

/// The figure in a page: as wide as the screen. For narrow screens there is a second copy with the panels below each other and
/// letters of the same size. A heat map keeps its rows of numbers and scrolls sideways.
pub(crate) fn in_page(shown: &Figure) -> String {
    let wide = figure(shown, false, WIDTH_PX);
    match &shown.content {
        Content::HeatMap(_) => format!("<div class=\"scroll\">{wide}</div>\n"),
        Content::Panels(_) | Content::Mosaic(_) => format!(
            "<div class=\"wide\">{wide}</div>\n<div class=\"slim\">{}</div>\n",
            figure(shown, false, SLIM_PX)
        ),
    }
}

/// The figure as SVG, of a width in px; `alone` adds the style sheet and the background that a page gives to inline figures.
pub(crate) fn figure(figure: &Figure, alone: bool, width_px: f64) -> String {
    let (body, height_px) = drawn(figure, width_px);
    let (w, h) = (px(width_px), px(height_px));
    let mut out = String::new();
    let _ = write!(
        out,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"fg\" viewBox=\"0 0 {w} {h}\" width=\"{w}\" height=\"{h}\" role=\"img\"><title>{}</title>",
        svg::set(&figure.caption)
    );
    if alone {
        let _ = write!(
            out,
            "<style>{STYLE}</style><rect class=\"bg\" width=\"{w}\" height=\"{h}\"/>"
        );
    }
    out.push_str(&body.to_svg());
    out.push_str("</svg>\n");
    out
}

/// The elements of a figure of a width in px, and its height.
pub(crate) fn drawn(figure: &Figure, width_px: f64) -> (Drawing, f64) {
    let mut drawing = Drawing::default();
    let height_px = match &figure.content {
        Content::Panels(panels) => panels_grid(&mut drawing, figure, panels, width_px),
        Content::HeatMap(map) => heat_map(&mut drawing, map),
        Content::Mosaic(pictures) => mosaic(&mut drawing, pictures, width_px),
    };
    (drawing, height_px)
}

/// Draws the panels and returns the height of all.
fn panels_grid(drawing: &mut Drawing, figure: &Figure, panels: &[Panel], width_px: f64) -> f64 {
    let shared = figure.share_x.then(|| {
        panels
            .iter()
            .filter_map(|panel| data_range(panel, true))
            .reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    });
    let columns = if width_px < WIDTH_PX {
        1
    } else {
        figure.columns.min(panels.len().max(1))
    };
    let width = width_px / columns as f64;
    let left = panels.iter().map(left_px).fold(LEFT_PX, f64::max);
    let mut top = 4.0;
    // Do not repeat the legend of a colour.
    let mut told: Vec<Entry<'_>> = Vec::new();
    if let Some((first, others)) = panels.split_first()
        && columns > 1
        && others.iter().all(|panel| entries(panel) == entries(first))
    {
        let room = width_px - left - RIGHT_PX;
        top += legend(drawing, first, &told, (left, top), room);
        told = entries(first);
    }
    for (row_index, row) in panels.chunks(columns).enumerate() {
        let last_row = (row_index + 1) * columns >= panels.len();
        let mut tallest: f64 = 0.0;
        let inner = width - left - RIGHT_PX;
        let mut of_row = told.clone();
        let mut head = 0.0_f64;
        for panel in row {
            head = head.max(head_px(panel, &of_row, inner));
            of_row.extend(entries(panel));
        }
        for (column, panel) in row.iter().enumerate() {
            let frame = Frame {
                left: column as f64 * width + left,
                left_px: left,
                top,
                width: inner,
                head_px: head,
                x_range: shared.unwrap_or_else(|| data_range(panel, true)),
                show_x: !(figure.share_x && columns == 1) || last_row,
                told: &told,
            };
            tallest = tallest.max(draw_panel(drawing, panel, &frame));
            told.extend(entries(panel));
        }
        top += tallest;
    }
    top + 2.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::Axis;
    use crate::figure::HeatMap;
    use crate::series::Series;
    use crate::svg::text_width_px;

    fn attribute<'t>(tag: &'t str, name: &str) -> Option<&'t str> {
        let from = tag.split(&format!(" {name}=\"")).nth(1)?;
        from.split('"').next()
    }

    fn number(tag: &str, name: &str) -> f64 {
        attribute(tag, name).and_then(|n| n.parse().ok()).unwrap()
    }

    /// The horizontal texts of a drawing that extend beyond it, or beyond the panel that clips them.
    fn clipped(svg: &str) -> Vec<String> {
        let mut open: Vec<(f64, f64, f64)> = Vec::new();
        let mut found = Vec::new();
        for piece in svg.split('<').skip(1) {
            let (tag, text) = piece.split_once('>').unwrap();
            if tag.starts_with("svg ") {
                let (w, h) = (number(tag, "width"), number(tag, "height"));
                open.push((w, h, 0.0));
            } else if tag.starts_with("/svg") {
                open.pop();
            } else if tag.starts_with("text ") {
                let (w, h, _) = *open.last().unwrap();
                let (x, y) = (number(tag, "x"), number(tag, "y"));
                let wide = text_width_px(text);
                let (low, high, long) = match attribute(tag, "text-anchor") {
                    Some("end") if tag.contains("rotate") => (y, y + wide, h),
                    _ if tag.contains("rotate") => (y - wide / 2.0, y + wide / 2.0, h),
                    Some("start") => (x, x + wide, w),
                    Some("end") => (x - wide, x, w),
                    _ => (x - wide / 2.0, x + wide / 2.0, w),
                };
                if low < -0.5 || high > long + 0.5 || y > h || y < 8.0 {
                    found.push(format!("{text}: {low} to {high} of {long}, {y} of {h}"));
                }
            }
        }
        found
    }

    fn long_words() -> Figure {
        let x: Vec<f64> = (0..50).map(|k| 20_000.0 * f64::from(k)).collect();
        let y: Vec<f64> = x.iter().map(|x| -1e-5 * (x * 1e-4).sin()).collect();
        let panel = |name: &str| {
            Panel::new(
                Axis::linear("time since the cycle began", "s"),
                Axis::linear("length at the start of the cycle", "um"),
            )
            .title("A title that is longer than a narrow screen is wide, about what is below it")
            .series(Series::line(
                "means of ten cycles with their 95 % intervals",
                &x,
                &y,
            ))
            .series(Series::points(name, &x, &y))
            .vertical(
                980_000.0,
                "a marker with a label that is far too long for a narrow panel",
            )
            .horizontal(
                0.0,
                "upper limit of the displacement that the board may command",
            )
        };
        Figure::new("long", "c")
            .panel(panel("the cyclic arm"))
            .panel(panel("the static arm beside it"))
            .columns(2)
    }

    /// The letters of a drawing's texts, whatever lines they are in.
    fn letters(svg: &str) -> String {
        let texts = svg.split("<text ").skip(1);
        let texts = texts.filter_map(|tag| tag.split_once('>')?.1.split('<').next());
        texts.flat_map(str::chars).filter(|c| *c != ' ').collect()
    }

    fn assert_whole(svg: &str, labels: &[&str]) {
        for label in labels {
            let all = letters(svg);
            assert!(
                all.contains(&svg::set(label).replace(' ', "")),
                "{label} in {all}"
            );
        }
        assert!(!svg.contains('\u{2026}'));
    }

    /// Bars over names: as many lines as they need, or turned.
    #[test]
    fn no_name_at_an_axis_is_shortened() {
        let bands = ["0\u{2013}1", "80\u{2013}160", "500\u{2013}1600"].repeat(3);
        let runs = ["20261122T143420Z-a-run-with-a-name"; 30];
        let few = [
            "the model as it was before",
            "the same with a delay",
            "floor",
        ];
        for names in [&bands[..], &runs[..], &few[..]] {
            let at: Vec<f64> = (0..names.len()).map(|n| n as f64).collect();
            let axis = Axis::categories("frequency band (Hz) of all the records together", names);
            let panel = Panel::new(axis, Axis::linear("error", "nm RMS"))
                .series(Series::bars("before", &at, &at, 0.4));
            for width_px in [WIDTH_PX, SLIM_PX] {
                let svg = figure(&Figure::new("f", "c").panel(panel.clone()), false, width_px);
                assert_whole(&svg, names);
                assert_eq!(clipped(&svg), Vec::<String>::new(), "{width_px} px");
            }
        }
    }

    #[test]
    fn no_label_is_cut_off_wide_or_narrow_whatever_its_length() {
        for width_px in [WIDTH_PX, SLIM_PX] {
            let svg = figure(&long_words(), false, width_px);
            assert_eq!(clipped(&svg), Vec::<String>::new(), "{width_px} px");
            let labels = [
                "A title that is longer than a narrow screen is wide, about what is below it",
                "a marker with a label that is far too long for a narrow panel",
                "upper limit of the displacement that the board may command",
                "length at the start of the cycle (um)",
                "means of ten cycles with their 95 % intervals",
            ];
            assert_whole(&svg, &labels);
        }
        let names = ["20261122T143420Z-a-run-with-a-long-name-that-goes-on", "b"];
        let map = HeatMap::new(
            "excess, standard deviations",
            &names,
            &["0-1", "160-500"],
            &[1.0, -1000.0, 3.0, 4.0],
        );
        let svg = figure(&Figure::heat_map("map", "c", map), false, WIDTH_PX);
        assert_eq!(clipped(&svg), Vec::<String>::new());
        assert_whole(&svg, &names);
    }

    #[test]
    fn on_a_narrow_screen_letters_have_ten_pixels_and_nothing_is_lost() {
        // A screen of 400 px leaves a figure 360: 20 px of margin on each side.
        let shown = 360.0 / SLIM_PX * 12.0;
        assert!(STYLE.contains("font-size:12px") && shown >= 10.0, "{shown}");
        let page = in_page(&long_words());
        let (wide, slim) = page.split_once("<div class=\"slim\">").unwrap();
        for class in ["class=\"dot", "class=\"ln"] {
            assert!(wide.contains(class) && slim.contains(class), "{class}");
        }
        assert!(slim.contains(&format!("viewBox=\"0 0 {SLIM_PX} ")));
    }

    #[test]
    fn long_numbers_at_an_axis_leave_its_title_free() {
        let (x, y) = ([0.0, 1.0], [20.000_01, 20.000_31]);
        let panel = Panel::new(Axis::linear("time", "s"), Axis::linear("PZT", "um"))
            .series(Series::line("command", &x, &y));
        let svg = figure(&Figure::new("f", "c").panel(panel), false, WIDTH_PX);
        let title = svg
            .split("<text")
            .find(|tag| tag.contains("rotate"))
            .unwrap();
        let at = title.split("rotate(-90 ").nth(1).unwrap();
        let at: f64 = at.split([' ', ',']).next().unwrap().parse().unwrap();
        for tag in svg.split("<text").filter(|tag| tag.contains(">20.000")) {
            let label = tag.split(['>', '<']).nth(1).unwrap();
            let from = number(tag, "x") - text_width_px(label);
            assert!(from > at + 6.0, "{label} begins at {from}, title at {at}");
        }
    }

    #[test]
    fn a_point_is_named_although_a_line_of_its_name_is() {
        let panel = || Panel::new(Axis::linear("x", ""), Axis::linear("y", ""));
        let (x, y) = ([1.0, 2.0], [2.0, 3.0]);
        let shown = Figure::new("f", "c")
            .panel(panel().series(Series::line("measured", &x, &y).color(0)))
            .panel(panel().series(Series::points("measured", &x, &y).color(0)));
        let svg = figure(&shown, false, WIDTH_PX);
        assert_eq!(svg.matches(">measured<").count(), 2);
    }

    #[test]
    fn a_legend_says_each_name_once() {
        let series = |name: &str, color| Series::points(name, &[1.0], &[2.0]).color(color);
        let panel = || Panel::new(Axis::linear("x", ""), Axis::linear("y", ""));
        let shown = Figure::new("f", "c")
            .panel(panel().series(series("cyclic", 0)))
            .panel(
                panel()
                    .series(series("cyclic", 0))
                    .series(series("static", 1)),
            )
            .panel(panel().series(series("cyclic", 0)));
        for columns in [1, 3] {
            let svg = figure(&shown.clone().columns(columns), false, WIDTH_PX);
            if columns == 1 {
                assert_eq!(svg.matches(">cyclic<").count(), 1);
                assert_eq!(svg.matches(">static<").count(), 1);
            }
        }
        let beside = Figure::new("f", "c")
            .panel(panel().series(series("PZT", 0)))
            .panel(panel().series(series("PZT", 0)))
            .columns(2);
        let svg = figure(&beside, false, WIDTH_PX);
        assert_eq!(svg.matches(">PZT<").count(), 1);
    }

    #[test]
    fn an_axis_is_no_longer_than_its_points() {
        let points = Series::points("", &[20.0, 80.0], &[1.0, f64::NAN]);
        let panel = Panel::new(Axis::log("f", "Hz"), Axis::linear("g", "dB")).series(points);
        assert_eq!(data_range(&panel, true), Some((20.0, 20.0)));
    }
}
