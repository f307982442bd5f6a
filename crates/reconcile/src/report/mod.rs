//! The HTML report: the answer first, then the shrinking gap, traces, what is left, and the numbers.

mod answer;

use crate::units::figure;
use crate::verdict::map::DiscrepancyMap;
use crate::verdict::result::Reconciliation;
use cellpos_report::{Axis, Column, Emphasis, Figure, HeatMap, Panel, Report, Series, Table};

/// Makes the report of a result, the answer first and the numbers last; `title` names the data.
pub fn report(result: &Reconciliation, title: &str) -> Report {
    let mut r = Report::new(&format!("Reconcile: {title}"));
    answer::answer(&mut r, result);
    innovations(&mut r, result);
    waterfall(&mut r, result);
    traces(&mut r, result);
    what_is_left(&mut r, result);
    numbers(&mut r, result);
    response(&mut r, result);
    r.section("Where");
    r.list(&result.places);
    heat(
        &mut r,
        "map-before",
        "Innovations beyond the noise floor, standard deviations: null model",
        &result.before,
    );
    heat(
        &mut r,
        "map-after",
        "The same with the effects added",
        &result.after,
    );
    gap(&mut r, result);
    records(&mut r, result);
    r
}

fn records(r: &mut Report, result: &Reconciliation) {
    r.section("Records and noise");
    let mut t = Table::new([
        Column::left("record"),
        Column::right("rows"),
        Column::right("frames with a bead"),
    ]);
    for (name, rows, frames) in &result.records {
        t.row([name.clone(), rows.to_string(), frames.to_string()]);
    }
    r.table(t);
    r.paragraph(&format!(
        "Noise of these records: a random walk of {} {}^2/s, white noise of {} RMS; together an innovation of {} RMS, which is the floor of every figure here.",
        figure(result.noise.diffusion_um2_per_s(result.sample_s)),
        result.gap.unit,
        small(result, result.noise.localisation_um()),
        small(result, result.noise.innovation_um())
    ));
}

/// Unit of the printed figures of the gap: nanometres for micrometres, else the unit of the records; with the factor.
fn fine(result: &Reconciliation) -> (f64, &str) {
    match result.gap.unit.as_str() {
        "um" => (1e3, "nm"),
        unit => (1.0, unit),
    }
}

/// A figure of the gap.
fn small(result: &Reconciliation, value: f64) -> String {
    let (factor, unit) = fine(result);
    format!("{} {unit}", figure(factor * value))
}

/// How the gap shrank, effect by effect.
fn waterfall(r: &mut Report, result: &Reconciliation) {
    let g = &result.gap;
    let (factor, unit) = fine(result);
    // The gain of the base set free is no step of the search.
    let steps: Vec<_> = (g.steps.iter().enumerate())
        .filter(|(i, s)| *i == 0 || !s.effects.is_empty())
        .map(|(_, s)| s)
        .collect();
    // One step has the numbers of the answer, no course.
    if steps.len() < 3 {
        return;
    }
    let names: Vec<String> = steps
        .iter()
        .map(|s| match s.effects.is_empty() {
            true => "null model".to_owned(),
            false => s.effects.join(" + "),
        })
        .collect();
    let at: Vec<f64> = (0..steps.len()).map(|i| i as f64).collect();
    let rms: Vec<f64> = steps.iter().map(|s| factor * s.rms).collect();
    r.figure(
        Figure::new(
            "waterfall",
            "Prediction error of all records as the search went on; the line is the noise floor",
        )
        .panel(
            Panel::new(
                Axis::categories("model", &names),
                Axis::linear("innovation", &format!("{unit} RMS")),
            )
            .series(Series::bars("", &at, &rms, 0.6))
            .horizontal(factor * g.floor, "floor"),
        ),
    );
}

/// What no name explains, and the experiment that would tell more.
fn what_is_left(r: &mut Report, result: &Reconciliation) {
    let experiments: Vec<String> = (result.effects.iter())
        .filter_map(|e| Some(format!("{}: {}", e.id, e.separate_by.as_ref()?)))
        .collect();
    if result.remainder.is_none() && result.hypothesis.is_none() && experiments.is_empty() {
        return;
    }
    r.section("What is left, and what would tell more");
    if let Some(rest) = &result.remainder {
        r.note(
            Emphasis::Warning,
            &format!(
                "Remainder, {:.1} % of the excess: {}; {}",
                100.0 * rest.share,
                rest.how,
                rest.places.join("; ")
            ),
        );
    }
    if let Some(h) = &result.hypothesis {
        r.note(
            Emphasis::Warning,
            &format!(
                "Hypothesis, worth {:.0} % of the excess on held-out data: {}",
                100.0 * h.held_out_worth,
                h.formula
            ),
        );
    }
    for experiment in &experiments {
        r.note(Emphasis::Plain, experiment);
    }
}

/// The effects with all their numbers.
fn numbers(r: &mut Report, result: &Reconciliation) {
    if result.effects.is_empty() {
        return;
    }
    r.section("The effects in numbers");
    let mut t = Table::new([
        Column::left("effect"),
        Column::left("place"),
        Column::left("parameters (95 % interval)"),
        Column::right("needed for"),
        Column::right("p"),
        Column::left("or"),
    ]);
    for e in &result.effects {
        let p = e
            .parameters
            .iter()
            .map(|(n, v)| format!("{n} = {} {}", interval(v.value, v.ci95), v.unit))
            .collect::<Vec<_>>()
            .join("; ");
        t.row([
            e.id.clone(),
            e.place.to_owned(),
            p,
            format!("{:.1} %", 100.0 * e.explained),
            p_value(e.p_value),
            e.alternatives.join(", "),
        ]);
    }
    t.caption(
        "Needed for: the part of the excess over the noise floor that comes back without this effect. What any of several effects can \
         take is nobody's, so the parts need not add up to 100 %. Or: effects that explain these records as well.",
    );
    r.table(t);
}

/// A band by its edges in Hz, to three digits.
fn band_name(low_hz: f64, high_hz: f64) -> String {
    let [low, high] = [low_hz, high_hz].map(|hz| figure(hz).parse().unwrap_or(hz));
    format!("{low}\u{2013}{high}")
}

fn heat(r: &mut Report, name: &str, caption: &str, map: &DiscrepancyMap) {
    let n = map.edges_hz.len();
    let rows: Vec<&crate::verdict::map::MapRow> =
        map.rows.iter().filter(|row| row.cells.len() == n).collect();
    let names: Vec<&str> = rows.iter().map(|row| row.name.as_str()).collect();
    let mut bands: Vec<String> = (map.edges_hz.windows(2))
        .map(|edge| band_name(edge[0], edge[1]))
        .collect();
    bands.push("all".to_owned());
    let caption = &format!("{caption}; by record and band (Hz)");
    let values: Vec<f64> = rows
        .iter()
        .flat_map(|row| row.cells.iter().map(|c| c.z))
        .collect();
    r.figure(Figure::heat_map(
        name,
        caption,
        HeatMap::new("excess, standard deviations", &names, &bands, &values),
    ));
}

/// A probability; one below the search's resolution is printed as a bound.
fn p_value(p: f64) -> String {
    const LEAST: f64 = 1e-16;
    if p < LEAST {
        format!("< {LEAST:.0e}")
    } else {
        format!("{p:.1e}")
    }
}

/// A value with its 95 % interval, to the digits that the interval leaves it.
fn interval(value: f64, ci95: [f64; 2]) -> String {
    let [value, low, high] = digits(value, ci95);
    format!("{value} [{low}, {high}]")
}

/// A value and the ends of its interval, to the digits that the interval leaves them.
fn digits(value: f64, [low, high]: [f64; 2]) -> [String; 3] {
    let width = (high - low).abs();
    // Two digits of the width; a value without a width, to six digits.
    let smallest = if width > 0.0 && width.is_finite() {
        0.1 * width
    } else {
        1e-5 * value.abs().max(f64::MIN_POSITIVE)
    };
    let digits = (-smallest.log10().floor()).clamp(0.0, 12.0) as usize;
    [value, low, high].map(|value| format!("{value:.digits$}"))
}

/// Gain and phase with their 95 % intervals: low, middle, high; NaN in a band that was not excited.
struct Supported {
    hz: Vec<f64>,
    gain_db: [Vec<f64>; 3],
    phase_deg: [Vec<f64>; 3],
    left_out: usize,
}

impl Supported {
    fn of(map: &DiscrepancyMap) -> Self {
        let mut found = Self {
            hz: Vec::new(),
            gain_db: Default::default(),
            phase_deg: Default::default(),
            left_out: 0,
        };
        for band in &map.ratios {
            found.hz.push(band.hz);
            let half = 1.96 * band.error;
            let gain = |factor: f64| band.gain_db + 20.0 * factor.max(1e-6).log10();
            let (gains, phases) = if band.is_supported() {
                (
                    [gain(1.0 - half), band.gain_db, gain(1.0 + half)],
                    [-half, 0.0, half].map(|angle| band.phase_deg + angle.to_degrees()),
                )
            } else {
                found.left_out += 1;
                ([f64::NAN; 3], [f64::NAN; 3])
            };
            for (column, value) in found.gain_db.iter_mut().zip(gains) {
                column.push(value);
            }
            for (column, value) in found.phase_deg.iter_mut().zip(phases) {
                column.push(value);
            }
        }
        found
    }
}

fn response(r: &mut Report, result: &Reconciliation) {
    r.section("Response: measured over simulated");
    let (before, after) = (Supported::of(&result.before), Supported::of(&result.after));
    let any = before.gain_db[1].iter().any(|db| db.is_finite());
    r.paragraph(&format!(
        "0 dB and 0 deg mean that the model is right at that frequency. Bars: 95 % intervals. Bands in which less than \
         {:.0} % of the motion was driven are left out ({} of {}): there the record shows noise, and in a loop the answer to it.",
        100.0 * crate::verdict::response::BandRatio::SUPPORTED,
        before.left_out,
        before.hz.len()
    ));
    if !any {
        r.note(
            Emphasis::Plain,
            "no band was driven enough to draw a response: nothing is drawn",
        );
        return;
    }
    let mut gain = Panel::new(Axis::log("frequency", "Hz"), Axis::linear("gain", "dB"));
    let mut phase = Panel::new(Axis::log("frequency", "Hz"), Axis::linear("phase", "deg"));
    for (name, color, of) in [("before", 0, &before), ("after", 1, &after)] {
        // Points: a band that stands alone has no line, and between two bands nothing was measured.
        let drawn = |label: &str, [low, middle, high]: &[Vec<f64>; 3]| {
            Series::intervals(label, &of.hz, middle, low, high).color(color)
        };
        gain = gain.series(drawn(name, &of.gain_db));
        phase = phase.series(drawn("", &of.phase_deg));
    }
    r.figure(
        Figure::new("response", "Measured over simulated, before and after")
            .panel(gain)
            .panel(phase)
            .share_x(),
    );
}

fn gap(r: &mut Report, result: &Reconciliation) {
    r.section("The gap");
    let g = &result.gap;
    let (factor, unit) = fine(result);
    r.paragraph(&format!(
        "On held-out records: {} before, {} after, floor {} RMS of innovation; {:.1} % of the excess over the floor is closed.",
        small(result, g.before),
        small(result, g.after),
        small(result, g.floor),
        100.0 * g.closure()
    ));
    let mut t = Table::new([
        Column::left("model, as the search went on"),
        Column::right(&format!("RMS innovation [{unit}]")),
    ]);
    for s in &g.steps {
        let name = if s.effects.is_empty() {
            match s.base_gain {
                Some(gain) => format!("null model, base gain free ({gain:.4})"),
                None => "null model".to_owned(),
            }
        } else {
            s.effects.join(" + ")
        };
        t.row([name, figure(factor * s.rms)]);
    }
    r.table(t);
    let mut t = Table::new([
        Column::left("held-out record"),
        Column::right(&format!("before [{unit}]")),
        Column::right(&format!("after [{unit}]")),
    ]);
    for p in &g.per_record {
        t.row([
            p.record.clone(),
            figure(factor * p.before),
            figure(factor * p.after),
        ]);
    }
    r.table(t);
}

/// The figure that answers the question: the gap of the model before and after.
fn innovations(r: &mut Report, result: &Reconciliation) {
    let g = &result.gap;
    let (factor, unit) = fine(result);
    let whole_hz = g.bands.last().map_or(1.0, |band| band.high_hz);
    let names: Vec<String> = (g.bands.iter())
        .map(|band| band_name(band.low_hz, band.high_hz))
        .collect();
    let at = |side: f64| {
        (0..names.len())
            .map(|n| n as f64 + side)
            .collect::<Vec<f64>>()
    };
    // A band's share of the whole: the squares of all bands add up to the square of the whole.
    let share = |f: fn(&crate::verdict::result::BandGap) -> f64| {
        let of = |band| {
            let band: &crate::verdict::result::BandGap = band;
            factor * f(band) * ((band.high_hz - band.low_hz) / whole_hz).sqrt()
        };
        g.bands.iter().map(of).collect::<Vec<f64>>()
    };
    let whole = |f: fn(&crate::verdict::result::BandGap) -> f64| {
        let squares: f64 = share(f).iter().map(|part| part * part).sum();
        format!("{} {unit}", figure(squares.sqrt()))
    };
    r.figure(
        Figure::new(
            "spectrum",
            &format!(
                "Prediction error by frequency band: the part of each band, of the model as it was and with the effects added, and the part \
                 that noise alone has (points; by chance a band is a little below it). The squares of the parts add up to the square of the \
                 whole: {} before, {} after, {} of noise, of all records together, each counting alike, and of all of each record: \
                 the sentence above is of the parts that the fit had not seen.",
                whole(|b| b.before),
                whole(|b| b.after),
                whole(|b| b.floor)
            ),
        )
        .panel(
            Panel::new(
                Axis::categories("frequency band (Hz)", &names),
                Axis::linear("prediction error", &format!("{unit} RMS")),
            )
            .series(Series::bars("before", &at(-0.2), &share(|b| b.before), 0.38))
            .series(Series::bars("after", &at(0.2), &share(|b| b.after), 0.38))
            .series(Series::points("noise alone", &at(0.2), &share(|b| b.floor)).color(7)),
        ),
    );
}

/// The residual of a free run that is right: noise, and on a plant that integrates whatever it adds up.
fn free_run_noise(result: &Reconciliation) -> String {
    let shown = (result.traces.all.iter())
        .map(|trace| trace.time_s.len())
        .max()
        .unwrap_or(0);
    let noise = &result.noise;
    let walk = (noise.walk_um2 * shown as f64).sqrt();
    let still = noise.white_um2 + noise.coloured.map_or(0.0, |c| c.variance_um2);
    let still = still.max(0.0).sqrt();
    let mut left = Vec::new();
    if still > 1e-2 * walk {
        left.push(format!("noise of {} RMS", small(result, still)));
    }
    if walk > still {
        let end_s = figure(shown as f64 * result.sample_s);
        let away = small(result, walk);
        left.push(format!(
            "a Brownian path, which goes some {away} in {end_s} s"
        ));
    }
    let off = if result.traces.ramp {
        "a level and a ramp, which an error of the zero flow makes"
    } else {
        "a level"
    };
    format!(
        "Free runs of both models from the start of each record, each moved by {off}. A right model still leaves {}.",
        left.join(", and ")
    )
}

fn traces(r: &mut Report, result: &Reconciliation) {
    r.section("Traces");
    r.paragraph(&free_run_noise(result));
    let unit = &result.gap.unit;
    for t in &result.traces.all {
        r.figure(
            Figure::new(
                &format!("trace-{}", t.record),
                &format!("{}: position and free-run residual", t.record),
            )
            .panel(
                Panel::new(Axis::linear("time", "s"), Axis::linear("position", unit))
                    .series(Series::line("measured", &t.time_s, &t.measured_um))
                    .series(Series::line("before", &t.time_s, &t.before_um).thin())
                    .series(Series::line("after", &t.time_s, &t.after_um).thin()),
            )
            .panel(
                Panel::new(Axis::linear("time", "s"), Axis::linear("residual", unit))
                    .series(
                        Series::line("", &t.time_s, &t.residual_before_um)
                            .thin()
                            .color(1),
                    )
                    .series(
                        Series::line("", &t.time_s, &t.residual_after_um)
                            .thin()
                            .color(2),
                    ),
            )
            .share_x(),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interval_has_the_digits_that_it_leaves_the_value() {
        assert_eq!(interval(2.0, [1.998_1, 2.002_9]), "2.0000 [1.9981, 2.0029]");
        assert_eq!(interval(123.456, [113.4, 133.5]), "123 [113, 134]");
        assert_eq!(
            interval(0.25, [0.25, 0.25]),
            "0.250000 [0.250000, 0.250000]"
        );
    }

    #[test]
    fn a_probability_too_small_to_compute_is_no_number() {
        assert_eq!(p_value(1e-300), "< 1e-16");
        assert_eq!(p_value(0.0321), "3.2e-2");
    }
}
