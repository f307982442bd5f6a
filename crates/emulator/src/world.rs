//! The world: everything between the board's output and the camera's delivery.

use crate::camera::{Camera, EXPOSURE_STEPS, Exposure, FrameInfo, PositionFix, Sample};
use crate::cell::Cell;
use crate::config::WorldConfig;
use crate::error::WorldError;
use crate::faults::FaultKind;
use crate::imperfections::Wander;
use crate::partner::PressurePartner;
use crate::render::{Renderer, localisation_bound_um, mean_between};
use crate::second_bead::{self, confined};
use crate::zero_flow::ZeroFlow;
use cellpos_numeric::Random;
use cellpos_plant::effects::{Action, Shown};
use cellpos_plant::{Chain, Model, Noise};
use cellpos_vision::FixQuality;

/// Turns a seed into that of frames of the empty channel.
const EMPTY_SEED: u64 = 0x5eed_0f0e_3a97_7c41;

/// The emulated world. Times are nanoseconds of the caller's clock, from `start_ns` on.
///
/// ```
/// use cellpos_emulator::{World, WorldConfig};
/// use cellpos_plant::Model;
/// let mut world = World::new(&WorldConfig::ideal(), &Model::eq6(), 0).unwrap();
/// let mut pixels = Vec::new();
/// while let None = world.take_frame(&mut pixels) {
///     // The board's output stands at 20 um, where the bead is at rest, for another 0.1 ms.
///     world.advance_to(world.now_ns() + 100_000, 20.0);
/// }
/// // The first frame is exposed about 1 ms and delivered 2 ms later.
/// assert_eq!(world.now_ns(), 3_000_000);
/// assert_eq!(pixels.len(), 256 * 32);
/// ```
#[derive(Debug, Clone)]
pub struct World {
    config: WorldConfig,
    chain: Chain,
    pub(crate) partner: Option<PressurePartner>,
    zero_flow: ZeroFlow,
    /// Present zero flow, um from the mean.
    zero_flow_um: f64,
    focus: Wander,
    defocus: f64,
    /// Of the angle between the rows of the picture and the channel.
    sin_cos: (f64, f64),
    /// Range of the bead across the channel, um.
    most_lateral_um: f64,
    camera: Camera,
    renderer: Renderer,
    start_ns: i64,
    now_ns: i64,
    /// From the chain's bead to the one in view: start, drift, a new bead, time spent stuck.
    offset_um: f64,
    lateral_um: f64,
    /// Second bead: distance along the channel from the first, and position across it.
    second_um: Option<(f64, f64)>,
    stuck_um: Option<f64>,
    /// Zero flow at which the PZT is made to stand, um.
    stands_um: Option<f64>,
    brownian: Random,
    localisation: Random,
    localisation_um: f64,
    snr: f64,
    /// Exposure since which the bead has been out of the frame.
    out_since_ns: Option<i64>,
    /// Effects of the model on light and table.
    shown: Vec<Box<dyn Shown>>,
    led: bool,
    has_events: bool,
    cell: Option<Cell>,
    /// Picture and position that a hanging frame grabber repeats.
    newest_picture: Vec<u8>,
    newest_position: Option<PositionFix>,
}

impl World {
    /// A world at `start_ns` with the bead at [`WorldConfig::start_um`] and the PZT resting at neutral.
    ///
    /// The configuration's neutral and diffusion replace the model's. The model's effects at the camera's place (delay, exposure, drops,
    /// repeats, clock skew) replace the configuration's values.
    ///
    /// # Errors
    /// [`WorldError`] names the invalid value.
    pub fn new(config: &WorldConfig, model: &Model, start_ns: i64) -> Result<Self, WorldError> {
        config.validate()?;
        let it = config.imperfections();
        let mut running = model.clone();
        running.working_point_um = config.neutral_um;
        running.noise = Noise {
            diffusion_um2_per_s: config.diffusion_um2_per_s,
            localisation_um: 0.0,
        };
        let chain = Chain::with_brownian_motion(&running, config.seed)
            .map_err(|error| WorldError::Model(error.to_string()))?;
        let renderer = renderer(config)?;
        let localisation_um = match config.localisation_um {
            Some(um) => um,
            None => localisation_bound_um(config).ok_or(WorldError::Value {
                key: "contrast_grey",
                value: config.contrast_grey,
                must: "different from 0, or `localisation_um` given",
            })?,
        };
        let pixel_variance = config.background_grey / config.electrons_per_grey
            + config.read_noise_grey * config.read_noise_grey
            + 1.0 / 12.0;
        Ok(Self {
            camera: Camera::new(config, model, start_ns),
            offset_um: config.start_um - chain.bead_um(),
            chain,
            partner: None,
            zero_flow: ZeroFlow::new(config),
            focus: Wander::new(
                it.focus_wander,
                it.focus_time_s,
                Random::stream(config.seed, 32),
            ),
            defocus: 0.0,
            sin_cos: it.tilt_deg.to_radians().sin_cos(),
            most_lateral_um: it.lateral_um,
            zero_flow_um: 0.0,
            renderer,
            start_ns,
            now_ns: start_ns,
            lateral_um: 0.0,
            second_um: None,
            stuck_um: None,
            stands_um: None,
            brownian: Random::stream(config.seed, 1),
            localisation: Random::stream(config.seed, 2),
            localisation_um,
            snr: config.contrast_grey.abs() / pixel_variance.sqrt(),
            out_since_ns: None,
            shown: model
                .ordered_effects()
                .into_iter()
                .filter_map(|e| match e.act() {
                    Action::Show(mut shown) => {
                        shown.seed(config.seed ^ 0xd1b5_4a32_d192_ed03);
                        Some(shown)
                    }
                    _ => None,
                })
                .collect(),
            led: false,
            has_events: !config.faults.event.is_empty(),
            cell: config.cell.map(|cell| Cell::new(cell, config.seed)),
            newest_picture: Vec::new(),
            newest_position: None,
            config: config.clone(),
        })
    }

    /// The configuration it was made from.
    pub fn config(&self) -> &WorldConfig {
        &self.config
    }

    /// Time up to which the world has been advanced, ns.
    pub fn now_ns(&self) -> i64 {
        self.now_ns
    }

    /// True bead position along the channel now, um.
    pub fn bead_um(&self) -> f64 {
        self.stuck_um
            .unwrap_or(self.chain.bead_um() + self.offset_um)
    }

    /// True length of the cell now, um; `None` for a bead.
    pub fn length_um(&self) -> Option<f64> {
        self.cell.as_ref().map(Cell::length_um)
    }

    /// True bead position across the channel now, um from the middle line of the frame.
    pub fn lateral_um(&self) -> f64 {
        self.lateral_um
    }

    /// True PZT displacement now, um.
    pub fn pzt_um(&self) -> f64 {
        self.chain.pzt_um()
    }

    /// True zero flow now, um: the displacement at which the wandering, drifting and stepping flow is zero. It does not include the
    /// steady flow of [`WorldConfig::drift_um_per_s`].
    pub fn zero_flow_um(&self) -> f64 {
        self.config.neutral_um + self.zero_flow_um
    }

    /// Standard deviation of positions delivered without pictures, um RMS.
    pub fn localisation_um(&self) -> f64 {
        self.localisation_um
    }

    fn is_in_frame(&self, x_um: f64, length_um: Option<f64>) -> bool {
        x_um.abs() < self.config.half_frame_um() + self.config.half_length_um(length_um)
    }

    /// Frames of the empty channel of the same rig, rows contiguous, one byte per pixel. Their noise is separate, so they change
    /// nothing in a world with the same seed.
    ///
    /// # Errors
    /// [`WorldError`] names the invalid value.
    pub fn empty_frames(config: &WorldConfig, count: usize) -> Result<Vec<Vec<u8>>, WorldError> {
        config.validate()?;
        let other = WorldConfig {
            seed: config.seed ^ EMPTY_SEED,
            ..config.clone()
        };
        let mut renderer = renderer(&other)?;
        let draw = |_| {
            let mut pixels = Vec::new();
            renderer.draw(&[], 0.0, &mut pixels);
            pixels
        };
        Ok((0..count).map(draw).collect())
    }

    /// Advances to `t_ns` with the board's output at `applied_um`; does nothing for a past time.
    ///
    /// A new output takes effect at the world's present time. So advance to the instant of the change with the old output, then continue
    /// with the new one.
    pub fn advance_to(&mut self, t_ns: i64, applied_um: f64) {
        loop {
            let sample_ns = self.camera.next_sample_ns();
            if sample_ns > t_ns {
                break;
            }
            self.step_to(sample_ns, applied_um);
            let sample = self.look();
            if self.camera.sample(sample) {
                self.defocus = self.focus.advance(1.0 / self.config.rate_hz);
                self.after_frame();
            }
        }
        self.step_to(t_ns, applied_um);
    }

    fn active(&self, kind: FaultKind) -> bool {
        self.has_events && self.config.faults.active(kind, self.now_ns - self.start_ns)
    }

    fn step_to(&mut self, t_ns: i64, applied_um: f64) {
        if t_ns <= self.now_ns {
            return;
        }
        let dt_s = (t_ns - self.now_ns) as f64 * 1e-9;
        let before_um = self.chain.bead_um();
        let at_um = self.bead_um();
        let stepped = self.active(FaultKind::FlowStep);
        self.zero_flow_um = self.zero_flow.advance(dt_s, stepped);
        let partner_um = self.partner.as_mut().map_or(0.0, |p| p.advance(dt_s));
        self.chain.set_beside_um(partner_um - self.zero_flow_um);
        self.stands_um = if self.active(FaultKind::HoldZeroFlow) {
            self.stands_um.or(Some(self.zero_flow_um()))
        } else {
            None
        };
        let reached_um = (self.stands_um).unwrap_or_else(|| self.reached_um(applied_um));
        self.chain.advance(reached_um, dt_s);
        if let Some(cell) = &mut self.cell {
            self.offset_um += cell.surplus_um(at_um, self.chain.bead_um() - before_um);
            cell.advance(at_um, dt_s);
        }
        if self.stands_um.is_none() {
            self.offset_um += self.config.drift_um_per_s * dt_s;
        }
        let spread_um = (2.0 * self.config.diffusion_um2_per_s * dt_s).sqrt();
        self.lateral_um = confined(
            self.lateral_um + spread_um * self.brownian.normal(),
            self.most_lateral_um,
        );
        self.now_ns = t_ns;
        if self.has_events {
            self.follow_events(spread_um);
        }
    }

    /// Output of the amplifier for the board's output, um.
    fn reached_um(&self, applied_um: f64) -> f64 {
        let flipped_um = if self.active(FaultKind::GainFlip) {
            2.0 * self.config.neutral_um - applied_um
        } else {
            applied_um
        };
        if self.active(FaultKind::ClipAmplifier) {
            flipped_um.min(self.config.faults.clip_um)
        } else {
            flipped_um
        }
    }

    fn follow_events(&mut self, spread_um: f64) {
        self.second_um = if self.active(FaultKind::SecondBead) {
            let start_um = (self.config.faults.second_bead_um, 0.0);
            Some(second_bead::diffuse(
                self.second_um.unwrap_or(start_um),
                self.lateral_um,
                spread_um,
                (2.0 * self.config.bead_radius_um, self.most_lateral_um),
                &mut self.brownian,
            ))
        } else {
            None
        };
        match (self.active(FaultKind::StickBead), self.stuck_um) {
            (true, None) => self.stuck_um = Some(self.bead_um()),
            (false, Some(stuck_um)) => {
                self.offset_um = stuck_um - self.chain.bead_um();
                self.stuck_um = None;
            }
            _ => {}
        }
    }

    fn look(&mut self) -> Sample {
        let true_um = self.bead_um();
        let seen_um = self.apparent_um(true_um);
        let second_um = self
            .second_um
            .map(|(along, across)| (self.apparent_um(true_um + along), across));
        Sample {
            length_um: self.length_um().unwrap_or(f64::NAN),
            true_um,
            lateral_um: self.lateral_um,
            seen_um,
            second_um,
            defocus: self.defocus,
            visible: !self.active(FaultKind::LoseBead),
            lit: self.led,
        }
    }

    /// Position at which the camera sees an object at `x_um`: the model's effects on light and table.
    fn apparent_um(&mut self, x_um: f64) -> f64 {
        let t_s = (self.now_ns - self.start_ns) as f64 * 1e-9;
        let mut seen_um = x_um;
        for shown in &mut self.shown {
            seen_um = shown.show(seen_um, t_s);
        }
        seen_um
    }

    fn after_frame(&mut self) {
        let bead_um = self.bead_um();
        let Some(after_ms) = self.config.new_bead_after_ms else {
            return;
        };
        if self.is_in_frame(bead_um, self.length_um()) {
            self.out_since_ns = None;
            return;
        }
        let since_ns = *self.out_since_ns.get_or_insert(self.now_ns);
        // The liquid carries the beads: the next one comes in upstream. Where it would take more than five hundred exposures to cross the
        // frame, it is put into the middle.
        let flow_um_per_s = self.chain.flow_um_per_s() + self.config.drift_um_per_s;
        let field_um = f64::from(self.config.width_px) * self.config.pixel_um;
        let slow = flow_um_per_s.abs() < 0.002 * field_um * self.config.rate_hz;
        if (self.now_ns - since_ns) as f64 * 1e-6 >= after_ms {
            let upstream_um = -self.config.half_frame_um().copysign(flow_um_per_s);
            self.offset_um = if slow { 0.0 } else { upstream_um } - self.chain.bead_um();
            self.out_since_ns = None;
        }
    }

    /// Switches the LED in front of the camera, from now on.
    pub fn set_led(&mut self, on: bool) {
        self.led = on;
    }

    /// Delivery time of the next frame that is already exposed, ns. Later exposures are delivered later, unless frames are reordered.
    pub fn next_delivery_ns(&self) -> Option<i64> {
        self.camera.next_delivery_ns()
    }

    /// Draws the next frame that has been delivered by now into `pixels` (rows contiguous, one byte per pixel).
    pub fn take_frame(&mut self, pixels: &mut Vec<u8>) -> Option<FrameInfo> {
        let (exposure, info) = self.camera.take(self.now_ns)?;
        if exposure.frozen && !self.newest_picture.is_empty() {
            pixels.clone_from(&self.newest_picture);
            return Some(info);
        }
        let (sin, cos) = self.sin_cos;
        let px = |(along_um, across_um): (f64, f64)| {
            let (x_um, y_um) = (
                along_um * cos - across_um * sin,
                along_um * sin + across_um * cos,
            );
            (
                self.config.px_from_um(x_um),
                self.config.origin_y_px() + y_um / self.config.pixel_um,
            )
        };
        let defocus = exposure.defocus();
        let path = exposure.samples.map(|s| px((s.seen_um, s.lateral_um)));
        let first = match (self.config.cell, exposure.mid_length_um()) {
            (Some(cell), Some(um)) => self.renderer.cell(&path, um, cell.width_um(um)),
            _ => self.renderer.bead(&path, defocus),
        };
        let second = exposure.second_path().map(|path| match self.config.cell {
            // Another cell, at rest.
            Some(cell) => {
                let path = path.map(px);
                self.renderer.cell(&path, cell.rest_um, cell.rest_um)
            }
            None => self.renderer.bead(&path.map(px), defocus),
        });
        match (exposure.is_visible(), second) {
            (true, None) => self.renderer.draw(&[first], info.lit, pixels),
            (true, Some(second)) => self.renderer.draw(&[first, second], info.lit, pixels),
            (false, Some(second)) => self.renderer.draw(&[second], info.lit, pixels),
            (false, None) => self.renderer.draw(&[], info.lit, pixels),
        }
        if self.has_events {
            self.newest_picture.clone_from(pixels);
        }
        Some(info)
    }

    /// The position in the next frame delivered by now, with the noise that its picture would give.
    ///
    /// Frames and positions come from the same queue: take either the one or the other.
    pub fn take_position(&mut self) -> Option<PositionFix> {
        let (exposure, info) = self.camera.take(self.now_ns)?;
        if exposure.frozen
            && let Some(newest) = self.newest_position
        {
            return Some(PositionFix { info, ..newest });
        }
        let path = exposure.samples.map(|s| (s.seen_um, s.lateral_um));
        let (mean_um, _) = mean_between(&path, 0.0, EXPOSURE_STEPS as f64);
        // Drawn for every frame, so that a lost bead does not shift the noise of later ones.
        let noise_um = self.localisation_um * self.localisation.normal();
        let verdict = self.verdict(&exposure, mean_um);
        let good = verdict == FixQuality::Good;
        let or_nan = |value| if good { value } else { f64::NAN };
        let (length_um, area_um2) = match (&mut self.cell, exposure.mid_length_um()) {
            (Some(cell), Some(length_um)) if good => cell.measured(length_um),
            _ => (f64::NAN, f64::NAN),
        };
        let (length_sd_um, area_sd_um2) = match &self.cell {
            Some(cell) if length_um.is_finite() => cell.noise(length_um),
            _ => (f64::NAN, f64::NAN),
        };
        let fix = PositionFix {
            length_um,
            area_um2,
            length_sd_um,
            area_sd_um2,
            info,
            x_um: or_nan(mean_um + noise_um),
            variance_um2: or_nan(self.localisation_um * self.localisation_um),
            snr: self.snr,
            verdict,
        };
        self.newest_position = Some(fix);
        Some(fix)
    }

    fn verdict(&self, exposure: &Exposure, mean_um: f64) -> FixQuality {
        let config = &self.config;
        let length_um = exposure.mid_length_um();
        if !exposure.is_visible() || !self.is_in_frame(mean_um, length_um) {
            return FixQuality::NoSignal;
        }
        let half_um = config.half_length_um(length_um);
        if mean_um.abs() > config.half_frame_um() - half_um {
            return FixQuality::AtBorder;
        }
        let other_um = config.half_length_um(config.cell.map(|cell| cell.rest_um));
        let merged = exposure
            .second_path()
            .is_some_and(|path| (path[0].0 - mean_um).abs() < half_um + other_um);
        if merged {
            FixQuality::BadFit
        } else {
            FixQuality::Good
        }
    }
}

fn renderer(config: &WorldConfig) -> Result<Renderer, WorldError> {
    Renderer::new(config).ok_or(WorldError::Value {
        key: "bead_radius_um",
        value: config.bead_radius_um,
        must: "above 0 um",
    })
}
