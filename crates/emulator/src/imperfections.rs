//! Imperfections of a real rig: flow, light and clocks.
//!
//! Every such key of `[emulator]` may be left out. With `ideal = false` it then has the value of a real rig; on an
//! ideal rig it is zero. A given key holds on either rig.

use crate::config::WorldConfig;
use crate::error::{WorldError, within};
use cellpos_numeric::Random;

/// The imperfections of a rig, all keys decided.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Imperfections {
    /// Wander of the zero flow about its mean (Ornstein-Uhlenbeck), um RMS.
    pub zero_flow_wander_um: f64,
    /// Correlation time of that, s.
    pub zero_flow_wander_time_s: f64,
    /// Drift of the zero flow, um of PZT displacement per second.
    pub zero_flow_drift_um_per_s: f64,
    /// The frame follows the bead across the channel to within this distance of its middle line, um.
    pub lateral_um: f64,
    /// Angle from the rows of the picture to the channel, degrees.
    pub tilt_deg: f64,
    /// Relative change of the bead's ring as the focus wanders, RMS.
    pub focus_wander: f64,
    /// Correlation time of the focus, s.
    pub focus_time_s: f64,
    /// Specks of dust in the picture.
    pub dust: u16,
    /// Change of the light across the frame's width, as a fraction.
    pub light_slope: f64,
    /// Light missing in the corners, as a fraction.
    pub vignette: f64,
    /// Depth of the line by which a wall of the channel shows, grey levels.
    pub wall_grey: f64,
    /// Excess of the camera's period over its stated period, parts per million.
    pub camera_clock_ppm: f64,
    /// Jitter of the exposures about the camera's clock, us RMS; not visible in its time stamps.
    pub exposure_jitter_us: f64,
    /// Mean additional delay of a frame over the fastest, us (exponential).
    pub arrival_jitter_us: f64,
}

impl Imperfections {
    /// A rig on a good day: values that a user would not call a fault.
    pub const REAL: Self = Self {
        // A syringe pump at rest, and a reservoir that empties: 6 nm of PZT move a bead by 2.6 um/s.
        zero_flow_wander_um: 0.006,
        zero_flow_wander_time_s: 20.0,
        zero_flow_drift_um_per_s: 0.001,
        lateral_um: 0.5,
        tilt_deg: 1.0,
        // A stage that moves by some tens of nanometres while the focus is kept.
        focus_wander: 0.005,
        focus_time_s: 5.0,
        dust: 3,
        light_slope: 0.1,
        vignette: 0.1,
        wall_grey: 25.0,
        // A quartz: up to 50 ppm by its data sheet, 15 as they come.
        camera_clock_ppm: 15.0,
        exposure_jitter_us: 2.0,
        arrival_jitter_us: 30.0,
    };
    /// A rig without.
    pub const IDEAL: Self = Self {
        zero_flow_wander_um: 0.0,
        zero_flow_wander_time_s: 20.0,
        zero_flow_drift_um_per_s: 0.0,
        lateral_um: 0.25,
        tilt_deg: 0.0,
        focus_wander: 0.0,
        focus_time_s: 5.0,
        dust: 0,
        light_slope: 0.0,
        vignette: 0.0,
        wall_grey: 0.0,
        camera_clock_ppm: 0.0,
        exposure_jitter_us: 0.0,
        arrival_jitter_us: 0.0,
    };

    /// Whether the light of the empty channel is even over the picture.
    pub fn has_even_light(&self) -> bool {
        [self.light_slope, self.vignette, self.wall_grey] == [0.0; 3] && self.dust == 0
    }
}

impl WorldConfig {
    /// The imperfections with the keys that were left out.
    pub fn imperfections(&self) -> Imperfections {
        let rest = match (self.ideal, self.cell) {
            (true, _) => Imperfections::IDEAL,
            (false, None) => Imperfections::REAL,
            // Its constriction is along the rows, leaves no room for a walk, and has its own walls.
            (false, Some(_)) => Imperfections {
                lateral_um: Imperfections::IDEAL.lateral_um,
                tilt_deg: 0.0,
                wall_grey: 0.0,
                ..Imperfections::REAL
            },
        };
        Imperfections {
            zero_flow_wander_um: self.zero_flow_wander_um.unwrap_or(rest.zero_flow_wander_um),
            zero_flow_wander_time_s: self
                .zero_flow_wander_time_s
                .unwrap_or(rest.zero_flow_wander_time_s),
            zero_flow_drift_um_per_s: self
                .zero_flow_drift_um_per_s
                .unwrap_or(rest.zero_flow_drift_um_per_s),
            lateral_um: self.lateral_um.unwrap_or(rest.lateral_um),
            tilt_deg: self.tilt_deg.unwrap_or(rest.tilt_deg),
            focus_wander: self.focus_wander.unwrap_or(rest.focus_wander),
            focus_time_s: self.focus_time_s.unwrap_or(rest.focus_time_s),
            dust: self.dust.unwrap_or(rest.dust),
            light_slope: self.light_slope.unwrap_or(rest.light_slope),
            vignette: self.vignette.unwrap_or(rest.vignette),
            wall_grey: self.wall_grey.unwrap_or(rest.wall_grey),
            camera_clock_ppm: self.camera_clock_ppm.unwrap_or(rest.camera_clock_ppm),
            exposure_jitter_us: self.exposure_jitter_us.unwrap_or(rest.exposure_jitter_us),
            arrival_jitter_us: self.arrival_jitter_us.unwrap_or(rest.arrival_jitter_us),
        }
    }

    pub(crate) fn validate_imperfections(&self) -> Result<(), WorldError> {
        let it = self.imperfections();
        let half_height_um = 0.5 * f64::from(self.height_px) * self.pixel_um;
        let period_us = 1e6 / self.rate_hz;
        let checks = [
            (
                "zero_flow_wander_um",
                it.zero_flow_wander_um,
                0.0,
                100.0,
                "0..100 um",
            ),
            (
                "zero_flow_wander_time_s",
                it.zero_flow_wander_time_s,
                1e-3,
                1e6,
                "0.001..1000000 s",
            ),
            (
                "zero_flow_drift_um_per_s",
                it.zero_flow_drift_um_per_s,
                -10.0,
                10.0,
                "-10..10 um/s",
            ),
            ("tilt_deg", it.tilt_deg, -45.0, 45.0, "-45..45 degrees"),
            (
                "focus_wander",
                it.focus_wander,
                0.0,
                0.2,
                "0..0.2 of the ring's size",
            ),
            (
                "focus_time_s",
                it.focus_time_s,
                1e-3,
                1e6,
                "0.001..1000000 s",
            ),
            ("dust", f64::from(it.dust), 0.0, 1000.0, "0..1000 specks"),
            ("light_slope", it.light_slope, -1.0, 1.0, "-1..1"),
            ("vignette", it.vignette, 0.0, 1.0, "0..1"),
            ("wall_grey", it.wall_grey, 0.0, 255.0, "0..255 grey levels"),
            (
                "camera_clock_ppm",
                it.camera_clock_ppm,
                -1000.0,
                1000.0,
                "-1000..1000 parts per million",
            ),
            (
                "exposure_jitter_us",
                it.exposure_jitter_us,
                0.0,
                0.1 * period_us,
                "0 us to a tenth of the frame period",
            ),
            (
                "arrival_jitter_us",
                it.arrival_jitter_us,
                0.0,
                10.0 * period_us,
                "0 us to ten frame periods",
            ),
        ];
        for (key, value, low, high, must) in checks {
            within(key, value, low, high, must)?;
        }
        // A picture that is smaller than the usual walk keeps its bead in view.
        match self.lateral_um {
            Some(um) => within(
                "lateral_um",
                um,
                0.0,
                half_height_um,
                "0 um to half the frame's height",
            ),
            None => Ok(()),
        }
    }
}

/// An Ornstein-Uhlenbeck process, exact for any step, so its statistics do not depend on the calls' spacing.
#[derive(Debug, Clone)]
pub(crate) struct Wander {
    rms: f64,
    time_s: f64,
    value: f64,
    noise: Random,
}

impl Wander {
    /// Starts in its stationary distribution. A process of size 0 draws nothing more.
    pub(crate) fn new(rms: f64, time_s: f64, mut noise: Random) -> Self {
        let value = rms * noise.normal();
        Self {
            rms,
            time_s,
            value,
            noise,
        }
    }

    /// Moves on by `dt_s`; its value then.
    pub(crate) fn advance(&mut self, dt_s: f64) -> f64 {
        if self.rms > 0.0 {
            let kept = (-dt_s / self.time_s).exp();
            let fresh = (1.0 - kept * kept).sqrt();
            self.value = kept * self.value + fresh * self.rms * self.noise.normal();
        }
        self.value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_left_out_is_that_of_a_real_rig_or_nothing_on_an_ideal_one_and_a_key_given_holds_on_both()
     {
        assert_eq!(WorldConfig::real().imperfections(), Imperfections::REAL);
        assert_eq!(WorldConfig::ideal().imperfections(), Imperfections::IDEAL);
        for ideal in [false, true] {
            let given = WorldConfig {
                ideal,
                zero_flow_wander_um: Some(0.01),
                dust: Some(0),
                ..WorldConfig::default()
            };
            let it = given.imperfections();
            assert_eq!((it.zero_flow_wander_um, it.dust), (0.01, 0));
            assert_eq!(it.camera_clock_ppm == 0.0, ideal);
        }
    }

    #[test]
    fn a_value_that_cannot_be_is_named() {
        for (config, key) in [
            (
                WorldConfig {
                    tilt_deg: Some(60.0),
                    ..WorldConfig::default()
                },
                "tilt_deg",
            ),
            (
                WorldConfig {
                    exposure_jitter_us: Some(200.0),
                    ..WorldConfig::default()
                },
                "exposure_jitter_us",
            ),
            (
                WorldConfig {
                    lateral_um: Some(2.0),
                    ..WorldConfig::default()
                },
                "lateral_um",
            ),
        ] {
            let error = config.validate().unwrap_err().to_string();
            assert!(error.contains(key), "{error}");
        }
    }
}
