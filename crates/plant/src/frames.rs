//! Frames that are lost or delivered twice, as whole rows of a record.

use crate::effects::Action;
use crate::model::Model;
use cellpos_numeric::Random;

/// Fate of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameFate {
    /// Recorded.
    Kept,
    /// Lost: its row is missing.
    Dropped,
    /// The frame before is delivered again in its place: its row repeats that position.
    Repeated,
}

/// The fates of the frames of a record, from the rates of the effects frame-drops and frame-repeats and a seed.
///
/// The first frame is always kept. The fate of a frame does not depend on the number of frames after it.
pub fn frame_fates(model: &Model, frames: usize, seed: u64) -> Vec<FrameFate> {
    // Independent causes: the chance to escape all is the product.
    let (mut not_dropped, mut not_repeated) = (1.0, 1.0);
    for effect in &model.effects {
        match effect.act() {
            Action::Drop(rate) => not_dropped *= 1.0 - rate,
            Action::Repeat(rate) => not_repeated *= 1.0 - rate,
            _ => {}
        }
    }
    let (drops, repeats) = (1.0 - not_dropped, 1.0 - not_repeated);
    let mut random = Random::new(seed ^ 0x5851_f42d_4c95_7f2d);
    (0..frames)
        .map(|k| {
            let (a, b) = (random.uniform(), random.uniform());
            if k == 0 {
                FrameFate::Kept
            } else if a < drops {
                FrameFate::Dropped
            } else if b < repeats {
                FrameFate::Repeated
            } else {
                FrameFate::Kept
            }
        })
        .collect()
}

/// The recorded positions of a record whose frames have these fates: `None` for a missing row, the last position
/// delivered for a repeated frame. The shorter length counts.
pub fn apply_frame_fates(bead_um: &[f64], fates: &[FrameFate]) -> Vec<Option<f64>> {
    let mut last = None;
    bead_um
        .iter()
        .zip(fates)
        .map(|(&y, fate)| match fate {
            FrameFate::Kept => {
                last = Some(y);
                last
            }
            FrameFate::Dropped => None,
            FrameFate::Repeated => last,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::{frame_drops, frame_repeats};

    #[test]
    fn frames_are_lost_and_repeated_at_their_rates() {
        let model = Model::eq6()
            .with_effect(frame_drops(0.02))
            .with_effect(frame_repeats(0.05));
        let n = 50_000;
        let fates = frame_fates(&model, n, 1);
        let count = |f| fates.iter().filter(|x| **x == f).count() as f64 / n as f64;
        assert!((count(FrameFate::Dropped) - 0.02).abs() < 0.003);
        assert!((count(FrameFate::Repeated) - 0.98 * 0.05).abs() < 0.004);
        assert_eq!(fates[..100], frame_fates(&model, 100, 1)[..]);
    }

    #[test]
    fn a_repeated_frame_gives_an_increment_of_exactly_zero() {
        use FrameFate::{Dropped, Kept, Repeated};
        let rows = apply_frame_fates(&[1.0, 2.0, 3.0, 4.0], &[Kept, Repeated, Dropped, Repeated]);
        assert_eq!(rows, [Some(1.0), Some(1.0), None, Some(1.0)]);
    }
}
