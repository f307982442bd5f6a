//! Figures: panels of series, a heat map or pictures, with a name and a caption.

use crate::axis::Axis;
use crate::mosaic::Mosaic;
use crate::series::Series;

/// A marker line across a panel.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Marker {
    pub(crate) value: f64,
    pub(crate) label: String,
    pub(crate) vertical: bool,
}

/// One plot: two axes and the series between them.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    pub(crate) title: String,
    pub(crate) x: Axis,
    pub(crate) y: Axis,
    pub(crate) series: Vec<Series>,
    pub(crate) markers: Vec<Marker>,
    pub(crate) equal: bool,
    pub(crate) height_px: f64,
}

impl Panel {
    /// An empty panel.
    pub fn new(x: Axis, y: Axis) -> Self {
        Self {
            title: String::new(),
            x,
            y,
            series: Vec::new(),
            markers: Vec::new(),
            equal: false,
            height_px: 240.0,
        }
    }

    /// A line of text above the panel.
    #[must_use]
    pub fn title(mut self, title: &str) -> Self {
        title.clone_into(&mut self.title);
        self
    }

    /// Adds a series. Series are drawn in the order added; bands go below everything else.
    #[must_use]
    pub fn series(mut self, series: Series) -> Self {
        self.series.push(series);
        self
    }

    /// Adds a vertical marker line at `x` with a label (may be empty). The range grows to hold it.
    #[must_use]
    pub fn vertical(mut self, x: f64, label: &str) -> Self {
        self.markers.push(Marker {
            value: x,
            label: label.to_owned(),
            vertical: true,
        });
        self
    }

    /// Adds a horizontal marker line at `y` with a label (may be empty). The range grows to hold it.
    #[must_use]
    pub fn horizontal(mut self, y: f64, label: &str) -> Self {
        self.markers.push(Marker {
            value: y,
            label: label.to_owned(),
            vertical: false,
        });
        self
    }

    /// Gives both (linear) axes the same scale, for plots in a plane.
    #[must_use]
    pub fn equal_axes(mut self) -> Self {
        self.equal = true;
        self.height_px = self.height_px.max(420.0);
        self
    }

    /// Height of the plotting area, 60 to 1200 px.
    #[must_use]
    pub fn height_px(mut self, height_px: f64) -> Self {
        if height_px.is_finite() {
            self.height_px = height_px.clamp(60.0, 1200.0);
        }
        self
    }
}

/// A table of numbers shown as colours, such as a map of where a model fails.
#[derive(Debug, Clone, PartialEq)]
pub struct HeatMap {
    pub(crate) rows: Vec<String>,
    pub(crate) columns: Vec<String>,
    pub(crate) values: Vec<f64>,
    pub(crate) label: String,
}

impl HeatMap {
    /// `rows.len() * columns.len()` `values`, row by row; missing values and NaN stay blank. `label` names
    /// the quantity and its unit. Values of both signs are coloured from blue over white to orange, about zero; values
    /// of one sign from pale to dark.
    pub fn new<R: AsRef<str>, C: AsRef<str>>(
        label: &str,
        rows: &[R],
        columns: &[C],
        values: &[f64],
    ) -> Self {
        Self {
            rows: rows.iter().map(|name| name.as_ref().to_owned()).collect(),
            columns: columns
                .iter()
                .map(|name| name.as_ref().to_owned())
                .collect(),
            values: values.to_vec(),
            label: label.to_owned(),
        }
    }

    /// Value of a cell, if there is one.
    pub(crate) fn value(&self, row: usize, column: usize) -> Option<f64> {
        self.values
            .get(row * self.columns.len() + column)
            .copied()
            .filter(|value| value.is_finite())
    }
}

/// What a figure shows.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Content {
    Panels(Vec<Panel>),
    HeatMap(HeatMap),
    Mosaic(Mosaic),
}

/// A figure: a name (for its files), a caption, and panels, a heat map or pictures.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    pub(crate) name: String,
    pub(crate) caption: String,
    pub(crate) content: Content,
    pub(crate) columns: usize,
    pub(crate) share_x: bool,
}

impl Figure {
    /// An empty figure. `name` becomes the file name of its SVG and CSV (letters, digits, `-` and `_` are kept);
    /// `caption` is shown below it.
    pub fn new(name: &str, caption: &str) -> Self {
        Self {
            name: slug(name),
            caption: caption.to_owned(),
            content: Content::Panels(Vec::new()),
            columns: 1,
            share_x: false,
        }
    }

    /// A heat map.
    pub fn heat_map(name: &str, caption: &str, map: HeatMap) -> Self {
        Self {
            content: Content::HeatMap(map),
            ..Self::new(name, caption)
        }
    }

    /// Pictures in rows and columns.
    pub fn mosaic(name: &str, caption: &str, mosaic: Mosaic) -> Self {
        Self {
            content: Content::Mosaic(mosaic),
            ..Self::new(name, caption)
        }
    }

    /// An empty Bode plot: magnitude in dB above phase in degrees on one logarithmic axis in Hz. Add curves with
    /// [`Figure::bode_series`].
    pub fn bode(name: &str, caption: &str) -> Self {
        let frequency = || Axis::log("frequency", "Hz");
        Self::new(name, caption)
            .panel(Panel::new(frequency(), Axis::linear("gain", "dB")))
            .panel(Panel::new(frequency(), Axis::linear("phase", "deg")).height_px(180.0))
            .share_x()
    }

    /// Adds a series to the magnitude panel and one to the phase panel of a Bode plot, in the same colour.
    #[must_use]
    pub fn bode_series(mut self, magnitude: Series, phase: Series) -> Self {
        if let Content::Panels(panels) = &mut self.content
            && let [upper, lower, ..] = panels.as_mut_slice()
        {
            let color = magnitude.color.unwrap_or(upper.series.len());
            upper.series.push(magnitude.color(color));
            let color = phase.color.unwrap_or(color);
            lower.series.push(phase.color(color));
        }
        self
    }

    /// Adds a marker line at a frequency to both panels of a Bode plot; the label is in the upper one.
    #[must_use]
    pub fn bode_frequency(mut self, frequency_hz: f64, label: &str) -> Self {
        if let Content::Panels(panels) = &mut self.content {
            for (index, panel) in panels.iter_mut().enumerate() {
                panel.markers.push(Marker {
                    value: frequency_hz,
                    label: if index == 0 {
                        label.to_owned()
                    } else {
                        String::new()
                    },
                    vertical: true,
                });
            }
        }
        self
    }

    /// An empty Nyquist plot (real and imaginary part, equal axes) with the point -1 marked by two lines.
    pub fn nyquist(name: &str, caption: &str) -> Self {
        Self::new(name, caption).panel(
            Panel::new(
                Axis::linear("real part", ""),
                Axis::linear("imaginary part", ""),
            )
            .equal_axes()
            .series(Series::points("\u{2212}1", &[-1.0], &[0.0]).color(7)),
        )
    }

    /// Adds a panel below the others or, with [`Figure::columns`], next to them. On a heat map this has no effect.
    #[must_use]
    pub fn panel(mut self, panel: Panel) -> Self {
        if let Content::Panels(panels) = &mut self.content {
            panels.push(panel);
        }
        self
    }

    /// Adds a series to the last panel.
    #[must_use]
    pub fn series(mut self, series: Series) -> Self {
        if let Content::Panels(panels) = &mut self.content
            && let Some(panel) = panels.last_mut()
        {
            panel.series.push(series);
        }
        self
    }

    /// Gives the figure another caption.
    #[must_use]
    pub fn caption(mut self, caption: &str) -> Self {
        caption.clone_into(&mut self.caption);
        self
    }

    /// Lays the panels out in this many columns (1 to 6).
    #[must_use]
    pub fn columns(mut self, columns: usize) -> Self {
        self.columns = columns.clamp(1, 6);
        self
    }

    /// All panels get one common range of x.
    #[must_use]
    pub fn share_x(mut self) -> Self {
        self.share_x = true;
        self
    }

    /// Name of the figure, as used for its files.
    pub fn name(&self) -> &str {
        &self.name
    }
}

/// A name that is safe as a file name on every system.
pub(crate) fn slug(name: &str) -> String {
    let mut slug = String::new();
    for c in name.chars().take(80) {
        if c.is_ascii_alphanumeric() || c == '_' {
            slug.push(c.to_ascii_lowercase());
        } else if !slug.ends_with('-') {
            slug.push('-');
        }
    }
    let slug = slug.trim_matches('-');
    if slug.is_empty() {
        "figure".to_owned()
    } else {
        slug.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_safe_file_names() {
        assert_eq!(slug("Fig. 7: Bode (raw)"), "fig-7-bode-raw");
        assert_eq!(slug("../../etc/passwd"), "etc-passwd");
        assert_eq!(slug("µ"), "figure");
    }
}
