//! Measures the slow partner of the PZT: gain, lag and delay, each with an interval.
//!
//! The loop holds a bead with the PZT, and the partner makes a square wave unknown to the loop. The motion that the PZT does not
//! explain comes from the partner: its command through a lag and a delay, times the gain, into the same plant. This command is
//! not part of the loop, so feedback causes no bias. To hold the bead the PZT cancels the partner's motion, so the gain in um of
//! PZT does not depend on the plant's gain.

use crate::experiment::on_rig::OnRig;
use crate::experiment::rows::fix_noise_um;
use cellpos_control::Probe;
use cellpos_ident::least_squares::{covariance, minimise};
use cellpos_numeric::statistics::Z95;
use cellpos_plant::{Model, Simulator};
use cellpos_runtime::{EndRule, Event, RunSink, Statistics, TickFlags, TickRecord};
use cellpos_session::setup::{Prepared, ReferenceSpec};
use cellpos_session::{EndKind, Failure, Rig};
use serde::Serialize;
use std::sync::mpsc::{Sender, channel};

/// How the partner is moved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moves {
    /// Half of peak to peak on its own scale, um.
    pub amplitude_um: f64,
    /// Time up, and time down, s.
    pub half_period_s: f64,
    /// Of the whole measurement, s.
    pub duration_s: f64,
}

/// The moves, and the speed at which the device follows.
#[derive(Debug, Clone, Copy)]
struct Followed {
    half_period_s: f64,
    duration_s: f64,
    slew_um_per_s: f64,
}

/// The result; intervals are half widths, 95 %.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Measured {
    /// PZT displacement, um, with the effect of 1 um of the partner.
    pub gain: f64,
    /// Its interval.
    pub gain_ci95: f64,
    /// Lag (63 % of a step), ms.
    pub lag_ms: f64,
    /// Its interval.
    pub lag_ci95_ms: f64,
    /// Dead time before the lag, ms.
    pub delay_ms: f64,
    /// Its interval.
    pub delay_ci95_ms: f64,
    /// Rows that were used.
    pub rows: usize,
}

/// Passes every tick to the thread that waits for the run.
struct Ticks(Sender<TickRecord>);

impl RunSink for Ticks {
    fn tick(&mut self, record: &TickRecord) {
        // No receiver: the run has ended already.
        let _ = self.0.send(*record);
    }
    fn event(&mut self, _: &Event) {}
    fn progress(&mut self, _: &Statistics) {}
}

/// Moves the partner of a rig while the bead is held, and measures it.
///
/// # Errors
/// The rig file has no partner, the run ended early, or the partner's effect is below the noise.
pub fn measure(on: &OnRig, moves: Moves) -> Result<Measured, Failure> {
    let mut file = on.file.clone();
    let table = file.partner.as_mut().ok_or_else(no_partner)?;
    // Mid-ranging is off during the measurement, so any gain will do.
    table.gain = table.gain.or(Some(1.0));
    let period_s = file.timing.period_us * 1e-6;
    let partner_period_s = table.period_ms * 1e-3;
    let followed = Followed {
        half_period_s: moves.half_period_s,
        duration_s: moves.duration_s,
        slew_um_per_s: table.slew_um_per_s,
    };
    let mut rig = Rig::open(file, on.options())?;
    let mut prepared = Prepared {
        model: on.model.clone(),
        controller: on.controller,
    };
    rig.fit(&mut prepared);
    let mut setup = rig.set_up(prepared, ReferenceSpec::Hold { position_um: 0.0 })?;
    if let Some(partner) = &mut setup.config.partner {
        partner.probe = Some(Probe {
            amplitude_um: moves.amplitude_um,
            half_period_s: moves.half_period_s,
        });
    }
    let core = setup.core()?;
    let (sender, received) = channel();
    let end = EndRule {
        ticks: Some((moves.duration_s / period_s) as u64),
        ..EndRule::default()
    };
    let armed = rig.arm(&setup, core, Ticks(sender), end)?;
    let finished = armed.moving_the_bead().start()?.wait()?;
    let ticks: Vec<TickRecord> = received.try_iter().collect();
    if ticks
        .iter()
        .any(|tick| tick.flags.has(TickFlags::PARTNER_LOST))
    {
        return Err(Failure::Failed(miette::miette!(
            help = "is the program that serves it running, and within its watchdog?",
            "the slow actuator was silent or did not obey during the measurement"
        )));
    }
    if !matches!(finished.ended.kind, EndKind::Done | EndKind::NotKept) {
        return Err(finished
            .ended
            .failure("a smaller --amplitude keeps the bead in view"));
    }
    fit(&ticks, &on.model, period_s, partner_period_s, followed)
}

fn no_partner() -> Failure {
    Failure::bad_input(
        "the rig file has no table [partner]",
        "docs/pair.md says how to write one",
    )
}

/// The rows that the fit uses: commands, and positions of exposures a known time before.
struct Data {
    pzt_um: Vec<f64>,
    partner_um: Vec<f64>,
    bead_um: Vec<f64>,
    age_s: f64,
}

fn data(ticks: &[TickRecord], moves: Followed) -> Option<Data> {
    let held: Vec<&TickRecord> = (ticks.iter())
        .filter(|tick| tick.is_running() && tick.partner_command_um.is_finite())
        .collect();
    let ages: Vec<f64> = held
        .iter()
        .filter(|tick| !tick.flags.has(TickFlags::TIMER))
        .map(|tick| (tick.time_ns - tick.mid_exposure_ns) as f64 * 1e-9)
        .collect();
    let enough = held.len() > 100 && moves.duration_s > 4.0 * moves.half_period_s;
    let age_s = ages.iter().sum::<f64>() / ages.len().max(1) as f64;
    (enough && !ages.is_empty()).then(|| Data {
        pzt_um: held.iter().map(|tick| tick.command_um).collect(),
        partner_um: settled(&held),
        bead_um: held
            .iter()
            .map(|tick| {
                let usable = !tick.flags.has(TickFlags::TIMER) && tick.is_controlled();
                if usable { tick.measured_um } else { f64::NAN }
            })
            .collect(),
        age_s,
    })
}

/// The commands as the device executed them, on the steps of its converter, from its own report at the end of each.
fn settled(held: &[&TickRecord]) -> Vec<f64> {
    let mut out: Vec<f64> = held.iter().map(|tick| tick.partner_command_um).collect();
    let mut end = held.len();
    while end > 0 {
        let command_um = out[end - 1];
        let start = (0..end)
            .rev()
            .take_while(|&k| out[k] == command_um)
            .last()
            .unwrap_or(end - 1);
        let applied_um = held[end - 1].partner_applied_um;
        // Until the new report arrives, it is still that of the command before.
        let of_this = end - start > 100 && applied_um.is_finite();
        if of_this {
            out[start..end].fill(applied_um);
        }
        end = start;
    }
    out
}

/// Gain, lag and delay from the ticks of a run.
fn fit(
    ticks: &[TickRecord],
    model: &Model,
    period_s: f64,
    partner_period_s: f64,
    moves: Followed,
) -> Result<Measured, Failure> {
    let data = data(ticks, moves).ok_or_else(too_little)?;
    let noise_um = fix_noise_um(ticks).unwrap_or(0.0);
    // Use increments over a quarter of the partner's period: several increments contain each step, and most of the noise of a fix
    // averages out.
    let apart = ((0.25 * partner_period_s / period_s).round() as usize).max(1);
    let walk_um2 = 2.0 * model.noise.diffusion_um2_per_s * apart as f64 * period_s;
    let sd_um = (walk_um2 + 2.0 * noise_um * noise_um).max(1e-8).sqrt();
    let through = |input: &[f64]| through(model, input, period_s, data.age_s);
    let of_pzt = through(&data.pzt_um)?;
    let flat = through(&vec![model.working_point_um + 1.0; data.pzt_um.len()])?;
    let ramp: Vec<f64> = (0..data.pzt_um.len())
        .map(|k| model.working_point_um + k as f64 / data.pzt_um.len() as f64)
        .collect();
    let ramp = through(&ramp)?;
    let left: Vec<f64> = data
        .bead_um
        .iter()
        .zip(&of_pzt)
        .map(|(p, s)| p - s)
        .collect();
    let rows = (data.bead_um.len() - 1) / apart;
    let slewed = slewed(&data.partner_um, moves.slew_um_per_s * period_s);
    let base_um = data.partner_um.first().copied().unwrap_or(0.0);
    let residuals = |x: &[f64], out: &mut [f64]| {
        let lag_s = x[1].exp() * 1e-3;
        let output = lagged(&slewed, period_s, lag_s, x[2] * 1e-3);
        let input: Vec<f64> = output
            .iter()
            .map(|y| model.working_point_um + y - base_um)
            .collect();
        let Ok(of_partner) = through(&input) else {
            return out.fill(f64::NAN);
        };
        let z = |k: usize| left[k] - x[0] * of_partner[k] - x[3] * flat[k] - x[4] * ramp[k];
        for (row, out) in out.iter_mut().enumerate() {
            let change = z((row + 1) * apart) - z(row * apart);
            *out = if change.is_finite() {
                change / sd_um
            } else {
                0.0
            };
        }
    };
    let start_ms = 1e3 * 2.0 * partner_period_s;
    let start = [0.5, start_ms.ln(), 0.25e3 * partner_period_s, 0.0, 0.0];
    let steps = [1e-3, 1e-2, 0.1, 1e-3, 1e-3];
    let least = minimise(&start, &steps, rows, residuals);
    let spread = (least.chi2 / (rows as f64 - 5.0).max(1.0)).max(1.0);
    let cov = covariance(&least.jacobian) * spread;
    let half = |i: usize| Z95 * cov[(i, i)].max(0.0).sqrt();
    let [gain, lag_ms, delay_ms] = [
        least.parameters[0],
        least.parameters[1].exp(),
        least.parameters[2],
    ];
    if !least.converged || half(0).is_nan() || half(0) > 0.2 * gain.abs() {
        return Err(Failure::Failed(miette::miette!(
            help = "a larger --amplitude or a longer --duration; does it move the bead at all?",
            "the slow actuator cannot be told from the bead's own motion: gain {gain:.3} +- {:.3}",
            half(0)
        )));
    }
    if lag_ms + delay_ms > 250.0 * moves.half_period_s {
        return Err(Failure::Failed(miette::miette!(
            help = "give it four times that: --half-period",
            "the slow actuator takes {:.0} ms, longer than a square wave of {} s shows",
            lag_ms + delay_ms,
            moves.half_period_s
        )));
    }
    Ok(Measured {
        gain,
        gain_ci95: half(0),
        lag_ms,
        lag_ci95_ms: half(1) * lag_ms,
        delay_ms: delay_ms.max(0.0),
        delay_ci95_ms: half(2),
        rows,
    })
}

fn too_little() -> Failure {
    Failure::Failed(miette::miette!(
        help = "a longer --duration; is a bead in view?",
        "too few ticks with a held bead"
    ))
}

/// Positions that a drive gives at the exposures of its rows.
fn through(model: &Model, input: &[f64], period_s: f64, age_s: f64) -> Result<Vec<f64>, Failure> {
    // The plant alone: the model's other effects belong to the camera, or are too fast to matter for a slow partner.
    let bare = Model {
        effects: Vec::new(),
        camera_delay_s: None,
        frame_age_s: None,
        ..model.clone()
    };
    let mut simulator = Simulator::new(&bare, period_s, None).map_err(Failure::input)?;
    let mut path: Vec<f64> = Vec::with_capacity(input.len());
    for um in input {
        path.push(simulator.measure());
        simulator.hold(*um);
    }
    Ok(earlier(&path, age_s / period_s))
}

/// A path a number of rows before each row, linear between rows.
fn earlier(path: &[f64], rows: f64) -> Vec<f64> {
    let at = |k: f64| {
        let k = k.clamp(0.0, (path.len() - 1) as f64);
        let (low, part) = (k.floor() as usize, k.fract());
        let high = (low + 1).min(path.len() - 1);
        path[low] + part * (path[high] - path[low])
    };
    (0..path.len()).map(|k| at(k as f64 - rows)).collect()
}

/// Commands as a device with a slew limit follows them, in the middle of each row; at most `most_um` per row.
fn slewed(commands_um: &[f64], most_um: f64) -> Vec<f64> {
    let mut at_um = commands_um.first().copied().unwrap_or(0.0);
    let mut path = Vec::with_capacity(commands_um.len());
    for command_um in commands_um {
        let before_um = at_um;
        at_um = command_um.clamp(at_um - most_um, at_um + most_um);
        path.push(0.5 * (before_um + at_um));
    }
    path
}

/// The partner's output for its commands, in the middle of each row.
fn lagged(commands_um: &[f64], period_s: f64, lag_s: f64, delay_s: f64) -> Vec<f64> {
    let share = -(-period_s / lag_s).exp_m1();
    let half = -(-0.5 * period_s / lag_s).exp_m1();
    let mut output_um = commands_um.first().copied().unwrap_or(0.0);
    let path: Vec<f64> = commands_um
        .iter()
        .map(|command_um| {
            let middle_um = output_um + half * (command_um - output_um);
            output_um += share * (command_um - output_um);
            middle_um
        })
        .collect();
    earlier(&path, delay_s / period_s)
}
