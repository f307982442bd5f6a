//! A whole identification from its arguments: plan, run, delay test, summary.

pub mod held_bead;
pub mod led;
pub mod page;
mod partial;
pub mod said;

use crate::experiment::again::Again;
use crate::experiment::on_rig::{Acquired, Listener, OnRig, Trouble};
use cellpos_ident::excitation::ExcitationLimits;
use cellpos_ident::experiment::{Cause, Measured, Plan, RecordedSegment, common_age_s};
use cellpos_ident::frequency_response::Settings;
use cellpos_ident::summary::{Identification, summarise};
use cellpos_plant::Hertz;
use cellpos_session::view::Pages;
use cellpos_session::{Failure, setup};
use held_bead::{HeldBead, Setup};
use led::DelayTest;
use std::path::{Path, PathBuf};

/// How to excite.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Excitation {
    /// One sine after the other.
    Stepped,
    /// All frequencies at once, with random phases; odd lines, with detection lines between.
    Multisine,
    /// A repeated logarithmic sweep through all frequencies.
    Sweep,
}

/// What to measure.
#[derive(Debug, Clone)]
pub struct Job {
    /// The rig.
    pub setup: Setup,
    /// Lines, Hz.
    pub lines_hz: Vec<f64>,
    /// How to excite.
    pub excitation: Excitation,
    /// Largest amplitudes.
    pub limits: ExcitationLimits,
    /// Measuring time of a line at 1 Hz, s; inversely proportional to frequency.
    pub seconds_at_1_hz: f64,
    /// Edges of the LED test; 0: none.
    pub led_edges: usize,
    /// Bootstrap replicates.
    pub bootstrap: usize,
    /// Seed of excitation, dither and bootstrap.
    pub seed: u64,
    /// The rig of a rig.toml. Left out: an emulated rig in this process, without the loop's threads.
    pub rig: Option<OnRig>,
    /// Segments of a stopped identification to continue from.
    pub resume: Option<PathBuf>,
    /// File for the finished segments if the identification is stopped.
    pub keep_in: Option<PathBuf>,
}

/// The outcome.
pub struct Done {
    /// The plan that was run.
    pub plan: Plan,
    /// The records.
    pub records: Vec<RecordedSegment>,
    /// The result.
    pub result: Identification,
    /// The LED test.
    pub led: Option<DelayTest>,
    /// PZT displacement at rest, um.
    pub neutral_um: f64,
    /// The board of a rig, by its own description.
    pub board: Option<String>,
    /// Mean time from the middle of an exposure to the tick that used it, s: the camera's part of the delay.
    pub age_s: f64,
    /// Folders of the runs on the rig, which replay and report as any other.
    pub runs: Vec<String>,
}

/// Runs a job; calls `progress` with ticks done and ticks in all.
pub fn run(job: &Job, progress: impl FnMut(usize, usize) + Send) -> Result<Done, Failure> {
    run_shown(job, progress, None)
}

/// The same; on a rig the live page of `pages` shows it.
pub fn run_shown(
    job: &Job,
    mut progress: impl FnMut(usize, usize) + Send,
    pages: Option<&mut Pages>,
) -> Result<Done, Failure> {
    let plan = plan(job)?;
    let total = plan.ticks() + job.led_edges * 11;
    let records = match &job.resume {
        Some(path) => partial::load(path, &plan)?,
        None => Vec::new(),
    };
    let mut heard = |ticks: usize| progress(ticks.min(total), total);
    let Raw {
        records,
        mut led,
        neutral_um,
        board,
        age_s,
        fix_noise_um,
        mut warnings,
        runs,
    } = match &job.rig {
        Some(rig) => on_rig(job, rig, &plan, records, &mut heard, pages)?,
        None => held_bead(job, &plan, records, &mut heard)?,
    };
    // The delay is computed from the common age of the lines.
    let age_s = common_age_s(&records).unwrap_or(age_s);
    let measured = plan
        .analyse_with_noise(
            &records,
            &Settings::default(),
            job.setup.sampling(),
            job.setup.two_lags,
        )
        .map_err(Failure::failed)?;
    progress(total, total);
    // The LED test ends at the exposure, a row of the record at its tick.
    if let Some(test) = &mut led {
        warnings.extend(test.vague());
        warnings.extend(job.rig.as_ref().and_then(|rig| test.stamps_off(&rig.file)));
        test.up_to_the_tick(age_s);
    }
    let mut result = conclude(job, measured, led.as_ref())?;
    result.stated_noise_um = fix_noise_um;
    result.warnings.extend(warnings);
    if let Some(rig) = &job.rig {
        let advice = setup::camera_delay_advice(age_s * 1e3, &rig.file.timing);
        result.warnings.extend(advice);
    }
    Ok(Done {
        plan,
        records,
        result,
        led,
        neutral_um,
        board,
        age_s,
        runs,
    })
}

fn plan(job: &Job) -> Result<Plan, Failure> {
    let expected = job.setup.expected()?;
    let period_s = job.setup.sampling().period_s;
    let (lines_hz, seconds) = (&job.lines_hz, job.seconds_at_1_hz);
    Ok(match job.excitation {
        Excitation::Multisine => {
            Plan::multisine(lines_hz, &expected, job.limits, period_s, seconds, job.seed)
        }
        Excitation::Stepped => {
            Plan::stepped_sines(lines_hz, &expected, job.limits, period_s, seconds)
        }
        Excitation::Sweep => Plan::log_sweep(lines_hz, &expected, job.limits, period_s, seconds),
    })
}

/// What was acquired.
struct Raw {
    records: Vec<RecordedSegment>,
    led: Option<DelayTest>,
    neutral_um: f64,
    board: Option<String>,
    age_s: f64,
    fix_noise_um: Option<f64>,
    warnings: Vec<String>,
    runs: Vec<String>,
}

fn held_bead(
    job: &Job,
    plan: &Plan,
    mut records: Vec<RecordedSegment>,
    progress: &mut dyn FnMut(usize),
) -> Result<Raw, Failure> {
    // Segments run in order here: those behind a gap are measured again.
    let whole = records.iter().zip(0..).take_while(|(r, i)| r.index == *i);
    records.truncate(whole.count());
    let mut bead = HeldBead::open(job.setup.clone())?;
    let records = acquire(job, plan, &mut bead, records, progress)?;
    let led = if job.led_edges > 0 {
        Some(bead.delay_test(job.led_edges, job.seed)?)
    } else {
        None
    };
    let neutral_um = bead.neutral_um();
    let (fix_noise_um, age_s) = (bead.fix_noise_um(), bead.age_s());
    bead.close()?;
    Ok(Raw {
        records,
        led,
        neutral_um,
        board: None,
        age_s,
        fix_noise_um,
        warnings: Vec::new(),
        runs: Vec::new(),
    })
}

/// The delay from the edges of an LED, if the job requests the test.
fn led_delay(job: &Job, rig: &OnRig) -> Result<Option<DelayTest>, Failure> {
    Ok(match (job.led_edges, rig.file.is_emulated()) {
        (0, _) => None,
        (edges, true) => {
            let mut world = rig.file.emulator.clone();
            world.faults = Default::default();
            let model = cellpos_plant::Model::load(&world.model).map_err(Failure::input)?;
            let clock = job.setup.clock.clone();
            let setup = Setup {
                world,
                model,
                clock,
                frames: true,
                closed_loop: true,
                pi: None,
                two_lags: job.setup.two_lags,
            };
            Some(HeldBead::open(setup)?.delay_test(edges, job.seed)?)
        }
        (edges, false) => Some(rig.delay_test(edges, job.seed)?),
    })
}

/// Runs on the rig of a rig.toml until no segment is missing or five runs in a row have measured none. It runs again after a lost
/// bead or a stall of machine or line, but not if a person must act first.
fn on_rig(
    job: &Job,
    rig: &OnRig,
    plan: &Plan,
    mut records: Vec<RecordedSegment>,
    progress: &mut (dyn FnMut(usize) + Send),
    mut pages: Option<&mut Pages>,
) -> Result<Raw, Failure> {
    let mut again = Again::of(plan);
    let mut warnings = Vec::new();
    let mut runs = Vec::new();
    let mut rig = rig.clone();
    let mut age_s = rig.file.timing.camera_delay_ms * 1e-3;
    let mut fix_noise_um = None;
    let mut board = None;
    loop {
        let todo = again.missing(&records);
        if todo.is_empty() {
            break;
        }
        // Write each segment to the disk when it ends, so that it survives the process.
        let before = records.clone();
        let mut segment = |so_far: &Acquired| {
            if let Err(failure) = kept(job, plan, &joined(&before, &so_far.records)) {
                tracing::warn!("{}", failure.text());
            }
        };
        let mut listener = Listener {
            progress: &mut *progress,
            segment: &mut segment,
        };
        let acquired = match rig.acquire_shown(plan, &todo, &mut listener, pages.as_deref_mut()) {
            Ok(acquired) => acquired,
            Err(failure) => {
                unfinished(pages, &failure.text(), plan, &records);
                return Err(match kept(job, plan, &records) {
                    Ok(Some(path)) => failure.with_remedy(&resume(&path, plan, &records)),
                    Ok(None) | Err(_) => failure,
                });
            }
        };
        records = joined(&records, &acquired.records);
        again.learn(&acquired, &records);
        if !acquired.records.is_empty() {
            // Where the zero flow has wandered meanwhile the flow is slow and a bead stays in view: the next run begins there.
            rig.file.rested_um = Some(acquired.neutral_um);
        }
        age_s = acquired.age_s.unwrap_or(age_s);
        fix_noise_um = acquired.fix_noise_um.or(fix_noise_um);
        board = Some(acquired.board);
        runs.extend(acquired.run);
        let gentler = todo.iter().filter(|turn| turn.part < 1.0);
        let done = gentler.filter(|turn| records.iter().any(|r| r.index == turn.index));
        warnings.extend(done.map(|turn| {
            format!(
                "segment {} ({}) lost the bead twice as planned and is measured at {} of its amplitude",
                turn.index + 1,
                plan.segments[turn.index].label,
                turn.part
            )
        }));
        match acquired.trouble {
            None => {}
            Some(trouble) if again.may_go_on(&trouble) => {
                tracing::warn!("{}; measuring again what is missing", trouble.seen());
            }
            Some(trouble) => {
                unfinished(pages, &trouble.to_string(), plan, &records);
                return Err(stopped(job, plan, &records, &trouble)?);
            }
        }
    }
    if let Some(pages) = pages {
        pages.over(
            true,
            "all segments are measured, and the model is being fitted.",
        );
    }
    let led = led_delay(job, &rig)?;
    Ok(Raw {
        records,
        led,
        neutral_um: rig.file.rested_um.unwrap_or(rig.file.first_neutral_um),
        board,
        age_s,
        fix_noise_um,
        warnings,
        runs,
    })
}

/// Tells the page why there is no further run.
fn unfinished(pages: Option<&mut Pages>, why: &str, plan: &Plan, records: &[RecordedSegment]) {
    if let Some(pages) = pages {
        let (done, of) = (records.len(), plan.segments.len());
        pages.over(
            false,
            &format!("{why}; {done} of {of} segments are measured."),
        );
    }
}

/// Segments of earlier runs and of this one, in order.
fn joined(before: &[RecordedSegment], now: &[RecordedSegment]) -> Vec<RecordedSegment> {
    let mut all = [before, now].concat();
    all.sort_by_key(|r| r.index);
    all
}

/// Writes the finished segments; returns the file, if there are any.
fn kept(job: &Job, plan: &Plan, records: &[RecordedSegment]) -> Result<Option<PathBuf>, Failure> {
    let Some(path) = job.keep_in.as_ref().filter(|_| !records.is_empty()) else {
        return Ok(None);
    };
    partial::save(path, plan, records)?;
    Ok(Some(path.clone()))
}

/// How to continue with the segments that a file keeps.
fn resume(path: &Path, plan: &Plan, records: &[RecordedSegment]) -> String {
    format!(
        "continue with the same arguments and --resume {}: {} of {} segments are kept",
        path.display(),
        records.len(),
        plan.segments.len()
    )
}

/// The failure of a stopped identification: the finished segments are kept, and the message says how to continue.
fn stopped(
    job: &Job,
    plan: &Plan,
    records: &[RecordedSegment],
    why: &Trouble,
) -> Result<Failure, Failure> {
    let kept = kept(job, plan, records)?;
    let go_on = match &kept {
        Some(path) => resume(path, plan, records),
        None => "start again: no segment was finished".to_string(),
    };
    Ok(match why {
        Trouble::Ended(ended) => ended.failure(&go_on),
        Trouble::Spoilt { out_of_view, .. } => {
            let first = match out_of_view {
                true => "bring a bead into view",
                false => {
                    "end what holds up machine, camera or line (cellpos doctor --why) or hides the bead (cellpos camera)"
                }
            };
            Failure::Failed(miette::miette!(
                help = format!("{first}, then {go_on}"),
                "{why}"
            ))
        }
    })
}

fn conclude(
    job: &Job,
    measured: Measured,
    led: Option<&DelayTest>,
) -> Result<Identification, Failure> {
    summarise(
        measured,
        job.setup.sampling(),
        led.map(|l| l.estimate),
        job.bootstrap,
        job.seed,
        Some(job.setup.model.plant.velocity_gain_at(Hertz(2.0))),
        job.setup.two_lags,
    )
    .map_err(Failure::failed)
}

/// Runs a plan. After a lost bead the experiment waits for a new one and resumes at the failed segment, at most three times.
fn acquire(
    job: &Job,
    plan: &Plan,
    bead: &mut HeldBead,
    mut records: Vec<RecordedSegment>,
    mut progress: &mut dyn FnMut(usize),
) -> Result<Vec<RecordedSegment>, Failure> {
    for attempt in 0..4 {
        match plan.run(bead, records.len(), &mut progress) {
            Ok(more) => {
                records.extend(more);
                return Ok(records);
            }
            Err(ended) => {
                records.extend(ended.done);
                match ended.cause {
                    Cause::Rig(failure) => {
                        kept(job, plan, &records)?;
                        return Err(failure);
                    }
                    Cause::BeadLost(error)
                        if attempt == 3 || bead.setup().world.new_bead_after_ms.is_none() =>
                    {
                        tracing::warn!("{error}");
                        let (done, of) = (records.len(), plan.segments.len());
                        let missing = of - done;
                        let first = error.to_string();
                        let why = Trouble::Spoilt {
                            missing,
                            of,
                            first,
                            out_of_view: true,
                        };
                        return Err(stopped(job, plan, &records, &why)?);
                    }
                    Cause::BeadLost(error) => {
                        tracing::warn!("{error}; waiting for another bead");
                        bead.wait_for_bead()?;
                    }
                }
            }
        }
    }
    Ok(records)
}
