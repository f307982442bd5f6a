//! Pictures side by side in rows and columns, with a scale bar.

use crate::drawing::{Anchor, Drawing, Shape};
use crate::svg::{self, LINE_PX, px};
use crate::tile::Tile;

/// Pictures in rows and columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Mosaic {
    pub(crate) label: String,
    pub(crate) rows: Vec<String>,
    pub(crate) columns: Vec<String>,
    pub(crate) tiles: Vec<Option<Tile>>,
    pub(crate) pixel_um: Option<f64>,
}

impl Mosaic {
    /// `rows.len() * columns.len()` `tiles`, row by row; a missing one stays blank. `label` names the quantity and the unit of
    /// [`Tile::value`].
    pub fn new(label: &str, rows: &[String], columns: &[String], tiles: Vec<Option<Tile>>) -> Self {
        Self {
            label: label.to_owned(),
            rows: rows.to_vec(),
            columns: columns.to_vec(),
            tiles,
            pixel_um: None,
        }
    }

    /// Adds a scale bar for pixels of this size, um.
    #[must_use]
    pub fn scale(mut self, pixel_um: f64) -> Self {
        self.pixel_um = (pixel_um.is_finite() && pixel_um > 0.0).then_some(pixel_um);
        self
    }

    pub(crate) fn tile(&self, row: usize, column: usize) -> Option<&Tile> {
        self.tiles.get(row * self.columns.len() + column)?.as_ref()
    }
}

/// Room between two pictures, px.
const GAP: f64 = 3.0;
/// Largest size of a picture's pixel, px.
const LARGEST_PIXEL: f64 = 3.0;

/// Draws the pictures with their names and the scale bar, and returns the height.
pub(crate) fn mosaic(drawing: &mut Drawing, mosaic: &Mosaic, width_px: f64) -> f64 {
    let widest = (mosaic.rows.iter().map(|name| svg::text_width_px(name))).fold(20.0, f64::max);
    let left = (widest + 12.0).min(width_px / 3.0);
    let size = |of: fn(&Tile) -> u32| {
        let sizes = mosaic.tiles.iter().flatten().map(of);
        f64::from(sizes.max().unwrap_or(1))
    };
    let (wide, high) = (size(|tile| tile.width), size(|tile| tile.height));
    let count = mosaic.columns.len().max(1) as f64;
    let pixel_px = (((width_px - left) / count - GAP) / wide).min(LARGEST_PIXEL);
    let (wide, high) = (wide * pixel_px, high * pixel_px);
    let across = |column: usize| left + column as f64 * (wide + GAP);
    let most = (mosaic.columns.iter())
        .map(|name| svg::lines(name, wide).len())
        .max()
        .unwrap_or(1);
    let top = 9.0 + LINE_PX * most as f64;
    for (column, name) in mosaic.columns.iter().enumerate() {
        let middle = across(column) + wide / 2.0;
        drawing.lines_up("", (middle, top - 8.0), Anchor::Middle, name, wide);
    }
    for (row, name) in mosaic.rows.iter().enumerate() {
        let y = top + row as f64 * (high + GAP);
        let tall = LINE_PX * svg::lines(name, left - 10.0).len() as f64;
        let at = (left - 8.0, y + (high - tall) / 2.0 + 11.5);
        drawing.lines_down("", at, Anchor::End, name, left - 10.0);
        for column in 0..mosaic.columns.len() {
            let at = (across(column), y);
            match mosaic.tile(row, column) {
                Some(tile) => drawing.shapes.push(Shape::Picture {
                    at,
                    size: (
                        f64::from(tile.width) * pixel_px,
                        f64::from(tile.height) * pixel_px,
                    ),
                    tile: tile.clone(),
                }),
                None => drawing.rect("nil", at, (wide, high)),
            }
        }
    }
    let bottom = top + mosaic.rows.len() as f64 * (high + GAP);
    let Some(pixel_um) = mosaic.pixel_um else {
        return bottom + 2.0;
    };
    let um = round_length(0.5 * wide / pixel_px * pixel_um);
    let long = um / pixel_um * pixel_px;
    drawing.rect("scl", (left, bottom + 9.0), (long, 3.0));
    let at = (left + long + 8.0, bottom + 15.0);
    drawing.text("", at, Anchor::Start, &format!("{} um", px(um)));
    bottom + 22.0
}

/// The largest of 1, 2, 5, 10, ... (and their tenths, ...) that is no longer than this.
fn round_length(most: f64) -> f64 {
    let decade = 10f64.powf(most.log10().floor());
    let step = [5.0, 2.0].into_iter().find(|step| step * decade <= most);
    step.unwrap_or(1.0) * decade
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Figure;

    fn figure() -> Figure {
        let tile = |value| Tile {
            width: 20,
            height: 4,
            pixels: (0..80).collect(),
            png: vec![1, 2, 3],
            value,
        };
        let names = |names: &[&str]| {
            names
                .iter()
                .map(|name| (*name).to_owned())
                .collect::<Vec<_>>()
        };
        let tiles = vec![Some(tile(0.5)), None, Some(tile(1.5)), Some(tile(2.5))];
        let mosaic = Mosaic::new(
            "time (s)",
            &names(&["0", "0.5"]),
            &names(&["cycle 1", "cycle 9"]),
            tiles,
        );
        Figure::mosaic("montage", "c", mosaic.scale(0.2))
    }

    #[test]
    fn every_picture_is_in_svg_pdf_and_csv_and_the_bar_has_its_length() {
        let svg = figure().to_svg();
        assert_eq!(svg.matches("<image ").count(), 3);
        assert!(svg.contains("data:image/png;base64,AQID") && svg.contains(">cycle 9<"));
        // 20 px of 0.2 um, drawn three times as large: of half of its width, 2 um, the bar takes 2 um, 30 px.
        assert!(
            svg.contains("class=\"scl\"") && svg.contains("width=\"30\" height=\"3\""),
            "{svg}"
        );
        assert!(svg.contains(">2 \u{b5}m<"));
        let pdf = String::from_utf8(figure().to_pdf()).unwrap();
        assert_eq!(pdf.matches("BI /W 20 /H 4 ").count(), 3);
        assert!(pdf.contains("000102") && pdf.contains("4E4F>"));
        let csv = figure().to_csv();
        assert!(csv.contains("1,0.5,cycle 1,,1.5,,,time (s)\n"), "{csv}");
    }

    #[test]
    fn a_bar_is_of_a_round_length() {
        for (most, long) in [(9.9, 5.0), (4.9, 2.0), (1.5, 1.0), (10.0, 10.0), (0.3, 0.2)] {
            assert!((round_length(most) - long).abs() < 1e-9, "{most}");
        }
    }
}
