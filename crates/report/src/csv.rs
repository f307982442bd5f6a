//! The data of a figure as CSV.

use crate::figure::{Content, Figure};
use cellpos_table::csv_field;
use std::fmt::Write;

impl Figure {
    /// The data of the figure, undecimated, one line per point: `panel,series,x,x_axis,y,low,high,y_axis` with label
    /// and unit of the axes in `x_axis` and `y_axis`. A heat map and a mosaic have their rows as series and their
    /// columns as x; the y of a mosaic is the quantity of its label.
    pub fn to_csv(&self) -> String {
        figure(self)
    }
}

fn field(text: &str) -> String {
    csv_field(text).into_owned()
}

/// A number that reads back to the same bits; empty if missing.
fn number(value: Option<f64>) -> String {
    match value {
        Some(value) if value.is_finite() => format!("{value}"),
        _ => String::new(),
    }
}

pub(crate) fn figure(figure: &Figure) -> String {
    let mut out = String::from("panel,series,x,x_axis,y,low,high,y_axis\n");
    // Writing to a String cannot fail.
    match &figure.content {
        Content::Panels(panels) => {
            for (index, panel) in panels.iter().enumerate() {
                let name = if panel.title.is_empty() {
                    (index + 1).to_string()
                } else {
                    panel.title.clone()
                };
                let (x_axis, y_axis) = (field(&panel.x.title()), field(&panel.y.title()));
                for series in &panel.series {
                    let head = format!("{},{}", field(&name), field(&series.label));
                    for (point, x) in series.x.iter().take(series.len()).enumerate() {
                        let (y, low, high) = series.values(point);
                        let _ = writeln!(
                            out,
                            "{head},{},{x_axis},{},{},{},{y_axis}",
                            number(Some(*x)),
                            number(y),
                            number(low),
                            number(high)
                        );
                    }
                }
            }
        }
        Content::Mosaic(mosaic) => {
            let label = field(&mosaic.label);
            for (row, row_name) in mosaic.rows.iter().enumerate() {
                for (column, column_name) in mosaic.columns.iter().enumerate() {
                    let value = mosaic.tile(row, column).map(|tile| tile.value);
                    let (row_name, column_name) = (field(row_name), field(column_name));
                    let value = number(value);
                    let _ = writeln!(out, "1,{row_name},{column_name},,{value},,,{label}");
                }
            }
        }
        Content::HeatMap(map) => {
            for (row, row_name) in map.rows.iter().enumerate() {
                for (column, column_name) in map.columns.iter().enumerate() {
                    let _ = writeln!(
                        out,
                        "1,{},{},,{},,,{}",
                        field(row_name),
                        field(column_name),
                        number(map.value(row, column)),
                        field(&map.label)
                    );
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use crate::{Axis, Figure, HeatMap, Panel, Series};

    #[test]
    fn figure_data_reads_back_to_the_bit_and_names_the_units() {
        let figure = Figure::new("a", "").panel(
            Panel::new(
                Axis::linear("time", "s"),
                Axis::linear("bead, measured", "um"),
            )
            .series(Series::line(
                "say \"x\"",
                &[0.1, 0.2],
                &[1.0 / 3.0, f64::NAN],
            ))
            .series(Series::band("b", &[1.0], &[2.0], &[3.0])),
        );
        let csv = figure.to_csv();
        let lines: Vec<_> = csv.lines().collect();
        assert_eq!(
            lines[1],
            "1,\"say \"\"x\"\"\",0.1,time (s),0.3333333333333333,,,\"bead, measured (um)\""
        );
        assert_eq!(
            lines[2],
            "1,\"say \"\"x\"\"\",0.2,time (s),,,,\"bead, measured (um)\""
        );
        assert_eq!(lines[3], "1,b,1,time (s),,2,3,\"bead, measured (um)\"");
    }

    #[test]
    fn a_heat_map_writes_one_line_per_cell() {
        let map = HeatMap::new("z", &["r1", "r2"], &["c1"], &[1.0, f64::NAN]);
        let csv = Figure::heat_map("m", "", map).to_csv();
        assert_eq!(csv.lines().count(), 3);
        assert!(csv.ends_with("1,r2,c1,,,,,z\n"));
    }
}
