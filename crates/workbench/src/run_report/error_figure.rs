//! The error of a run in a figure: over time, and how it is spread, or what was reached.

use super::bound::Bound;
use super::ticks::Ticks;
use super::traces;
use cellpos_report::{Axis, Figure, Panel, Series};
use cellpos_script::CycleRow;

/// The motions of waves: amplitude (half of peak to peak, um), and reached over commanded amplitude of each of its cycles.
pub(super) fn motions(rows: &[CycleRow]) -> Vec<(f64, Vec<f64>)> {
    let mut found: Vec<(&CycleRow, Vec<f64>)> = Vec::new();
    let whole = rows.iter().filter(super::fatigue::is_whole);
    for row in whole.filter(|row| !super::cycles::was_elsewhere(row)) {
        let reached = row.reached_um / row.commanded_um;
        if !reached.is_finite() {
            continue;
        }
        let same = |(known, _): &&mut (&CycleRow, Vec<f64>)| {
            row.moves_as((known.stroke_um, known.duration_s))
        };
        match found.iter_mut().find(same) {
            Some((_, values)) => values.push(reached),
            None => found.push((row, vec![reached])),
        }
    }
    let mut found: Vec<(f64, Vec<f64>)> = found
        .into_iter()
        .map(|(row, values)| (row.stroke_um, values))
        .collect();
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found
}

pub(super) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The error over the run; beside it how it is spread, or the motion.
pub(super) fn error_figure(ticks: &Ticks, bound: Option<&Bound>, rows: &[CycleRow]) -> Figure {
    let course = ticks.rms_nm.series("measured").color(0);
    let mut over_time =
        Panel::new(Axis::linear("time", "s"), Axis::log("error", "nm RMS")).series(course);
    let mut caption = format!(
        "Error: measured position less the target at the time of its exposure, its RMS over each {} s from the closing of the loop on",
        super::cycles::short(ticks.rms_nm.long_s())
    );
    if let Some(bound) = bound {
        let (ends, at) = ([0.0, ticks.end_s()], [1e3 * bound.rms_um; 2]);
        over_time = over_time.series(
            Series::line("lowest possible", &ends, &at)
                .dashed()
                .color(1),
        );
        caption.push_str("; dashed: the lowest possible over a long time");
    }
    let reached = motions(rows);
    let beside = if ticks.motion_rms_um().is_none() {
        caption.push_str(". Right: how often each error occurred");
        spread(ticks, bound, &mut caption)
    } else if reached.len() > 1 {
        caption.push_str(". Right: amplitude reached, with the 95 % interval of its mean where that is larger than the point");
        amplitudes(&reached)
    } else if rows.is_empty() {
        caption.push_str(
            ". Right: the end of the run, each measured position at the time of its exposure",
        );
        let end = ticks.last_periods(3.0);
        Panel::new(Axis::linear("time", "s"), Axis::linear("position", "um"))
            .series(Series::line("target", &end.time_s, &end.target_um).color(1))
            .series(
                Series::points("each position", &end.time_s, &end.measured_um)
                    .color(0)
                    .thin(),
            )
    } else {
        caption.push_str(". Right: position and target over the whole run");
        traces::position(ticks)
    };
    Figure::new("error", &(caption + "."))
        .panel(over_time)
        .panel(beside)
        .columns(2)
}

/// How often each error occurred, and how often it would at the bound.
fn spread(ticks: &Ticks, bound: Option<&Bound>, caption: &mut String) -> Panel {
    const BINS: usize = 50;
    let panel = Panel::new(Axis::linear("error", "nm"), Axis::linear("positions", ""))
        .series(ticks.error_nm.histogram("", BINS).color(0));
    let (Some(bound), Some((low, high))) = (bound, ticks.error_nm.ends()) else {
        return panel;
    };
    caption.push_str(", and would at the lowest possible (dashed)");
    let sigma_nm = 1e3 * bound.rms_um;
    let each = ticks.error_nm.count() as f64 * (high - low) / BINS as f64;
    let most = 4.0 * sigma_nm;
    let (x, y): (Vec<f64>, Vec<f64>) = (-100..=100)
        .map(|k| {
            let nm = most * f64::from(k) / 100.0;
            let density =
                (-0.5 * (nm / sigma_nm).powi(2)).exp() / (sigma_nm * std::f64::consts::TAU.sqrt());
            (nm, each * density)
        })
        .unzip();
    panel.series(Series::line("", &x, &y).dashed().color(1))
}

/// Amplitude reached of each that was commanded.
fn amplitudes(reached: &[(f64, Vec<f64>)]) -> Panel {
    let names: Vec<String> = reached
        .iter()
        .map(|(um, _)| super::cycles::short(*um))
        .collect();
    let at: Vec<f64> = (0..reached.len()).map(|n| n as f64).collect();
    let of = |end: f64| -> Vec<f64> {
        let value = |values: &Vec<f64>| 100.0 * (mean(values) + end * super::half95(values));
        reached.iter().map(|(_, values)| value(values)).collect()
    };
    let means: Vec<f64> = reached
        .iter()
        .map(|(_, values)| 100.0 * mean(values))
        .collect();
    let axis = Axis::categories("commanded amplitude (um)", &names);
    Panel::new(axis, Axis::linear("reached", "%"))
        .series(Series::intervals("reached", &at, &means, &of(-1.0), &of(1.0)).color(0))
        .horizontal(100.0, "")
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_script::ArmKind;

    #[test]
    fn cycles_of_one_amplitude_are_one_motion() {
        let rows: Vec<CycleRow> = (0..12)
            .map(|cycle| {
                let mut row = CycleRow::empty(cycle, 1, ArmKind::Cyclic);
                (row.stroke_um, row.duration_s) = ([4.0, 0.5, 2.0][cycle as usize % 3], 0.25);
                row.start_s = cycle as f64;
                // The fundamental of a wave is fitted to its ticks, and scatters.
                row.commanded_um = 0.81 * row.stroke_um * (1.0 + 1e-3 * (cycle % 2) as f64);
                (row.reached_um, row.bias_um) = (0.9 * row.commanded_um, 0.0);
                row
            })
            .collect();
        let found = motions(&rows);
        let amplitudes: Vec<f64> = found.iter().map(|(um, _)| *um).collect();
        assert_eq!(amplitudes, [0.5, 2.0, 4.0]);
        assert!(
            found
                .iter()
                .all(|(_, reached)| reached.len() == 4 && (mean(reached) - 0.9).abs() < 1e-9)
        );
    }
}
