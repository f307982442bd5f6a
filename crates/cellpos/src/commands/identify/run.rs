//! From arguments to a finished identification of the emulated rig: plan, run, delay test, summary.

use super::bench::{DelayTest, HeldBead, Setup};
use crate::outcome::Failure;
use cellpos_ident::excitation::Limits;
use cellpos_ident::experiment::{Cause, Measured, Plan, RecordedSegment};
use cellpos_ident::frequency_response::Settings;
use cellpos_ident::summary::{Identification, summarise};

/// What to measure.
#[derive(Debug, Clone)]
pub struct Job {
    /// The rig.
    pub setup: Setup,
    /// Lines, Hz.
    pub lines_hz: Vec<f64>,
    /// All lines at once (random-phase multisine) or one after the other.
    pub multisine: bool,
    /// Largest amplitudes.
    pub limits: Limits,
    /// Measuring time per line is this over the frequency, s at 1 Hz.
    pub seconds_at_1_hz: f64,
    /// Edges of the LED test; 0: none.
    pub led_edges: usize,
    /// Bootstrap replicates.
    pub bootstrap: usize,
    /// Seed of excitation, dither and bootstrap.
    pub seed: u64,
}

/// What came of it.
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
}

/// Runs a job; `progress` hears ticks done and ticks in all.
pub fn run(job: &Job, mut progress: impl FnMut(usize, usize)) -> Result<Done, Failure> {
    let expected = job.setup.expected()?;
    let period_s = job.setup.sampling().period_s;
    let plan = if job.multisine {
        Plan::multisine(
            &job.lines_hz,
            &expected,
            job.limits,
            period_s,
            job.seconds_at_1_hz,
            job.seed,
        )
    } else {
        Plan::stepped_sines(
            &job.lines_hz,
            &expected,
            job.limits,
            period_s,
            job.seconds_at_1_hz,
        )
    };
    let total = plan.ticks() + job.led_edges * 11;
    let mut bead = HeldBead::open(job.setup.clone())?;
    let records = acquire(&plan, &mut bead, |ticks| progress(ticks, total))?;
    let measured = plan
        .analyse(&records, &Settings::default())
        .map_err(Failure::failed)?;
    let led = if job.led_edges > 0 {
        Some(bead.delay_test(job.led_edges, job.seed)?)
    } else {
        None
    };
    let neutral_um = bead.neutral_um();
    bead.close()?;
    progress(total, total);
    let result = conclude(job, measured, led.as_ref())?;
    Ok(Done {
        plan,
        records,
        result,
        led,
        neutral_um,
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
    )
    .map_err(Failure::failed)
}

/// Runs a plan. A bead that is lost once is given up and a new one waited for: the experiment resumes at the segment
/// that failed, at most three times.
fn acquire(
    plan: &Plan,
    bead: &mut HeldBead,
    mut progress: impl FnMut(usize),
) -> Result<Vec<RecordedSegment>, Failure> {
    let mut records: Vec<RecordedSegment> = Vec::new();
    for attempt in 0..4 {
        match plan.run(bead, records.len(), &mut progress) {
            Ok(more) => {
                records.extend(more);
                return Ok(records);
            }
            Err(stopped) => {
                records.extend(stopped.done);
                match stopped.cause {
                    Cause::Rig(failure) => return Err(failure),
                    Cause::BeadLost(error)
                        if attempt == 3 || bead.setup().world.new_bead_after_ms.is_none() =>
                    {
                        return Err(Failure::failed(error));
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
