//! The states of a rig as types: [`Rig`] -> [`Armed`] -> [`Running`] -> [`Finished`].

use crate::clues::Clues;
use crate::devices::{Devices, Options, check_armed, session_number};
use crate::ended::{Ended, Expected};
use crate::failure::Failure;
use crate::fit;
use crate::fit::diffusion_um2_per_s;
use crate::frames_seen::FramesSeen;
use crate::real_time::LockedMemory;
use crate::rig_file::{ClockKind, Connected, RigFile};
use crate::running;
use crate::setup::{Prepared, ReferenceSpec, Setup, SetupConfig};
use crate::signals::{self, Place};
use crate::witness::Witness;
use cellpos_control::{LearnedTable, Limits, PartnerConfig};
use cellpos_plant::Model;
use cellpos_rig::{
    Actuator, ActuatorInfo, ArmRequest, Clock, FrameWatch, PositionSource, SourceInfo,
};
use cellpos_runtime::live::{Operator, Threads};
use cellpos_runtime::realtime::{Conditions, Request};
use cellpos_runtime::recorder::RecorderReport;
use cellpos_runtime::{
    Core, EndRule, Hold, ReferenceGenerator, RunError, RunSink, Statistics, Summary, live,
    virtual_run,
};
use std::sync::Arc;
use std::time::Duration;

/// A rig that is connected and not armed: the PZT is at park or on its way there.
pub struct Rig {
    file: RigFile,
    options: Options,
    devices: Devices,
    operator: Arc<Operator>,
    /// Whether nothing was armed on it yet.
    fresh: bool,
}

impl Rig {
    /// Connects camera and board. Nothing moves.
    ///
    /// # Errors
    /// An invalid value in the rig file, or a device that does not answer.
    pub fn open(file: RigFile, options: Options) -> Result<Self, Failure> {
        let connected = file.connect(options.clock, options.frames)?;
        Ok(Self::of(file, options, connected))
    }

    /// A rig of devices that no rig file describes: any stream of positions, any actuator. From `file` it takes the loop's part:
    /// limits, times, arming. The positions are stamped by `clock`; if it is virtual, no device may wait for the machine's clock.
    ///
    /// # Errors
    /// Never in practice: the nominal model is built in.
    pub fn with_devices(
        file: RigFile,
        options: Options,
        source: Box<dyn PositionSource>,
        actuator: Box<dyn Actuator>,
        clock: Clock,
    ) -> Result<Self, Failure> {
        let connected = Connected::of(source, actuator, clock)?;
        Ok(Self::of(file, options, connected))
    }

    fn of(file: RigFile, options: Options, connected: Connected) -> Self {
        Self {
            file,
            options,
            devices: Devices {
                connected,
                armed: false,
            },
            operator: Arc::default(),
            fresh: true,
        }
    }

    /// The rig's file.
    pub fn file(&self) -> &RigFile {
        &self.file
    }

    /// How it is used.
    pub fn options(&self) -> Options {
        self.options
    }

    /// Its clock.
    pub fn clock(&self) -> &Clock {
        &self.devices.connected.clock
    }

    /// Description of the board.
    pub fn actuator(&self) -> ActuatorInfo {
        self.devices.connected.actuator.info()
    }

    /// Description of the camera.
    pub fn source(&self) -> SourceInfo {
        self.devices.connected.source.info()
    }

    /// Shows each new frame to `watch` from now on; `false` if the rig has no frames.
    pub fn watch(&mut self, watch: Box<dyn FrameWatch>) -> bool {
        self.devices.connected.source.watch(watch)
    }

    /// Measures rate and age of the frames for `span_ns`. Call it before the rig is armed.
    ///
    /// # Errors
    /// The camera delivers nothing more.
    pub fn look(&mut self, span_ns: i64) -> Result<FramesSeen, Failure> {
        let connected = &mut self.devices.connected;
        let request = match self.options.best_effort {
            true => Request::best_effort(),
            false => Request::like_control(),
        };
        FramesSeen::of(
            connected.source.as_mut(),
            &connected.clock,
            span_ns,
            &request,
        )
    }

    /// The handle that requests freeze, park and pause of the next run on this rig.
    pub fn operator(&self) -> &Arc<Operator> {
        &self.operator
    }

    /// Warnings about it.
    pub fn warnings(&self) -> &[String] {
        &self.devices.connected.warnings
    }

    /// Model and controller by their options (`eq6` or a path; `pi`, `lead`, `lqg`, `mpc` or a path), fitted to this rig as
    /// [`Rig::fit`] does.
    ///
    /// # Errors
    /// No such model or controller, or one made for another delay.
    pub fn prepare(&self, model: &str, controller: &str) -> Result<Prepared, Failure> {
        let mut prepared = fit::prepare(model, controller, &self.file)?;
        self.fit(&mut prepared);
        Ok(prepared)
    }

    /// Narrows a controller's limits to those of rig file and board, and its planned positions to the field of view. Passes the
    /// exposure to the estimator and the plant to the tracker.
    pub fn fit(&self, prepared: &mut Prepared) {
        self.devices.connected.expect(&prepared.model);
        fit::narrow(prepared, &self.file, &self.devices.connected);
    }

    /// Completes the set-up with the PZT's displacement. If the PZT is still moving to park, it waits at most ten seconds.
    ///
    /// # Errors
    /// The board cannot be read, or the PZT does not come to rest.
    pub fn set_up(
        &mut self,
        prepared: Prepared,
        reference: ReferenceSpec,
    ) -> Result<Setup, Failure> {
        let disagrees = crate::setup::model_delay_warning(&prepared.model, &self.file.timing);
        self.devices.connected.warnings.extend(disagrees);
        let partner = self.partner(&prepared.controller.limits)?;
        Ok(Setup {
            config: SetupConfig {
                partner,
                displacement_um: self
                    .standing_um()?
                    .unwrap_or(prepared.controller.limits.park_um),
                neutral_um: self.first_zero_flow_um(&prepared.model),
                reference,
                timing: self.file.timing,
                watchdog_ms: self.watchdog_ms(),
                arming: self.file.arming,
                learn: None,
                motions: Vec::new(),
            },
            model: prepared.model,
            controller: prepared.controller,
        })
    }

    /// Zero flow at which a run with this model begins, um.
    pub fn first_zero_flow_um(&self, model: &Model) -> f64 {
        fit::first_zero_flow_um(&self.file, model, &self.actuator().name)
    }

    /// Silence after which the board is asked to hold, ms.
    fn watchdog_ms(&self) -> u16 {
        let [asked, _] = self.file.watchdogs_ms();
        asked.unwrap_or_else(|| self.file.timing.board_watchdog_ms())
    }

    /// The slow partner as the loop knows it, for a PZT with these limits.
    fn partner(&self, limits: &Limits) -> Result<Option<PartnerConfig>, Failure> {
        let Some(table) = &self.file.partner else {
            return Ok(None);
        };
        let info = self.devices.connected.actuator.partner_info();
        let step_um = info.map_or(0.0, |info| info.step_um);
        let config = table
            .config(limits)
            .map(|config| PartnerConfig { step_um, ..config });
        config.map(Some).ok_or_else(|| {
            Failure::bad_input(
                "[partner] gain is missing: the slow actuator's effect on the flow is not known",
                "measure it: cellpos rig partner RIG --write; or leave the table [partner] out to run the PZT alone",
            )
        })
    }

    /// Displacement of the PZT, um; `None` if the board reports nothing before it is armed (it is then at park).
    fn standing_um(&mut self) -> Result<Option<f64>, Failure> {
        const PATIENCE: Duration = Duration::from_secs(10);
        const SILENCE: Duration = Duration::from_millis(300);
        const LOOK_EVERY: Duration = Duration::from_millis(15);
        let connected = &mut self.devices.connected;
        let mut last: Option<f64> = None;
        let start_ns = connected.clock.now_ns();
        loop {
            let report = connected.actuator.poll().map_err(Failure::failed)?;
            if let Some(report) = report {
                // A device that was just switched on in this process has not moved yet.
                let still = self.fresh && connected.clock.is_virtual();
                if still || last == Some(report.applied_um) {
                    return Ok(Some(report.applied_um));
                }
                last = Some(report.applied_um);
            }
            let waited = Duration::from_nanos((connected.clock.now_ns() - start_ns).max(0) as u64);
            if last.is_none() && waited > SILENCE {
                return Ok(None);
            }
            if waited > PATIENCE {
                return Err(Failure::bad_input(
                    format!(
                        "the PZT does not come to rest: it is at {:.3} um and still moving after {} s",
                        last.unwrap_or(f64::NAN),
                        PATIENCE.as_secs()
                    ),
                    "does another program use the board?",
                ));
            }
            connected.clock.sleep(LOOK_EVERY);
        }
    }

    /// Arms the board: the last thing before the loop runs, when folder, script, loop and recorder are ready. On failure the sink
    /// is returned, so that its content is not lost.
    ///
    /// # Errors
    /// A stop was requested, the board refused, or its state or displacement is wrong. It is disarmed again.
    pub fn arm<R, S>(
        mut self,
        setup: &Setup,
        core: Core<R>,
        sink: S,
        end: EndRule,
    ) -> Result<Armed<R, S>, Box<NotArmed<S>>> {
        let timing = &setup.config.timing;
        let hold = Hold::new(
            diffusion_um2_per_s(&self.file, &setup.model),
            timing.camera_delay_ms * 1e-3,
            timing.period_us * 1e-6,
        );
        let cell = self.file.follows_a_cell();
        match self.try_arm(setup) {
            Ok((place, memory)) => Ok(Armed {
                rig: self,
                core,
                sink,
                end,
                statistics: Statistics::default().holding(hold),
                expected: Expected {
                    timing: setup.config.timing,
                    arming: setup.config.arming,
                    cell,
                },
                _memory: memory,
                _place: place,
            }),
            Err(failure) => Err(Box::new(NotArmed {
                failure,
                sink,
                rig: self,
            })),
        }
    }

    fn try_arm(&mut self, setup: &Setup) -> Result<(Place, Option<LockedMemory>), Failure> {
        let memory = match self.options {
            Options {
                best_effort: false,
                clock: ClockKind::Real,
                ..
            } => LockedMemory::lock(),
            _ => None,
        };
        let place = signals::hold(&self.operator).map_err(Failure::failed)?;
        let limits = setup.controller.limits;
        let own = self.actuator();
        let id = if self.clock().is_virtual() {
            1
        } else {
            session_number()
        };
        let [_, hold_watchdog_ms] = self.file.watchdogs_ms();
        let session = ArmRequest {
            session: id,
            park_um: limits.park_um,
            // Use the rig's own slew limit. A controller may have a smaller one from tick to tick, but the PZT should reach each
            // command as early in the tick as the rig allows.
            limits: [
                limits.low_um,
                limits.high_um,
                self.file.limits.slew_um_per_s.min(own.slew_um_per_s),
            ],
            watchdog_ms: Some(setup.config.watchdog_ms),
            hold_watchdog_ms,
        };
        self.fresh = false;
        let expected_um = setup.config.displacement_um;
        if let Err(failure) = self.arm_board(&session, expected_um, own.step_um) {
            // While this is held, no signal ends the program before the board is parked.
            self.devices.disarm();
            return Err(failure);
        }
        Ok((place, memory))
    }

    fn arm_board(
        &mut self,
        request: &ArmRequest,
        expected_um: f64,
        step_um: f64,
    ) -> Result<(), Failure> {
        // From here on the board may be armed, whatever its answer.
        self.devices.armed = true;
        let actuator = self.devices.connected.actuator.as_mut();
        let report = actuator.arm(request).map_err(Failure::failed)?;
        check_armed(&report, request.session, expected_um, step_um)
    }
}

/// Why a rig could not be armed, with everything that was to run on it.
pub struct NotArmed<S> {
    /// Why.
    pub failure: Failure,
    /// The sink.
    pub sink: S,
    /// The rig, disarmed.
    pub rig: Rig,
}

impl<S> From<Box<NotArmed<S>>> for Failure {
    fn from(not_armed: Box<NotArmed<S>>) -> Self {
        not_armed.failure
    }
}

/// A rig whose board is armed and waits for the first command. Dropped, it is parked.
pub struct Armed<R, S> {
    // Fields are dropped in this order: the board is parked before the signals stop reaching it.
    rig: Rig,
    core: Core<R>,
    sink: S,
    end: EndRule,
    statistics: Statistics,
    expected: Expected,
    _memory: Option<LockedMemory>,
    _place: Place,
}

impl<R, S> Armed<R, S>
where
    R: ReferenceGenerator + Send + 'static,
    S: RunSink + 'static,
{
    /// The handle that requests freeze, park and pause.
    pub fn operator(&self) -> &Arc<Operator> {
        &self.rig.operator
    }

    /// The same for an experiment that moves the bead: a large distance from the reference is then not a failure.
    #[must_use]
    pub fn moving_the_bead(self) -> Self {
        Self {
            statistics: Statistics::default(),
            ..self
        }
    }

    /// Starts the loop on its threads.
    ///
    /// # Errors
    /// No thread could be started; the board is parked.
    pub fn start(self) -> Result<Running<S>, Failure> {
        let operator = Arc::clone(&self.rig.operator);
        let thread = std::thread::Builder::new()
            .name("cellpos-board".to_string())
            .spawn(move || self.run())
            .map_err(Failure::failed)?;
        Ok(Running::new(operator, thread))
    }

    /// Runs the loop on its own threads; the calling thread waits for them.
    fn run(self) -> Result<Finished<S>, Failure> {
        // Dropped in reverse order if the driver panics: the rig is parked before the signals stop reaching it.
        let Self {
            _place: place,
            _memory: memory,
            mut rig,
            core,
            sink,
            end,
            statistics,
            expected,
        } = self;
        let sink = Witness {
            sink,
            clues: Clues::default(),
        };
        let operator = std::mem::take(&mut rig.operator);
        let connected = &mut rig.devices.connected;
        let (source, actuator) = (connected.source.as_mut(), connected.actuator.as_mut());
        let finished = if connected.clock.is_virtual() {
            let asked = |_| operator.take();
            let clock = &connected.clock;
            virtual_run::run(core, clock, source, actuator, sink, statistics, end, asked)
        } else {
            let threads = if rig.options.best_effort {
                Threads::best_effort()
            } else {
                Threads::real_time()
            };
            live::run(
                core, source, actuator, sink, statistics, end, &threads, &operator,
            )
        };
        // Freezes and parks again if the driver could not.
        if finished.as_ref().is_ok_and(|run| run.io_error.is_none()) {
            rig.devices.armed = false;
        }
        rig.devices.disarm();
        drop((memory, place));
        let finished = finished.map_err(Failure::of_run)?;
        let Witness { sink, clues } = finished.sink;
        Ok(Finished {
            odd_gain: clues.odd_gain(),
            ended: clues.ended(
                &finished.summary,
                finished.io_error.as_ref(),
                finished.recorder.fault,
                &finished.conditions,
                &expected,
            ),
            rig,
            summary: finished.summary,
            conditions: finished.conditions,
            learned: finished.learned,
            recorder: finished.recorder,
            trouble: finished.io_error,
            sink,
        })
    }
}

/// A running loop and its end.
pub type Running<S> = running::Running<Finished<S>>;

/// A run that is over; the PZT is at park or on its way there.
pub struct Finished<S> {
    /// How it ended, in sentences.
    pub ended: Ended,
    /// The rig, disarmed: it may be armed again.
    pub rig: Rig,
    /// Its figures.
    pub summary: Summary,
    /// Real-time conditions of the control thread.
    pub conditions: Conditions,
    /// The result of learning over cycles, for each periodic motion of the reference; `None` without a learner.
    pub learned: Vec<Option<LearnedTable>>,
    /// How the recording went.
    pub recorder: RecorderReport,
    /// Gain over the model's from the arming pulse, if it was accepted but differs from the model's.
    pub odd_gain: Option<f64>,
    /// Failure of a thread other than control, if any.
    pub trouble: Option<RunError>,
    /// The sink, with all that it received.
    pub sink: S,
}
