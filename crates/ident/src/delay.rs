//! The delay from a command to the exposure that shows it, by dithered edges: the LED test of the paper's Fig. 6, below a
//! millisecond.
//!
//! Through a 1 kHz camera a single edge gives the delay only to within a frame. If the edge falls into an exposure, the
//! brightness of that frame gives it to some microseconds; if it falls between two exposures, it is known to within the gap.
//! Times are those of the exposures, from the frames' own time stamps, so late arrival and stalls of the machine do not matter.
//! The median discards edges that a stall sent late. Not for the delay of PZT and flow: that is in the phase slope.

use crate::error::IdentError;
use cellpos_numeric::Random;

/// One edge and its frames. The light changed between two times of the camera; they are equal if the brightness of a frame gives
/// the time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenEdge {
    /// Time at which the light was switched, s.
    pub sent_s: f64,
    /// Last time at which the light had not changed, s.
    pub before_s: f64,
    /// First time at which the light had changed, s.
    pub after_s: f64,
}

/// Frames of the test: one row each.
#[derive(Debug, Clone, Copy)]
pub struct Brightness<'a> {
    /// Middle of the exposure by the frame's time stamp, s; rising.
    pub mid_s: &'a [f64],
    /// Exposure, s; 0 if the camera does not report it: a frame then shows only whether the light was on in its middle.
    pub exposure_s: f64,
    /// Mean grey level.
    pub grey: &'a [f64],
}

/// A delay with its confidence.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DelayEstimate {
    /// Best value, s.
    pub delay_s: f64,
    /// Standard deviation, s.
    pub sd_s: f64,
    /// 95 % interval, s.
    pub ci95_s: [f64; 2],
    /// Edges used.
    pub edges: usize,
    /// Most by which the delay of a record may differ from it besides, s; 0 for edges through the same device at the same times.
    pub not_accounted_s: f64,
}

/// Times at which to switch the light: `count` edges, `spacing_s` apart, each dithered over one frame period. The dither is
/// stratified: one draw in each of `count` equal parts of the period, in random order. It covers the period more evenly than
/// independent draws.
pub fn dithered_edges(
    count: usize,
    spacing_s: f64,
    frame_period_s: f64,
    start_s: f64,
    seed: u64,
) -> Vec<f64> {
    let mut random = Random::new(seed);
    let mut strata: Vec<usize> = (0..count).collect();
    for i in (1..count).rev() {
        strata.swap(i, random.below(i + 1));
    }
    strata
        .iter()
        .enumerate()
        .map(|(i, &s)| {
            start_s
                + i as f64 * spacing_s
                + (s as f64 + random.uniform()) / count as f64 * frame_period_s
        })
        .collect()
}

/// The edges of a test, and the delay that they tell.
///
/// A light that changes while the shutter is open shows in part of that frame's brightness. If too few frames are between dark and lit,
/// the frames show the light at one instant of their exposure, as the pictures of a simulated camera may. Nobody knows at which instant:
/// the delay is that to the middle, and half of the exposure is not accounted for.
///
/// # Errors
/// [`IdentError::EdgesNotSeen`] when fewer than half the edges show, [`IdentError::TooShort`] below four, [`IdentError::Lengths`].
pub fn delay_test(
    sent_s: &[f64],
    frames: Brightness,
) -> Result<(Vec<SeenEdge>, DelayEstimate), IdentError> {
    let edges = find_edges(sent_s, frames)?;
    if !frames.show_instants(&edges) {
        let estimate = delay_from_edges(&edges)?;
        return Ok((edges, estimate));
    }
    let edges = find_edges(
        sent_s,
        Brightness {
            exposure_s: 0.0,
            ..frames
        },
    )?;
    let estimate = DelayEstimate {
        not_accounted_s: 0.5 * frames.exposure_s,
        ..delay_from_edges(&edges)?
    };
    Ok((edges, estimate))
}

impl Brightness<'_> {
    /// Whether far fewer edges show in a part of an exposure than fell into one.
    fn show_instants(&self, edges: &[SeenEdge]) -> bool {
        let [Some(first), Some(last)] = [self.mid_s.first(), self.mid_s.last()] else {
            return false;
        };
        let period_s = (last - first) / (self.mid_s.len() as f64 - 1.0);
        let timed = edges.iter().filter(|e| e.before_s == e.after_s).count();
        let told = 1.0 - 2.0 * Levels::of(self.grey).doubt;
        let fell = edges.len() as f64 * (self.exposure_s / period_s).min(1.0) * told;
        // From 48 edges on, a quarter is five standard deviations below all.
        fell >= 4.0 * ENOUGH_TIMES as f64 && 4.0 * (timed as f64) < fell
    }
}

/// Finds each edge in a brightness record. Edges in `sent_s` alternate, and the first one rises.
///
/// # Errors
/// [`IdentError::EdgesNotSeen`] when fewer than half the edges show, [`IdentError::Lengths`].
pub fn find_edges(sent_s: &[f64], frames: Brightness) -> Result<Vec<SeenEdge>, IdentError> {
    let Brightness {
        mid_s,
        exposure_s,
        grey,
    } = frames;
    if mid_s.len() != grey.len() {
        return Err(IdentError::Lengths {
            input: mid_s.len(),
            output: grey.len(),
        });
    }
    let levels = Levels::of(grey);
    let mut seen = Vec::with_capacity(sent_s.len());
    for (i, &sent) in sent_s.iter().enumerate() {
        let rising = i % 2 == 0;
        let until = sent_s.get(i + 1).copied().unwrap_or(f64::INFINITY);
        // Skip frames that ended before the light was switched; stamps may be off by an exposure.
        let start = mid_s.partition_point(|&t| t < sent - 0.5 * exposure_s - 1e-12);
        let turned = |k: usize| {
            let lit = levels.share(grey[k]);
            if rising { lit } else { 1.0 - lit }
        };
        // An edge belongs to a command only if the light was in the other state when the command was sent.
        if start == 0 || start >= mid_s.len() || turned(start - 1) > 0.5 {
            continue;
        }
        let found = (start..mid_s.len())
            .take_while(|&k| mid_s[k] < until)
            .find(|&k| turned(k) > levels.doubt);
        let Some(k) = found else {
            continue;
        };
        let (share, half_s) = (turned(k), 0.5 * exposure_s);
        let (before_s, after_s) = if exposure_s > 0.0 && share < 1.0 - levels.doubt {
            let at_s = mid_s[k] + half_s - share * exposure_s;
            (at_s, at_s)
        } else {
            (mid_s[k - 1] + half_s, mid_s[k] - half_s)
        };
        seen.push(SeenEdge {
            sent_s: sent,
            before_s,
            after_s: after_s.max(before_s),
        });
    }
    if seen.len() * 2 < sent_s.len() || seen.is_empty() {
        return Err(IdentError::EdgesNotSeen {
            seen: seen.len(),
            sent: sent_s.len(),
            threshold: levels.threshold,
        });
    }
    Ok(seen)
}

/// Grey levels of the light off and on.
struct Levels {
    /// Between both.
    threshold: f64,
    dark: f64,
    lit: f64,
    /// Share of the light that noise can imitate.
    doubt: f64,
}

impl Levels {
    fn of(grey: &[f64]) -> Self {
        let low = grey.iter().copied().fold(f64::INFINITY, f64::min);
        let high = grey.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let threshold = 0.5 * (low + high);
        let side = |above: bool| {
            let mut side: Vec<f64> = grey
                .iter()
                .copied()
                .filter(|g| (*g > threshold) == above)
                .collect();
            side.sort_by(f64::total_cmp);
            let at = |share: f64| {
                let last = side.len().saturating_sub(1) as f64;
                side.get((share * last) as usize)
                    .copied()
                    .unwrap_or(threshold)
            };
            // Few frames hold an edge, so the quartiles of all frames of a level measure its noise.
            (at(0.5), 0.74 * (at(0.75) - at(0.25)))
        };
        let ((dark, dark_sd), (lit, lit_sd)) = (side(false), side(true));
        let swing = (lit - dark).max(f64::MIN_POSITIVE);
        // Five standard deviations: about one frame in a million is mistaken. A share below 1 % of an exposure adds nothing.
        let doubt = (5.0 * dark_sd.max(lit_sd) / swing).clamp(0.01, 0.45);
        Self {
            threshold,
            dark,
            lit,
            doubt,
        }
    }

    /// Part of the exposure for which the light was on, 0 to 1.
    fn share(&self, grey: f64) -> f64 {
        ((grey - self.dark) / (self.lit - self.dark).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0)
    }
}

/// Fewest timed edges for an interval of the median by ranks.
const ENOUGH_TIMES: usize = 12;

/// The delay from edges, as a median: edges delayed by a stall are outvoted.
///
/// The dither lets a part of the edges fall into an exposure, whatever the delay, and their time is known exactly. Their median
/// has an interval by ranks, without an assumed distribution. If they are too few, each edge gives
/// `before - sent < L <= after - sent`, and the estimate is the value that most of these intervals share; its interval comes from
/// resampled edges.
///
/// # Errors
/// [`IdentError::TooShort`] below four edges.
pub fn delay_from_edges(edges: &[SeenEdge]) -> Result<DelayEstimate, IdentError> {
    let n = edges.len();
    if n < 4 {
        return Err(IdentError::TooShort {
            what: "a delay test",
            rows: n,
            needed: 4,
        });
    }
    let mut times: Vec<f64> = edges
        .iter()
        .filter(|e| e.before_s == e.after_s)
        .map(|e| e.after_s - e.sent_s)
        .collect();
    if times.len() >= ENOUGH_TIMES {
        times.sort_by(f64::total_cmp);
        return Ok(median(&times, n));
    }
    let spans: Vec<[f64; 2]> = edges
        .iter()
        .map(|e| [e.before_s - e.sent_s, e.after_s - e.sent_s])
        .collect();
    let low = spans.iter().map(|s| s[0]).fold(f64::NEG_INFINITY, f64::max);
    let high = spans.iter().map(|s| s[1]).fold(f64::INFINITY, f64::min);
    if low < high {
        // All intervals overlap. The dither covers the period evenly, so every delay in the overlap is equally likely.
        let (delay_s, width) = (0.5 * (low + high), high - low);
        return Ok(DelayEstimate {
            delay_s,
            sd_s: width / 12f64.sqrt(),
            ci95_s: [delay_s - 0.475 * width, delay_s + 0.475 * width],
            edges: n,
            not_accounted_s: 0.0,
        });
    }
    let [low, high] = most_agreed(&spans);
    let mut random = Random::new(n as u64);
    let mut drawn: Vec<[f64; 2]> = (0..200)
        .map(|_| {
            let again: Vec<[f64; 2]> = (0..n).map(|_| spans[random.below(n)]).collect();
            most_agreed(&again)
        })
        .collect();
    let delay_s = 0.5 * (low + high);
    drawn.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let least = drawn[5][0].min(low);
    drawn.sort_by(|a, b| a[1].total_cmp(&b[1]));
    let most = drawn[194][1].max(high);
    Ok(DelayEstimate {
        delay_s,
        sd_s: (most - least) / 3.92,
        ci95_s: [least, most],
        edges: n,
        not_accounted_s: 0.0,
    })
}

/// Median of sorted times with its 95 % interval: the ranks `n/2 -+ 0.98 sqrt(n)` of a binomial.
fn median(times: &[f64], edges: usize) -> DelayEstimate {
    let n = times.len() as f64;
    let at = |rank: f64| times[(rank.max(0.0) as usize).min(times.len() - 1)];
    let half = 0.98 * n.sqrt();
    let delay_s = 0.5 * (at(0.5 * n - 0.5) + at(0.5 * n));
    // The resolution of 8-bit brightness and the camera's own jitter limit the interval to some microseconds.
    const LEAST_S: f64 = 2e-6;
    let low = at((0.5 * n - half).floor()).min(delay_s - LEAST_S);
    let high = at((0.5 * n + half).ceil()).max(delay_s + LEAST_S);
    DelayEstimate {
        delay_s,
        sd_s: (high - low) / 3.92,
        ci95_s: [low, high],
        edges,
        not_accounted_s: 0.0,
    }
}

/// Where most intervals overlap.
fn most_agreed(spans: &[[f64; 2]]) -> [f64; 2] {
    let mut ends: Vec<(f64, i32)> = spans
        .iter()
        .flat_map(|[low, high]| [(*low, 1), (*high, -1)])
        .collect();
    // At equal times, count a beginning before an end.
    ends.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
    let (mut depth, mut deepest, mut best) = (0, 0, [0.0, 0.0]);
    for (i, (at, step)) in ends.iter().enumerate() {
        depth += step;
        if depth > deepest {
            deepest = depth;
            let end = ends.get(i + 1).map_or(*at, |next| next.0);
            best = [*at, end];
        }
    }
    best
}

/// Gap between two intervals, s, if it exceeds `tolerance_s`; `None`: they agree.
pub fn apart_s(one95_s: [f64; 2], other95_s: [f64; 2], tolerance_s: f64) -> Option<f64> {
    let gap = (other95_s[0] - one95_s[1]).max(one95_s[0] - other95_s[1]);
    (gap > tolerance_s).then_some(gap)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames at 1 kHz with the light during their exposure; each switch reaches the light `line_s` later.
    fn test_record(
        sent_s: &[f64],
        exposure_s: f64,
        line_s: impl Fn(usize) -> f64,
    ) -> (Vec<f64>, Vec<f64>) {
        let mut random = Random::new(5);
        let last = sent_s[sent_s.len() - 1] + 0.05;
        let mid_s: Vec<f64> = (0..(last * 1e3) as usize)
            .map(|k| k as f64 * 1e-3)
            .collect();
        let switched: Vec<f64> = (sent_s.iter().enumerate())
            .map(|(i, s)| s + line_s(i))
            .collect();
        let lit_at = |t: f64| switched.partition_point(|e| *e <= t) % 2 == 1;
        let grey = mid_s
            .iter()
            .map(|mid| {
                let steps = if exposure_s > 0.0 { 500 } else { 1 };
                let part = |k: usize| (k as f64 + 0.5) / steps as f64 - 0.5;
                let lit = (0..steps)
                    .filter(|k| lit_at(mid + exposure_s * part(*k)))
                    .count();
                20.0 + 180.0 * lit as f64 / steps as f64 + 0.1 * random.normal()
            })
            .collect();
        (mid_s, grey)
    }

    #[test]
    fn a_hundred_dithered_edges_recover_the_delay_below_a_tenth_of_a_millisecond_whatever_stalls() {
        for (exposure_s, within_s) in [(0.0, 1e-4), (1e-4, 1e-4), (5e-4, 2e-5), (1e-3, 2e-5)] {
            let mut covered = 0;
            for seed in 0..20 {
                for delay_s in [0.000_07, 0.0007, 0.0033] {
                    let sent = dithered_edges(100, 0.011, 1e-3, 0.01, seed);
                    let mut random = Random::new(seed + 100);
                    // The machine delays every fifth switch by 0.1 to 4 ms.
                    let held: Vec<f64> = (0..sent.len())
                        .map(|_| match random.uniform() {
                            u if u < 0.2 => 1e-4 + 4e-3 * random.uniform(),
                            _ => 5e-6 * random.normal(),
                        })
                        .collect();
                    let (mid_s, grey) = test_record(&sent, exposure_s, |i| delay_s + held[i]);
                    let frames = Brightness {
                        mid_s: &mid_s,
                        exposure_s,
                        grey: &grey,
                    };
                    let edges = find_edges(&sent, frames).unwrap();
                    let found = delay_from_edges(&edges).unwrap();
                    let off_s = found.delay_s - delay_s;
                    assert!(
                        off_s.abs() < within_s,
                        "{exposure_s} {delay_s} s, seed {seed}: {found:?}"
                    );
                    assert!(found.ci95_s[0] <= found.delay_s && found.delay_s <= found.ci95_s[1]);
                    // Median delay of all switches, the delayed ones included.
                    let mut all: Vec<f64> = held.iter().map(|h| delay_s + h).collect();
                    all.sort_by(f64::total_cmp);
                    let truth = 0.5 * (all[49] + all[50]);
                    covered += usize::from(found.ci95_s[0] <= truth && truth <= found.ci95_s[1]);
                }
            }
            assert!(covered >= 54, "{exposure_s}: {covered} of 60");
        }
    }

    #[test]
    fn frames_that_show_the_light_at_one_instant_leave_half_of_the_exposure_open() {
        let sent = dithered_edges(300, 0.011, 1e-3, 0.01, 3);
        let (exposure_s, delay_s) = (5e-4, 0.0018);
        for (instant_s, is_open) in [(Some(2.5e-4), true), (Some(-2.5e-4), true), (None, false)] {
            let (mid_s, grey) = match instant_s {
                Some(at_s) => test_record(&sent, 0.0, |_| delay_s - at_s),
                None => test_record(&sent, exposure_s, |_| delay_s),
            };
            let frames = Brightness {
                mid_s: &mid_s,
                exposure_s,
                grey: &grey,
            };
            let (_, found) = delay_test(&sent, frames).unwrap();
            let open_s = if is_open { 2.5e-4 } else { 0.0 };
            assert_eq!(found.not_accounted_s, open_s, "{instant_s:?}: {found:?}");
            let [low, high] = found.ci95_s;
            assert!(
                (low - open_s..=high + open_s).contains(&delay_s),
                "{instant_s:?}: {found:?}"
            );
            assert!(high - low < 5e-5, "{instant_s:?}: {found:?}");
        }
    }

    #[test]
    fn edges_that_never_show_are_an_error_that_counts_them() {
        let sent = dithered_edges(20, 0.011, 1e-3, 0.01, 1);
        let frames: Vec<f64> = (0..400).map(|k| k as f64 * 1e-3).collect();
        let dark: Vec<f64> = frames
            .iter()
            .map(|t| (t * 700.0).sin())
            .map(|v| v.min(0.0) * 0.0)
            .collect();
        let frames = Brightness {
            mid_s: &frames,
            exposure_s: 0.0,
            grey: &dark,
        };
        let error = find_edges(&sent, frames).unwrap_err();
        assert!(
            matches!(
                error,
                IdentError::EdgesNotSeen {
                    seen: 0,
                    sent: 20,
                    ..
                }
            ),
            "{error}"
        );
    }

    #[test]
    fn two_delays_that_contradict_each_other_are_reported_with_the_gap() {
        let led = [0.00199, 0.00201];
        assert_eq!(apart_s(led, [0.0015, 0.0025], 1e-5), None);
        let gap = apart_s(led, [0.0026, 0.0028], 1e-5).unwrap();
        assert!((gap - 0.00059).abs() < 1e-9);
        assert_eq!(apart_s([0.0026, 0.0028], led, 1e-5), Some(gap));
    }
}
