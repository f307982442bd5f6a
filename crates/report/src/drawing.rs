//! The elements of a figure, before it becomes SVG or PDF.

use crate::picture::base64;
use crate::svg::{LINE_PX, lines, px, set};
use crate::tile::Tile;
use std::fmt::Write;

/// The anchor of a text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Anchor {
    Start,
    Middle,
    End,
}

/// How the points of a path are joined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Join {
    Open,
    Closed,
    /// Each point is a stroke of no length with round ends: a tenth of the bytes of circles.
    Specks,
}

/// One element; lengths in px from the upper left corner, `class` as in the style sheet.
#[derive(Debug, Clone)]
pub(crate) enum Shape {
    Path {
        class: String,
        points: Vec<(f64, f64)>,
        join: Join,
    },
    Rect {
        class: String,
        at: (f64, f64),
        size: (f64, f64),
    },
    /// A rectangle with a given colour.
    Filled {
        rgb: (u8, u8, u8),
        at: (f64, f64),
        size: (f64, f64),
    },
    Circle {
        class: String,
        at: (f64, f64),
        radius: f64,
    },
    Text {
        class: String,
        at: (f64, f64),
        anchor: Anchor,
        /// Reads upwards.
        upright: bool,
        text: String,
    },
    /// A grey picture.
    Picture {
        at: (f64, f64),
        size: (f64, f64),
        tile: Tile,
    },
    /// All shapes up to [`Shape::Leave`] are measured from here and clipped to this size.
    Enter {
        at: (f64, f64),
        size: (f64, f64),
    },
    Leave,
}

/// Elements in the order in which they are drawn.
#[derive(Debug, Default)]
pub(crate) struct Drawing {
    pub(crate) shapes: Vec<Shape>,
}

impl Drawing {
    pub(crate) fn line(&mut self, class: &str, from: (f64, f64), to: (f64, f64)) {
        self.path(class, vec![from, to], Join::Open);
    }

    pub(crate) fn path(&mut self, class: &str, points: Vec<(f64, f64)>, join: Join) {
        let class = class.to_owned();
        self.shapes.push(Shape::Path {
            class,
            points,
            join,
        });
    }

    pub(crate) fn rect(&mut self, class: &str, at: (f64, f64), (wide, high): (f64, f64)) {
        self.shapes.push(Shape::Rect {
            class: class.to_owned(),
            at,
            size: (wide.max(0.0), high.max(0.0)),
        });
    }

    pub(crate) fn text(&mut self, class: &str, at: (f64, f64), anchor: Anchor, text: &str) {
        if !text.is_empty() {
            self.shapes.push(Shape::Text {
                class: class.to_owned(),
                at,
                anchor,
                upright: false,
                text: text.to_owned(),
            });
        }
    }

    /// A text in lines of at most a width, the last of them at `at`; returns their height.
    pub(crate) fn lines_up(
        &mut self,
        class: &str,
        (x, y): (f64, f64),
        anchor: Anchor,
        text: &str,
        width_px: f64,
    ) -> f64 {
        let height = LINE_PX * lines(text, width_px).len() as f64;
        self.lines_down(class, (x, y + LINE_PX - height), anchor, text, width_px)
    }

    /// A text in lines of at most a width, the first of them at `at`; returns their height.
    pub(crate) fn lines_down(
        &mut self,
        class: &str,
        (x, y): (f64, f64),
        anchor: Anchor,
        text: &str,
        width_px: f64,
    ) -> f64 {
        let lines = lines(text, width_px);
        for (n, line) in lines.iter().enumerate() {
            self.text(class, (x, y + LINE_PX * n as f64), anchor, line);
        }
        LINE_PX * lines.len() as f64
    }

    /// A text that reads upwards.
    pub(crate) fn upright(&mut self, class: &str, at: (f64, f64), anchor: Anchor, text: &str) {
        self.shapes.push(Shape::Text {
            class: class.to_owned(),
            at,
            anchor,
            upright: true,
            text: text.to_owned(),
        });
    }

    /// The elements as SVG.
    pub(crate) fn to_svg(&self) -> String {
        let mut out = String::new();
        self.shapes.iter().for_each(|shape| shape.svg(&mut out));
        out
    }
}

impl Shape {
    // Writing to a String cannot fail.
    fn svg(&self, out: &mut String) {
        match self {
            Shape::Path {
                class,
                points,
                join,
            } => path(out, class, points, *join),
            Shape::Rect { class, at, size } => {
                let _ = write!(out, "<rect class=\"{class}\"{}/>", placed(*at, *size));
            }
            Shape::Filled {
                rgb: (r, g, b),
                at,
                size,
            } => {
                let fill = format!("#{r:02x}{g:02x}{b:02x}");
                let _ = write!(out, "<rect fill=\"{fill}\"{}/>", placed(*at, *size));
            }
            Shape::Circle { class, at, radius } => {
                let (x, y, r) = (px(at.0), px(at.1), px(*radius));
                let _ = write!(
                    out,
                    "<circle class=\"{class}\" cx=\"{x}\" cy=\"{y}\" r=\"{r}\"/>"
                );
            }
            Shape::Text {
                class,
                at,
                anchor,
                upright,
                text,
            } => {
                let (x, y) = (px(at.0), px(at.1));
                let anchor = match anchor {
                    Anchor::Start => "start",
                    Anchor::Middle => "middle",
                    Anchor::End => "end",
                };
                let turned = if *upright {
                    format!(" transform=\"rotate(-90 {x} {y})\"")
                } else {
                    String::new()
                };
                let _ = write!(
                    out,
                    "<text class=\"{class}\" x=\"{x}\" y=\"{y}\" text-anchor=\"{anchor}\"{turned}>{}</text>",
                    set(text)
                );
            }
            Shape::Picture { at, size, tile } => {
                let _ = write!(
                    out,
                    "<image{} style=\"image-rendering:pixelated\" href=\"data:image/png;base64,{}\"/>",
                    placed(*at, *size),
                    base64(&tile.png)
                );
            }
            // A nested svg clips its content without an identifier, which would have to be unique in a page.
            Shape::Enter { at, size } => {
                let (w, h) = (px(size.0), px(size.1));
                let _ = write!(out, "<svg{} viewBox=\"0 0 {w} {h}\">", placed(*at, *size));
            }
            Shape::Leave => out.push_str("</svg>"),
        }
    }
}

fn placed(at: (f64, f64), size: (f64, f64)) -> String {
    format!(
        " x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\"",
        px(at.0),
        px(at.1),
        px(size.0),
        px(size.1)
    )
}

fn path(out: &mut String, class: &str, points: &[(f64, f64)], join: Join) {
    let _ = write!(out, "<path class=\"{class}\" d=\"");
    for (index, (x, y)) in points.iter().enumerate() {
        let (x, y) = (px(*x), px(*y));
        let _ = match (join, index) {
            (Join::Specks, _) => write!(out, "M{x} {y}h0"),
            (_, 0) => write!(out, "M{x} {y}"),
            _ => write!(out, "L{x} {y}"),
        };
    }
    if join == Join::Closed {
        out.push('Z');
    }
    out.push_str("\"/>");
}
