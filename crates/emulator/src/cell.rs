//! A cell instead of a bead: the flow drives it into a constriction, where it stretches and tires.
//!
//! The shape is a Kelvin-Voigt body: its length follows the load with a first-order lag. The lag is short on the way into the
//! constriction and longer during the recovery outside. With every passage it stretches less and recovers more slowly, linearly
//! up to the last passage of [`CellConfig::fatigue_passages`]. In the constriction the same PZT displacement moves it faster. Not
//! here: friction at the wall and adhesion.

use crate::error::{WorldError, within};
use cellpos_numeric::Random;
use serde::{Deserialize, Serialize};
use std::f64::consts::FRAC_PI_4;

/// A cell and its constriction, the table `[emulator.cell]` of rig.toml. Every key may be left out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CellConfig {
    /// Middle of the constriction's mouth; it continues to larger positions, um.
    pub entry_um: f64,
    /// Length of the mouth, over which gain and load change, um.
    pub mouth_um: f64,
    /// Ratio of the cell's speeds inside and outside, at the same displacement of the PZT.
    pub gain: f64,
    /// Length of the cell without load, um.
    pub rest_um: f64,
    /// Length inside over length without load, at the first passage.
    pub stretch_first: f64,
    /// The same, at the last.
    pub stretch_last: f64,
    /// Time constant of stretching, s.
    pub loading_s: f64,
    /// Time constant of the recovery after the first passage, s.
    pub recovery_first_s: f64,
    /// The same, after the last.
    pub recovery_last_s: f64,
    /// Passages over which it tires; later ones change nothing.
    pub fatigue_passages: u32,
    /// Passages that it made before this run; a run that is resumed counts its cycles.
    pub passages_before: u32,
    /// Contrast of the body, as a share of `contrast_grey`; negative: darker than the background.
    pub body: f64,
    /// Contrast of rim and halo at 1 um out of focus, as a share of `contrast_grey`.
    pub halo: f64,
    /// Distance of the cell's middle from the focus, um. If positive, the rim has the sign of the contrast and the halo the
    /// opposite one; if negative, the other way round.
    pub focus_um: f64,
    /// Noise of the length delivered without pictures, um RMS; the area is that of the measured length.
    pub noise_um: f64,
}

impl Default for CellConfig {
    /// Stretch 3.80 to 2.86 and recovery 0.16 to 0.37 s over 180 passages, as published for red blood cells of 8 um.
    fn default() -> Self {
        Self {
            entry_um: 4.0,
            mouth_um: 1.0,
            gain: 1.5,
            rest_um: 8.0,
            stretch_first: 3.80,
            stretch_last: 2.86,
            loading_s: 0.05,
            recovery_first_s: 0.16,
            recovery_last_s: 0.37,
            fatigue_passages: 180,
            passages_before: 0,
            body: 1.0,
            halo: 0.5,
            focus_um: 0.5,
            noise_um: 0.05,
        }
    }
}

impl CellConfig {
    pub(crate) fn validate(&self) -> Result<(), WorldError> {
        within(
            "cell.entry_um",
            self.entry_um,
            -1e4,
            1e4,
            "-10000..10000 um",
        )?;
        within("cell.mouth_um", self.mouth_um, 1e-3, 1e3, "0.001..1000 um")?;
        within("cell.gain", self.gain, 0.1, 10.0, "0.1..10")?;
        within("cell.rest_um", self.rest_um, 0.1, 100.0, "0.1..100 um")?;
        within("cell.noise_um", self.noise_um, 0.0, 10.0, "0..10 um")?;
        within("cell.body", self.body, -2.0, 2.0, "-2..2 of the contrast")?;
        within("cell.halo", self.halo, 0.0, 2.0, "0..2 of the contrast")?;
        within("cell.focus_um", self.focus_um, -20.0, 20.0, "-20..20 um")?;
        let passages = f64::from(self.fatigue_passages);
        within("cell.fatigue_passages", passages, 2.0, 1e9, "2 or more")?;
        for (key, value) in [
            ("cell.stretch_first", self.stretch_first),
            ("cell.stretch_last", self.stretch_last),
        ] {
            within(key, value, 0.1, 20.0, "0.1..20")?;
        }
        for (key, value) in [
            ("cell.loading_s", self.loading_s),
            ("cell.recovery_first_s", self.recovery_first_s),
            ("cell.recovery_last_s", self.recovery_last_s),
        ] {
            within(key, value, 1e-4, 100.0, "0.0001..100 s")?;
        }
        Ok(())
    }

    /// Width of the cell at a length, um: it keeps its volume.
    ///
    /// Length L and width W are the axes of an ellipsoid of revolution that is a sphere of diameter D = `rest_um`
    /// without load: L W^2 = D^3.
    pub(crate) fn width_um(&self, length_um: f64) -> f64 {
        self.rest_um * (self.rest_um / length_um).sqrt()
    }

    /// Projected area of the cell at a length, um^2: that of the ellipse with the axes L and W of
    /// [`CellConfig::width_um`], pi/4 D^1.5 L^0.5.
    pub(crate) fn area_um2(&self, length_um: f64) -> f64 {
        FRAC_PI_4 * length_um * self.width_um(length_um)
    }

    /// Degree to which a position is inside: 0 outside, 1 inside, smooth in between.
    pub(crate) fn inside(&self, x_um: f64) -> f64 {
        let share = ((x_um - self.entry_um) / self.mouth_um + 0.5).clamp(0.0, 1.0);
        share * share * (3.0 - 2.0 * share)
    }

    fn between(&self, first: f64, last: f64, passages: u32) -> f64 {
        let share = f64::from(passages) / f64::from(self.fatigue_passages - 1);
        first + (last - first) * share.min(1.0)
    }
}

/// The present state of the cell.
#[derive(Debug, Clone)]
pub(crate) struct Cell {
    config: CellConfig,
    length_um: f64,
    passages: u32,
    was_inside: bool,
    noise: Random,
}

impl Cell {
    pub(crate) fn new(config: CellConfig, seed: u64) -> Self {
        Self {
            config,
            length_um: config.rest_um,
            passages: config.passages_before,
            was_inside: false,
            noise: Random::stream(seed, 3),
        }
    }

    /// Additional motion of the cell with the fluid, compared with a bead that moves by `bead_um` from `x_um`.
    pub(crate) fn surplus_um(&self, x_um: f64, bead_um: f64) -> f64 {
        bead_um * (self.config.gain - 1.0) * self.config.inside(x_um)
    }

    /// The shape `dt_s` later, at a position held meanwhile.
    pub(crate) fn advance(&mut self, x_um: f64, dt_s: f64) {
        let c = &self.config;
        let inside = c.inside(x_um);
        let stretch = c.between(c.stretch_first, c.stretch_last, self.passages);
        let load_um = c.rest_um * (1.0 + (stretch - 1.0) * inside);
        // The recovery after a passage belongs to that passage, although it counts only when the cell has left.
        let tired = self.passages.saturating_sub(u32::from(!self.was_inside));
        let recovery_s = c.between(c.recovery_first_s, c.recovery_last_s, tired);
        let lag_s = if load_um > self.length_um {
            c.loading_s
        } else {
            recovery_s
        };
        self.length_um = load_um + (self.length_um - load_um) * (-dt_s / lag_s).exp();
        if inside > 0.5 {
            self.was_inside = true;
        } else if self.was_inside && inside == 0.0 {
            self.was_inside = false;
            self.passages = self.passages.saturating_add(1);
        }
    }

    /// True length, um.
    pub(crate) fn length_um(&self) -> f64 {
        self.length_um
    }

    /// Standard deviations that [`Cell::measured`] has of a length: of the length (um) and of the area (um^2).
    pub(crate) fn noise(&self, length_um: f64) -> (f64, f64) {
        let noise_um = self.config.noise_um;
        // The area is proportional to the root of the length.
        let area_um2 = 0.5 * self.config.area_um2(length_um) / length_um * noise_um;
        (noise_um, area_um2)
    }

    /// Length (um) and projected area (um^2) as measured of a cell of a true length.
    ///
    /// The area comes from the measured length, so both have the same noise. Both are NaN if the noise makes the length negative.
    pub(crate) fn measured(&mut self, length_um: f64) -> (f64, f64) {
        let noisy_um = length_um + self.config.noise_um * self.noise.normal();
        if noisy_um > 0.0 {
            (noisy_um, self.config.area_um2(noisy_um))
        } else {
            (f64::NAN, f64::NAN)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn length_follows_the_closed_form_of_a_kelvin_voigt_body_and_tires_with_each_passage() {
        let config = CellConfig::default();
        let mut cell = Cell::new(config, 1);
        let mut stretches = Vec::new();
        for _ in 0..200 {
            for _ in 0..1000 {
                cell.advance(8.0, 1e-3);
            }
            stretches.push(cell.length_um() / config.rest_um);
            let (start_um, tired) = (cell.length_um(), stretches.len() - 1);
            for _ in 0..1000 {
                cell.advance(0.0, 1e-3);
            }
            let lag_s = 0.16 + (0.37 - 0.16) * (tired as f64 / 179.0).min(1.0);
            // The first tick outside counts the passage.
            let expected = config.rest_um + (start_um - config.rest_um) * (-1.0 / lag_s).exp();
            assert!((cell.length_um() - expected).abs() < 0.03, "{tired}");
        }
        assert!((stretches[0] - 3.80).abs() < 1e-6);
        assert!((stretches[179] - 2.86).abs() < 1e-6);
        assert!((stretches[90] - (3.80 - 0.94 * 90.0 / 179.0)).abs() < 1e-6);
        assert_eq!(stretches[199], stretches[180], "it tires no further");
    }

    #[test]
    fn the_cell_keeps_its_volume_and_is_a_sphere_at_rest() {
        let config = CellConfig::default();
        let rest_um = config.rest_um;
        assert!((config.width_um(rest_um) - rest_um).abs() < 1e-12);
        let disc_um2 = std::f64::consts::PI * rest_um * rest_um / 4.0;
        assert!((config.area_um2(rest_um) - disc_um2).abs() < 1e-12 * disc_um2);
        let sphere_um3 = std::f64::consts::PI * rest_um.powi(3) / 6.0;
        for stretch in [0.5, 1.0, 2.86, 3.80] {
            let length_um = stretch * rest_um;
            let width_um = config.width_um(length_um);
            let volume_um3 = std::f64::consts::PI / 6.0 * length_um * width_um * width_um;
            assert!((volume_um3 / sphere_um3 - 1.0).abs() < 1e-12, "{stretch}");
            let closed_um2 = FRAC_PI_4 * rest_um.powf(1.5) * length_um.sqrt();
            assert!((config.area_um2(length_um) / closed_um2 - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn length_and_area_are_measured_with_the_same_noise() {
        let config = CellConfig::default();
        let mut cell = Cell::new(config, 7);
        let mut squares = 0.0;
        for _ in 0..2000 {
            let (length_um, area_um2) = cell.measured(20.0);
            squares += (length_um - 20.0).powi(2);
            assert_eq!(area_um2, config.area_um2(length_um));
        }
        let rms_um = (squares / 2000.0).sqrt();
        // The standard deviation of that estimate is 1/sqrt(2 * 2000) = 1.6 %.
        assert!((rms_um / config.noise_um - 1.0).abs() < 0.08, "{rms_um}");
    }

    #[test]
    fn the_same_flow_moves_the_cell_faster_inside() {
        let cell = Cell::new(CellConfig::default(), 1);
        assert_eq!(cell.surplus_um(0.0, 1.0), 0.0);
        assert!((cell.surplus_um(8.0, 1.0) - 0.5).abs() < 1e-12);
        assert!((cell.surplus_um(4.0, 1.0) - 0.25).abs() < 1e-12);
    }
}
