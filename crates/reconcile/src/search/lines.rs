//! A line in the residual of a fit, with a separate amplitude and phase in every record.

use crate::dot::dot;
use crate::fit::catalogue::{Part, Variant};
use crate::fit::context::{Context, Fit};
use crate::mask::Mask;
use crate::search::cost::threshold_of_waves;
use cellpos_numeric::fft::{self, Complex};
use cellpos_plant::effects::{FitParameter, Role};
use std::f64::consts::TAU;
use std::ops::Range;

/// What a line leaves over.
pub(crate) struct Line {
    pub hz: f64,
    /// Mean over the records \[um\].
    pub amplitude_um: f64,
    pub left: Vec<Vec<f64>>,
}

/// Takes a line off, amplitude and phase of every record from the rows of a mask.
pub(crate) fn without_line(ctx: &Context<'_>, fit: &Fit, hz: f64, train: &Mask) -> Option<Line> {
    let mut left = fit.innovations.clone();
    let mut sum = 0.0;
    for ((r, e), mask) in ctx.problem.records.iter().zip(&mut left).zip(train) {
        let n = e.len();
        let (s, c): (Vec<f64>, Vec<f64>) = (0..n)
            .map(|k| (TAU * hz * k as f64 * ctx.problem.base.sample_s).sin_cos())
            .unzip();
        let (mut ws, mut wc) = (vec![0.0; n], vec![0.0; n]);
        r.whiten(&s, &mut ws);
        r.whiten(&c, &mut wc);
        let rows = mask.first()?.clone();
        let (ws_in, wc_in, e_in) = (&ws[rows.clone()], &wc[rows.clone()], &e[rows]);
        let (ss, cc, sc) = (dot(ws_in, ws_in), dot(wc_in, wc_in), dot(ws_in, wc_in));
        let (se, ce) = (dot(ws_in, e_in), dot(wc_in, e_in));
        let det = ss * cc - sc * sc;
        if det <= 1e-9 * ss * cc {
            continue;
        }
        let (a, b) = ((cc * se - sc * ce) / det, (ss * ce - sc * se) / det);
        sum += a.hypot(b);
        for (e, (s, c)) in e.iter_mut().zip(ws.iter().zip(&wc)) {
            *e -= a * s + b * c;
        }
    }
    Some(Line {
        hz,
        amplitude_um: sum / ctx.problem.records.len() as f64,
        left,
    })
}

/// Where fits of lines, alone or with their multiples, begin: each at the most power in the spectrum of the innovations. Candidates of
/// another kind have no start here.
///
/// The filter is the same for neighbouring frequencies, so that it divides out of the gain of a line.
pub(crate) fn line_starts(
    ctx: &Context<'_>,
    fit: &Fit,
    variants: &[Variant],
    mask: &Mask,
    simulated: &[Vec<f64>],
) -> Vec<Part> {
    let of_line = |v: &Variant| match (v.candidate().role, v.candidate().params) {
        (Role::Line { harmonics }, [hz]) => Some((*v, harmonics, hz)),
        _ => None,
    };
    let lines: Vec<_> = variants.iter().filter_map(of_line).collect();
    let highest_hz = (lines.iter())
        .map(|(_, harmonics, hz)| *harmonics as f64 * hz.upper)
        .fold(0.0, f64::max);
    if lines.is_empty() {
        return Vec::new();
    }
    let Some(spectra) = Spectra::of(ctx, fit, mask, simulated, highest_hz) else {
        return Vec::new();
    };
    let start = |(variant, harmonics, hz): (Variant, usize, &FitParameter)| {
        let hz = spectra.strongest(harmonics, hz.lower..hz.upper)?;
        Some(Part::new(variant, &[hz]))
    };
    lines.into_iter().filter_map(start).collect()
}

/// Power of the innovations by frequency: the gain of a line of that frequency.
struct Spectra {
    /// From one frequency to the next, Hz, and how many of these steps tell two lines apart.
    step_hz: f64,
    apart: usize,
    /// Of all records.
    whole: Vec<f64>,
    /// Of each record: that of the innovations, and that of the simulated response and of its distortions.
    records: Vec<[Vec<f64>; 2]>,
    /// Of the parts of each record, with their share of the rows.
    parts: Vec<(f64, Vec<f64>)>,
}

impl Spectra {
    fn of(
        ctx: &Context<'_>,
        fit: &Fit,
        mask: &Mask,
        simulated: &[Vec<f64>],
        highest_hz: f64,
    ) -> Option<Self> {
        let rows = fit.innovations.iter().map(Vec::len).max()?;
        let bins = (4 * rows).next_power_of_two();
        let step_hz = 1.0 / (bins as f64 * ctx.problem.base.sample_s);
        let kept = (bins / 2 + 1).min((highest_hz / step_hz) as usize + 2);
        let plan = fft::plan(bins);
        let (mut counted, mut transform) = (plan.make_input_vec(), plan.make_output_vec());
        let mut spectrum = |e: &[f64], ranges: &[Range<usize>], part: Range<usize>| {
            counted.fill(0.0);
            let mut count = 0;
            for range in ranges {
                let range = range.start.max(part.start)..range.end.min(part.end);
                count += range.len();
                if !range.is_empty() {
                    counted[range.clone()].copy_from_slice(&e[range]);
                }
            }
            plan.process(&mut counted, &mut transform).ok()?;
            let power = |x: &Complex<f64>| 2.0 * x.norm_sqr() / count.max(1) as f64;
            let powers: Vec<f64> = transform[..kept].iter().map(power).collect();
            Some((count as f64, powers))
        };
        let (mut whole, mut parts, mut count) = (vec![0.0; kept], Vec::new(), 0.0);
        let mut records = Vec::with_capacity(fit.innovations.len());
        let add = |sum: &mut [f64], power: &[f64]| {
            sum.iter_mut().zip(power).for_each(|(sum, x)| *sum += x);
        };
        for (((e, ranges), record), simulated) in (fit.innovations.iter().zip(mask))
            .zip(&ctx.problem.records)
            .zip(simulated)
        {
            let (own, power) = spectrum(e, ranges, 0..e.len())?;
            count += own;
            add(&mut whole, &power);
            let mut response = vec![0.0; kept];
            for distorted in distortions(simulated).iter().filter(|d| !d.is_empty()) {
                let whitened = record.whitened(distorted);
                add(&mut response, &spectrum(&whitened, ranges, 0..e.len())?.1);
            }
            records.push([power, response]);
            for k in 0..PARTS_OF_RECORD {
                let part = k * e.len() / PARTS_OF_RECORD..(k + 1) * e.len() / PARTS_OF_RECORD;
                parts.push(spectrum(e, ranges, part)?);
            }
        }
        for (rows, _) in &mut parts {
            *rows /= count;
        }
        Some(Self {
            step_hz,
            apart: bins.div_ceil(rows),
            whole,
            records,
            parts,
        })
    }

    /// Power around a frequency in a sum of spectra, over that of white noise: the median on both sides.
    fn background(&self, powers: &[f64], spectra: usize, bin: usize) -> f64 {
        let below = bin.saturating_sub(BESIDE * self.apart)..bin.saturating_sub(self.apart);
        let above = bin + self.apart + 1..bin + BESIDE * self.apart + 1;
        let mut beside: Vec<f64> = (below.chain(above).step_by(self.apart))
            .filter_map(|bin| powers.get(bin).copied())
            .collect();
        if beside.is_empty() {
            return 1.0;
        }
        let middle = beside.len() / 2;
        let (_, median, _) = beside.select_nth_unstable_by(middle, f64::total_cmp);
        // Of chi-square with two degrees of freedom a spectrum (Wilson and Hilferty).
        let spectra = spectra as f64;
        let white = 2.0 * spectra * (1.0 - 1.0 / (9.0 * spectra)).powi(3);
        *median / white
    }

    /// Whether a line stands out of what is beside it, `least` times white noise. Innovations have more there where the noise is slow or a
    /// response is missing. Where the response of a record, or a distortion of it, has a line as well, its equation may leave a part of
    /// that, for it is not exactly nature's: such a record says nothing. In a loop the command answers a line, and the others tell it.
    fn stands_out(&self, bin: usize, least: f64) -> bool {
        let own = |[power, response]: &[Vec<f64>; 2]| {
            let (power, left) = (power.get(bin)?, MISFIT * response.get(bin)?);
            let answers = response[bin] > least * self.background(response, 1, bin);
            (!answers || *power >= left).then_some(*power)
        };
        let itself: f64 = self.records.iter().filter_map(own).sum();
        let background = self.background(&self.whole, self.records.len(), bin);
        itself > least * background.max(1.0)
    }

    /// The frequency, Hz, that gains most together with its multiples, `harmonics` in all. It has to stand out itself, because the halves
    /// and thirds of a line have the line among their multiples; and in every part in which so much is expected. The equation of the
    /// response is not exactly nature's: what is small beside the response or its distortions is no line.
    fn strongest(&self, harmonics: usize, hz: Range<f64>) -> Option<f64> {
        // Fine enough for the highest multiple.
        let step_hz = self.step_hz / harmonics as f64;
        let (from, to) = ((hz.start / step_hz) as usize, (hz.end / step_hz) as usize);
        let least = threshold_of_waves(to.saturating_sub(from));
        let bin = |m: usize, times: usize| (times * m + harmonics / 2) / harmonics;
        let gain = |m: usize| -> f64 {
            let itself = self.whole.get(bin(m, 1)).copied().unwrap_or(0.0);
            let lasts = || {
                self.parts.iter().all(|(share, power)| {
                    let expected = itself * share;
                    expected < least || power[bin(m, 1)] > STOPPED * expected
                })
            };
            if itself < least || !self.stands_out(bin(m, 1), least) || !lasts() {
                return 0.0;
            }
            let powers = (1..=harmonics).filter_map(|times| self.whole.get(bin(m, times)));
            powers.sum()
        };
        let gains = (from..=to).map(|m| (m, gain(m)));
        let (best, most) = gains.max_by(|a, b| a.1.total_cmp(&b.1))?;
        (most > 0.0).then_some(best as f64 * step_hz)
    }
}

/// Power that a wrong equation may leave of the response or of a distortion of it: equations are known to a tenth.
const MISFIT: f64 = 0.01;
/// Resolved frequencies on either side that are the background of a line.
const BESIDE: usize = 10;

/// A response, its size and the sign of its speed, of the same mean square: where it has a frequency, an equation that is not nature's leaves
/// the even multiples of a bend and the odd ones of a play as well. None of a record that does not count.
fn distortions(response_um: &[f64]) -> [Vec<f64>; 3] {
    let centred = |x: Vec<f64>| {
        let middle = x.iter().sum::<f64>() / x.len().max(1) as f64;
        let off: Vec<f64> = x.iter().map(|y| y - middle).collect();
        let squares: f64 = off.iter().map(|y| y * y).sum();
        (off, squares)
    };
    let (response, squares) = centred(response_um.to_vec());
    let size = response.iter().map(|y| y.abs()).collect();
    let rises =
        |k: usize| response[(k + 1).min(response.len() - 1)] - response[k.saturating_sub(1)];
    let way = (0..response.len()).map(|k| rises(k).signum()).collect();
    let scaled = |x| {
        let (off, own) = centred(x);
        let scale = if own > 0.0 {
            (squares / own).sqrt()
        } else {
            0.0
        };
        off.into_iter().map(|y| scale * y).collect()
    };
    [scaled(size), scaled(way), response]
}

/// Parts of each record in which a line has to be. A misfit of the response is where the command moves. A pump or the mains do not stop
/// with the command.
const PARTS_OF_RECORD: usize = 4;
/// Share of its mean power below which a line is not in a part. Where as much is expected as stands out of noise (some 30 times its
/// variance), noise takes a line below that once in some five hundred times.
const STOPPED: f64 = 0.25;

/// The frequency of the strongest line in the innovations that lasts, Hz. In a loop the command has it as well, and answers it.
pub(crate) fn strongest_line(ctx: &Context<'_>, fit: &Fit) -> Option<f64> {
    /// Slower ones a walk hides.
    const LOWEST_HZ: f64 = 3.0;
    let highest_hz = 0.48 / ctx.problem.base.sample_s;
    if highest_hz <= LOWEST_HZ {
        return None;
    }
    let all = ctx.problem.all();
    let simulated = ctx.simulated(&fit.parts, fit.offset_um, &all);
    let spectra = Spectra::of(ctx, fit, &all, &simulated, highest_hz)?;
    spectra.strongest(1, LOWEST_HZ..highest_hz)
}

#[cfg(test)]
mod tests {
    use super::*;

    const BINS: usize = 1000;
    const LINE: usize = 500;

    /// Two records with white innovations, a line of the same power in both, and responses that have the given power there.
    fn spectra(responses: [f64; 2]) -> Spectra {
        let with_line = |level: f64, line: f64| {
            let mut powers = vec![level; BINS];
            powers[LINE] = line;
            powers
        };
        Spectra {
            step_hz: 0.1,
            apart: 4,
            whole: with_line(4.0, 2000.0),
            records: responses
                .map(|response| [with_line(2.0, 1000.0), with_line(10.0, response)])
                .to_vec(),
            parts: Vec::new(),
        }
    }

    #[test]
    fn a_line_that_one_record_hides_in_its_response_is_told_by_another() {
        let frequency_hz = 0.1 * LINE as f64;
        let found = |responses| spectra(responses).strongest(1, 40.0..60.0);
        assert_eq!(found([10.0, 10.0]), Some(frequency_hz));
        assert_eq!(found([1e7, 10.0]), Some(frequency_hz));
        assert_eq!(found([1e7, 1e7]), None);
        // More than an equation known to a tenth leaves of a response.
        assert_eq!(found([1e4, 1e4]), Some(frequency_hz));
    }
}
