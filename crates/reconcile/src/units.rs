//! Units of the records and of the results, and their factor within a search.
//!
//! A search has bounds, smallest sizes and steps in micrometres, the size of this rig's motion. Records of another plant may be in
//! any unit. They are brought to that size first, with every number of the model, and the results are given in the records' units.
//! So a record times a thousand is the same record.

use crate::data::record::{Record, command_range_um};
use crate::error::ReconcileError;
use cellpos_plant::effects::{EffectKind, Place};
use cellpos_plant::{Effect, Model, Noise};

/// Names of the units of command and position, as results tell them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Units {
    /// Of the command.
    pub input: String,
    /// Of the position.
    pub output: String,
}

impl Default for Units {
    fn default() -> Self {
        Self {
            input: "um".to_owned(),
            output: "um".to_owned(),
        }
    }
}

/// Range of the commands of other data within a search \[um\]: about that of this rig's.
const INPUT_RANGE_UM: f64 = 8.0;

/// Range of the positions of other data within a search \[um\].
const OUTPUT_RANGE_UM: f64 = 30.0;

/// Part of the positions at either end that does not count for their range: a few rows may be far out.
const FAR_OUT: f64 = 0.01;

/// A figure with three digits, whatever unit it is in.
pub fn figure(x: f64) -> String {
    figure_of(x, 3)
}

/// A figure with this number of digits, in any unit.
pub fn figure_of(x: f64, digits: i32) -> String {
    if x == 0.0 || !x.is_finite() {
        return format!("{x}");
    }
    let behind = (digits - 1 - x.abs().log10().floor() as i32).clamp(0, 12) as usize;
    if x.abs() < 1e-9 {
        format!("{x:.*e}", digits.max(1) as usize - 1)
    } else {
        format!("{x:.behind$}")
    }
}

/// The factor of one unit of the records within a search, and its name.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Scales {
    names: Units,
    /// um per unit of the command.
    input: f64,
    /// um per unit of the position.
    output: f64,
}

/// The signal that a length belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Side {
    Input,
    Output,
}

/// The signal in whose unit the lengths of a kind of effect are.
pub(crate) fn side_of(kind: &dyn EffectKind) -> Side {
    let spec = kind.spec();
    match spec.place {
        Place::Driver | Place::Pzt => Side::Input,
        _ if spec.ahead_of_plant => Side::Input,
        _ => Side::Output,
    }
}

/// Power of the micrometre in a unit of the catalogue (`um/s`, `1/um^2`).
fn power_of(unit: &str) -> i32 {
    let (above, below) = unit.split_once('/').unwrap_or((unit, ""));
    let power = |part: &str| match part.strip_prefix("um") {
        Some("") => 1,
        Some(rest) => (rest.strip_prefix('^')).map_or(0, |n| n.parse().unwrap_or(0)),
        None => 0,
    };
    power(above) - power(below)
}

/// A product of powers of units in words: `V/degC^3`, `s^2/um`, `1`.
fn product(powers: &[(&str, i32)]) -> String {
    let mut all: Vec<(&str, i32)> = Vec::new();
    for &(name, power) in powers {
        match all.iter_mut().find(|(known, _)| *known == name) {
            Some((_, sum)) => *sum += power,
            None => all.push((name, power)),
        }
    }
    let side = |sign: i32| -> Vec<String> {
        let of_side = all.iter().filter(|(_, power)| power * sign > 0);
        of_side
            .map(|(name, power)| {
                let plain = !name.contains([' ', '/', '*']);
                let name = match plain {
                    true => (*name).to_owned(),
                    false => format!("({name})"),
                };
                match power.abs() {
                    1 => name,
                    power => format!("{name}^{power}"),
                }
            })
            .collect()
    };
    let (above, below) = (side(1).join(" "), side(-1));
    let above = match above.is_empty() {
        true => "1".to_owned(),
        false => above,
    };
    match below.as_slice() {
        [] => above,
        [one] => format!("{above}/{one}"),
        many => format!("{above}/({})", many.join(" ")),
    }
}

impl Scales {
    /// Of this rig's records: micrometres as they are.
    #[cfg(test)]
    pub(crate) fn none() -> Self {
        Self {
            names: Units::default(),
            input: 1.0,
            output: 1.0,
        }
    }

    /// Of records of this rig (`foreign` is false) none but their names; else such that command and position have the size
    /// of this rig's.
    pub(crate) fn of(records: &[Record], names: &Units, foreign: bool) -> Self {
        let mut scales = Self {
            names: names.clone(),
            input: 1.0,
            output: 1.0,
        };
        if foreign {
            let per = |size: f64, range: f64| match size.is_normal() && range.is_normal() {
                true => size / range,
                false => 1.0,
            };
            scales.input = per(INPUT_RANGE_UM, command_range_um(records));
            scales.output = per(OUTPUT_RANGE_UM, position_range(records));
        }
        scales
    }

    /// um per unit of command and of position.
    pub(crate) fn per_unit(&self) -> [f64; 2] {
        [self.input, self.output]
    }

    /// Whether the records have other units than this rig's.
    pub(crate) fn is_of_records(&self) -> bool {
        self.per_unit() != [1.0, 1.0]
    }

    /// Those units in words.
    pub(crate) fn words(&self) -> String {
        format!("{} -> {}", self.names.input, self.names.output)
    }

    fn side(&self, side: Side) -> (f64, &str) {
        match side {
            Side::Input => (self.input, &self.names.input),
            Side::Output => (self.output, &self.names.output),
        }
    }

    /// A command within the search, in the unit of the records.
    pub(crate) fn input(&self, um: f64) -> f64 {
        um / self.input
    }

    /// A position within the search, in the unit of the records.
    pub(crate) fn output(&self, um: f64) -> f64 {
        um / self.output
    }

    /// Name of the unit of the command.
    pub(crate) fn input_unit(&self) -> &str {
        &self.names.input
    }

    /// Name of the unit of the position.
    pub(crate) fn output_unit(&self) -> &str {
        &self.names.output
    }

    /// A position within the search, in words.
    pub(crate) fn told(&self, um: f64) -> String {
        format!("{} {}", figure(self.output(um)), self.names.output)
    }

    /// A coefficient that gives a `side` from a product of this many commands, positions and seconds: its value and its unit.
    pub(crate) fn coefficient(&self, value: f64, side: Side, powers: [i32; 3]) -> (f64, String) {
        let [of_input, of_output, seconds] = powers;
        let (made, name) = self.side(side);
        let factor = self.input.powi(of_input) * self.output.powi(of_output) / made;
        let unit = product(&[
            (name, 1),
            (&self.names.input, -of_input),
            (&self.names.output, -of_output),
            ("s", -seconds),
        ]);
        (value * factor, unit)
    }

    /// The factor that brings a number of a kind of effect from the search's unit to the records' unit, and that unit; None for a
    /// number without a length.
    pub(crate) fn of_number(&self, kind: &dyn EffectKind, unit: &str) -> Option<(f64, String)> {
        let power = power_of(unit);
        if power == 0 || kind.definition().is_some() {
            return None;
        }
        let (per, name) = self.side(side_of(kind));
        let seconds = -i32::from(unit.ends_with("/s"));
        Some((per.powi(-power), product(&[(name, power), ("s", seconds)])))
    }

    /// An effect with all its numbers times what one unit counts for (`inwards`), or back.
    fn effect(&self, effect: &Effect, inwards: bool) -> Effect {
        let kind = effect.kind();
        let form = &kind.spec().forms[effect.form_index()];
        let own = kind.definition().is_some();
        let (per, _) = self.side(side_of(kind));
        let factor = |unit: &str| match (own, inwards) {
            (true, _) => 1.0,
            (false, true) => per.powi(power_of(unit)),
            (false, false) => per.powi(-power_of(unit)),
        };
        let scalars: Vec<f64> = (form.scalars.iter().enumerate())
            .map(|(i, p)| effect.scalar(i) * factor(p.unit))
            .collect();
        let lists: Vec<Vec<f64>> = (form.lists.iter().enumerate())
            .map(|(i, p)| effect.list(i).iter().map(|v| v * factor(p.unit)).collect())
            .collect();
        let lists: Vec<&[f64]> = lists.iter().map(Vec::as_slice).collect();
        let same = Effect::new(kind, effect.form_index(), &scalars, &lists);
        match inwards {
            true => same.counted_in(self.per_unit()),
            false if self.is_of_records() => same.in_any_unit(),
            false => same,
        }
    }

    /// An effect of the search, in the units of the records.
    pub(crate) fn effect_out(&self, effect: &Effect) -> Effect {
        self.effect(effect, false)
    }

    /// A model of these records in the search's units.
    ///
    /// # Errors
    /// A plant whose gain has no number then.
    pub(crate) fn model(&self, model: &Model) -> Result<Model, ReconcileError> {
        if !self.is_of_records() {
            return Ok(model.clone());
        }
        let plant = (model.plant.scaled(self.output / self.input))
            .map_err(|e| ReconcileError::Model(e.to_string()))?;
        Ok(Model {
            plant,
            working_point_um: model.working_point_um * self.input,
            effects: (model.effects.iter())
                .map(|effect| self.effect(effect, true))
                .collect(),
            noise: Noise {
                diffusion_um2_per_s: model.noise.diffusion_um2_per_s * self.output.powi(2),
                localisation_um: model.noise.localisation_um * self.output,
            },
            ..model.clone()
        })
    }

    /// Records as the search has them.
    pub(crate) fn records(&self, records: &[Record]) -> Vec<Record> {
        let mut records = records.to_vec();
        if self.is_of_records() {
            for r in &mut records {
                r.pzt_um.iter_mut().for_each(|v| *v *= self.input);
                let of_bead = r.bead_um.iter_mut().chain(&mut r.late_motion_um);
                of_bead.for_each(|v| *v *= self.output);
                r.resolution_um *= self.output;
                r.slew_um_per_s *= self.input;
            }
        }
        records
    }
}

/// Range of the positions, without what is far out.
fn position_range(records: &[Record]) -> f64 {
    let mut all: Vec<f64> = (records.iter())
        .flat_map(|r| r.bead_um.iter().copied())
        .filter(|y| y.is_finite())
        .collect();
    all.sort_by(f64::total_cmp);
    let (Some(first), Some(last)) = (all.first(), all.last()) else {
        return 0.0;
    };
    let out = (FAR_OUT * all.len() as f64) as usize;
    let inner = all[all.len() - 1 - out] - all[out];
    // Positions that hardly ever move have all of their range at the ends.
    if inner > 0.05 * (last - first) {
        inner
    } else {
        last - first
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_plant::effects::{backlash, find, saturation, wall_adhesion};

    fn of_volts_and_rpm() -> Scales {
        Scales {
            names: Units {
                input: "V".to_owned(),
                output: "rpm".to_owned(),
            },
            input: 4.0,
            output: 0.01,
        }
    }

    #[test]
    fn units_are_told_as_products_of_powers() {
        let scales = of_volts_and_rpm();
        // A force in proportion to the cube of the position.
        let (value, unit) = scales.coefficient(2.0, Side::Input, [0, 3, 0]);
        assert!((value / (2.0 * 1e-6 / 4.0) - 1.0).abs() < 1e-12);
        assert_eq!(unit, "V/rpm^3");
        assert_eq!(scales.coefficient(1.0, Side::Output, [0, 1, 0]).1, "1");
        assert_eq!(scales.coefficient(1.0, Side::Output, [0, 1, -1]).1, "s");
        let um = Scales::none();
        assert_eq!(
            um.coefficient(3.0, Side::Input, [0, 2, -2]).1,
            "s^2/um",
            "v |v|"
        );
        assert_eq!(um.coefficient(3.0, Side::Output, [0, 0, 1]).1, "um/s");
        assert_eq!(
            product(&[("m/s", 1), ("input units", -2)]),
            "(m/s)/(input units)^2"
        );
    }

    #[test]
    fn lengths_go_with_the_signal_that_they_are_of() {
        let scales = of_volts_and_rpm();
        let inside = |effect: &Effect| scales.effect(effect, true);
        assert_eq!(inside(&backlash(0.5)).scalar(0), 2.0);
        assert_eq!(inside(&wall_adhesion(100.0)).scalar(0), 1.0);
        let clip = inside(&saturation(-1.0, 3.0));
        assert_eq!((clip.scalar(0), clip.scalar(1)), (-4.0, 12.0));
        assert_eq!(scales.effect_out(&clip), saturation(-1.0, 3.0));
        let (factor, unit) = scales
            .of_number(find("wall-adhesion").unwrap(), "um/s")
            .unwrap();
        assert_eq!(unit, "rpm/s");
        assert!((factor - 100.0).abs() < 1e-9);
    }

    #[test]
    fn a_record_times_anything_is_the_same_within_the_search() {
        let time_s: Vec<f64> = (0..400).map(|k| f64::from(k) * 0.1).collect();
        let u: Vec<f64> = (0..400).map(|k| f64::from(k % 37)).collect();
        let y: Vec<f64> = (0..400).map(|k| (0.1 * f64::from(k)).sin()).collect();
        let inside = |a: f64, b: f64| {
            let (u, y): (Vec<f64>, Vec<f64>) = (
                u.iter().map(|v| a * v).collect(),
                y.iter().map(|v| b * v).collect(),
            );
            let r = [Record::from_rows("r", &time_s, &u, &y).unwrap()];
            Scales::of(&r, &Units::default(), true).records(&r)
        };
        let (one, other) = (inside(1.0, 1.0), inside(1e3, 1e-3));
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near(&one[0].pzt_um, &other[0].pzt_um));
        assert!(near(&one[0].bead_um, &other[0].bead_um));
    }
}
