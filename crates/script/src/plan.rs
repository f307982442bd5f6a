//! A script laid out in time.

use crate::error::ScriptError;
use crate::script::{
    Condition, Load, MoveShape, OnTimeout, Script, Step, StepKind, Stop, WaveShape,
};
use cellpos_control::Reference;
use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};
use std::ops::Range;

/// Most segments of a plan.
const MAX_SEGMENTS: usize = 2_000_000;
/// Longest plan, s: thirty days.
const MAX_S: f64 = 30.0 * 86_400.0;

/// What a segment does; it starts at the segment's `from_um`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Motion {
    /// Stays.
    Hold,
    /// Goes to a position over the segment's duration.
    Move {
        /// How.
        shape: MoveShape,
        /// Where to, um.
        to_um: f64,
    },
    /// Periodic motion about `from_um`.
    Wave {
        /// Shape.
        shape: WaveShape,
        /// Amplitude, um.
        amplitude_um: f64,
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Cycles over which the amplitude grows.
        ramp_in: f64,
        /// Cycles over which it falls.
        ramp_out: f64,
    },
    /// Periodic motion through points of the plan.
    Points {
        /// First point.
        first: usize,
        /// Number of points.
        count: usize,
        /// Duration of one cycle, s.
        period_s: f64,
    },
    /// Stays until a condition is met; takes no time in the plan.
    Wait {
        /// The condition.
        condition: Condition,
        /// Longest time, s.
        timeout_s: f64,
        /// What then.
        on_timeout: OnTimeout,
    },
}

/// A piece of the plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// Start, s.
    pub start_s: f64,
    /// Duration, s.
    pub duration_s: f64,
    /// Position at the start, um.
    pub from_um: f64,
    /// What it does.
    pub motion: Motion,
    /// Line of its step in the file.
    pub line: usize,
}

/// A mark in the record.
#[derive(Debug, Clone, PartialEq)]
pub struct Mark {
    /// When, s.
    pub time_s: f64,
    /// What to write.
    pub text: String,
}

/// Which arm of a test a cycle belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ArmKind {
    /// The one that moves.
    #[default]
    Cyclic,
    /// The static control beside it.
    Static,
}

/// One cycle: a period of a wave, or a pass of a repeat that holds no wave; in a static arm, as much time as a cycle of
/// the arm that it stands beside takes in the mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cycle {
    /// Number, from 0.
    pub number: u64,
    /// Its arm.
    pub arm: ArmKind,
    /// Start, s.
    pub start_s: f64,
    /// Duration, s.
    pub duration_s: f64,
}

/// Equal cycles one after the other.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Cycles {
    first: u64,
    count: u64,
    start_s: f64,
    period_s: f64,
    arm: ArmKind,
}

/// A script laid out in time. Waits take no time in it: a [`crate::Cursor`] stops its clock at them.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    segments: Vec<Segment>,
    points: Vec<(f64, f64)>,
    cycles: Vec<Cycles>,
    marks: Vec<Mark>,
    /// Waits: number of the segment and its time, s.
    waits: Vec<(usize, f64)>,
    stop: Stop,
    start_um: f64,
    duration_s: f64,
}

impl Plan {
    /// Lays a script out.
    ///
    /// # Errors
    /// [`ScriptError`] when it is too long, or a control arm names a label that is not above it.
    pub fn new(script: &Script) -> Result<Self, ScriptError> {
        Self::lay_out(script, false)
    }

    /// With at most three passes of each repeat and six cycles at full amplitude of each wave: it asks the same of the
    /// rig and is quick to go through.
    pub(crate) fn shortened(script: &Script) -> Result<Self, ScriptError> {
        Self::lay_out(script, true)
    }

    fn lay_out(script: &Script, short: bool) -> Result<Self, ScriptError> {
        let mut builder = Builder {
            script,
            short,
            time_s: 0.0,
            at_um: script.start_um,
            integral: 0.0,
            range: script.start_um..script.start_um,
            next_cycle: 0,
            labels: BTreeMap::new(),
            plan: Self {
                segments: Vec::new(),
                points: Vec::new(),
                cycles: Vec::new(),
                marks: Vec::new(),
                waits: Vec::new(),
                stop: script.stop,
                start_um: script.start_um,
                duration_s: 0.0,
            },
        };
        builder.steps(&script.steps)?;
        builder.plan.duration_s = builder.time_s;
        Ok(builder.plan)
    }

    /// Duration without waits, s.
    pub fn total_s(&self) -> f64 {
        self.duration_s
    }

    /// Position at the start, um.
    pub fn start_um(&self) -> f64 {
        self.start_um
    }

    /// The segments, in order of time.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// The marks, in order of time.
    pub fn marks(&self) -> &[Mark] {
        &self.marks
    }

    /// The stop conditions.
    pub fn stop(&self) -> &Stop {
        &self.stop
    }

    /// When the plan's clock next stands still for a wait, from a segment on, s; infinity: never.
    pub(crate) fn next_wait_s(&self, segment: usize) -> f64 {
        let index = self.waits.partition_point(|(number, _)| *number < segment);
        self.waits.get(index).map_or(f64::INFINITY, |wait| wait.1)
    }

    /// Number of cycles.
    pub fn cycle_count(&self) -> u64 {
        self.cycles.last().map_or(0, |run| run.first + run.count)
    }

    /// A cycle by its number.
    pub fn cycle(&self, number: u64) -> Option<Cycle> {
        let index = self.cycles.partition_point(|run| run.first <= number);
        let run = index
            .checked_sub(1)
            .and_then(|index| self.cycles.get(index))?;
        let within = number - run.first;
        (within < run.count).then_some(Cycle {
            number,
            arm: run.arm,
            start_s: run.start_s + within as f64 * run.period_s,
            duration_s: run.period_s,
        })
    }

    /// The cycle that a time falls into.
    pub fn cycle_at(&self, time_s: f64) -> Option<Cycle> {
        let index = self.cycles.partition_point(|run| run.start_s <= time_s);
        let run = index
            .checked_sub(1)
            .and_then(|index| self.cycles.get(index))?;
        let within = ((time_s - run.start_s) / run.period_s).floor();
        (within < run.count as f64)
            .then(|| run.first + within as u64)
            .and_then(|number| self.cycle(number))
    }

    /// Cycles that have ended by a time.
    pub fn cycles_done(&self, time_s: f64) -> u64 {
        let index = self.cycles.partition_point(|run| run.start_s <= time_s);
        index
            .checked_sub(1)
            .and_then(|index| self.cycles.get(index))
            .map_or(0, |run| {
                // A time at the end of a cycle up to rounding counts as its end.
                let within = ((time_s - run.start_s) / run.period_s + 1e-9).floor();
                run.first + (within.max(0.0) as u64).min(run.count)
            })
    }

    /// The segment that a time falls into (the first after a wait; the last from the end on).
    pub fn segment_at(&self, time_s: f64) -> Option<&Segment> {
        let index = self.segments.partition_point(|s| s.start_s <= time_s);
        self.segments.get(index.saturating_sub(1))
    }

    /// Position within a segment, um. Allocates nothing.
    pub(crate) fn segment_um(&self, segment: &Segment, time_s: f64) -> f64 {
        let t = (time_s - segment.start_s).clamp(0.0, segment.duration_s);
        let from = segment.from_um;
        match segment.motion {
            Motion::Hold | Motion::Wait { .. } => from,
            Motion::Move { shape, to_um } => {
                let share = if segment.duration_s > 0.0 {
                    t / segment.duration_s
                } else {
                    1.0
                };
                from + (to_um - from) * progress(shape, share)
            }
            Motion::Wave {
                shape,
                amplitude_um,
                frequency_hz,
                ramp_in,
                ramp_out,
            } => {
                let phase = t * frequency_hz;
                let left = (segment.duration_s - t) * frequency_hz;
                from + amplitude_um
                    * rise(phase, ramp_in)
                    * rise(left, ramp_out)
                    * wave(shape, phase)
            }
            Motion::Points {
                first,
                count,
                period_s,
            } => {
                let points = self.points.get(first..first + count).unwrap_or(&[]);
                let within = if t >= segment.duration_s {
                    0.0
                } else {
                    t % period_s
                };
                let next = points.partition_point(|(time, _)| *time <= within);
                let before = next.checked_sub(1).and_then(|index| points.get(index));
                match (before, points.get(next)) {
                    (Some((t0, x0)), Some((t1, x1))) => {
                        from + x0 + (x1 - x0) * (within - t0) / (t1 - t0)
                    }
                    (Some((_, x)), None) | (None, Some((_, x))) => from + x,
                    (None, None) => from,
                }
            }
        }
    }
}

impl Reference for Plan {
    /// The reference at a time of the plan, um: held before the start and after the end. Allocates nothing.
    fn at_um(&self, time_s: f64) -> f64 {
        match self.segment_at(time_s) {
            Some(segment) if time_s >= 0.0 => self.segment_um(segment, time_s),
            _ => self.start_um,
        }
    }

    fn duration_s(&self) -> Option<f64> {
        Some(self.duration_s)
    }
}

/// Share of a move done at a share of its time.
fn progress(shape: MoveShape, x: f64) -> f64 {
    match shape {
        MoveShape::ConstantVelocity => x,
        MoveShape::MinimumJerk => x * x * x * (10.0 + x * (6.0 * x - 15.0)),
        MoveShape::SCurve => x - (TAU * x).sin() / TAU,
    }
}

/// A wave of amplitude 1 at a phase in cycles.
fn wave(shape: WaveShape, phase: f64) -> f64 {
    let triangle = || 1.0 - 4.0 * ((phase + 0.25).fract() - 0.5).abs();
    match shape {
        WaveShape::Sine => (TAU * phase.fract()).sin(),
        WaveShape::Triangle => triangle(),
        WaveShape::Trapezoid => (2.0 * triangle()).clamp(-1.0, 1.0),
    }
}

/// From 0 to 1 over `length` cycles, as a raised cosine.
fn rise(cycles: f64, length: f64) -> f64 {
    if cycles >= length {
        1.0
    } else {
        0.5 - 0.5 * (PI * cycles.max(0.0) / length).cos()
    }
}

/// What is known of a labelled step.
#[derive(Debug, Clone, Copy)]
struct Arm {
    cycles: u64,
    duration_s: f64,
    mean_um: f64,
    peak_um: f64,
}

struct Builder<'s> {
    script: &'s Script,
    short: bool,
    time_s: f64,
    at_um: f64,
    /// Integral of the position over time, um s.
    integral: f64,
    /// Positions reached since the innermost label began.
    range: Range<f64>,
    next_cycle: u64,
    labels: BTreeMap<String, Arm>,
    plan: Plan,
}

impl Builder<'_> {
    fn fail(&self, step: &Step, message: String, help: &str) -> ScriptError {
        ScriptError::new(
            &self.script.file,
            &self.script.text,
            step.span.clone(),
            message,
            Some(help.to_owned()),
        )
    }

    fn steps(&mut self, steps: &[Step]) -> Result<(), ScriptError> {
        steps.iter().try_for_each(|step| self.step(step))
    }

    /// Adds a segment that moves between positions `low` and `high` from here, with its mean.
    fn push(
        &mut self,
        step: &Step,
        motion: Motion,
        duration_s: f64,
        mean_um: f64,
        (low, high): (f64, f64),
    ) -> Result<(), ScriptError> {
        if self.plan.segments.len() >= MAX_SEGMENTS || self.time_s + duration_s > MAX_S {
            return Err(self.fail(
                step,
                format!("the script is longer than {MAX_SEGMENTS} segments or thirty days"),
                "use fewer repeats, or a wave instead of single moves",
            ));
        }
        self.plan.segments.push(Segment {
            start_s: self.time_s,
            duration_s,
            from_um: self.at_um,
            motion,
            line: step.line,
        });
        self.time_s += duration_s;
        self.integral += mean_um * duration_s;
        self.range = self.range.start.min(low)..self.range.end.max(high);
        Ok(())
    }

    fn cycles(&mut self, start_s: f64, period_s: f64, count: u64) {
        self.arm_cycles(start_s, period_s, count, ArmKind::Cyclic);
    }

    fn arm_cycles(&mut self, start_s: f64, period_s: f64, count: u64, arm: ArmKind) {
        self.plan.cycles.push(Cycles {
            arm,
            first: self.next_cycle,
            count,
            start_s,
            period_s,
        });
        self.next_cycle += count;
    }

    fn go(
        &mut self,
        step: &Step,
        to_um: f64,
        duration_s: f64,
        shape: MoveShape,
    ) -> Result<(), ScriptError> {
        let from = self.at_um;
        let motion = Motion::Move { shape, to_um };
        let ends = (from.min(to_um), from.max(to_um));
        self.push(step, motion, duration_s, (from + to_um) / 2.0, ends)?;
        self.at_um = to_um;
        Ok(())
    }

    fn hold(&mut self, step: &Step, duration_s: f64) -> Result<(), ScriptError> {
        let at = self.at_um;
        self.push(step, Motion::Hold, duration_s, at, (at, at))
    }

    fn step(&mut self, step: &Step) -> Result<(), ScriptError> {
        let began = (self.time_s, self.integral, self.at_um);
        let cycles_before = self.next_cycle;
        let outer = std::mem::replace(&mut self.range, self.at_um..self.at_um);
        self.inner(step)?;
        if let Some(label) = &step.label {
            let duration_s = self.time_s - began.0;
            let far = |x: f64| (x - began.2).abs();
            let peak_um = if far(self.range.start) > far(self.range.end) {
                self.range.start
            } else {
                self.range.end
            };
            let mean_um = if duration_s > 0.0 {
                (self.integral - began.1) / duration_s
            } else {
                self.at_um
            };
            let arm = Arm {
                cycles: self.next_cycle - cycles_before,
                duration_s,
                mean_um,
                peak_um,
            };
            self.labels.insert(label.clone(), arm);
        }
        self.range = self.range.start.min(outer.start)..self.range.end.max(outer.end);
        Ok(())
    }

    fn inner(&mut self, step: &Step) -> Result<(), ScriptError> {
        match &step.kind {
            StepKind::Hold { duration_s } => self.hold(step, *duration_s),
            StepKind::Move {
                to_um,
                duration_s,
                speed_um_per_s,
                shape,
            } => {
                let distance = (to_um - self.at_um).abs();
                let duration_s = match (duration_s, speed_um_per_s) {
                    (Some(duration_s), _) => *duration_s,
                    (None, Some(speed)) => distance / speed,
                    (None, None) => 0.0,
                };
                self.go(step, *to_um, duration_s, *shape)
            }
            StepKind::Wave {
                shape,
                amplitude_um,
                frequency_hz,
                cycles,
                ramp_in,
                ramp_out,
            } => {
                let cycles = if self.short {
                    (*cycles).min(ramp_in + ramp_out + 6)
                } else {
                    *cycles
                };
                let motion = Motion::Wave {
                    shape: *shape,
                    amplitude_um: *amplitude_um,
                    frequency_hz: *frequency_hz,
                    ramp_in: *ramp_in as f64,
                    ramp_out: *ramp_out as f64,
                };
                let (at, start_s) = (self.at_um, self.time_s);
                let reach = (at - amplitude_um, at + amplitude_um);
                self.push(step, motion, cycles as f64 / frequency_hz, at, reach)?;
                self.cycles(start_s, 1.0 / frequency_hz, cycles);
                Ok(())
            }
            StepKind::Waveform { points, cycles } => {
                let cycles = if self.short {
                    (*cycles).min(3)
                } else {
                    *cycles
                };
                let period_s = points.last().map_or(0.0, |(time, _)| *time);
                let first = self.plan.points.len();
                if first + points.len() > MAX_SEGMENTS {
                    let help = "put the repetition into `cycles` of the waveform";
                    return Err(self.fail(step, "too many points in all".to_owned(), help));
                }
                self.plan.points.extend(points);
                let area: f64 = points
                    .windows(2)
                    .map(|pair| (pair[1].0 - pair[0].0) * (pair[0].1 + pair[1].1) / 2.0)
                    .sum();
                let (low, high) = points.iter().fold((0.0f64, 0.0f64), |(low, high), (_, x)| {
                    (low.min(*x), high.max(*x))
                });
                let motion = Motion::Points {
                    first,
                    count: points.len(),
                    period_s,
                };
                let (at, start_s) = (self.at_um, self.time_s);
                let duration_s = cycles as f64 * period_s;
                self.push(
                    step,
                    motion,
                    duration_s,
                    at + area / period_s,
                    (at + low, at + high),
                )?;
                self.cycles(start_s, period_s, cycles);
                Ok(())
            }
            StepKind::Repeat { times, steps } => {
                let times = if self.short { (*times).min(3) } else { *times };
                for _ in 0..times {
                    let (start_s, cycles) = (self.time_s, self.next_cycle);
                    self.steps(steps)?;
                    // A pass without a wave inside, and without passes that were counted already, is a cycle.
                    if self.next_cycle == cycles && self.time_s > start_s {
                        self.cycles(start_s, self.time_s - start_s, 1);
                    }
                }
                Ok(())
            }
            StepKind::Group(steps) => self.steps(steps),
            StepKind::Wait {
                condition,
                timeout_s,
                on_timeout,
            } => {
                let motion = Motion::Wait {
                    condition: *condition,
                    timeout_s: *timeout_s,
                    on_timeout: *on_timeout,
                };
                let wait = (self.plan.segments.len(), self.time_s);
                self.push(step, motion, 0.0, self.at_um, (self.at_um, self.at_um))?;
                self.plan.waits.push(wait);
                Ok(())
            }
            StepKind::Mark { text } => {
                if self.plan.marks.len() < MAX_SEGMENTS {
                    self.plan.marks.push(Mark {
                        time_s: self.time_s,
                        text: text.clone(),
                    });
                }
                Ok(())
            }
            StepKind::Static { like, load } => {
                let Some(arm) = self.labels.get(like).copied() else {
                    let names: Vec<&str> = self.labels.keys().map(String::as_str).collect();
                    let help = if names.is_empty() {
                        "give the step above a label".to_owned()
                    } else {
                        format!("labels above: {}", names.join(", "))
                    };
                    let message = format!("no step above is labelled `{like}`");
                    return Err(self.fail(step, message, &help));
                };
                let home_um = self.at_um;
                let load_um = match load {
                    Load::Mean => arm.mean_um,
                    Load::Peak => arm.peak_um,
                };
                let (start_s, cycles) = (self.time_s, arm.cycles);
                let travel_s = (arm.duration_s * 0.1).min(1.0);
                self.go(step, load_um, travel_s, MoveShape::MinimumJerk)?;
                self.hold(step, arm.duration_s - 2.0 * travel_s)?;
                self.go(step, home_um, travel_s, MoveShape::MinimumJerk)?;
                if cycles > 0 && arm.duration_s > 0.0 {
                    let period_s = arm.duration_s / cycles as f64;
                    self.arm_cycles(start_s, period_s, cycles, ArmKind::Static);
                }
                Ok(())
            }
        }
    }
}
