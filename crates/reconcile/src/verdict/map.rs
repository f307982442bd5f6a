//! WHERE the model fails: the innovations by record and band, time and excitation, and a sentence about it.

use crate::fit::context::{Context, Fit};
use realfft::RealFftPlanner;
use realfft::num_complex::Complex;

/// Edges of the bands \[Hz\].
pub const BAND_EDGES_HZ: [f64; 8] = [0.0, 1.0, 4.0, 15.0, 40.0, 80.0, 160.0, 500.0];

/// One cell of the map.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Cell {
    /// RMS of the innovations in the cell \[um\].
    pub rms_um: f64,
    /// What noise alone would give \[um\].
    pub floor_um: f64,
    /// Excess over the floor in standard deviations of the noise's own scatter.
    pub z: f64,
    /// Whether it is beyond what the whole map would show by chance once in twenty times.
    pub flagged: bool,
}

/// A line of the map: one record, or one part of the records.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct MapRow {
    /// Record or part.
    pub name: String,
    /// One cell per band of [`BAND_EDGES_HZ`]; the last is the whole row.
    pub cells: Vec<Cell>,
}

/// Ratio of the measured to the simulated motion in a band.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct BandRatio {
    /// Middle of the band \[Hz\].
    pub hz: f64,
    /// Gain of measured over simulated \[dB\].
    pub gain_db: f64,
    /// Phase of measured over simulated \[deg\].
    pub phase_deg: f64,
    /// Standard error of the ratio, in parts.
    pub error: f64,
    /// Part of the measured motion in the band that the simulated one accounts for, were the model right: near 1 where the
    /// band was excited beyond the noise, near 0 where nothing but noise moved the bead. In a loop the command answers that
    /// noise, so that a ratio without support is that of noise to its answer.
    pub coherence: f64,
}

impl BandRatio {
    /// Coherence from which on a ratio says something of the plant.
    pub const SUPPORTED: f64 = 0.9;

    /// Whether the band was excited enough for its ratio to be one of the plant.
    pub fn is_supported(&self) -> bool {
        self.coherence >= Self::SUPPORTED
    }
}

/// The discrepancy map of a fit.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct DiscrepancyMap {
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

/// Labels of the bands.
pub fn band_labels() -> Vec<String> {
    let mut labels: Vec<String> = BAND_EDGES_HZ
        .windows(2)
        .map(|w| format!("{}..{} Hz", w[0], w[1]))
        .collect();
    labels.push("all".to_owned());
    labels
}

fn cell(energy: f64, n: f64, sigma_um: f64, slack: f64, limit: f64) -> Cell {
    let n = n.max(1.0);
    // The floor itself is known to about one percent: an excess below that is none.
    // Wilson-Hilferty: a band of few bins is far from normal.
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

/// Makes the map.
pub(crate) fn map(ctx: &Context<'_>, fit: &Fit) -> DiscrepancyMap {
    let sample_s = ctx.problem.base.sample_s;
    let sigma = ctx.problem.noise.innovation_um();
    let bands = BAND_EDGES_HZ.len() - 1;
    // Records x (bands + 1) + 3 thirds, 5 % together, would be 3.2 standard deviations for 60 cells; a whole one more,
    // because the floor's shape (a walk plus white noise) is not that of nature to the last percent either.
    let limit = 4.2;
    let mut planner = RealFftPlanner::<f64>::new();
    let mut rows = Vec::new();
    for (r, e) in ctx.problem.records.iter().zip(&fit.innovations) {
        let spectrum = transform(&mut planner, e);
        let n = e.len();
        let share = r.whitener.count() as f64 / n as f64;
        let mut energy = vec![0.0; bands];
        let mut bins = vec![0.0; bands];
        for (k, x) in spectrum.iter().enumerate() {
            let hz = k as f64 / (n as f64 * sample_s);
            let Some(b) = BAND_EDGES_HZ
                .windows(2)
                .position(|w| hz >= w[0] && hz < w[1])
            else {
                continue;
            };
            let double = if k == 0 || 2 * k == n { 1.0 } else { 2.0 };
            energy[b] += double * x.norm_sqr() / n as f64;
            bins[b] += double * share;
        }
        let mut cells: Vec<Cell> = (0..bands)
            .map(|b| cell(energy[b], bins[b], sigma, 0.012, limit))
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
        rows,
        ratios: ratios(ctx, fit, &mut planner),
    }
}

fn transform(planner: &mut RealFftPlanner<f64>, x: &[f64]) -> Vec<Complex<f64>> {
    let plan = planner.plan_fft_forward(x.len());
    let mut input = x.to_vec();
    let mut output = plan.make_output_vec();
    // Lengths come from the plan itself, so that this cannot fail; an empty answer would only leave the map blank.
    if plan.process(&mut input, &mut output).is_err() {
        output.fill(Complex::new(0.0, 0.0));
    }
    output
}

/// Complex ratio of measured to simulated, on whitened series, in bands a third of an octave wide.
fn ratios(ctx: &Context<'_>, fit: &Fit, planner: &mut RealFftPlanner<f64>) -> Vec<BandRatio> {
    let sample_s = ctx.problem.base.sample_s;
    let sim = ctx.simulated(&fit.parts, &ctx.problem.all());
    let centres: Vec<f64> = (0..30)
        .map(|i| 0.5 * 2f64.powf(f64::from(i) / 3.0))
        .filter(|f| *f < 0.45 / sample_s)
        .collect();
    let mut cross = vec![Complex::new(0.0, 0.0); centres.len()];
    let mut power = vec![0.0; centres.len()];
    let mut bins = vec![0.0; centres.len()];
    for (i, r) in ctx.problem.records.iter().enumerate() {
        if r.rest {
            continue;
        }
        let n = r.u.len();
        let mut s = vec![0.0; n];
        r.whiten(&sim[i], &mut s);
        // A sine of micrometres would leak into its neighbours far above the noise, and pass for their excitation.
        let windowed = |x: &[f64]| -> Vec<f64> {
            let hann = |k: usize| 1.0 - (std::f64::consts::TAU * k as f64 / n as f64).cos();
            x.iter()
                .enumerate()
                .map(|(k, x)| x * hann(k) * (2.0f64 / 3.0).sqrt())
                .collect()
        };
        let (fs, fe) = (
            transform(planner, &windowed(&s)),
            transform(planner, &windowed(&fit.innovations[i])),
        );
        for k in 1..fs.len() {
            let hz = k as f64 / (n as f64 * sample_s);
            let Some(b) = centres
                .iter()
                .position(|c| (hz / c).log2().abs() <= 1.0 / 6.0)
            else {
                continue;
            };
            cross[b] += fe[k] * fs[k].conj() / n as f64;
            power[b] += fs[k].norm_sqr() / n as f64;
            bins[b] += 1.0;
        }
    }
    centres
        .iter()
        .zip(cross.iter().zip(power.iter().zip(&bins)))
        .filter(|(_, (_, (p, _)))| **p > 50.0)
        .map(|(hz, (c, (p, bins)))| {
            let ratio = Complex::new(1.0, 0.0) + c / p;
            BandRatio {
                hz: *hz,
                gain_db: 20.0 * ratio.norm().log10(),
                phase_deg: ratio.arg().to_degrees(),
                error: (1.0 / p).sqrt(),
                // Whitened: the noise has a power of one in each bin.
                coherence: p / (p + bins),
            }
        })
        .collect()
}
