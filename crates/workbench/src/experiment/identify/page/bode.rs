//! The Bode plot of an identification, and what the fit leaves of it.

use cellpos_ident::candidate_model::CandidateModel;
use cellpos_ident::summary::Identification;
use cellpos_numeric::statistics::Z95;
use cellpos_plant::{Complex, EQ5_VELOCITY_GAIN_PER_S, Hertz, TransferFunction};
use cellpos_report::{Axis, Figure, Panel, Series, log_grid};

/// What a Bode plot shows beyond the points and the fit.
#[derive(Debug, Clone, Copy)]
pub struct Shown {
    /// Up to where the fit is drawn, Hz.
    pub high_hz: f64,
    /// Eq. (6) and the integrator of Eq. (5).
    pub eq6: bool,
    /// The phase with the delay left in.
    pub delayed: bool,
}

fn unwrapped_deg(phase: f64) -> f64 {
    phase - 360.0 * ((phase + 90.0) / 360.0).round()
}

/// A band wider than the intervals of its points by this factor shows a parameter that the points do not determine: a plant of
/// `p` parameters through `n` points has a band of about sqrt(p/n) intervals, so one interval or less.
const WIDEST_BAND: f64 = 3.0;

/// Gain or phase.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Part {
    Gain,
    Phase,
}

impl Part {
    fn of(self, response: Complex<f64>) -> f64 {
        match self {
            Self::Gain => 20.0 * response.norm().log10(),
            Self::Phase => unwrapped_deg(response.arg().to_degrees()),
        }
    }

    fn axis(self, less_fit: bool) -> Axis {
        match (self, less_fit) {
            (Self::Gain, false) => Axis::linear("gain", "dB"),
            (Self::Gain, true) => Axis::linear("gain less fit", "dB"),
            (Self::Phase, false) => Axis::linear("phase", "deg"),
            (Self::Phase, true) => Axis::linear("phase less fit", "deg"),
        }
    }
}

/// Bode plot of the compensated points and the fitted model; beside it both less the fit, with its 95 % band.
pub fn bode(name: &str, caption: &str, result: &Identification, shown: Shown) -> Figure {
    let mut figure = Figure::new(name, caption).columns(2);
    for part in [Part::Gain, Part::Phase] {
        figure = figure
            .panel(panel(result, part, false, shown))
            .panel(panel(result, part, true, shown));
    }
    figure
}

fn panel(result: &Identification, part: Part, less_fit: bool, shown: Shown) -> Panel {
    let points = &result.compensated;
    let model = result.judged.model;
    let fit = |hz: f64| part.of(model.response(hz));
    let off = |hz: f64| if less_fit { fit(hz) } else { 0.0 };
    let f: Vec<f64> = points.iter().map(|p| p.frequency_hz).collect();
    let value = |sign: f64| -> Vec<f64> {
        let of = |p: &cellpos_ident::summary::CompensatedPoint| match part {
            Part::Gain => p.gain_db + sign * Z95 * p.gain_sd_db,
            Part::Phase => p.phase_deg + sign * Z95 * p.phase_sd_deg,
        };
        points.iter().map(|p| of(p) - off(p.frequency_hz)).collect()
    };
    let pick = |of: fn(f64, f64) -> f64| f.iter().copied().fold(f64::NAN, of);
    let (lowest, highest) = (pick(f64::min), pick(f64::max));
    let grid = log_grid(lowest, shown.high_hz.max(highest), 160);
    let curve =
        |of: &dyn Fn(f64) -> f64| -> Vec<f64> { grid.iter().map(|&hz| of(hz) - off(hz)).collect() };
    let mut panel = Panel::new(
        Axis::log("frequency", "Hz").range(0.8 * lowest, 1.25 * shown.high_hz.max(highest)),
        part.axis(less_fit),
    )
    .height_px(170.0);
    let ends_of = |hz: f64| {
        let (gain, phase) = result.band(hz);
        if part == Part::Gain { gain } else { phase }
    };
    // Parts of a band that describes the points nowhere near as well as they are known would look like a feature of the plant.
    let describes = points.iter().all(|p| {
        let sd = if part == Part::Gain {
            p.gain_sd_db
        } else {
            p.phase_sd_deg
        };
        let [low, high] = ends_of(p.frequency_hz);
        high - low <= WIDEST_BAND * 2.0 * Z95 * sd
    });
    if less_fit && describes {
        // Beyond the measured frequencies the band is the form's, no measurement's.
        let ends = grid.iter().map(|&hz| {
            let [low, high] = ends_of(hz);
            match (lowest..=highest).contains(&hz) {
                true => (low - off(hz), high - off(hz)),
                false => (f64::NAN, f64::NAN),
            }
        });
        let (low, high): (Vec<f64>, Vec<f64>) = ends.unzip();
        panel = panel.series(Series::band("95 % of the fit", &grid, &low, &high).color(1));
    }
    panel = panel
        .series(Series::line("fit", &grid, &curve(&fit)).color(1))
        .series(Series::intervals("measured", &f, &value(0.0), &value(-1.0), &value(1.0)).color(0));
    if shown.delayed && !less_fit && part == Part::Phase {
        let delayed: Vec<f64> = points.iter().map(|p| p.delayed_phase_deg).collect();
        panel = panel.series(Series::points("measured, delay left in", &f, &delayed).color(3));
    }
    if shown.eq6 {
        let nominal = TransferFunction::eq6();
        let eq6 = curve(&|hz| part.of(nominal.response(Hertz(hz))));
        panel = panel.series(Series::line("Eq. (6)", &grid, &eq6).dashed().color(2));
        if !less_fit {
            let integrator = CandidateModel::integrator(EQ5_VELOCITY_GAIN_PER_S, 0.0);
            let eq5 = curve(&|hz| part.of(integrator.response(hz)));
            let label = "Eq. (5), as 2\u{3c0} 63/s";
            panel = panel.series(Series::line(label, &grid, &eq5).thin().color(7));
        }
    }
    panel
}
