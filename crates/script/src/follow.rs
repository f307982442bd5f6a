//! A script as the reference generator of a loop.

use crate::cursor::{Cursor, Progress, Seen, StopReason};
use crate::plan::Plan;
use cellpos_runtime::{ReferenceGenerator, ReferenceInput, ReferenceOutput, Stage};
use std::sync::Arc;

/// References kept, to compare a position with the reference of the time at which it was measured.
const PAST: usize = 64;
/// Ticks of hold at the end of a script, so that the positions of its last cycle still arrive.
const TAIL_TICKS: u32 = 25;

/// Leads a loop through a plan.
///
/// Before the plan's clock starts, and after a skipped step, the bead moves to the plan's position and settles there (minimum
/// jerk, at most [`Follower::APPROACH_UM_PER_S`]). While the bead is frozen the plan's clock stops, so that a pause costs no
/// cycle. Running time and stop conditions continue.
#[derive(Debug, Clone)]
pub struct Follower {
    plan: Arc<Plan>,
    cursor: Cursor,
    approach: Approach,
    delay_ticks: usize,
    past_um: [f64; PAST],
    past: usize,
    reference_um: f64,
    stage: Stage,
    swing: Option<(u16, f64)>,
    /// Whether the script's time runs: not before its first tick.
    begun: bool,
    tail: u32,
}

/// Progress of the approach to the plan's next position.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Approach {
    /// Waiting for the first position.
    Due,
    /// On the way.
    Going { from_um: f64, tick: u32, ticks: u32 },
    /// There.
    Over,
}

impl Follower {
    /// Highest speed of the approach, um/s.
    pub const APPROACH_UM_PER_S: f64 = 100.0;
    /// Time to settle before the plan continues, s.
    pub const SETTLE_S: f64 = 0.2;

    /// Follows a plan from a time on (0, or the end of the last cycle that is done). `delay_ticks`: from the middle of an
    /// exposure to the tick that uses it.
    pub fn new(plan: Arc<Plan>, from_s: f64, delay_ticks: usize) -> Self {
        let cursor = plan.start_at(from_s);
        let reference_um = plan.reference_um(&cursor);
        Self {
            plan,
            cursor,
            approach: Approach::Due,
            delay_ticks,
            past_um: [reference_um; PAST],
            past: 0,
            reference_um,
            stage: Stage::None,
            swing: None,
            begun: false,
            tail: 0,
        }
    }

    /// The same, with the cell's length at the start of the run, um, as the reference of its change.
    #[must_use]
    pub fn with_first_length(mut self, length_um: Option<f64>) -> Self {
        self.cursor.expect_length(length_um);
        self
    }

    /// The same, with the time that the script has run in the sessions before, s; None: as long as the plan says.
    #[must_use]
    pub fn with_elapsed(mut self, elapsed_s: Option<f64>) -> Self {
        if let Some(elapsed_s) = elapsed_s {
            self.cursor.expect_elapsed(elapsed_s);
        }
        self
    }

    fn seen(&self, input: &ReferenceInput) -> Seen {
        let back = (self.delay_ticks + usize::from(input.age_ticks)).clamp(1, PAST);
        let then_um = self
            .past_um
            .get((self.past + PAST - back) % PAST)
            .copied()
            .unwrap_or(self.reference_um);
        Seen {
            position_um: input.position_um,
            length_um: input.length_um,
            error_um: input.position_um.map(|position_um| position_um - then_um),
        }
    }

    /// One tick of the approach to the plan's position; None: it is over.
    fn approach(&mut self, input: &ReferenceInput) -> Option<f64> {
        let to_um = self.plan.reference_um(&self.cursor);
        if self.approach == Approach::Due {
            let from_um = input.position_um?;
            // The highest speed of a minimum-jerk move is 15/8 of its mean speed.
            let move_s = 1.875 * (to_um - from_um).abs() / Self::APPROACH_UM_PER_S;
            self.approach = Approach::Going {
                from_um,
                tick: 0,
                ticks: (move_s / input.sample_s).ceil() as u32,
            };
        }
        let Approach::Going {
            from_um,
            tick,
            ticks,
        } = self.approach
        else {
            return None;
        };
        let settle = (Self::SETTLE_S / input.sample_s).ceil() as u32;
        if tick >= ticks.saturating_add(settle) {
            self.approach = Approach::Over;
            return None;
        }
        self.approach = Approach::Going {
            from_um,
            tick: tick + 1,
            ticks,
        };
        let x = if tick < ticks {
            f64::from(tick) / f64::from(ticks)
        } else {
            1.0
        };
        Some(from_um + (to_um - from_um) * x * x * x * (10.0 + x * (6.0 * x - 15.0)))
    }

    /// Reference and stage of a tick of the closed loop.
    fn follow(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) {
        if input.skip && !self.stage.is_over() {
            self.cursor.skip(&self.plan);
            self.approach = Approach::Going {
                from_um: self.reference_um,
                tick: 0,
                ticks: (1.875 * (self.plan.reference_um(&self.cursor) - self.reference_um).abs()
                    / (Self::APPROACH_UM_PER_S * input.sample_s))
                    .ceil() as u32,
            };
        }
        let seen = self.seen(input);
        let before = self.stage;
        if self.approach != Approach::Over && !input.frozen {
            match self.approach(input) {
                Some(reference_um) => {
                    if self.begun {
                        self.cursor.pass(input.sample_s);
                    }
                    self.reference_um = reference_um;
                    self.stage = Stage::Approach;
                    preview_um.fill(reference_um);
                    return;
                }
                None if self.approach == Approach::Due => {
                    self.stage = Stage::Approach;
                    preview_um.fill(self.reference_um);
                    return;
                }
                None => {}
            }
        }
        self.begun = true;
        if input.frozen {
            let output = self.plan.stand(&mut self.cursor, input.sample_s, &seen);
            self.stage = match stage(output.status) {
                over if over.is_over() => over,
                _ => Stage::Paused,
            };
            preview_um.fill(self.reference_um);
        } else {
            let output = self.plan.step(&mut self.cursor, input.sample_s, &seen);
            self.reference_um = output.reference_um;
            self.stage = stage(output.status);
            self.swing = output.swing;
            self.plan.preview(&self.cursor, input.sample_s, preview_um);
        }
        if before.is_over() {
            self.tail = self.tail.saturating_add(1);
        }
    }
}

fn stage(status: Progress) -> Stage {
    match status {
        Progress::Running => Stage::Running,
        Progress::Waiting => Stage::Waiting,
        Progress::Done => Stage::Done,
        Progress::Stopped(reason) => match reason {
            StopReason::Lost => Stage::StoppedLost,
            StopReason::Error => Stage::StoppedError,
            StopReason::LengthChange => Stage::StoppedLength,
            StopReason::Time => Stage::StoppedTime,
            StopReason::Cycles => Stage::StoppedCycles,
            StopReason::WaitTimeout => Stage::StoppedWait,
        },
    }
}

impl ReferenceGenerator for Follower {
    fn step(&mut self, input: &ReferenceInput, preview_um: &mut [f64]) -> ReferenceOutput {
        // The plan's time of this tick: the cursor itself is a sample ahead after its step.
        let plan_s = self.cursor.plan_s();
        self.swing = None;
        if input.running {
            self.follow(input, preview_um);
        } else {
            preview_um.fill(self.reference_um);
        }
        if let Some(slot) = self.past_um.get_mut(self.past) {
            *slot = self.reference_um;
        }
        self.past = (self.past + 1) % PAST;
        let plan_s = if input.skip {
            self.cursor.plan_s()
        } else {
            plan_s
        };
        ReferenceOutput {
            phase: self.swing.map(|(_, phase)| phase),
            motion: self.swing.map_or(0, |(motion, _)| motion),
            reference_um: self.reference_um,
            plan_ns: (plan_s * 1e9).round() as i64,
            stage: if input.running {
                self.stage
            } else {
                Stage::None
            },
        }
    }

    fn finished(&self) -> bool {
        self.tail >= TAIL_TICKS
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::script::Script;

    const TEXT: &str = "start = \"2um\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"10Hz\"\ncycles = 3\n\
                        [[step]]\ndo = \"wait\"\nfor = \"position\"\nabove = \"5um\"\ntimeout = \"50ms\"\non_timeout = \"continue\"\n\
                        [[step]]\ndo = \"move\"\nto = \"4um\"\nduration = \"100ms\"\n";

    fn follower(text: &str) -> Follower {
        let plan = Plan::new(&Script::parse(text, "t.toml").unwrap()).unwrap();
        Follower::new(Arc::new(plan), 0.0, 2)
    }

    fn input(position_um: f64) -> ReferenceInput {
        ReferenceInput {
            running: true,
            frozen: false,
            skip: false,
            tick: 0,
            sample_s: 1e-3,
            position_um: Some(position_um),
            age_ticks: 0,
            length_um: None,
            target_um: None,
        }
    }

    /// Runs to the end with a bead that is always at the reference; returns (reference, stage, plan) of each tick.
    fn walk(
        follower: &mut Follower,
        change: impl Fn(usize, &mut ReferenceInput),
    ) -> Vec<ReferenceOutput> {
        let mut preview = [0.0; 40];
        let mut all: Vec<ReferenceOutput> = Vec::new();
        while !follower.finished() {
            let at = all.last().map_or(0.0, |output| output.reference_um);
            let mut told = input(at);
            change(all.len(), &mut told);
            let expected = preview[0];
            let output = follower.step(&told, &mut preview);
            if output.stage == Stage::Running
                && all.last().is_some_and(|last| last.stage == Stage::Running)
            {
                assert!(
                    (expected - output.reference_um).abs() < 1e-9,
                    "preview of {} at {}",
                    expected,
                    output.plan_ns
                );
            }
            all.push(output);
            assert!(all.len() < 10_000);
        }
        all
    }

    #[test]
    fn the_bead_is_led_to_the_start_without_a_jump_and_every_tick_of_the_plan_comes_once() {
        let mut follower = follower(TEXT);
        let all = walk(&mut follower, |_, _| {});
        for pair in all.windows(2) {
            assert!((pair[1].reference_um - pair[0].reference_um).abs() < 0.11);
            assert!(pair[1].plan_ns >= pair[0].plan_ns);
        }
        let running: Vec<i64> = all
            .iter()
            .filter(|output| output.stage == Stage::Running)
            .map(|output| output.plan_ns)
            .collect();
        let expected: Vec<i64> = (0..400).map(|tick| tick * 1_000_000).collect();
        assert_eq!(running, expected);
        let waited = all.iter().filter(|o| o.stage == Stage::Waiting).count();
        assert_eq!(waited, 50);
        assert_eq!(all.last().unwrap().stage, Stage::Done);
        assert_eq!(all.last().unwrap().reference_um, 4.0);
    }

    #[test]
    fn a_frozen_bead_stops_the_plans_clock_and_the_reference_goes_on_where_it_stood() {
        let mut follower = follower(TEXT);
        let all = walk(&mut follower, |tick, told| {
            told.frozen = (300..450).contains(&tick);
        });
        let paused: Vec<&ReferenceOutput> =
            all.iter().filter(|o| o.stage == Stage::Paused).collect();
        assert_eq!(paused.len(), 150);
        assert!(paused.iter().all(|o| o.plan_ns == paused[0].plan_ns));
        let running = all.iter().filter(|o| o.stage == Stage::Running).count();
        assert_eq!(running, 400, "no tick of the plan is lost to the pause");
    }

    #[test]
    fn the_time_of_a_script_is_that_of_all_its_sessions_with_pauses_and_ways_and_without_the_approach()
     {
        let text = "[stop]\nafter = \"2s\"\n[[step]]\ndo = \"hold\"\nduration = \"1s\"\n\
                    [[step]]\ndo = \"hold\"\nduration = \"10s\"\n";
        let ticks = |follower: &mut Follower, change: &dyn Fn(usize, &mut ReferenceInput)| {
            let all = walk(follower, change);
            assert!(all.iter().any(|output| output.stage == Stage::StoppedTime));
            let first = all.iter().position(|o| o.stage == Stage::Running).unwrap();
            let over = all.iter().position(|o| o.stage.is_over()).unwrap();
            over - first
        };
        let about = |found: usize, expected: usize| found.abs_diff(expected) <= 1;
        assert!(about(ticks(&mut follower(text), &|_, _| {}), 2000));
        let change = |tick: usize, told: &mut ReferenceInput| {
            told.frozen = (300..450).contains(&tick);
            told.skip = tick == 600;
        };
        let found = ticks(&mut follower(text), &change);
        assert!(about(found, 2000), "{found}");
        // The session before ran for 1.4 s, and the plan continues from 1 s.
        let plan = Arc::new(Plan::new(&Script::parse(text, "t.toml").unwrap()).unwrap());
        let resumed = |elapsed_s| Follower::new(Arc::clone(&plan), 1.0, 2).with_elapsed(elapsed_s);
        assert!(about(ticks(&mut resumed(Some(1.4)), &|_, _| {}), 600));
        assert!(about(ticks(&mut resumed(None), &|_, _| {}), 1000));
    }

    #[test]
    fn a_skipped_step_is_left_for_the_next_one_without_a_jump() {
        let mut follower = follower(TEXT);
        let all = walk(&mut follower, |tick, told| told.skip = tick == 330);
        assert!(all[330].plan_ns == 300_000_000, "{:?}", all[330]);
        for pair in all.windows(2) {
            assert!((pair[1].reference_um - pair[0].reference_um).abs() < 0.11);
        }
        assert_eq!(all.last().unwrap().stage, Stage::Done);
    }

    #[test]
    fn the_error_is_that_of_the_time_of_the_exposure() {
        // 5 um at 20 Hz moves 0.63 um a tick: against the reference of now a perfect bead seen 2 ms late is 1.3 um off.
        let text = "[stop]\nerror_above = \"500nm\"\n[[step]]\ndo = \"sine\"\namplitude = \"5um\"\nfrequency = \"20Hz\"\ncycles = 4\n";
        let mut late = follower(text);
        let mut preview = [0.0; 1];
        let mut past = [0.0; 3];
        while !late.finished() {
            let output = late.step(&input(past[1]), &mut preview);
            past = [output.reference_um, past[0], past[1]];
        }
        assert_eq!(late.stage, Stage::Done);
        let mut lost = follower(text);
        while !lost.finished() {
            lost.step(&input(0.0), &mut preview);
        }
        assert_eq!(lost.stage, Stage::StoppedError);
    }

    #[test]
    fn a_bead_that_stays_away_ends_the_script_though_its_clock_stands_still() {
        let mut follower = follower(&format!(
            "[stop]\nlost_longer_than = \"200ms\"\n{}",
            TEXT.replace("start = \"2um\"\n", "")
        ));
        let all = walk(&mut follower, |tick, told| {
            if tick >= 300 {
                told.position_um = None;
                told.frozen = tick >= 320;
            }
        });
        assert_eq!(all.last().unwrap().stage, Stage::StoppedLost);
        let over = all.iter().position(|o| o.stage.is_over()).unwrap();
        assert!((499..=503).contains(&over), "{over}");
    }
}
