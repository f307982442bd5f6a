//! The series of a panel: lines, steps, points, bands, bars.

/// How a series is drawn, with its data other than `x`.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    /// Straight lines between neighbours; a value that is not finite breaks the line.
    Line {
        /// Values, one per `x`.
        y: Vec<f64>,
    },
    /// Each value held until the next `x` (zero-order hold).
    Step {
        /// Values, one per `x`.
        y: Vec<f64>,
    },
    /// Marks without lines, with an optional interval each.
    Points {
        /// Values, one per `x`.
        y: Vec<f64>,
        /// Lower and upper ends of the intervals, one per `x`.
        interval: Option<(Vec<f64>, Vec<f64>)>,
    },
    /// The area between two curves.
    Band {
        /// Lower curve.
        low: Vec<f64>,
        /// Upper curve.
        high: Vec<f64>,
    },
    /// Bars from zero, centred on `x`.
    Bars {
        /// Heights, one per `x`.
        y: Vec<f64>,
        /// Width of a bar in units of `x`.
        width: f64,
    },
}

/// One series of a panel.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    pub(crate) label: String,
    pub(crate) x: Vec<f64>,
    pub(crate) kind: Kind,
    pub(crate) color: Option<usize>,
    pub(crate) dashed: bool,
    pub(crate) thin: bool,
}

impl Series {
    fn new(label: &str, x: &[f64], kind: Kind) -> Self {
        Self {
            label: label.to_owned(),
            x: x.to_vec(),
            kind,
            color: None,
            dashed: false,
            thin: false,
        }
    }

    /// Straight lines between neighbours. Surplus values of the longer slice are not drawn.
    pub fn line(label: &str, x: &[f64], y: &[f64]) -> Self {
        Self::new(label, x, Kind::Line { y: y.to_vec() })
    }

    /// Each value held until the next `x`: how a command is held between ticks.
    pub fn step(label: &str, x: &[f64], y: &[f64]) -> Self {
        Self::new(label, x, Kind::Step { y: y.to_vec() })
    }

    /// Marks without lines.
    pub fn points(label: &str, x: &[f64], y: &[f64]) -> Self {
        Self::new(
            label,
            x,
            Kind::Points {
                y: y.to_vec(),
                interval: None,
            },
        )
    }

    /// Marks with an interval each, from `low` to `high`.
    pub fn intervals(label: &str, x: &[f64], y: &[f64], low: &[f64], high: &[f64]) -> Self {
        Self::new(
            label,
            x,
            Kind::Points {
                y: y.to_vec(),
                interval: Some((low.to_vec(), high.to_vec())),
            },
        )
    }

    /// The area between two curves, such as a confidence band.
    pub fn band(label: &str, x: &[f64], low: &[f64], high: &[f64]) -> Self {
        Self::new(
            label,
            x,
            Kind::Band {
                low: low.to_vec(),
                high: high.to_vec(),
            },
        )
    }

    /// Bars from zero, centred on `x`, `width` wide in units of `x`.
    pub fn bars(label: &str, x: &[f64], y: &[f64], width: f64) -> Self {
        Self::new(
            label,
            x,
            Kind::Bars {
                y: y.to_vec(),
                width: if width.is_finite() { width.abs() } else { 0.8 },
            },
        )
    }

    /// Counts of `values` in `bins` equal bins between their minimum and maximum; values that are not finite are left
    /// out.
    pub fn histogram(label: &str, values: &[f64], bins: usize) -> Self {
        let finite = || values.iter().copied().filter(|value| value.is_finite());
        let (low, high) = finite().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
            (low.min(v), high.max(v))
        });
        let bins = bins.max(1);
        if low > high {
            return Self::bars(label, &[], &[], 1.0);
        }
        let width = if high > low {
            (high - low) / bins as f64
        } else {
            1.0
        };
        let mut counts = vec![0.0; bins];
        for value in finite() {
            let bin = (((value - low) / width) as usize).min(bins - 1);
            if let Some(count) = counts.get_mut(bin) {
                *count += 1.0;
            }
        }
        let centres: Vec<f64> = (0..bins)
            .map(|bin| low + (bin as f64 + 0.5) * width)
            .collect();
        Self::bars(label, &centres, &counts, width)
    }

    /// Uses the colour with this number of the palette instead of the next free one. So a band and its line, or the
    /// same quantity in two panels, have one colour.
    #[must_use]
    pub fn color(mut self, number: usize) -> Self {
        self.color = Some(number);
        self
    }

    /// Draws the line dashed.
    #[must_use]
    pub fn dashed(mut self) -> Self {
        self.dashed = true;
        self
    }

    /// Draws the line thin: for traces that are mostly noise.
    #[must_use]
    pub fn thin(mut self) -> Self {
        self.thin = true;
        self
    }

    /// Number of points that have all their values.
    pub fn len(&self) -> usize {
        let shortest = match &self.kind {
            Kind::Line { y } | Kind::Step { y } | Kind::Bars { y, .. } => y.len(),
            Kind::Points { y, interval } => interval.as_ref().map_or(y.len(), |(low, high)| {
                y.len().min(low.len()).min(high.len())
            }),
            Kind::Band { low, high } => low.len().min(high.len()),
        };
        self.x.len().min(shortest)
    }

    /// Whether there is nothing to draw.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Value or values at a point: `(y, low, high)`, each if the kind has it.
    pub(crate) fn values(&self, index: usize) -> (Option<f64>, Option<f64>, Option<f64>) {
        let get = |values: &[f64]| values.get(index).copied();
        match &self.kind {
            Kind::Line { y } | Kind::Step { y } | Kind::Bars { y, .. } => (get(y), None, None),
            Kind::Points { y, interval } => match interval {
                Some((low, high)) => (get(y), get(low), get(high)),
                None => (get(y), None, None),
            },
            Kind::Band { low, high } => (None, get(low), get(high)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_histogram_counts_every_finite_value_once() {
        let values = [0.0, 0.1, 0.1, f64::NAN, 0.9, 1.0];
        let series = Series::histogram("error", &values, 10);
        let Kind::Bars { y, width } = &series.kind else {
            panic!("bars expected");
        };
        assert_eq!(y.iter().sum::<f64>(), 5.0);
        assert_eq!(y[9], 2.0);
        assert!((width - 0.1).abs() < 1e-12);
        assert!(Series::histogram("none", &[f64::NAN], 5).is_empty());
    }

    #[test]
    fn slices_of_unequal_length_are_cut_to_the_shortest() {
        assert_eq!(Series::line("a", &[1.0, 2.0, 3.0], &[1.0]).len(), 1);
        assert_eq!(Series::band("a", &[1.0], &[1.0, 2.0], &[]).len(), 0);
    }
}
