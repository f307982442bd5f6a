//! The numbers of what was found, with their intervals.

use crate::fit::catalogue::Part;
use crate::fit::context::{Context, Fit};
use crate::verdict::result::Interval;
use cellpos_plant::effects::{self, FitParameter, Role};
use std::collections::BTreeMap;

/// Relative error of a parameter that no length of record reduces: two integrators of the same equations that take an edge of the
/// command differently agree to about a thousandth (two of these).
const NUMERIC: f64 = 5e-4;

/// That error in the fit's coordinates.
pub(crate) fn numeric_error(p: &FitParameter, x: f64) -> f64 {
    NUMERIC * if p.log { 1.0 } else { x.abs() }
}

/// Standard deviations of a normal distribution that hold 95 % of it.
pub(crate) const SURE: f64 = 1.96;

/// How sure the numbers of a set are.
pub(crate) struct Sureness {
    /// By how many times each is less sure than the likelihood says: it scatters between the records, or something is left over.
    pub wide: Vec<f64>,
    /// The ends by the profile of the likelihood, so much wider.
    pub ends: Vec<Option<[f64; 2]>>,
}

/// Parameters of part `index` with 95 % intervals in their units.
pub(crate) fn parameters(
    ctx: &Context<'_>,
    fit: &Fit,
    index: usize,
    sure: &Sureness,
) -> BTreeMap<String, Interval> {
    let offset: usize = fit.parts[..index]
        .iter()
        .map(|p| p.variant().params.len())
        .sum();
    let part = &fit.parts[index];
    let mut out = BTreeMap::new();
    for (j, p) in part.variant().params.iter().enumerate() {
        let x = part.theta[j];
        let wide = SURE * sure.wide[offset + j];
        let sd = fit.covariance[(offset + j, offset + j)].max(0.0).sqrt();
        let by_curvature = [x - wide * sd, x + wide * sd];
        let [low, high] = sure.ends[offset + j].unwrap_or(by_curvature);
        let numeric = wide * numeric_error(p, x);
        // What no record sees may be anything in its range.
        let (low, high) = if sd.is_finite() {
            let end = |to: f64| (to - x).abs().hypot(numeric);
            (p.natural(x - end(low)), p.natural(x + end(high)))
        } else {
            (p.lower, p.upper)
        };
        let name = if p.name == "weights" {
            format!("weights[{j}]")
        } else {
            p.name.to_owned()
        };
        out.insert(
            name,
            Interval {
                value: p.natural(x),
                ci95: [low, high],
                unit: unit_of(part, p.name).to_owned(),
            },
        );
    }
    match part.variant().role {
        Role::Line { harmonics } => {
            let line = &fit.lines[fit.nth_of_role(index)];
            let um = wave_um(ctx, part, line, 1);
            if harmonics > 1 && um.value > 0.0 {
                let of_second = wave_um(ctx, part, line, 2);
                let share = |second_um: f64| second_um / um.value;
                let second = Interval {
                    value: share(of_second.value),
                    ci95: of_second.ci95.map(share),
                    unit: String::new(),
                };
                out.insert("second".to_owned(), second);
            }
            out.insert("um".to_owned(), um);
        }
        Role::Position => {
            out.extend(wave_of_position(ctx, fit, index, fit.nth_of_role(index)));
        }
        Role::Chain => {}
    }
    for interval in out.values_mut() {
        tell(ctx, part, interval);
    }
    out
}

/// One number of a part as the search has it, in the unit of the records.
pub(crate) fn told(ctx: &Context<'_>, part: &Part, name: &str, value: f64) -> Interval {
    let mut interval = Interval {
        value,
        ci95: [value; 2],
        unit: unit_of(part, name).to_owned(),
    };
    tell(ctx, part, &mut interval);
    interval
}

fn tell(ctx: &Context<'_>, part: &Part, interval: &mut Interval) {
    let scaled =
        effects::find(part.id()).and_then(|kind| ctx.scales.of_number(kind, &interval.unit));
    if let Some((factor, unit)) = scaled {
        interval.value *= factor;
        interval.ci95 = interval.ci95.map(|v| v * factor);
        interval.unit = unit;
    }
}

/// A value with the standard deviations about it that cover 95 %.
fn about(value: f64, sd: f64, unit: &str) -> Interval {
    Interval {
        value,
        ci95: [value - SURE * sd, value + SURE * sd],
        unit: unit.to_owned(),
    }
}

/// Amplitude of a line: the mean over the records, by their rows.
/// Mean amplitude of a line at `times` its frequency.
fn wave_um(ctx: &Context<'_>, part: &Part, line: &[Vec<[f64; 2]>], times: usize) -> Interval {
    let records = &ctx.problem.records;
    let rows: f64 = records.iter().map(|r| r.u.len() as f64).sum();
    let mean = ctx.mean_wave_um(line, times);
    // One record's amplitude has the error sigma sqrt(2/n) over the filter's gain at the line.
    let w = std::f64::consts::TAU * times as f64 * part.natural()[0] * ctx.problem.base.sample_s;
    let theta = ctx.problem.noise.white_um2 / ctx.problem.noise.innovation_um().powi(2);
    let gain = (2.0 * (w / 2.0).sin()) / (1.0 + theta * theta - 2.0 * theta * w.cos()).sqrt();
    let sd = ctx.problem.noise.innovation_um() * (2.0 / rows).sqrt() / gain.max(1e-6);
    // A sine and a cosine of noise have a length themselves: sd_i^2/(2 A) in the mean of each record's.
    let mean = (mean - 0.5 * sd * sd * line.len() as f64 / mean.max(1e-12)).max(0.0);
    about(mean, sd, "um")
}

/// Amplitude of an error periodic in position, in pixels; by the exact filter, where it was run, the pixel as well.
fn wave_of_position(
    ctx: &Context<'_>,
    fit: &Fit,
    index: usize,
    nth: usize,
) -> Vec<(String, Interval)> {
    if let Some(Some(exact)) = fit.locking.get(index) {
        let (amplitude, sd) = exact.amplitude_px();
        let factor = (SURE * exact.log_pixel_error().hypot(NUMERIC)).exp();
        let pixel = Interval {
            value: exact.pixel_um,
            ci95: [exact.pixel_um / factor, exact.pixel_um * factor],
            unit: "um".to_owned(),
        };
        let amplitude = about(amplitude, sd.hypot(NUMERIC * amplitude), "px");
        return vec![
            ("pixel_um".to_owned(), pixel),
            ("amplitude".to_owned(), amplitude),
        ];
    }
    let [a, b] = fit.positions[nth];
    let pixel = fit.parts[index].natural()[0];
    let rows: f64 = ctx.problem.count(&ctx.problem.all()) as f64;
    // The fit sees the error at an uncertain position: less sharp than it is.
    let scale = pixel * ctx.problem.noise.sharpness(pixel);
    let sd = ctx.problem.noise.innovation_um() * (2.0 / rows).sqrt() / scale;
    let amplitude = a.hypot(b) / scale;
    // Positions carry the error themselves: the second order of its slope, as an error of the method.
    let bent = amplitude * (std::f64::consts::TAU * amplitude).powi(2) / 16.0;
    vec![(
        "amplitude".to_owned(),
        about(amplitude, sd.hypot(bent), "px"),
    )]
}

/// Unit of a parameter; a width of operators is that of their thresholds.
fn unit_of(part: &Part, name: &str) -> &'static str {
    if name == "width_um" {
        return "um";
    }
    effects::find(part.id()).map_or("", |k| k.spec().unit(name))
}
