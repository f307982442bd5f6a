//! Axes: scale, range, ticks and their labels.

/// The mapping of values to an axis.
#[derive(Debug, Clone, PartialEq)]
pub enum Scale {
    /// Equal differences, equal lengths.
    Linear,
    /// Equal ratios have equal lengths; values that are not positive are left out.
    Log,
    /// Named places at 0, 1, 2, ...
    Categories(Vec<String>),
}

/// One axis of a panel: its label, unit, scale and range.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    pub(crate) label: String,
    pub(crate) unit: String,
    pub(crate) scale: Scale,
    pub(crate) range: Option<(f64, f64)>,
}

/// Places of a curve on a logarithmic axis: `count` evenly in the logarithm.
pub fn log_grid(low: f64, high: f64, count: usize) -> Vec<f64> {
    (0..count)
        .map(|i| low * (high / low).powf(i as f64 / (count - 1) as f64))
        .collect()
}

impl Axis {
    /// A linear axis. `unit` is written in brackets after the label; empty for a number without unit.
    pub fn linear(label: &str, unit: &str) -> Self {
        Self::new(label, unit, Scale::Linear)
    }

    /// A logarithmic axis.
    pub fn log(label: &str, unit: &str) -> Self {
        Self::new(label, unit, Scale::Log)
    }

    /// An axis with named places at 0, 1, 2, ... (for bars).
    pub fn categories<S: AsRef<str>>(label: &str, names: &[S]) -> Self {
        let names = names.iter().map(|name| name.as_ref().to_owned()).collect();
        Self::new(label, "", Scale::Categories(names))
    }

    fn new(label: &str, unit: &str, scale: Scale) -> Self {
        Self {
            label: label.to_owned(),
            unit: unit.to_owned(),
            scale,
            range: None,
        }
    }

    /// Fixes the range; without it the range follows the data. A range that is empty, not finite, or not positive on
    /// a logarithmic axis is ignored.
    #[must_use]
    pub fn range(mut self, low: f64, high: f64) -> Self {
        let fits = low.is_finite()
            && high.is_finite()
            && low < high
            && (high - low).is_finite()
            && (self.scale != Scale::Log || low > 0.0);
        self.range = fits.then_some((low, high));
        self
    }

    /// Label and unit at the axis.
    pub(crate) fn title(&self) -> String {
        match (self.label.as_str(), self.unit.as_str()) {
            (label, "") => label.to_owned(),
            ("", unit) => unit.to_owned(),
            (label, unit) => format!("{label} ({unit})"),
        }
    }

    /// Whether a value has a place on this axis.
    pub(crate) fn places(&self, value: f64) -> bool {
        value.is_finite() && (self.scale != Scale::Log || value > 0.0)
    }
}

/// One tick: its value, and its label unless it is a minor tick.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Tick {
    pub(crate) value: f64,
    pub(crate) label: Option<String>,
}

/// An axis with its final range, laid over a length in pixels.
#[derive(Debug, Clone)]
pub(crate) struct Placed<'a> {
    pub(crate) axis: &'a Axis,
    pub(crate) low: f64,
    pub(crate) high: f64,
    pub(crate) length_px: f64,
}

impl<'a> Placed<'a> {
    /// `data` is the range of the data (None: no data); `pad` the share of the range left free on each side.
    pub(crate) fn new(
        axis: &'a Axis,
        data: Option<(f64, f64)>,
        pad: f64,
        length_px: f64,
    ) -> Placed<'a> {
        let (low, high) = match (&axis.scale, axis.range, data) {
            (_, Some(range), _) => range,
            (Scale::Categories(names), ..) => (-0.6, names.len().max(1) as f64 - 0.4),
            (Scale::Log, None, Some((low, high))) => {
                // Beyond these exponents the ends of the range would overflow.
                let (mut a, mut b) = (
                    low.log10().clamp(-250.0, 250.0),
                    high.log10().clamp(-250.0, 250.0),
                );
                if b - a < 1e-9 {
                    (a, b) = (a - 0.3, b + 0.3);
                }
                let room = (b - a) * pad;
                (10f64.powf(a - room), 10f64.powf(b + room))
            }
            (Scale::Log, None, None) => (0.1, 10.0),
            (Scale::Linear, None, Some((low, high))) => {
                let (mut a, mut b) = (low.clamp(-1e250, 1e250), high.clamp(-1e250, 1e250));
                let size = a.abs().max(b.abs());
                if b - a <= 1e-12 * size || b == a {
                    let half = if size == 0.0 { 0.5 } else { size * 0.1 };
                    (a, b) = (a - half, b + half);
                }
                let room = (b - a) * pad;
                (a - room, b + room)
            }
            (Scale::Linear, None, None) => (0.0, 1.0),
        };
        Placed {
            axis,
            low,
            high,
            length_px,
        }
    }

    /// Distance in pixels from the low end; None if the value has no place (not finite, not positive on a log axis).
    pub(crate) fn at(&self, value: f64) -> Option<f64> {
        if !self.axis.places(value) {
            return None;
        }
        let share = match self.axis.scale {
            Scale::Log => (value / self.low).ln() / (self.high / self.low).ln(),
            _ => (value - self.low) / (self.high - self.low),
        };
        // Far outside the panel the exact place does not show, but huge coordinates upset some viewers.
        Some((share * self.length_px).clamp(-2e4, 2e4))
    }

    /// Ticks about `spacing_px` apart.
    pub(crate) fn ticks(&self, spacing_px: f64) -> Vec<Tick> {
        let most = (self.length_px / spacing_px).max(2.0);
        match &self.axis.scale {
            Scale::Linear => self.linear_ticks(most),
            Scale::Log => self.log_ticks(most),
            Scale::Categories(names) => names
                .iter()
                .enumerate()
                .map(|(place, name)| Tick {
                    value: place as f64,
                    label: Some(name.clone()),
                })
                .collect(),
        }
    }

    fn linear_ticks(&self, most: f64) -> Vec<Tick> {
        let rough = (self.high - self.low) / most;
        let step = if self.axis.unit == "deg" && rough > 2.0 {
            [5.0, 15.0, 30.0, 45.0, 90.0, 180.0, 360.0]
                .into_iter()
                .find(|step| *step >= rough)
                .unwrap_or_else(|| 360.0 * (rough / 360.0).ceil())
        } else {
            nice_step(rough)
        };
        let first = (self.low / step - 1e-9).ceil();
        let count = ((self.high / step + 1e-9).floor() - first).max(0.0);
        if !first.is_finite() || !count.is_finite() || count > 200.0 {
            return Vec::new();
        }
        (0..=count as usize)
            .map(|index| {
                let value = (first + index as f64) * step;
                Tick {
                    value,
                    label: Some(format_tick(value, step)),
                }
            })
            .collect()
    }

    fn log_ticks(&self, most: f64) -> Vec<Tick> {
        let (low, high) = (self.low.log10(), self.high.log10());
        let decades = high - low;
        // The comparison is such that an invalid range gives no ticks.
        if !(0.0..700.0).contains(&decades) {
            return Vec::new();
        }
        if decades < 0.7 {
            return self.linear_ticks(most);
        }
        let stride = (decades / most).ceil().max(1.0) as i32;
        let mut ticks = Vec::new();
        for decade in (low.floor() as i32)..=(high.ceil() as i32) {
            for digit in 1..10u32 {
                let value = f64::from(digit) * 10f64.powi(decade);
                if value < self.low * (1.0 - 1e-9) || value > self.high * (1.0 + 1e-9) {
                    continue;
                }
                let named = match digit {
                    1 => decade.rem_euclid(stride) == 0,
                    2 | 5 => decades * 3.0 <= most,
                    _ => false,
                };
                if digit > 1 && stride > 1 {
                    continue;
                }
                ticks.push(Tick {
                    value,
                    label: named.then(|| format_log_tick(digit, decade)),
                });
            }
        }
        ticks
    }
}

/// The smallest of 1, 2, 2.5, 5 times a power of ten that is not below `rough`.
fn nice_step(rough: f64) -> f64 {
    if !(rough.is_finite() && rough > 0.0) {
        return 1.0;
    }
    let power = 10f64.powf(rough.log10().floor());
    for factor in [1.0, 2.0, 5.0] {
        if factor * power >= rough * (1.0 - 1e-9) {
            return factor * power;
        }
    }
    10.0 * power
}

/// A tick's value with as many decimals as its step needs.
fn format_tick(value: f64, step: f64) -> String {
    let value = if value.abs() < step * 1e-6 {
        0.0
    } else {
        value
    };
    let size = value.abs().max(step);
    if size >= 1e6 || step < 1e-5 {
        let text = format!("{value:.3e}");
        return match text.split_once('e') {
            Some((digits, exponent)) => {
                let digits = digits.trim_end_matches('0').trim_end_matches('.');
                minus(&format!("{digits}e{exponent}"))
            }
            None => minus(&text),
        };
    }
    let decimals = (-step.log10().floor()).clamp(0.0, 8.0) as usize;
    minus(&format!("{value:.decimals$}"))
}

fn format_log_tick(digit: u32, decade: i32) -> String {
    if (-3..=4).contains(&decade) {
        let value = f64::from(digit) * 10f64.powi(decade);
        let decimals = (-decade).max(0) as usize;
        format!("{value:.decimals$}")
    } else {
        minus(&format!("{digit}e{decade}"))
    }
}

/// A hyphen is too short for a minus sign.
fn minus(text: &str) -> String {
    text.replace('-', "\u{2212}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: &Axis, data: (f64, f64), length_px: f64) -> Vec<String> {
        Placed::new(axis, Some(data), 0.0, length_px)
            .ticks(60.0)
            .into_iter()
            .filter_map(|tick| tick.label)
            .collect()
    }

    #[test]
    fn linear_ticks_are_round_numbers_inside_the_range() {
        assert_eq!(
            labels(&Axis::linear("t", "s"), (0.0, 10.0), 360.0),
            ["0", "2", "4", "6", "8", "10"]
        );
        assert_eq!(
            labels(&Axis::linear("x", "um"), (-0.2, 0.2), 300.0),
            ["\u{2212}0.2", "\u{2212}0.1", "0.0", "0.1", "0.2"]
        );
    }

    #[test]
    fn phases_are_divided_by_parts_of_a_turn() {
        assert_eq!(
            labels(&Axis::linear("phase", "deg"), (-180.0, 0.0), 300.0),
            [
                "\u{2212}180",
                "\u{2212}135",
                "\u{2212}90",
                "\u{2212}45",
                "0"
            ]
        );
    }

    #[test]
    fn log_ticks_name_decades_and_leave_the_rest_minor() {
        let axis = Axis::log("frequency", "Hz");
        let placed = Placed::new(&axis, Some((1.0, 1000.0)), 0.0, 300.0);
        let ticks = placed.ticks(60.0);
        assert_eq!(ticks.len(), 28);
        let named: Vec<_> = ticks.iter().filter_map(|t| t.label.clone()).collect();
        assert_eq!(named, ["1", "10", "100", "1000"]);
        assert!((placed.at(10.0).unwrap() - 100.0).abs() < 1e-9);
        assert_eq!(placed.at(0.0), None);
        assert_eq!(placed.at(-1.0), None);
    }

    #[test]
    fn a_single_value_and_no_data_still_give_a_usable_range() {
        for axis in [Axis::linear("a", ""), Axis::log("a", "")] {
            for data in [None, Some((5.0, 5.0))] {
                let placed = Placed::new(&axis, data, 0.05, 100.0);
                assert!(placed.low < placed.high);
                assert!(!placed.ticks(30.0).is_empty());
            }
        }
    }

    #[test]
    fn a_useless_fixed_range_is_ignored() {
        assert_eq!(Axis::log("f", "Hz").range(0.0, 1.0).range, None);
        assert_eq!(Axis::linear("f", "Hz").range(2.0, 1.0).range, None);
        assert_eq!(Axis::linear("f", "Hz").range(f64::NAN, 1.0).range, None);
        assert_eq!(
            Axis::linear("f", "Hz").range(0.0, 1.0).range,
            Some((0.0, 1.0))
        );
    }
}
