//! A rendered scene that is difficult for vision: several beads, dust, uneven and flickering light, defocus, motion
//! blur.
//!
//! For tests of vision, not for a closed loop: nothing here follows a command. The rig with its plant is
//! [`EmulatedRig`](crate::EmulatedRig). A seed fixes every picture to the bit.

use cellpos_numeric::Random;
use cellpos_rig::clock::Clock;
use cellpos_rig::source::{Camera, CameraError, FrameBuffer, FrameStamp, SourceInfo};
use cellpos_vision::{RadialProfile, RingProfile};
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// Number of points that represent a bead's path during the exposure.
const BLUR_POINTS: usize = 5;

/// A bead of the scene.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SceneBead {
    /// Start, column, px.
    pub(crate) x_px: f64,
    /// Start, row, px.
    pub(crate) y_px: f64,
    /// Steady velocity along the rows, px/s.
    pub(crate) x_px_per_s: f64,
    /// Steady velocity along the columns, px/s.
    pub(crate) y_px_per_s: f64,
    /// Diffusion coefficient, px^2/s.
    pub(crate) diffusion_px2_per_s: f64,
    /// Edge radius in focus, px.
    pub(crate) edge_px: f64,
    /// Peak contrast in focus, grey levels.
    pub(crate) amplitude_grey: f64,
}

/// A speck that does not move.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Dust {
    /// Column, px.
    pub(crate) x_px: f64,
    /// Row, px.
    pub(crate) y_px: f64,
    /// Size: standard deviation of a Gaussian, px.
    pub(crate) sigma_px: f64,
    /// Grey levels taken off at its centre.
    pub(crate) depth_grey: f64,
}

/// A scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct SceneConfig {
    /// Pixels per row.
    pub(crate) width_px: usize,
    /// Rows.
    pub(crate) height_px: usize,
    /// Frame rate, Hz.
    pub(crate) rate_hz: f64,
    /// Exposure as a share of the frame interval, 0 to 1.
    pub(crate) exposure_share: f64,
    /// Light at the middle of the frame, grey levels.
    pub(crate) background_grey: f64,
    /// Change of the light across the frame's width, as a fraction.
    pub(crate) light_slope: f64,
    /// Light missing in the corners, as a fraction.
    pub(crate) vignette: f64,
    /// Amplitude of the light's flicker, as a fraction.
    pub(crate) flicker: f64,
    /// Frequency of the flicker, Hz.
    pub(crate) flicker_hz: f64,
    /// Amplitude of the beads' change of size by defocus, as a fraction; their contrast falls with their area.
    pub(crate) defocus: f64,
    /// Frequency of the defocus, Hz.
    pub(crate) defocus_hz: f64,
    /// Standard deviation of the noise without light, grey levels.
    pub(crate) read_sd_grey: f64,
    /// Shot noise: grey levels per photo-electron.
    pub(crate) shot_grey_per_electron: f64,
    /// Beads; the first is the one whose truth is stamped.
    pub(crate) beads: Vec<SceneBead>,
    /// Dust.
    pub(crate) dust: Vec<Dust>,
    /// Seed.
    pub(crate) seed: u64,
}

impl Default for SceneConfig {
    fn default() -> Self {
        let bead = |x_px, y_px| SceneBead {
            x_px,
            y_px,
            x_px_per_s: 0.0,
            y_px_per_s: 0.0,
            diffusion_px2_per_s: 30.0,
            edge_px: 4.5,
            amplitude_grey: 80.0,
        };
        SceneConfig {
            width_px: 128,
            height_px: 96,
            rate_hz: 1000.0,
            exposure_share: 0.5,
            background_grey: 110.0,
            light_slope: 0.2,
            vignette: 0.1,
            flicker: 0.05,
            flicker_hz: 100.0,
            defocus: 0.04,
            defocus_hz: 3.0,
            read_sd_grey: 1.5,
            shot_grey_per_electron: 0.02,
            beads: vec![bead(40.0, 48.0), bead(90.0, 30.0)],
            dust: vec![
                Dust {
                    x_px: 64.0,
                    y_px: 70.0,
                    sigma_px: 3.0,
                    depth_grey: 25.0,
                },
                Dust {
                    x_px: 15.0,
                    y_px: 20.0,
                    sigma_px: 1.5,
                    depth_grey: 40.0,
                },
            ],
            seed: 1,
        }
    }
}

/// A scene that cannot be rendered.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("scene: {key} = {value}: must be {must_be}")]
pub(crate) struct SceneError {
    /// Which key.
    pub(crate) key: &'static str,
    /// Its value.
    pub(crate) value: f64,
    /// What would be right.
    pub(crate) must_be: &'static str,
}

/// The camera of the scene.
#[derive(Debug)]
pub(crate) struct SceneCamera {
    config: SceneConfig,
    profiles: Vec<RingProfile>,
    /// Where the beads are at the middle of the newest exposure, px.
    places: Vec<(f64, f64)>,
    light: Vec<f64>,
    image: Vec<f64>,
    random: Random,
    clock: Clock,
    start_ns: Option<i64>,
    frames: u64,
}

impl SceneCamera {
    /// A camera before its first frame.
    ///
    /// # Errors
    /// The error names the first invalid key.
    pub(crate) fn new(config: SceneConfig, clock: Clock) -> Result<Self, SceneError> {
        let range = |key, value: f64, low: f64, high: f64, must_be| {
            if value >= low && value <= high {
                Ok(())
            } else {
                Err(SceneError {
                    key,
                    value,
                    must_be,
                })
            }
        };
        range(
            "width_px",
            config.width_px as f64,
            8.0,
            8192.0,
            "8 to 8192 px",
        )?;
        range(
            "height_px",
            config.height_px as f64,
            8.0,
            8192.0,
            "8 to 8192 px",
        )?;
        range("rate_hz", config.rate_hz, 0.1, 1e5, "0.1 to 1e5 Hz")?;
        range("exposure_share", config.exposure_share, 0.0, 1.0, "0 to 1")?;
        range(
            "background_grey",
            config.background_grey,
            0.0,
            255.0,
            "0 to 255 grey levels",
        )?;
        range("light_slope", config.light_slope, -1.0, 1.0, "-1 to 1")?;
        range("vignette", config.vignette, 0.0, 1.0, "0 to 1")?;
        range("flicker", config.flicker, 0.0, 1.0, "0 to 1")?;
        range("flicker_hz", config.flicker_hz, 0.0, 1e6, "0 to 1e6 Hz")?;
        range("defocus", config.defocus, 0.0, 0.5, "0 to 0.5")?;
        range("defocus_hz", config.defocus_hz, 0.0, 1e6, "0 to 1e6 Hz")?;
        range(
            "read_sd_grey",
            config.read_sd_grey,
            0.0,
            255.0,
            "0 to 255 grey levels",
        )?;
        range(
            "shot_grey_per_electron",
            config.shot_grey_per_electron,
            0.0,
            100.0,
            "0 to 100",
        )?;
        for d in &config.dust {
            range("dust.sigma_px", d.sigma_px, 0.1, 1e3, "0.1 to 1000 px")?;
        }
        let mut profiles = Vec::new();
        for b in &config.beads {
            range("beads.edge_px", b.edge_px, 0.5, 200.0, "0.5 to 200 px")?;
            range(
                "beads.diffusion_px2_per_s",
                b.diffusion_px2_per_s,
                0.0,
                1e6,
                "0 to 1e6 px^2/s",
            )?;
            let refused = SceneError {
                key: "beads.edge_px",
                value: b.edge_px,
                must_be: "above 0 px",
            };
            profiles.push(RingProfile::new(b.edge_px).ok_or(refused)?);
        }
        let light = uneven_light(&config);
        let random = Random::new(config.seed);
        let places = config.beads.iter().map(|b| (b.x_px, b.y_px)).collect();
        let image = vec![0.0; light.len()];
        Ok(SceneCamera {
            config,
            profiles,
            places,
            light,
            image,
            random,
            clock,
            start_ns: None,
            frames: 0,
        })
    }

    /// Positions of the beads in the newest frame (middle of the exposure), px.
    pub(crate) fn places(&self) -> &[(f64, f64)] {
        &self.places
    }

    fn render(&mut self, buffer: &mut FrameBuffer) {
        let interval_s = 1.0 / self.config.rate_hz;
        let time_s = self.frames as f64 * interval_s;
        let flicker = 1.0 + self.config.flicker * (TAU * self.config.flicker_hz * time_s).sin();
        let size = 1.0 + self.config.defocus * (TAU * self.config.defocus_hz * time_s).sin();
        for (v, light) in self.image.iter_mut().zip(&self.light) {
            *v = flicker * light;
        }
        for k in 0..self.config.beads.len() {
            let bead = self.config.beads[k];
            let step_px = (2.0 * bead.diffusion_px2_per_s * interval_s).sqrt();
            if self.frames > 0 {
                let (dx, dy) = (
                    step_px * self.random.normal(),
                    step_px * self.random.normal(),
                );
                self.places[k].0 += bead.x_px_per_s * interval_s + dx;
                self.places[k].1 += bead.y_px_per_s * interval_s + dy;
            }
            let (x, y) = self.places[k];
            let exposed_s = self.config.exposure_share * interval_s;
            for n in 0..BLUR_POINTS {
                let at_s = exposed_s * ((n as f64 + 0.5) / BLUR_POINTS as f64 - 0.5);
                let place = (x + bead.x_px_per_s * at_s, y + bead.y_px_per_s * at_s);
                let amplitude = flicker * bead.amplitude_grey / (size * size * BLUR_POINTS as f64);
                self.draw(k, place, size, amplitude);
            }
        }
        let (read, gain) = (self.config.read_sd_grey, self.config.shot_grey_per_electron);
        buffer.mono8.clear();
        for k in 0..self.image.len() {
            let v = self.image[k];
            let sd = (read * read + gain * v.max(0.0)).sqrt();
            buffer
                .mono8
                .push((v + sd * self.random.normal()).round().clamp(0.0, 255.0) as u8);
        }
        (buffer.width, buffer.height, buffer.bits) =
            (self.config.width_px, self.config.height_px, 8);
    }

    fn draw(&mut self, bead: usize, (x, y): (f64, f64), size: f64, amplitude: f64) {
        let profile = &self.profiles[bead];
        let reach_px = size * profile.support_px();
        let width = self.config.width_px;
        let span = |c: f64, len: usize| {
            (
                (c - reach_px).max(0.0) as usize,
                ((c + reach_px + 1.0).max(0.0) as usize).min(len),
            )
        };
        let (columns, rows) = (span(x, width), span(y, self.config.height_px));
        for j in rows.0..rows.1 {
            for i in columns.0..columns.1 {
                let r_px = f64::hypot(i as f64 - x, j as f64 - y);
                self.image[j * width + i] += amplitude * profile.value(r_px / size);
            }
        }
    }
}

/// Light with slope, vignette and dust.
fn uneven_light(config: &SceneConfig) -> Vec<f64> {
    let (width, height) = (config.width_px, config.height_px);
    let pixel = |k: usize| {
        let (i, j) = ((k % width) as f64, (k / width) as f64);
        let (u, v) = (i / (width - 1) as f64 - 0.5, j / (height - 1) as f64 - 0.5);
        let light =
            (1.0 + config.light_slope * u) * (1.0 - config.vignette * 2.0 * (u * u + v * v));
        let dust: f64 = config
            .dust
            .iter()
            .map(|d| {
                let r2 = (i - d.x_px).powi(2) + (j - d.y_px).powi(2);
                d.depth_grey * (-0.5 * r2 / (d.sigma_px * d.sigma_px)).exp()
            })
            .sum();
        (config.background_grey * light - dust).max(0.0)
    };
    (0..width * height).map(pixel).collect()
}

impl Camera for SceneCamera {
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError> {
        let start_ns = *self.start_ns.get_or_insert_with(|| self.clock.now_ns());
        let due_ns =
            start_ns.saturating_add((self.frames as f64 / self.config.rate_hz * 1e9) as i64);
        if due_ns > deadline_ns {
            self.clock.sleep_until_ns(deadline_ns);
            return Ok(None);
        }
        self.render(buffer);
        self.clock.sleep_until_ns(due_ns);
        self.frames += 1;
        Ok(Some(FrameStamp {
            id: self.frames,
            mid_exposure_ns: due_ns,
            exposure_ns: (self.config.exposure_share / self.config.rate_hz * 1e9) as i64,
            arrival_ns: self.clock.now_ns(),
            true_um: f64::NAN,
            true_pzt_um: f64::NAN,
        }))
    }

    fn info(&self) -> SourceInfo {
        SourceInfo {
            name: "rendered scene".to_string(),
            width_px: self.config.width_px,
            height_px: self.config.height_px,
            rate_hz: self.config.rate_hz,
            latency_ms: 0.0,
            exposure_s: 0.0,
            field_um: [0.0, 0.0],
        }
    }
}
