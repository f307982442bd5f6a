//! Records of another plant that hardly agree with their model. The turns of a sensor without a sign show it.

use crate::problem::Prepared;

/// Part of the motion that the size of the model's output must explain before a rectifier is spoken of.
const WITHOUT_SIGN: f64 = 0.2;

/// The same, as a share of the curvature that remains once the output is unfolded. Below this share it turns sharply at its lowest
/// and nowhere else. Smooth outputs keep 0.9 and more, measured drives behind a rectifier 0.46 to 0.78.
const UNFOLDED: f64 = 0.8;

/// Fewest turns that say so.
const TURNS: usize = 10;

/// How near its lowest an output turns that is folded there, in parts of its range.
const NEAR: f64 = 0.12;

/// `alike` is the part of the motion that follows the command as the model says, `without_sign` the part that follows the size of
/// the model's output.
pub(crate) fn unlike(records: &[Prepared], alike: f64, without_sign: f64) -> String {
    let part = format!(
        "only {:.0} % of the motion goes with the command as the model says, at any gain and delay",
        100.0 * alike.clamp(0.0, 1.0)
    );
    let follows = without_sign > WITHOUT_SIGN.max(2.0 * alike);
    let (curved, turns) = unfolded(records);
    let folded = curved < UNFOLDED && turns >= TURNS;
    let why = match (follows, folded) {
        (false, false) => {
            return format!(
                "{part}; the columns may be swapped, the model another plant's, or the plant so far from linear that no linear base stands for it: an effect with \
                 equations of its own (place = \"plant\") in a file, with --effects, can take its place"
            );
        }
        (true, _) => format!(
            "{:.0} % goes with the size of its output, whatever the sign",
            100.0 * without_sign
        ),
        (false, true) => {
            format!("the output turns sharply at its lowest, {turns} times, and nowhere else")
        }
    };
    format!(
        "{part}; {why}: it looks like the size of something without its sign, as of a sensor that rectifies; an effect of your own can say so (place = \"camera\", output = \
         \"abs(input + offset)\", or place = \"plant\" with the plant's own equations inside the abs), with --effects"
    )
}

/// The share of the curvature (energy of second differences) that remains if the outputs change their sign at every turn near
/// their lowest that becomes straighter by it, and the number of such turns.
fn unfolded(records: &[Prepared]) -> (f64, usize) {
    let (mut before, mut after, mut turns) = (0.0, 0.0, 0);
    for r in records.iter().filter(|r| !r.rest) {
        let seen: Vec<f64> = (r.y.iter().zip(&r.present))
            .filter(|(_, present)| **present)
            .map(|(y, _)| *y)
            .collect();
        let mut sorted = seen.clone();
        sorted.sort_by(f64::total_cmp);
        let hundredth = sorted.len() / 100;
        let (Some(low), Some(high)) = (
            sorted.get(hundredth),
            sorted.get(sorted.len().saturating_sub(1 + hundredth)),
        ) else {
            continue;
        };
        let size: Vec<f64> = seen.iter().map(|y| y - low).collect();
        let (unfolded, count) = unfold(&size, NEAR * (high - low));
        before += curvature(&size);
        after += curvature(&unfolded);
        turns += count;
    }
    (if before > 0.0 { after / before } else { 1.0 }, turns)
}

fn curvature(y: &[f64]) -> f64 {
    y.windows(3)
        .map(|w| (w[0] - 2.0 * w[1] + w[2]).powi(2))
        .sum()
}

/// With the sign changed at every turn below `near` that becomes straighter so; and how many these are.
fn unfold(size: &[f64], near: f64) -> (Vec<f64>, usize) {
    let mut out = size.to_vec();
    let (mut sign, mut turns) = (1.0, 0);
    let mut k = 1;
    while k + 1 < size.len() {
        out[k] = sign * size[k];
        let turn = size[k] <= size[k - 1] && size[k] < size[k + 1] && size[k] < near;
        if turn {
            let (from, to) = (k.saturating_sub(2), (k + 4).min(size.len()));
            let with = |flip: usize| -> f64 {
                let around: Vec<f64> = (from..to)
                    .map(|j| if j < flip { size[j] } else { -size[j] })
                    .collect();
                curvature(&around)
            };
            let (here, next, never) = (with(k), with(k + 1), with(to));
            if here.min(next) < never {
                turns += 1;
                if here < next {
                    out[k] = -out[k];
                }
                sign = -sign;
            }
        }
        k += 1;
    }
    if let Some(last) = out.last_mut() {
        *last *= sign;
    }
    (out, turns)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folded_wave_is_straighter_unfolded_and_a_whole_one_is_not() {
        let wave: Vec<f64> = (0..600).map(|k| (0.13 * f64::from(k)).sin()).collect();
        let folded: Vec<f64> = wave.iter().map(|y| y.abs()).collect();
        let (unfolded, turns) = unfold(&folded, 0.12);
        assert!((20..=26).contains(&turns), "{turns}");
        assert!(curvature(&unfolded) < 0.2 * curvature(&folded));
        let whole: Vec<f64> = wave.iter().map(|y| y + 1.0).collect();
        let (same, turns) = unfold(&whole, 0.24);
        assert!(curvature(&same) > 0.8 * curvature(&whole), "{turns}");
    }
}
