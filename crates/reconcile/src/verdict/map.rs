//! WHERE the model fails: the innovations by record and band, time and excitation, and a sentence about it.

use crate::fit::context::{Context, Fit};
use crate::thresholds::CHANCE_SD;
use crate::verdict::response::{self, BandRatio, transform};

/// Lower edges of the bands \[Hz\]. The last band of a record ends at half its rate, so the bands together hold all of its energy.
const BAND_STARTS_HZ: [f64; 10] = [
    0.0, 1.0, 4.0, 15.0, 40.0, 80.0, 160.0, 500.0, 1600.0, 5000.0,
];

/// Edges of the bands of records with a sample time in s \[Hz\]: one more than there are bands.
pub(crate) fn band_edges_hz(sample_s: f64) -> Vec<f64> {
    /// A narrower last band is part of the one below it: a rate of 1000.01 Hz has no band from 500 Hz on.
    const LEAST_RATIO: f64 = 1.1;
    let half_rate = 0.5 / sample_s;
    let mut edges: Vec<f64> = (BAND_STARTS_HZ.into_iter())
        .filter(|start| LEAST_RATIO * start < half_rate)
        .collect();
    edges.push(half_rate);
    edges
}

/// One cell of the map.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Cell {
    /// RMS of the innovations in the cell \[um\].
    pub rms_um: f64,
    /// What noise alone would give \[um\].
    pub floor_um: f64,
    /// Excess over the floor in standard deviations of the noise's own scatter.
    pub z: f64,
    /// Whether the excess is larger than the whole map would show by chance once in twenty times.
    pub flagged: bool,
}

/// A line of the map: one record, or one part of the records.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct MapRow {
    /// Record or part.
    pub name: String,
    /// One cell per band of the map; the last is the whole row.
    pub cells: Vec<Cell>,
}

/// The discrepancy map of a fit.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct DiscrepancyMap {
    /// Edges of the bands, from 0 to half the rate of the records \[Hz\].
    pub edges_hz: Vec<f64>,
    /// Records, then thirds of the time.
    pub rows: Vec<MapRow>,
    /// Response ratio per third-octave band, all records together.
    pub ratios: Vec<BandRatio>,
}

impl DiscrepancyMap {
    /// Whether anything is beyond the floor.
    pub fn any_flagged(&self) -> bool {
        self.rows.iter().any(|r| r.cells.iter().any(|c| c.flagged))
    }
}

fn cell(energy: f64, n: f64, sigma_um: f64, slack: f64, limit: f64) -> Cell {
    let n = n.max(1.0);
    // The floor is known to about one percent: a smaller excess does not count. Wilson-Hilferty: a band of few bins is far from
    // normal.
    let spread = 2.0 / (9.0 * n);
    let z =
        ((energy / n).max(0.0).cbrt() - (1.0 - spread)) / (spread + (slack / 3.0).powi(2)).sqrt();
    Cell {
        rms_um: sigma_um * (energy / n).max(0.0).sqrt(),
        floor_um: sigma_um,
        z,
        flagged: z > limit,
    }
}

/// Sum of squares of a row of innovations in each band, and how many numbers each band has.
fn energy_by_band(e: &[f64], edges_hz: &[f64], sample_s: f64) -> (Vec<f64>, Vec<f64>) {
    let bands = edges_hz.len() - 1;
    let n = e.len();
    let (mut energy, mut bins) = (vec![0.0; bands], vec![0.0; bands]);
    for (k, x) in transform(e).iter().enumerate() {
        let hz = k as f64 / (n as f64 * sample_s);
        let Some(b) = edges_hz[..bands].iter().rposition(|start| hz >= *start) else {
            continue;
        };
        let double = if k == 0 || 2 * k == n { 1.0 } else { 2.0 };
        energy[b] += double * x.norm_sqr() / n as f64;
        bins[b] += double;
    }
    (energy, bins)
}

/// Variance of what a fit leaves, relative to that of the noise, in the bands in which it differs from another: at least 1. Each band of each
/// record counts by the power of the difference there.
///
/// Where more than the noise is left, next to an unknown effect or under a noise that was stated wrongly, chance gains as much more.
pub(crate) fn left_along(ctx: &Context<'_>, fit: &Fit, other: &Fit) -> f64 {
    let sample_s = ctx.problem.base.sample_s;
    let edges_hz = band_edges_hz(sample_s);
    let (mut left, mut whole) = (0.0, 0.0);
    for (r, (e, other)) in
        (ctx.problem.records.iter()).zip(fit.innovations.iter().zip(&other.innovations))
    {
        let share = r.whitener.count() as f64 / e.len() as f64;
        let change: Vec<f64> = e.iter().zip(other).map(|(e, o)| o - e).collect();
        let (energy, bins) = energy_by_band(e, &edges_hz, sample_s);
        let (of_change, _) = energy_by_band(&change, &edges_hz, sample_s);
        for ((energy, bins), of_change) in energy.iter().zip(&bins).zip(&of_change) {
            if *bins > 0.0 {
                left += of_change * energy / (share * bins);
                whole += of_change;
            }
        }
    }
    if whole > 0.0 {
        (left / whole).max(1.0)
    } else {
        1.0
    }
}

/// Makes the map.
pub(crate) fn map(ctx: &Context<'_>, fit: &Fit) -> DiscrepancyMap {
    let sample_s = ctx.problem.base.sample_s;
    let sigma = ctx.problem.noise.innovation_um();
    let edges_hz = band_edges_hz(sample_s);
    let bands = edges_hz.len() - 1;
    let limit = CHANCE_SD;
    let mut rows = Vec::new();
    for (r, e) in ctx.problem.records.iter().zip(&fit.innovations) {
        let share = r.whitener.count() as f64 / e.len() as f64;
        let (energy, bins) = energy_by_band(e, &edges_hz, sample_s);
        let mut cells: Vec<Cell> = (0..bands)
            .map(|b| cell(energy[b], share * bins[b], sigma, 0.012, limit))
            .collect();
        cells.push(cell(
            e.iter().map(|x| x * x).sum(),
            r.whitener.count() as f64,
            sigma,
            0.012,
            limit,
        ));
        rows.push(MapRow {
            name: r.name.clone(),
            cells,
        });
    }
    for third in 0..3 {
        let (mut energy, mut count) = (0.0, 0.0);
        for (r, e) in ctx.problem.records.iter().zip(&fit.innovations) {
            let n = e.len();
            let rows = third * n / 3..(third + 1) * n / 3;
            for (k, e) in e.iter().enumerate().take(rows.end).skip(rows.start) {
                energy += e * e;
                count += f64::from(u8::from(r.whitener.counts(k)));
            }
        }
        let name = ["first third", "middle third", "last third"][third];
        rows.push(MapRow {
            name: name.to_owned(),
            cells: vec![cell(energy, count, sigma, 0.012, limit)],
        });
    }
    DiscrepancyMap {
        edges_hz,
        rows,
        ratios: response::ratios(ctx, fit),
    }
}
