//! An identification on the rig of a rig.toml, through the same loop, threads and safe states as `cellpos track`: the
//! bead is held at 0 um and the excitation is added to the command.
//!
//! The loop freezes and thaws by its own rules when the bead is lost; a segment in which it did is measured again.

use super::bench::{DelayTest, Setup, mean_grey};
use crate::outcome::Failure;
use crate::rig_file::{ClockKind, Frames, RigFile};
use crate::{session, setup};
use cellpos_control::design::DesignPlant;
use cellpos_control::{ControllerFile, Pi};
use cellpos_emulator::WorldConfig;
use cellpos_ident::delay::dithered_edges;
use cellpos_ident::excitation::Limits as ShapeLimits;
use cellpos_ident::experiment::{Plan, RecordedSegment, Span};
use cellpos_plant::Model;
use cellpos_rig::actuator::Session;
use cellpos_rig::clock::monotonic_ns;
use cellpos_rig::{Camera, Clock, FrameBuffer};
use cellpos_runtime::live::Operator;
use cellpos_runtime::{
    Core, EndRule, Event, Guide, GuideInput, GuideOutput, Life, RunSink, Stage, Statistics,
    Summary, TickFlags, TickRecord,
};

/// Ticks at rest between closing the loop and the first segment.
const SETTLE_TICKS: usize = 500;

/// A rig and the loop to hold a bead on it with.
#[derive(Debug, Clone)]
pub struct OnRig {
    /// The rig.
    pub file: RigFile,
    /// The plant that the controller believes in.
    pub model: Model,
    /// The controller.
    pub controller: ControllerFile,
    /// Which clock (an emulated rig may run on either).
    pub clock: ClockKind,
    /// Frames or positions (emulated rig).
    pub frames: Frames,
    /// Do not ask the operating system for real time.
    pub best_effort: bool,
}

/// What a run gave.
pub struct Acquired {
    /// Segments in which the bead was never lost for long.
    pub records: Vec<RecordedSegment>,
    /// Estimate of neutral at the end, um.
    pub neutral_um: f64,
    /// Mean time from the arrival of a frame to its tick, s: part of the record's delay, and not of the camera's.
    pub wait_s: f64,
    /// From the middle of an exposure to the arrival of its frame, by the stamps of the frames, s.
    pub path_s: f64,
    /// The whole run from where the loop was closed, row by row: commanded displacement, um, and bead position, um, NaN
    /// without one.
    pub rows: (Vec<f64>, Vec<f64>),
    /// Its rows whose frame came, but showed no bead to be trusted.
    pub unseen: Vec<bool>,
    /// Why segments are missing, if any are.
    pub trouble: Option<String>,
}

/// Holds the bead at 0 um and plays the excitation, counted from where the loop was closed.
#[derive(Debug)]
struct Exciting {
    excitation_um: Vec<f64>,
    now: Option<usize>,
}

impl Guide for Exciting {
    fn step(&mut self, input: &GuideInput, preview_um: &mut [f64]) -> GuideOutput {
        preview_um.fill(0.0);
        let tick = usize::try_from(input.tick).unwrap_or(usize::MAX);
        self.now = input.running.then_some(tick);
        GuideOutput {
            reference_um: 0.0,
            plan_ns: -1,
            stage: Stage::None,
            phase: None,
            motion: 0,
        }
    }

    fn excitation_um(&self) -> f64 {
        let at = self.now.and_then(|tick| tick.checked_sub(SETTLE_TICKS));
        at.and_then(|k| self.excitation_um.get(k))
            .copied()
            .unwrap_or(0.0)
    }

    fn finished(&self) -> bool {
        self.now
            .is_some_and(|tick| tick >= SETTLE_TICKS + self.excitation_um.len())
    }
}

/// Keeps every tick, and tells how far the excitation is.
struct Keeping<'a> {
    ticks: Vec<TickRecord>,
    progress: &'a mut (dyn FnMut(usize) + Send),
}

impl RunSink for Keeping<'_> {
    fn tick(&mut self, record: &TickRecord) {
        self.ticks.push(*record);
    }
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {
        (self.progress)(self.ticks.len());
    }
}

impl OnRig {
    /// A rig with a PI for its delay, made for `model`; `clock` left out: virtual where the rig is emulated.
    pub fn new(
        file: RigFile,
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
        let mut controller = setup::controller("pi", &model, &file.timing)?;
        // The rig's own limits alone: a controller's narrower ones are for holding, not for driving.
        controller.limits = file.limits;
        Ok(Self {
            file,
            model,
            controller,
            clock,
            frames,
            best_effort,
        })
    }

    /// What an excitation is shaped by: the model expected, the loop's PI and delay.
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
        }
    }

    /// Amplitudes that keep the bead in view, its image sharp and the board within its slew.
    pub fn limits(&self, bead_um: f64, bead_um_per_s: f64, pzt_um: f64) -> ShapeLimits {
        // The board follows a step within its first update of 0.1 ms if the slew lets it (4 um at 40 um/ms); a larger one
        // would be late by more, and bend the drive. A fifth is left to the loop that holds the bead.
        ShapeLimits {
            bead_um,
            bead_um_per_s,
            pzt_um,
            slew_um_per_s: 0.08 * self.file.limits.slew_um_per_s.min(40_000.0),
        }
    }

    /// Runs the segments `todo` of a plan once.
    pub fn acquire(
        &self,
        plan: &Plan,
        todo: &[usize],
        progress: &mut (dyn FnMut(usize) + Send),
    ) -> Result<Acquired, Failure> {
        let schedule = plan.schedule(todo);
        let mut rig = session::connect(&self.file, self.clock, self.frames, &self.model)?;
        let mut controller = self.controller;
        let board = rig.actuator.info();
        let own = controller.limits;
        let asked = setup::within(
            self.file.limits,
            [own.low_um, own.high_um, own.slew_um_per_s],
        );
        controller.limits =
            setup::within(asked, [board.low_um, board.high_um, board.slew_um_per_s]);
        let limits = controller.limits;
        let armed = rig
            .actuator
            .arm(&Session {
                id: 1,
                park_um: limits.park_um,
                limits: [limits.low_um, limits.high_um, limits.slew_um_per_s],
                watchdog_ms: self.file.watchdog_ms(),
            })
            .map_err(Failure::failed)?;
        let timing = self.file.timing;
        let believed = DesignPlant::from_model(
            &self.model,
            Some(controller.delay_ms * 1e-3),
            timing.period_us * 1e-6,
        )
        .map_err(Failure::input)?;
        let core = Core::new(
            controller
                .loop_config(&self.model)
                .map_err(Failure::input)?,
            Exciting {
                excitation_um: schedule.excitation_um,
                now: None,
            },
            timing,
            self.file.arming,
            &believed.plant,
            armed.applied_um,
            self.file.first_neutral_um,
        )
        .map_err(Failure::input)?;
        let sink = Keeping {
            ticks: Vec::new(),
            progress,
        };
        let finished = session::drive(
            core,
            &mut rig,
            sink,
            EndRule::default(),
            self.best_effort,
            &Operator::default(),
        )?;
        let ticks = finished.sink.ticks;
        let rows = Rows::of(&ticks, timing.period_ns(), timing.camera_delay_ms);
        let records: Vec<RecordedSegment> = schedule
            .spans
            .iter()
            .filter_map(|span| rows.segment(span, plan.lost_frames))
            .collect();
        let mut trouble = trouble(&finished.summary, records.len(), schedule.spans.len());
        if let Some(error) = finished.io_error {
            trouble = Some(format!("{}; {error}", trouble.unwrap_or_default()));
        }
        Ok(Acquired {
            records,
            neutral_um: ticks
                .last()
                .map_or(self.file.first_neutral_um, |t| t.neutral_um),
            wait_s: rows.wait_s(),
            path_s: 1e-9 * rows.path_ns as f64,
            rows: (rows.input, rows.output),
            unseen: rows.unseen,
            trouble,
        })
    }

    /// The LED test on a rig with a real board: its LED is switched at dithered instants before its camera.
    pub fn delay_test(&self, edges: usize, seed: u64) -> Result<DelayTest, Failure> {
        const APART_S: f64 = 0.011;
        let (mut camera, mut board) = self.file.open_for_led()?;
        let seconds = |ns: i64| ns as f64 * 1e-9;
        let start_ns = monotonic_ns();
        let period_s = self.file.timing.period_us * 1e-6;
        let edges_s = dithered_edges(edges, APART_S, period_s, seconds(start_ns) + 0.1, seed);
        let end_ns = start_ns + ((0.2 + APART_S * edges as f64) * 1e9) as i64;
        let mut buffer = FrameBuffer::default();
        let (mut frame_s, mut grey, mut switched_s) = (Vec::new(), Vec::new(), Vec::new());
        let mut on = false;
        let mut waiting = edges_s.iter().map(|s| (s * 1e9).round() as i64).peekable();
        loop {
            let now_ns = monotonic_ns();
            if now_ns >= end_ns {
                break;
            }
            if let Some(&edge_ns) = waiting.peek()
                && now_ns >= edge_ns
            {
                on = !on;
                switched_s.push(seconds(monotonic_ns()));
                board.led(on).map_err(Failure::failed)?;
                waiting.next();
            }
            let until_ns = waiting.peek().map_or(end_ns, |&ns| ns.min(end_ns));
            let stamp = camera
                .next_frame(&mut buffer, until_ns)
                .map_err(Failure::failed)?;
            if let Some(stamp) = stamp {
                frame_s.push(seconds(stamp.arrival_ns));
                grey.push(mean_grey(&buffer));
            }
        }
        board.led(false).map_err(Failure::failed)?;
        DelayTest::evaluate(switched_s, frame_s, grey)
    }
}

/// Whether a frame came at this tick and showed no bead to be trusted.
pub fn is_unseen(tick: &TickRecord) -> bool {
    let came = tick.verdict != 255 && !tick.flags.has(TickFlags::TIMER);
    came && !tick.measured_um.is_finite()
}

fn trouble(summary: &Summary, done: usize, wanted: usize) -> Option<String> {
    let lost = (done < wanted).then(|| {
        format!(
            "{} of {wanted} segments were spoilt by a lost bead",
            wanted - done
        )
    });
    match summary.safe_reason {
        Some(reason) => Some(format!("the run ended in Safe ({reason:?})")),
        None => lost,
    }
}

/// Ticks as rows of an evenly sampled record, by frame id: a tick that never came is a row without a position.
struct Rows {
    input: Vec<f64>,
    output: Vec<f64>,
    usable: Vec<bool>,
    /// The frame came, without a bead to be trusted.
    unseen: Vec<bool>,
    /// Sum and number of the times from the arrival of a frame to its tick, ns.
    waited: (i64, i64),
    /// Row of each tick since the loop was closed.
    of_tick: Vec<usize>,
    /// From the middle of an exposure to the arrival of its frame, ns.
    path_ns: i64,
}

/// The camera path: as configured, unless the stamps of most frames say that it is another by half a period or more. Then
/// it is that of the fastest frames, and what is later than those has waited.
fn camera_path_ns(ticks: &[TickRecord], period_ns: i64, configured_ms: f64) -> i64 {
    let configured_ns = (configured_ms * 1e6).round() as i64;
    let mut ages_ns: Vec<i64> = ticks
        .iter()
        .filter(|t| !t.flags.has(TickFlags::TIMER) && !t.flags.has(TickFlags::STALE))
        .map(|t| t.time_ns - t.mid_exposure_ns)
        .collect();
    ages_ns.sort_unstable();
    match (
        ages_ns.get(ages_ns.len() / 2),
        ages_ns.get(ages_ns.len() / 100),
    ) {
        (Some(median_ns), Some(fastest_ns))
            if 2 * (median_ns - configured_ns).abs() >= period_ns =>
        {
            *fastest_ns
        }
        _ => configured_ns,
    }
}

impl Rows {
    fn of(ticks: &[TickRecord], period_ns: i64, camera_delay_ms: f64) -> Self {
        let mut rows = Self {
            input: Vec::new(),
            output: Vec::new(),
            usable: Vec::new(),
            unseen: Vec::new(),
            waited: (0, 0),
            of_tick: Vec::new(),
            path_ns: 0,
        };
        let closed = ticks
            .iter()
            .position(|t| t.life == Life::Running as u8)
            .unwrap_or(ticks.len());
        rows.path_ns = camera_path_ns(&ticks[closed..], period_ns, camera_delay_ms);
        let mut first_id = None;
        let first_seq = ticks.get(closed).map_or(0, |t| t.seq);
        for tick in &ticks[closed..] {
            let has = |flag| tick.flags.has(flag);
            let new_frame = !has(TickFlags::TIMER) && !has(TickFlags::STALE);
            let next = rows.input.len();
            let row = if new_frame {
                let first = *first_id.get_or_insert(tick.frame_id.saturating_sub(next as u64));
                usize::try_from(tick.frame_id.saturating_sub(first)).unwrap_or(next)
            } else {
                next
            };
            // A row that a timer tick has already taken is overwritten by the frame that came late after all.
            let row = row.clamp(next.saturating_sub(1), next + 10_000);
            while rows.input.len() <= row {
                let held_um = rows.input.last().copied().unwrap_or(tick.command_um);
                rows.input.push(held_um);
                rows.output.push(f64::NAN);
                rows.usable.push(true);
                rows.unseen.push(false);
            }
            let late_ns = tick.time_ns - tick.mid_exposure_ns - rows.path_ns;
            let on_time = new_frame && !has(TickFlags::LOST) && 2 * late_ns < period_ns;
            if on_time {
                rows.waited.0 += late_ns;
                rows.waited.1 += 1;
            }
            rows.input[row] = tick.command_um;
            rows.output[row] = if on_time { tick.measured_um } else { f64::NAN };
            rows.unseen[row] = is_unseen(tick);
            rows.usable[row] = tick.life == Life::Running as u8 && !has(TickFlags::FREEZE);
            // A record that was lost leaves its tick's place to the one behind it.
            let at = usize::try_from(tick.seq.saturating_sub(first_seq)).unwrap_or(0);
            rows.of_tick.resize(at.max(rows.of_tick.len()), row);
            rows.of_tick.push(row);
        }
        rows
    }

    fn wait_s(&self) -> f64 {
        let (sum_ns, count) = self.waited;
        if count > 0 {
            1e-9 * sum_ns as f64 / count as f64
        } else {
            0.0
        }
    }

    /// A segment, unless it is not whole or the bead was lost in it for long.
    fn segment(&self, span: &Span, lost_frames: usize) -> Option<RecordedSegment> {
        let row_of = |tick: usize| self.of_tick.get(SETTLE_TICKS + tick).copied();
        let (start, from) = (row_of(span.start)?, row_of(span.start + span.settle)?);
        let end = row_of(span.start + span.rows)?;
        let output = self.output.get(start..end)?;
        let longest_gap = output
            .split(|y| y.is_finite())
            .map(<[f64]>::len)
            .max()
            .unwrap_or(0);
        let sound = self.usable.get(start..end)?.iter().all(|&u| u) && longest_gap < lost_frames;
        sound.then(|| RecordedSegment {
            index: span.index,
            from: from - start,
            input: self.input[start..end].to_vec(),
            output: output.to_vec(),
        })
    }
}
