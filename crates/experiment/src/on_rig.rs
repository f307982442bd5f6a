//! An identification on the rig of a rig.toml, through the same loop, threads and safe states as `cellpos track`: the
//! bead is held at 0 um and the excitation is added to the command.
//!
//! The loop freezes and thaws by its own rules when the bead is lost; a segment in which it did is measured again.

use crate::camera_rate::{foreign_rate_hz, other_rate};
use crate::exciting::{Exciting, Handing, SETTLE_TICKS};
use crate::identify::held_bead::{DelayTest, Setup, mean_grey};
use cellpos_control::{ControllerFile, Pi};
use cellpos_emulator::WorldConfig;
use cellpos_ident::delay::dithered_edges;
use cellpos_ident::excitation::Limits as ShapeLimits;
use cellpos_ident::experiment::{Plan, RecordedSegment, Span};
use cellpos_plant::Model;
use cellpos_rig::clock::monotonic_ns;
use cellpos_rig::{Camera, Clock, FrameBuffer};
use cellpos_runtime::{EndRule, Grid, Request, TickFlags, TickRecord};
use cellpos_session::rig_file::{ClockKind, Frames, RigFile};
use cellpos_session::setup::{self, Prepared, ReferenceSpec};
use cellpos_session::view::{Pages, Viewed};
use cellpos_session::{EndKind, Ended, Failure, Options, Rig};
use std::sync::Arc;
use std::time::Duration;

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
    /// Localisation noise as vision stated it, um RMS.
    pub fix_noise_um: Option<f64>,
    /// The whole run from where the loop was closed, row by row: commanded displacement, um, and bead position, um, NaN
    /// without one.
    pub rows: (Vec<f64>, Vec<f64>),
    /// Its rows whose frame came, but showed no bead to be trusted.
    pub unseen: Vec<bool>,
    /// Why segments are missing, if any are.
    pub trouble: Option<Trouble>,
}

/// Why segments are missing.
#[derive(Debug, Clone, PartialEq)]
pub enum Trouble {
    /// The run ended before its time: another one would end like it, until something is done.
    Ended(Ended),
    /// The bead was lost for long in some of them: measured again, they may be whole.
    Spoilt {
        /// How many.
        missing: usize,
        /// Of how many.
        of: usize,
    },
}

impl std::fmt::Display for Trouble {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Ended(ended) => ended.fmt(f),
            Self::Spoilt { missing, of } => {
                write!(
                    f,
                    "{missing} of {of} segments were spoilt by a lost bead or a freeze"
                )
            }
        }
    }
}

/// Who hears of a run while it goes on.
pub struct Listener<'a> {
    /// Ticks so far.
    pub progress: &'a mut (dyn FnMut(usize) + Send),
    /// What there is whenever a segment has ended.
    pub segment: &'a mut (dyn FnMut(&Acquired) + Send),
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
    /// The rig could not be set up or armed. A run that ended early is no error: [`Acquired::trouble`].
    pub fn acquire(
        &self,
        plan: &Plan,
        todo: &[usize],
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
        todo: &[usize],
        listener: &mut Listener<'_>,
        pages: Option<&mut Pages>,
    ) -> Result<Acquired, Failure> {
        /// How often the ticks are looked at.
        const LOOK_EVERY: Duration = Duration::from_millis(100);
        let schedule = plan.schedule(todo);
        let mut rig = Rig::open(self.file.clone(), self.options())?;
        let mut prepared = Prepared {
            model: self.model.clone(),
            controller: self.controller,
        };
        rig.fit(&mut prepared);
        let setup = rig.set_up(prepared, ReferenceSpec::Hold { position_um: 0.0 })?;
        let core = setup.core_following(Exciting::new(&schedule))?;
        let (sender, received) = std::sync::mpsc::channel();
        let period_ns = self.file.timing.period_ns();
        let mut view = match pages {
            Some(pages) => pages.next(&mut rig, &setup)?,
            None => None,
        };
        let handing = Handing::new(sender, &schedule.spans, 1e-9 * period_ns as f64);
        let sink = Viewed::new(handing, view.as_deref_mut());
        let running = rig.arm(&setup, core, sink, EndRule::default())?.start()?;
        let operator = Arc::clone(running.operator());
        let mut ticks: Vec<TickRecord> = Vec::new();
        let mut ended = 0;
        let finished = running.wait_with(LOOK_EVERY, || {
            ticks.extend(received.try_iter());
            (listener.progress)(ticks.len());
            if foreign_rate_hz(&ticks, period_ns).is_some() {
                // Known after a second; nothing of it can be used.
                operator.ask(Request::Park);
                return;
            }
            let now = ended_spans(&ticks, &schedule.spans);
            if now > ended {
                ended = now;
                (listener.segment)(&self.acquired(&ticks, plan, &schedule.spans));
            }
        })?;
        finished.sink.give_back(view);
        ticks.extend(received.try_iter());
        if let Some(rate_hz) = foreign_rate_hz(&ticks, period_ns) {
            return Err(other_rate(rate_hz, period_ns));
        }
        let mut acquired = self.acquired(&ticks, plan, &schedule.spans);
        let (done, of) = (acquired.records.len(), schedule.spans.len());
        acquired.trouble = if done == of {
            None
        } else if finished.ended.kind == EndKind::ReferenceOver {
            Some(Trouble::Spoilt {
                missing: of - done,
                of,
            })
        } else {
            Some(Trouble::Ended(finished.ended))
        };
        Ok(acquired)
    }

    /// What the ticks so far hold.
    fn acquired(&self, ticks: &[TickRecord], plan: &Plan, spans: &[Span]) -> Acquired {
        let timing = &self.file.timing;
        let rows = Rows::of(ticks, timing.period_ns(), timing.camera_delay_ms);
        let records = spans
            .iter()
            .filter_map(|span| rows.segment(span, plan.lost_frames))
            .collect();
        Acquired {
            records,
            neutral_um: ticks
                .last()
                .map_or(self.file.first_neutral_um, |t| t.neutral_um),
            wait_s: rows.wait_s(),
            path_s: 1e-9 * rows.path_ns as f64,
            fix_noise_um: fix_noise_um(ticks),
            rows: (rows.input, rows.output),
            unseen: rows.unseen,
            trouble: None,
        }
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

/// Localisation noise as vision stated it in some ticks, um RMS.
fn fix_noise_um(ticks: &[TickRecord]) -> Option<f64> {
    let (sum, count) = ticks
        .iter()
        .map(|tick| tick.variance_um2)
        .filter(|variance| variance.is_finite())
        .fold((0.0, 0u64), |(sum, count), variance| {
            (sum + variance, count + 1)
        });
    (count > 0).then(|| (sum / count as f64).max(0.0).sqrt())
}

/// Whether a frame came at this tick and showed no bead to be trusted.
pub fn is_unseen(tick: &TickRecord) -> bool {
    let came = tick.verdict != 255 && !tick.flags.has(TickFlags::TIMER);
    came && !tick.measured_um.is_finite()
}

/// Spans that are over.
fn ended_spans(ticks: &[TickRecord], spans: &[Span]) -> usize {
    let is_running = |t: &&TickRecord| t.is_running();
    let (Some(first), Some(last)) = (ticks.iter().find(is_running), ticks.last()) else {
        return 0;
    };
    let since = usize::try_from(last.seq.saturating_sub(first.seq)).unwrap_or(0);
    let over = |span: &&Span| SETTLE_TICKS + span.start + span.rows < since;
    spans.iter().filter(over).count()
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
            .position(TickRecord::is_running)
            .unwrap_or(ticks.len());
        rows.path_ns = camera_path_ns(&ticks[closed..], period_ns, camera_delay_ms);
        let mut first_id = None;
        // The excitation is played by the clock: a tick's place in it is its number on the clock's grid.
        let grid = Grid::new(ticks.first().map_or(0, |t| t.time_ns), period_ns);
        let first_index = ticks.get(closed).map_or(0, |t| grid.index(t.time_ns));
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
            rows.usable[row] = tick.is_controlled();
            // A tick that was skipped, or whose record was lost, leaves its place to the one behind it.
            let at = usize::try_from(grid.index(tick.time_ns) - first_index).unwrap_or(0);
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
