//! An identification on the rig of a rig.toml, through the same loop, threads and safe states as `cellpos track`. The bead is
//! held at 0 um and the excitation is added to the command.
//!
//! If the bead is lost, the loop freezes and thaws by its own rules, and the segment is measured again.

use crate::experiment::camera_rate::{InPeriods, foreign_rate_hz, other_rate};
use crate::experiment::exciting::Handing;
use crate::experiment::identify::held_bead::Setup;
use crate::experiment::identify::led::{DelayTest, dithered_trips, switch};
use crate::experiment::rows::{Delivered, Rows, ended_spans, fix_noise_um};
use cellpos_control::{ControllerFile, Pi};
use cellpos_emulator::WorldConfig;
use cellpos_ident::delay::dithered_edges;
use cellpos_ident::excitation::ExcitationLimits as ShapeLimits;
use cellpos_ident::experiment::{Plan, RecordedSegment, Span, Turn};
use cellpos_ident::identifiability::NOT_ACCOUNTED_S;
use cellpos_numeric::statistics::quantiles;
use cellpos_plant::Model;
use cellpos_record::RunWriter;
use cellpos_rig::Clock;
use cellpos_rig::clock::monotonic_ns;
use cellpos_runtime::{EndRule, Request, TickRecord, realtime};
use cellpos_session::rig_file::{ClockKind, Frames, RigFile};
use cellpos_session::setup::{self, Prepared, ReferenceSpec};
use cellpos_session::view::{Pages, Viewed};
use cellpos_session::{EndKind, Ended, Failure, NotArmed, Options, Rig, connect};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// A rig, and the loop that holds a bead on it.
#[derive(Debug, Clone)]
pub struct OnRig {
    /// The rig.
    pub file: RigFile,
    /// The plant that the controller assumes.
    pub model: Model,
    /// The controller.
    pub controller: ControllerFile,
    /// The clock (an emulated rig may run on either).
    pub clock: ClockKind,
    /// Frames or positions (emulated rig).
    pub frames: Frames,
    /// Do not ask the operating system for real time.
    pub best_effort: bool,
    /// Parent of the run folders; `None`: runs are not kept.
    pub record_in: Option<PathBuf>,
}

/// What board and camera say of themselves.
struct Devices {
    board: String,
    /// As [`Acquired::exposure_s`].
    exposure_s: f64,
    /// As [`Acquired::slew_um_per_s`].
    slew_um_per_s: f64,
}

impl Devices {
    fn of(rig: &Rig, file: &RigFile) -> Self {
        Self {
            board: rig.actuator().name,
            exposure_s: connect::known_exposure_s(file, &rig.source()).unwrap_or(0.0),
            slew_um_per_s: file.limits.slew_um_per_s.min(rig.actuator().slew_um_per_s),
        }
    }
}

/// What a run gave.
pub struct Acquired {
    /// The segments without a long loss of the bead.
    pub records: Vec<RecordedSegment>,
    /// Estimate of neutral at the end, um.
    pub neutral_um: f64,
    /// Mean time from the middle of an exposure to the tick that used it, by the stamps of the frames, s; without frames that a
    /// stall delayed. `None` before the first.
    pub age_s: Option<f64>,
    /// Localisation noise that vision reported, um RMS.
    pub fix_noise_um: Option<f64>,
    /// The whole run since the loop was closed, row by row.
    pub rows: Delivered,
    /// Places in the plan of the segments in which the bead left the view.
    pub out_of_view: Vec<usize>,
    /// Length of an exposure, s; 0 if neither rig file nor camera states it.
    pub exposure_s: f64,
    /// Largest speed of the displacement that the board allows, um/s.
    pub slew_um_per_s: f64,
    /// Why segments are missing, if any are.
    pub trouble: Option<Trouble>,
    /// Folder of the run.
    pub run: Option<String>,
    /// The board, by its own description.
    pub board: String,
}

/// Why segments are missing.
#[derive(Debug, Clone, PartialEq)]
pub enum Trouble {
    /// The run ended early, and a repetition would too until something is done.
    Ended(Ended),
    /// Some lost the bead for long; a repetition may be complete.
    Spoilt {
        /// How many.
        missing: usize,
        /// Of how many.
        of: usize,
        /// The first one, and the reason.
        first: String,
        /// The bead left the view in a segment. Otherwise machine or line stalled, or an operator froze the bead.
        out_of_view: bool,
    },
}

impl Trouble {
    /// What was seen, without the remedy.
    pub fn seen(&self) -> String {
        match self {
            Self::Ended(ended) => ended.seen.clone(),
            Self::Spoilt { .. } => self.to_string(),
        }
    }
}

impl std::fmt::Display for Trouble {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Ended(ended) => ended.fmt(f),
            Self::Spoilt {
                missing, of, first, ..
            } => {
                write!(f, "{missing} of {of} segments were spoilt; {first}")
            }
        }
    }
}

/// Receiver of the progress of a run.
pub struct Listener<'a> {
    /// Ticks so far.
    pub progress: &'a mut (dyn FnMut(usize) + Send),
    /// State after each segment.
    pub segment: &'a mut (dyn FnMut(&Acquired) + Send),
}

impl OnRig {
    /// A rig with a PI for its delay, made for `model`; `clock` left out: virtual where the rig is emulated. A record has a row per frame, so
    /// the loop runs at the rate of a camera that is slower.
    pub fn new(
        mut file: RigFile,
        model: Model,
        clock: Option<ClockKind>,
        frames: Frames,
        best_effort: bool,
    ) -> Result<Self, Failure> {
        let clock = clock.unwrap_or(if file.is_emulated() {
            ClockKind::Virtual
        } else {
            ClockKind::Real
        });
        let model = file.actuator.before(model);
        if let Some(own_us) = file.keep_the_pace_of_its_camera() {
            tracing::warn!(
                "the loop runs at the camera's {:.1} frames/s in this measurement, not at [timing] period_us = {own_us}",
                1.0 / file.frame_s()
            );
        }
        let mut controller = setup::controller("pi", &model, &file.timing, file.frame_s())?;
        // Only the rig's own limits apply: the narrower ones of a controller are for holding, not for an excitation.
        controller.limits = file.limits;
        Ok(Self {
            file,
            model,
            controller,
            clock,
            frames,
            best_effort,
            record_in: None,
        })
    }

    /// Inputs of the excitation's design: expected model, PI and delay of the loop.
    pub fn bench_setup(&self) -> Setup {
        let timing = &self.file.timing;
        let real = !self.file.is_emulated() || self.clock == ClockKind::Real;
        Setup {
            world: WorldConfig {
                rate_hz: 1e6 / timing.period_us,
                latency_ms: timing.camera_delay_ms,
                ..self.file.emulator.clone()
            },
            model: self.model.clone(),
            frames: self.frames == Frames::On,
            clock: if real {
                Clock::Real
            } else {
                Clock::virtual_at(0)
            },
            closed_loop: true,
            pi: Some(Pi::new(
                self.controller.pi.kp_um_per_um,
                self.controller.pi.ki_per_s,
            )),
            two_lags: self.file.actuator.period_ms().is_some(),
        }
    }

    /// The bead's amplitude for an excitation, um: at most `wanted_um`, and half of the way to where the nearer border cuts its image.
    /// A plant of twice the model's gain then still keeps the bead in the picture; one of more is measured more gently after a second failure.
    ///
    /// # Errors
    /// Those of [`RigFile::whole_bead_um`].
    pub fn bead_amplitude_um(&self, wanted_um: f64) -> Result<f64, Failure> {
        let [low_um, high_um] = self.file.whole_bead_um()?;
        let half_um = 0.5 * high_um.min(-low_um);
        // Holding a bead at a target outside the picture has a separate error.
        Ok(if half_um > 0.0 {
            wanted_um.min(half_um)
        } else {
            wanted_um
        })
    }

    /// Amplitudes that keep the bead in view, its image sharp and the board within its slew.
    pub fn limits(&self, bead_um: f64, bead_um_per_s: f64, pzt_um: f64) -> ShapeLimits {
        // The board follows a step within its first update of 0.1 ms if the slew permits (4 um at 40 um/ms). A larger step would
        // take longer and distort the excitation. A fifth is reserved for the loop that holds the bead.
        ShapeLimits {
            bead_um,
            bead_um_per_s,
            pzt_um,
            slew_um_per_s: 0.08 * self.file.limits.slew_um_per_s.min(40_000.0),
        }
    }

    /// How the rig is used.
    pub fn options(&self) -> Options {
        Options {
            clock: self.clock,
            frames: self.frames,
            best_effort: self.best_effort,
        }
    }

    /// Runs the segments `todo` of a plan once.
    ///
    /// # Errors
    /// The rig could not be set up or armed. A run that ended early is not an error: see [`Acquired::trouble`].
    pub fn acquire(
        &self,
        plan: &Plan,
        todo: &[Turn],
        listener: &mut Listener<'_>,
    ) -> Result<Acquired, Failure> {
        self.acquire_shown(plan, todo, listener, None)
    }

    /// The same, shown on a live page.
    ///
    /// # Errors
    /// As [`OnRig::acquire`]; a page that cannot be served.
    pub fn acquire_shown(
        &self,
        plan: &Plan,
        todo: &[Turn],
        listener: &mut Listener<'_>,
        pages: Option<&mut Pages>,
    ) -> Result<Acquired, Failure> {
        /// Interval between two checks of the ticks.
        const LOOK_EVERY: Duration = Duration::from_millis(100);
        let schedule = plan.schedule(todo);
        // This measures the PZT: a slow partner stays parked.
        let mut file = self.file.clone();
        file.partner = None;
        let mut rig = Rig::open(file, self.options())?;
        let devices = Devices::of(&rig, &self.file);
        let mut prepared = Prepared {
            model: self.model.clone(),
            controller: self.controller,
        };
        rig.fit(&mut prepared);
        let excitation = ReferenceSpec::Excitation {
            plan: plan.clone(),
            todo: todo.to_vec(),
        };
        let setup = rig.set_up(prepared, excitation)?;
        let core = setup.core()?;
        let writer = self.writer(&rig, &setup)?;
        let (sender, received) = std::sync::mpsc::channel();
        let period_ns = self.file.timing.period_ns();
        let mut in_periods = InPeriods::of(rig.source().rate_hz, period_ns);
        let mut counted = move |tick| match &mut in_periods {
            Some(periods) => periods.count(tick),
            None => tick,
        };
        let mut view = match pages {
            Some(pages) => pages.next(&mut rig, &setup)?,
            None => None,
        };
        let period_s = 1e-9 * period_ns as f64;
        let handing = Handing::new(writer, sender, &schedule.spans, period_s);
        let sink = Viewed::new(handing, view.as_deref_mut());
        let armed = rig.arm(&setup, core, sink, EndRule::default());
        let armed = armed.map_err(unarmed)?;
        let running = armed.moving_the_bead().start()?;
        let operator = Arc::clone(running.operator());
        let mut ticks: Vec<TickRecord> = Vec::new();
        let mut ended = 0;
        let finished = running.wait_with(LOOK_EVERY, || {
            ticks.extend(received.try_iter().map(&mut counted));
            (listener.progress)(ticks.len());
            if foreign_rate_hz(&ticks, period_ns).is_some() {
                // Detected after a second; the record is useless.
                operator.ask(Request::Park);
                return;
            }
            let now = ended_spans(&ticks, &schedule.spans);
            if now > ended {
                ended = now;
                (listener.segment)(&self.acquired(&ticks, plan, &schedule.spans, &devices));
            }
        })?;
        let over = matches!(
            finished.ended.kind,
            EndKind::ReferenceOver | EndKind::NotKept
        );
        let outcome = if over {
            "done"
        } else {
            finished.summary.state.name()
        };
        let (mut summary, conditions) = (finished.summary, finished.conditions);
        let writer = finished.sink.give_back(view).into_writer();
        let run = writer.map(|writer| {
            let mut warnings = Vec::new();
            let kept = connect::finish(
                writer,
                (outcome, &finished.ended),
                &mut summary,
                &conditions,
                &mut warnings,
            );
            for warning in warnings {
                tracing::warn!("{warning}");
            }
            kept.run
        });
        ticks.extend(received.try_iter().map(&mut counted));
        if let Some(rate_hz) = foreign_rate_hz(&ticks, period_ns) {
            return Err(other_rate(rate_hz, period_ns));
        }
        let mut acquired = self.acquired(&ticks, plan, &schedule.spans, &devices);
        acquired.run = run;
        let (done, of) = (acquired.records.len(), schedule.spans.len());
        acquired.trouble = if done == of {
            None
        } else if over {
            Some(Trouble::Spoilt {
                missing: of - done,
                of,
                first: self.first_spoilt(&ticks, plan, &schedule.spans),
                out_of_view: !acquired.out_of_view.is_empty(),
            })
        } else {
            Some(Trouble::Ended(finished.ended))
        };
        Ok(acquired)
    }

    /// The run folder, if one is wanted.
    fn writer(&self, rig: &Rig, setup: &setup::Setup) -> Result<Option<RunWriter>, Failure> {
        let Some(root) = &self.record_in else {
            return Ok(None);
        };
        let meta = connect::meta("identify-run", self.clock, &[], setup, rig)?;
        let writer = RunWriter::create(root, meta).map_err(Failure::input)?;
        Ok(Some(writer))
    }

    /// The result of the ticks so far.
    fn acquired(
        &self,
        ticks: &[TickRecord],
        plan: &Plan,
        spans: &[Span],
        devices: &Devices,
    ) -> Acquired {
        let rows = self.rows(ticks);
        let (mut records, mut out_of_view) = (Vec::new(), Vec::new());
        for span in spans {
            match rows.segment(span, plan.lost_frames) {
                Ok(record) => records.push(record),
                Err(spoilt) if spoilt.is_out_of_view() => out_of_view.push(span.index),
                Err(_) => {}
            }
        }
        Acquired {
            records,
            neutral_um: ticks
                .last()
                .map_or(self.file.first_neutral_um, |t| t.neutral_um),
            age_s: rows.age_s(),
            fix_noise_um: fix_noise_um(ticks),
            rows: rows.delivered(),
            out_of_view,
            exposure_s: devices.exposure_s,
            slew_um_per_s: devices.slew_um_per_s,
            trouble: None,
            run: None,
            board: devices.board.clone(),
        }
    }

    fn rows(&self, ticks: &[TickRecord]) -> Rows {
        Rows::of(ticks, self.file.timing.period_ns())
    }

    /// The first invalid segment, and the reason.
    fn first_spoilt(&self, ticks: &[TickRecord], plan: &Plan, spans: &[Span]) -> String {
        let rows = self.rows(ticks);
        let first = spans.iter().find_map(|span| {
            let spoilt = rows.segment(span, plan.lost_frames).err()?;
            let label = &plan.segments.get(span.index)?.label;
            let (number, why) = (span.index + 1, spoilt.words(plan.period_s));
            Some(format!("segment {number} ({label}): {why}"))
        });
        first.unwrap_or_default()
    }

    /// The LED test on a rig with a real board, which switches its LED at dithered instants in front of the camera.
    pub fn delay_test(&self, edges: usize, seed: u64) -> Result<DelayTest, Failure> {
        // An LED that is switched later than a command counts for the delay.
        let request = match self.best_effort {
            true => realtime::Request::best_effort(),
            false => realtime::Request::like_control(),
        };
        realtime::with(&request, || self.switched(edges, seed))
    }

    fn switched(&self, edges: usize, seed: u64) -> Result<DelayTest, Failure> {
        const APART_S: f64 = 0.011;
        let (mut camera, mut board) = self.file.open_for_led()?;
        let trips_s = dithered_trips(&mut board, seed)?;
        let seconds = |ns: i64| ns as f64 * 1e-9;
        let start_ns = monotonic_ns();
        let period_s = self.file.timing.period_us * 1e-6;
        let edges_s = dithered_edges(edges, APART_S, period_s, seconds(start_ns) + 0.1, seed);
        let end_ns = start_ns + ((0.2 + APART_S * edges as f64) * 1e9) as i64;
        let led = |on| board.led(on).map_err(Failure::failed);
        let (switched_s, seen) = switch(camera.as_mut(), led, &edges_s, end_ns)?;
        board.led(false).map_err(Failure::failed)?;
        let mut test = DelayTest::evaluate(switched_s, seen)?;
        // Pings come at any time, as the edges do, and wait for the board's next step. The commands of a loop come at one place in it: they
        // may wait for as little as the fastest pings, or for as much more than usual.
        let [least_s, usual_s] = quantiles(&trips_s, [0.05, 0.5]);
        // Without a trip the difference is NaN, and `max` gives the other number.
        test.estimate.not_accounted_s += (usual_s - least_s).max(NOT_ACCOUNTED_S);
        test.line_s = usual_s.is_finite().then_some(0.5 * usual_s);
        Ok(test)
    }
}

/// Ends the folder, and the page, of a run that was not armed.
fn unarmed(not_armed: Box<NotArmed<Viewed<Handing>>>) -> Failure {
    let NotArmed { sink, failure, .. } = *not_armed;
    if let Some(writer) = sink.refused(&failure).into_writer() {
        connect::not_armed(writer, &failure);
    }
    failure
}
