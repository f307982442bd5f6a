//! A bead held by PI on the emulated rig, with an excitation, for identification.
//!
//! The path is the rig's own: firmware library, plant, rendered frames, localiser. Each period the newest measurement is
//! taken, the controller steps, the command goes to the board. Afterwards the board's LED is switched at dithered
//! instants in front of the same camera for the delay test.

use super::led::{DelayTest, LitFrames};
use cellpos_control::{
    Controller, ControllerConfig, EstimatorConfig, Limits, LoopConfig, LoopInput, LoopModel,
    Measurement as Fix, Mode, Pi,
};
use cellpos_drivers::{BoardHost, CommandedFlow, FlowTap, VisionSource};
use cellpos_emulator::BoardConfig;
use cellpos_emulator::EmulatedPort;
use cellpos_emulator::EmulatedRig;
use cellpos_emulator::WorldConfig;
use cellpos_ident::delay::dithered_edges;
use cellpos_ident::experiment::{Bench, Row};
use cellpos_ident::sampled::{Hold, Sampling};
use cellpos_plant::{Complex, DiscretePlant, Hertz, Model, Seconds};
use cellpos_rig::ArmRequest;
use cellpos_rig::{Actuator, Camera, Clock, FrameBuffer, Measurement, PositionSource};
use cellpos_session::Failure;
use cellpos_vision::{Localiser, LocaliserConfig, ProfileSpec, Tracker, TrackerConfig};

/// PI gains for the nominal gain of Eq. (6) at a loop delay of 2.5 ms (Ms <= 1.6, Mt <= 1.3), scaled to the model's.
const KP: f64 = 0.46;
const KI_PER_S: f64 = 19.5;
const NOMINAL_GAIN_PER_S: f64 = 428.0;

/// What rig to emulate.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The world, seed included.
    pub world: WorldConfig,
    /// The plant behind it.
    pub model: Model,
    /// Frames through the localiser, or positions with the noise that frames would give.
    pub frames: bool,
    /// Virtual or real.
    pub clock: Clock,
    /// Hold the bead by PI; else the excitation moves the PZT about neutral in open loop.
    pub closed_loop: bool,
    /// The PI; left out: gains for a loop delay of 2.5 ms, scaled to the model's gain.
    pub pi: Option<Pi>,
    /// An actuator with a regulator and a tube moves the bead, not a PZT: the plant may have two lags.
    pub two_lags: bool,
}

impl Setup {
    /// How records of this rig are sampled: 1 kHz hold, the world's exposure.
    pub fn sampling(&self) -> Sampling {
        Sampling {
            period_s: 1.0 / self.world.rate_hz,
            exposure_s: self.world.exposure_ms * 1e-3,
            hold: Hold::ZeroOrder,
        }
    }

    fn pi(&self) -> Pi {
        if let Some(pi) = self.pi {
            return pi;
        }
        let scale = NOMINAL_GAIN_PER_S
            / self
                .model
                .plant
                .velocity_gain_at(Hertz(2.0))
                .abs()
                .max(1e-9);
        Pi::new(KP * scale, KI_PER_S * scale)
    }

    /// Expected `X2/X1` as a record shows it, and loop gain (0 in open loop), at a frequency in Hz.
    pub fn expected(
        &self,
    ) -> Result<impl Fn(f64) -> (Complex<f64>, Complex<f64>) + use<>, Failure> {
        let delay = Seconds(self.world.latency_ms * 1e-3);
        let plant = DiscretePlant::new(&self.model.plant, Seconds(1.0 / self.world.rate_hz), delay)
            .map_err(Failure::input)?;
        let pi = self.pi();
        let closed = f64::from(u8::from(self.closed_loop));
        Ok(move |f: f64| {
            let h = plant.response(Hertz(f));
            let s = Complex::new(0.0, 2.0 * std::f64::consts::PI * f);
            (h, h * (pi.kp + pi.ki_per_s / s) * closed)
        })
    }
}

/// A held bead.
pub struct HeldBead {
    setup: Setup,
    rig: EmulatedRig,
    source: Option<Box<dyn PositionSource>>,
    board: FlowTap<BoardHost<EmulatedPort>>,
    controller: Controller,
    next_ns: i64,
    period_ns: i64,
    start_ns: i64,
    neutral_um: f64,
    /// Sum and number of the variances that vision reported, um^2.
    variance_um2: (f64, u64),
    /// Sum and number of the ages of frames at their ticks, ns.
    ages: (i64, i64),
}

impl HeldBead {
    /// Localisation noise that vision reported so far, um RMS.
    pub fn fix_noise_um(&self) -> Option<f64> {
        let (sum, count) = self.variance_um2;
        (count > 0).then(|| (sum / count as f64).max(0.0).sqrt())
    }

    /// Mean time from the middle of an exposure to the tick that used it, s.
    pub fn age_s(&self) -> f64 {
        let (sum_ns, count) = self.ages;
        match count {
            0 => self.setup.world.latency_ms * 1e-3,
            _ => 1e-9 * sum_ns as f64 / count as f64,
        }
    }

    /// Switches the rig on, arms the board and lets the loop settle for half a second.
    pub fn open(setup: Setup) -> Result<Self, Failure> {
        let rig = EmulatedRig::new(
            BoardConfig::default(),
            &setup.world,
            &setup.model,
            setup.clock.clone(),
        )
        .map_err(Failure::input)?;
        let gain_per_s = setup.model.plant.velocity_gain_at(Hertz(2.0));
        let flow = CommandedFlow::new(gain_per_s);
        let board = rig.actuator().map_err(Failure::failed)?;
        let mut board = FlowTap::new(board, flow.clone(), setup.clock.clone());
        let info = board.info();
        let limits = Limits {
            low_um: info.low_um,
            high_um: info.high_um,
            slew_um_per_s: info.slew_um_per_s,
            park_um: 0.0,
        };
        let session = ArmRequest {
            session: 1,
            park_um: limits.park_um,
            limits: [limits.low_um, limits.high_um, limits.slew_um_per_s],
            watchdog_ms: None,
            hold_watchdog_ms: None,
        };
        let report = board.arm(&session).map_err(Failure::failed)?;
        let source: Box<dyn PositionSource> = if setup.frames {
            let edge_px = setup.world.bead_radius_px();
            let localiser = Localiser::new(LocaliserConfig::new(ProfileSpec::Ring { edge_px }))
                .map_err(Failure::input)?;
            let tracking = TrackerConfig::for_pixel_um(setup.world.pixel_um);
            let tracker = Tracker::new(localiser, tracking).map_err(Failure::input)?;
            let source = VisionSource::new(
                rig.camera(),
                tracker,
                rig.calibration(),
                setup.clock.clone(),
            );
            Box::new(source.with_flow(flow))
        } else {
            Box::new(rig.positions())
        };
        let mut controller = Controller::new(LoopConfig {
            model: LoopModel::integrator(gain_per_s, setup.world.latency_ms * 1e-3),
            estimator: EstimatorConfig {
                gain_uncertainty: 0.5,
                ..EstimatorConfig::default()
            },
            controller: ControllerConfig::Pi(setup.pi()),
            limits,
        })
        .map_err(Failure::input)?;
        let neutral_um = report.applied_um;
        controller.start(neutral_um, neutral_um);
        let period_ns = setup.world.period_ns();
        // Ticks coincide with the deliveries of frames, as on a rig, where the arrival of a frame starts the tick.
        let since_ns = setup.clock.now_ns();
        let next_ns = (since_ns / period_ns + 1) * period_ns;
        let mut bead = Self {
            rig,
            source: Some(source),
            board,
            controller,
            next_ns,
            period_ns,
            start_ns: since_ns,
            neutral_um,
            setup,
            variance_um2: (0.0, 0),
            ages: (0, 0),
        };
        for _ in 0..500 {
            bead.tick(0.0)?;
        }
        Ok(bead)
    }

    /// The newest measurement of the frames delivered by `now_ns`.
    fn newest(&mut self, now_ns: i64) -> Result<Option<Measurement>, Failure> {
        let Some(source) = &mut self.source else {
            return Ok(None);
        };
        let mut newest = None;
        while let Some(measurement) = source.next(now_ns).map_err(Failure::failed)? {
            newest = Some(measurement);
        }
        Ok(newest)
    }

    /// Waits for the next frame, at most a quarter of a period beyond its due time, and returns the newest measurement. A tick
    /// starts when a frame arrives, and the camera has its own clock.
    fn arrival(&mut self) -> Result<Option<Measurement>, Failure> {
        let latest_ns = self.next_ns + self.period_ns / 4;
        let first = match &mut self.source {
            Some(source) => source.next(latest_ns).map_err(Failure::failed)?,
            None => None,
        };
        self.next_ns = match &first {
            Some(measurement) => measurement.ready_ns.max(self.next_ns - self.period_ns / 4),
            None => latest_ns,
        };
        self.setup.clock.sleep_until_ns(self.next_ns);
        Ok(self.newest(self.next_ns)?.or(first))
    }

    fn send(&mut self, command_um: f64, neutral_um: f64) -> Result<(), Failure> {
        let time_us = u64::try_from((self.next_ns - self.start_ns) / 1000).unwrap_or(0);
        self.board
            .command(command_um, neutral_um, time_us)
            .map_err(Failure::failed)?;
        self.board.poll().map_err(Failure::failed)?;
        Ok(())
    }

    /// The LED test: `edges` dithered switches of the board's LED, seen in the mean grey level of the frames. The bead is
    /// released; the PZT rests at neutral.
    pub fn delay_test(&mut self, edges: usize, seed: u64) -> Result<DelayTest, Failure> {
        self.source = None;
        let mut camera = self.rig.camera();
        let period_s = self.period_ns as f64 * 1e-9;
        let first_s = self.next_ns as f64 * 1e-9 + 0.02;
        let sent_s = dithered_edges(edges, 0.011, period_s, first_s, seed);
        let end_ns = self.next_ns + ((edges as f64 * 0.011 + 0.06) * 1e9) as i64;
        let mut buffer = FrameBuffer::default();
        let mut seen = LitFrames::default();
        let mut on = false;
        let mut switched_s = Vec::with_capacity(edges);
        let mut waiting = sent_s.iter().map(|s| (s * 1e9).round() as i64).peekable();
        while self.next_ns < end_ns {
            while let Some(&edge_ns) = waiting.peek() {
                if edge_ns >= self.next_ns {
                    break;
                }
                self.setup.clock.sleep_until_ns(edge_ns);
                on = !on;
                switched_s.push(self.setup.clock.now_ns() as f64 * 1e-9);
                self.board.inner_mut().led(on).map_err(Failure::failed)?;
                waiting.next();
            }
            self.setup.clock.sleep_until_ns(self.next_ns);
            while let Some(stamp) = camera
                .next_frame(&mut buffer, self.next_ns)
                .map_err(Failure::failed)?
            {
                seen.push(&stamp, &buffer);
            }
            self.send(self.neutral_um, self.neutral_um)?;
            self.next_ns += self.period_ns;
        }
        DelayTest::evaluate(switched_s, seen)
    }

    /// Rests at neutral until a bead has been seen for 100 ms without a gap, at most for 10 s, then holds it for half a second.
    pub fn wait_for_bead(&mut self) -> Result<(), Failure> {
        let mut seen = 0;
        for _ in 0..10_000 {
            let good = self.arrival()?.is_some_and(|m| m.is_usable());
            self.send(self.neutral_um, self.neutral_um)?;
            self.next_ns += self.period_ns;
            seen = if good { seen + 1 } else { 0 };
            if seen == 100 {
                self.controller.start(self.neutral_um, self.neutral_um);
                for _ in 0..500 {
                    self.tick(0.0)?;
                }
                return Ok(());
            }
        }
        Err(Failure::Failed(miette::miette!(
            "no bead came into view within 10 s"
        )))
    }

    /// Ends the session: the board ramps to park.
    pub fn close(mut self) -> Result<(), Failure> {
        self.board.disarm().map_err(Failure::failed)
    }

    /// What was set up.
    pub fn setup(&self) -> &Setup {
        &self.setup
    }

    /// PZT displacement at which the bead was found at rest, um.
    pub fn neutral_um(&self) -> f64 {
        self.neutral_um
    }
}

impl Bench for HeldBead {
    type Error = Failure;

    fn tick(&mut self, excitation_um: f64) -> Result<Row, Failure> {
        let newest = self.arrival()?;
        let now_ns = self.next_ns;
        let good = newest.filter(Measurement::is_usable);
        if let Some(m) = good.filter(|m| m.variance_um2.is_finite()) {
            self.variance_um2.0 += m.variance_um2;
            self.variance_um2.1 += 1;
        }
        let age_ns = good.map_or(0, |m| now_ns - m.mid_exposure_ns);
        let late_ns = age_ns - (self.setup.world.latency_ms * 1e6).round() as i64;
        let age_samples =
            u16::try_from(((late_ns as f64 / self.period_ns as f64).round() as i64).max(0))
                .unwrap_or(u16::MAX);
        let input = LoopInput {
            measurement: good.map(|m| Fix {
                position_um: m.position_um,
                variance_um2: m.variance_um2,
                age_samples,
                offset_samples: 0.0,
            }),
            mode: if self.setup.closed_loop {
                Mode::Run
            } else {
                Mode::Direct(self.neutral_um + excitation_um)
            },
            excitation_um,
            ..LoopInput::default()
        };
        let out = self.controller.step(&input);
        self.send(out.command_um, out.neutral_um)?;
        self.next_ns += self.period_ns;
        // A row holds a position of the nominal age. An older position belongs to an earlier row and is left out.
        let on_time = good.filter(|_| age_samples == 0);
        if on_time.is_some() {
            self.ages.0 += age_ns;
            self.ages.1 += 1;
        }
        Ok(Row {
            command_um: out.command_um,
            bead_um: on_time.map(|m| m.position_um),
        })
    }
}
