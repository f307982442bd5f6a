//! The delay of the camera path by dithered edges: the LED test of the paper's Fig. 6, below a millisecond.
//!
//! One edge seen through a 1 kHz camera tells the delay to within a frame. Edges at random phases of the frame clock
//! tell more: an edge sent at `e` shows first in a frame taken at or after `e + L`, so each edge is an interval for `L`,
//! and the intervals of N edges share one that shrinks as 1/N. Where the exposure is long the brightness of the frame
//! that the edge falls into is used as well. Not for the delay of the PZT and the flow: that is in the phase slope.

use crate::error::IdentError;
use cellpos_numeric::Random;

/// One edge and what the camera saw of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeenEdge {
    /// Time at which the light was switched, s.
    pub sent_s: f64,
    /// Time stamp of the last frame without the edge, s.
    pub before_s: f64,
    /// Time stamp of the first frame with it, s.
    pub after_s: f64,
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
}

/// Times at which to switch the light: `count` edges, `spacing_s` apart, each dithered over one frame period. The
/// dither is stratified (one draw in each of `count` equal parts of the period, in random order), which covers the
/// period more evenly than independent draws.
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

/// Finds each edge in a brightness record: frame time stamps and brightness, threshold half way between dark and
/// bright. `sent_s` are rising or falling edges in turn, starting with rising.
///
/// # Errors
/// [`IdentError::EdgesNotSeen`] when fewer than half the edges show, [`IdentError::Lengths`].
pub fn find_edges(
    sent_s: &[f64],
    frame_s: &[f64],
    brightness: &[f64],
) -> Result<Vec<SeenEdge>, IdentError> {
    if frame_s.len() != brightness.len() {
        return Err(IdentError::Lengths {
            input: frame_s.len(),
            output: brightness.len(),
        });
    }
    let low = brightness.iter().copied().fold(f64::INFINITY, f64::min);
    let high = brightness.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let threshold = 0.5 * (low + high);
    let mut seen = Vec::with_capacity(sent_s.len());
    for (i, &sent) in sent_s.iter().enumerate() {
        let rising = i % 2 == 0;
        let until = sent_s.get(i + 1).copied().unwrap_or(f64::INFINITY);
        let start = frame_s.partition_point(|&t| t < sent - 1e-12);
        let lit = |k: usize| (brightness[k] > threshold) == rising;
        // An edge belongs to a switch only if the light was in the other state when it was sent.
        if start == 0 || start >= frame_s.len() || lit(start - 1) {
            continue;
        }
        let found = (start..frame_s.len())
            .take_while(|&k| frame_s[k] < until)
            .find(|&k| lit(k));
        if let Some(k) = found {
            seen.push(SeenEdge {
                sent_s: sent,
                before_s: frame_s[k - 1],
                after_s: frame_s[k],
            });
        }
    }
    if seen.len() * 2 < sent_s.len() || seen.is_empty() {
        return Err(IdentError::EdgesNotSeen {
            seen: seen.len(),
            sent: sent_s.len(),
            threshold,
        });
    }
    Ok(seen)
}

/// The delay from edges: the value that contradicts fewest of their intervals, with the spread that is left.
///
/// Each edge says `before - sent < L <= after - sent`. For jitter-free clocks the delay lies in the intersection, anywhere
/// with equal right (the dither covers the period evenly), so the 95 % interval is its middle 95 %; with jitter the intersection may be empty, and the middle of the edges' intervals is taken
/// with its standard error (about 0.3/sqrt(N) of a frame period).
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
    let low = edges
        .iter()
        .map(|e| e.before_s - e.sent_s)
        .fold(f64::NEG_INFINITY, f64::max);
    let high = edges
        .iter()
        .map(|e| e.after_s - e.sent_s)
        .fold(f64::INFINITY, f64::min);
    if low < high {
        let width = high - low;
        let (delay_s, sd_s) = (0.5 * (low + high), width / 12f64.sqrt());
        let half = 0.475 * width;
        return Ok(DelayEstimate {
            delay_s,
            sd_s,
            ci95_s: [delay_s - half, delay_s + half],
            edges: n,
        });
    }
    let middles: Vec<f64> = edges
        .iter()
        .map(|e| 0.5 * (e.before_s + e.after_s) - e.sent_s)
        .collect();
    let mean = middles.iter().sum::<f64>() / n as f64;
    let variance = middles.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / (n - 1) as f64;
    let sd_s = (variance / n as f64).sqrt();
    let t = cellpos_numeric::statistics::student_t_quantile(0.975, (n - 1) as f64);
    Ok(DelayEstimate {
        delay_s: mean,
        sd_s,
        ci95_s: [mean - t * sd_s, mean + t * sd_s],
        edges: n,
    })
}

/// Whether two delays contradict each other: the intervals of LED test and phase slope do not touch, allowing
/// `tolerance_s` for what neither accounts for. `None`: they agree; else by how much they miss each other, s.
pub fn disagreement_s(led: &DelayEstimate, phase95_s: [f64; 2], tolerance_s: f64) -> Option<f64> {
    let gap = (phase95_s[0] - led.ci95_s[1]).max(led.ci95_s[0] - phase95_s[1]);
    (gap > tolerance_s).then_some(gap)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames at 1 kHz whose brightness is the light `delay_s` earlier, stamped with their own time.
    fn test_record(edges_s: &[f64], delay_s: f64, jitter_s: f64) -> (Vec<f64>, Vec<f64>) {
        let mut random = Random::new(5);
        let last = edges_s[edges_s.len() - 1] + 0.05;
        let frames: Vec<f64> = (0..(last * 1e3) as usize)
            .map(|k| k as f64 * 1e-3)
            .collect();
        let brightness = frames
            .iter()
            .map(|t| {
                let switched =
                    edges_s.partition_point(|e| *e <= t - delay_s + jitter_s * random.normal());
                if switched % 2 == 1 {
                    200.0 + random.normal()
                } else {
                    20.0 + random.normal()
                }
            })
            .collect();
        (frames, brightness)
    }

    #[test]
    fn a_hundred_dithered_edges_recover_the_delay_to_a_tenth_of_a_millisecond() {
        for delay_s in [0.0007, 0.0020, 0.0033] {
            for seed in 0..10 {
                for jitter_s in [0.0, 5e-5] {
                    let sent = dithered_edges(100, 0.011, 1e-3, 0.01, seed);
                    let (frames, brightness) = test_record(&sent, delay_s, jitter_s);
                    let edges = find_edges(&sent, &frames, &brightness).unwrap();
                    let found = delay_from_edges(&edges).unwrap();
                    assert!(
                        (found.delay_s - delay_s).abs() < 1e-4,
                        "{delay_s} s, seed {seed}: {found:?}"
                    );
                }
            }
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
        let error = find_edges(&sent, &frames, &dark).unwrap_err();
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
        let led = DelayEstimate {
            delay_s: 0.002,
            sd_s: 1e-6,
            ci95_s: [0.00199, 0.00201],
            edges: 100,
        };
        assert_eq!(disagreement_s(&led, [0.0015, 0.0025], 1e-5), None);
        let gap = disagreement_s(&led, [0.0026, 0.0028], 1e-5).unwrap();
        assert!((gap - 0.00059).abs() < 1e-9);
    }
}
