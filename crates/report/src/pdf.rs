//! Figures to PDF: one page of the figure's size, with vector graphics and the fonts that every PDF reader has (Helvetica, Symbol).

use crate::draw::drawn;
use crate::drawing::{Anchor, Drawing, Join, Shape};
use crate::figure::Figure;
use crate::svg::{PALETTE, WIDTH_PX, px};
use crate::typeset::typeset;
use std::fmt::Write;

/// A PDF has 72 points to the inch, a style sheet 96 px.
const POINTS_PER_PX: f64 = 0.75;
/// Size of the letters, px: as in the style sheet.
const LETTER_PX: f64 = 12.0;
/// Length of the two parts of a circle's quarter as a cubic curve: 4/3 (sqrt(2) - 1).
const CURVE: f64 = 0.552_284_75;

impl Figure {
    /// The figure as a PDF document of one page. Its letters are those of the reader's Helvetica and Symbol, not embedded; a sign
    /// that neither has becomes a question mark.
    pub fn to_pdf(&self) -> Vec<u8> {
        let (drawing, height_px) = drawn(self, WIDTH_PX);
        let size = (WIDTH_PX * POINTS_PER_PX, height_px * POINTS_PER_PX);
        document(&self.caption, size, &content(&drawing, height_px))
    }
}

/// The objects of the document, with the table of their places.
fn document(caption: &str, (wide, high): (f64, f64), content: &str) -> Vec<u8> {
    let font = |name: &str, encoding: &str| {
        format!("<</Type/Font/Subtype/Type1/BaseFont/{name}{encoding}>>")
    };
    let latin = "/Encoding/WinAnsiEncoding";
    // UTF-16, the only encoding of a document's title that has all signs.
    let title: String = (typeset(caption).encode_utf16())
        .map(|unit| format!("{unit:04X}"))
        .collect();
    let objects = [
        "<</Type/Catalog/Pages 2 0 R>>".to_owned(),
        "<</Type/Pages/Kids[3 0 R]/Count 1>>".to_owned(),
        format!(
            "<</Type/Page/Parent 2 0 R/MediaBox[0 0 {} {}]/Contents 4 0 R/Resources<</Font<</F0 5 0 R/F1 6 0 R/F2 7 0 R>>\
             /ExtGState<</A2<</ca .2>>/A25<</ca .25>>/A7<</ca .75>>/A10<</ca 1>>>>>>>>",
            px(wide),
            px(high)
        ),
        format!(
            "<</Length {}>>stream\n{content}\nendstream",
            content.len() + 1
        ),
        font("Helvetica", latin),
        font("Helvetica-Bold", latin),
        font("Symbol", ""),
        format!("<</Title<FEFF{title}>/Producer(cellpos)>>"),
    ];
    let mut out = "%PDF-1.4\n".to_owned();
    let mut places = Vec::new();
    for (number, object) in (1..).zip(&objects) {
        places.push(out.len());
        let _ = writeln!(out, "{number} 0 obj{object}endobj");
    }
    let (count, table) = (objects.len() + 1, out.len());
    let _ = write!(out, "xref\n0 {count}\n0000000000 65535 f \n");
    for place in places {
        let _ = writeln!(out, "{place:010} 00000 n ");
    }
    let info = objects.len();
    let _ = write!(
        out,
        "trailer<</Size {count}/Root 1 0 R/Info {info} 0 R>>\nstartxref\n{table}\n%%EOF\n"
    );
    out.into_bytes()
}

/// The drawing, in px downwards as the shapes have it: the first line turns and scales the page.
fn content(drawing: &Drawing, height_px: f64) -> String {
    let mut out = format!(
        "{POINTS_PER_PX} 0 0 -{POINTS_PER_PX} 0 {} cm 1 J 1 j\n",
        px(height_px * POINTS_PER_PX)
    );
    for shape in &drawing.shapes {
        draw(&mut out, shape);
    }
    out
}

fn draw(out: &mut String, shape: &Shape) {
    // Writing to a String cannot fail.
    match shape {
        Shape::Path {
            class,
            points,
            join,
        } => {
            let ink = Ink::of(class);
            ink.set(out, *join == Join::Closed);
            for (index, (x, y)) in points.iter().enumerate() {
                let (x, y) = (px(*x), px(*y));
                let _ = match (join, index) {
                    (Join::Specks, _) => write!(out, "{x} {y} m {x} {y} l "),
                    (_, 0) => write!(out, "{x} {y} m "),
                    _ => write!(out, "{x} {y} l "),
                };
            }
            out.push_str(if *join == Join::Closed { "f\n" } else { "S\n" });
        }
        Shape::Rect { class, at, size } => {
            let stroked = class == "frm";
            Ink::of(class).set(out, !stroked);
            rect(out, *at, *size);
            out.push_str(if stroked { "S\n" } else { "f\n" });
        }
        Shape::Filled {
            rgb: (r, g, b),
            at,
            size,
        } => {
            let rgb = u32::from(*r) << 16 | u32::from(*g) << 8 | u32::from(*b);
            let _ = write!(out, "/A10 gs {} rg ", color(rgb));
            rect(out, *at, *size);
            out.push_str("f\n");
        }
        Shape::Circle { class, at, radius } => {
            Ink::of(class).set(out, true);
            circle(out, *at, *radius);
        }
        Shape::Text {
            class,
            at,
            anchor,
            upright,
            text,
        } => letters(out, class, *at, (*anchor, *upright), &typeset(text)),
        Shape::Picture { at, size, tile } => {
            let [x, low, w, h] = [at.0, at.1 + size.1, size.0, size.1].map(px);
            let grey: String = tile.pixels.iter().map(|v| format!("{v:02X}")).collect();
            // The unit square of a picture has its lower left corner at the origin, and the page is upside down.
            let _ = write!(
                out,
                "q {w} 0 0 -{h} {x} {low} cm BI /W {} /H {} /CS /G /BPC 8 /F /AHx ID {grey}>\nEI Q\n",
                tile.width, tile.height
            );
        }
        Shape::Enter { at, size } => {
            let _ = write!(out, "q 1 0 0 1 {} {} cm ", px(at.0), px(at.1));
            rect(out, (0.0, 0.0), *size);
            out.push_str("W n\n");
        }
        Shape::Leave => out.push_str("Q\n"),
    }
}

fn rect(out: &mut String, at: (f64, f64), size: (f64, f64)) {
    let [x, y, w, h] = [at.0, at.1, size.0, size.1].map(px);
    let _ = write!(out, "{x} {y} {w} {h} re ");
}

fn circle(out: &mut String, (x, y): (f64, f64), r: f64) {
    let c = CURVE * r;
    let _ = write!(out, "{} {} m ", px(x + r), px(y));
    for [x1, y1, x2, y2, x3, y3] in [
        [x + r, y + c, x + c, y + r, x, y + r],
        [x - c, y + r, x - r, y + c, x - r, y],
        [x - r, y - c, x - c, y - r, x, y - r],
        [x + c, y - r, x + r, y - c, x + r, y],
    ] {
        let numbers = [x1, y1, x2, y2, x3, y3].map(px);
        let _ = write!(out, "{} c ", numbers.join(" "));
    }
    out.push_str("f\n");
}

/// Colour and stroke of a class, as the style sheet has them on paper.
struct Ink {
    rgb: u32,
    width: &'static str,
    dash: &'static str,
    /// Name of the opacity in the page's resources.
    opacity: &'static str,
}

impl Ink {
    fn of(class: &str) -> Self {
        let mut ink = Self {
            rgb: 0x2b_2f36,
            width: "1",
            dash: "[]",
            opacity: "/A10",
        };
        for word in class.split(' ') {
            match word {
                "ln" => ink.width = "1.6",
                "thn" => ink.width = ".8",
                "spk" => ink.width = "2.4",
                "dsh" => ink.dash = "[6 4]",
                "bnd" => ink.opacity = "/A2",
                "bar" => ink.opacity = "/A7",
                "nil" => (ink.rgb, ink.opacity) = (0x8a_929c, "/A25"),
                "frm" => ink.rgb = 0x9a_a3ae,
                "grd" => ink.rgb = 0xe3_e7ec,
                "grm" => ink.rgb = 0xf1_f3f6,
                "mrk" => (ink.rgb, ink.dash) = (0x5c_6470, "[2 3]"),
                "mut" => ink.rgb = 0x5c_6470,
                "cell" => ink.rgb = 0x1b_1e23,
                "scl" => ink.rgb = 0x2b_2f36,
                "cellw" => ink.rgb = 0xff_ffff,
                _ => {
                    let number = word.strip_prefix(['s', 'f']).and_then(|n| n.parse().ok());
                    if let Some(rgb) = number.and_then(|n: usize| PALETTE.get(n)) {
                        ink.rgb = *rgb;
                    }
                }
            }
        }
        ink
    }

    fn set(&self, out: &mut String, filled: bool) {
        let _ = match filled {
            true => write!(out, "{} gs {} rg ", self.opacity, color(self.rgb)),
            false => write!(
                out,
                "{} RG {} w {} 0 d ",
                color(self.rgb),
                self.width,
                self.dash
            ),
        };
    }
}

fn color(rgb: u32) -> String {
    let part = |shift: u32| format!("{:.3}", f64::from(rgb >> shift & 0xff) / 255.0);
    [part(16), part(8), part(0)].join(" ")
}

/// A line of text; parts in Symbol and in Helvetica follow each other.
fn letters(
    out: &mut String,
    class: &str,
    (x, y): (f64, f64),
    (anchor, upright): (Anchor, bool),
    text: &str,
) {
    let signs: Vec<Sign> = text.chars().map(Sign::of).collect();
    let wide = signs.iter().map(|sign| f64::from(sign.width)).sum::<f64>() * LETTER_PX * 1e-3;
    let back = match anchor {
        Anchor::Start => 0.0,
        Anchor::Middle => wide / 2.0,
        Anchor::End => wide,
    };
    Ink::of(class).set(out, true);
    // The page is upside down for shapes: letters are turned back.
    let _ = match upright {
        false => write!(out, "BT 1 0 0 -1 {} {} Tm", px(x - back), px(y)),
        true => write!(out, "BT 0 -1 -1 0 {} {} Tm", px(x), px(y + back)),
    };
    let plain = if class == "ttl" { "/F1" } else { "/F0" };
    for part in signs.chunk_by(|a, b| a.symbol == b.symbol) {
        let symbol = part.first().is_some_and(|sign| sign.symbol);
        let font = if symbol { "/F2" } else { plain };
        let codes: String = part
            .iter()
            .map(|sign| format!("{:02X}", sign.code))
            .collect();
        let _ = write!(out, " {font} {LETTER_PX} Tf <{codes}> Tj");
    }
    out.push_str(" ET\n");
}

/// A sign: its code and width (1/1000 of the letters' size) in Helvetica or in Symbol.
struct Sign {
    symbol: bool,
    code: u8,
    width: u16,
}

/// Widths of Helvetica from the space to the tilde (Adobe's font metrics).
const WIDTHS: [u16; 95] = [
    278, 278, 355, 556, 556, 889, 667, 191, 333, 333, 389, 584, 278, 333, 278, 278, 556, 556, 556,
    556, 556, 556, 556, 556, 556, 556, 278, 278, 584, 584, 584, 556, 1015, 667, 667, 722, 722, 667,
    611, 778, 722, 278, 500, 667, 556, 833, 722, 778, 667, 778, 722, 667, 611, 722, 667, 944, 667,
    667, 611, 278, 278, 278, 469, 556, 333, 556, 556, 500, 556, 556, 278, 556, 556, 222, 222, 500,
    222, 833, 556, 556, 556, 556, 333, 500, 278, 556, 500, 722, 500, 500, 500, 334, 260, 334, 584,
];

impl Sign {
    fn of(sign: char) -> Self {
        let latin = |code: u8, width: u16| Self {
            symbol: false,
            code,
            width,
        };
        let symbol = |code: u8, width: u16| Self {
            symbol: true,
            code,
            width,
        };
        match sign {
            ' '..='~' => latin(sign as u8, WIDTHS[sign as usize - 0x20]),
            '\u{a0}' => latin(0x20, 278),
            '\u{b0}' => latin(0xb0, 400),
            '\u{b1}' | '\u{d7}' | '\u{f7}' => latin(sign as u8, 584),
            '\u{b2}' | '\u{b3}' | '\u{b9}' => latin(sign as u8, 333),
            '\u{b7}' => latin(0xb7, 278),
            // Other letters of Latin-1 are as wide as most are.
            '\u{a1}'..='\u{ff}' => latin(sign as u8, 556),
            '\u{2013}' => latin(0x96, 556),
            '\u{2014}' => latin(0x97, 1000),
            '\u{2018}' | '\u{2019}' => latin(0x92, 222),
            '\u{2026}' => latin(0x85, 1000),
            '\u{2212}' => symbol(0x2d, 549),
            '\u{221a}' => symbol(0xd6, 549),
            '\u{2264}' => symbol(0xa3, 549),
            '\u{2265}' => symbol(0xb3, 549),
            '\u{2192}' => symbol(0xae, 987),
            '\u{3b1}' => symbol(0x61, 631),
            '\u{3ba}' => symbol(0x6b, 549),
            '\u{3bc}' => latin(0xb5, 556),
            '\u{3c0}' => symbol(0x70, 549),
            '\u{3c3}' => symbol(0x73, 603),
            '\u{3c4}' => symbol(0x74, 439),
            '\u{3c9}' => symbol(0x77, 686),
            _ => latin(b'?', 556),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axis::Axis;
    use crate::figure::Panel;
    use crate::series::Series;
    use crate::svg::STYLE;

    #[test]
    fn paper_has_the_colours_of_the_style_sheet() {
        for (number, rgb) in PALETTE.iter().enumerate() {
            for (class, property) in [("s", "stroke"), ("f", "fill")] {
                let rule = format!(".fg .{class}{number}{{{property}:#{rgb:06x}}}");
                assert!(STYLE.contains(&rule), "{rule}");
            }
        }
        for (class, rule) in [
            ("frm", "fill:none;stroke:#"),
            ("grd", "stroke:#"),
            ("grm", "stroke:#"),
            ("mrk", "stroke:#"),
            ("mut", "fill:#"),
        ] {
            let rule = format!(".fg .{class}{{{rule}{:06x}", Ink::of(class).rgb);
            assert!(STYLE.contains(&rule), "{rule}");
        }
    }

    /// Every object is at its place in the table, and every figure's data and words are in the page.
    #[test]
    fn a_document_finds_its_objects_and_has_what_the_figure_has() {
        let x: Vec<f64> = (0..200).map(f64::from).collect();
        let figure = Figure::new("f", "Length in um.").panel(
            Panel::new(Axis::linear("time", "s"), Axis::linear("length", "um"))
                .title("Title")
                .series(Series::line("median", &x, &x).dashed())
                .series(Series::band("all", &x, &x, &x))
                .series(Series::points("each", &[3.0], &[-4.0]))
                .horizontal(2.0, "at \u{3c0}\u{2212}1"),
        );
        let text = String::from_utf8(figure.to_pdf()).unwrap();
        let table: usize = (text.split("startxref\n").nth(1).unwrap().lines().next())
            .and_then(|line| line.parse().ok())
            .unwrap();
        assert!(text[table..].starts_with("xref\n0 9\n"));
        for (number, line) in (1..).zip(text[table..].lines().skip(3).take(8)) {
            let place: usize = line[..10].parse().unwrap();
            assert!(
                text[place..].starts_with(&format!("{number} 0 obj")),
                "{line}"
            );
        }
        let hex = |text: &str| -> String {
            text.chars()
                .map(|sign| format!("{:02X}", Sign::of(sign).code))
                .collect()
        };
        for word in ["median", "all", "each", "length (\u{b5}m)", "Title"] {
            assert!(text.contains(&hex(word)), "{word}");
        }
        let mixed = "/F2 12 Tf <702D> Tj /F0 12 Tf <31> Tj";
        assert!(text.contains(mixed), "pi and a minus sign, then a digit");
        assert!(text.contains("/A2 gs 0.835 0.369 0.000 rg"), "the band");
        assert!(text.contains("[6 4] 0 d"));
        let stream = text.split("stream\n").nth(1).unwrap();
        let wanted = format!("<</Length {}>>stream", stream.find("endstream").unwrap());
        assert!(text.contains(&wanted), "{wanted}");
        assert_eq!(
            text.matches(" W n").count() + text.matches("W n\n").count(),
            2
        );
    }
}
