//! Specks of dust beside a bead that is followed.

use crate::common::Random;
use crate::tracking::{DT_S, Scene, tracker};

/// Largest residual ratio of a bead that swims past specks (x, y, contrast) and is accepted in every frame.
fn largest_residual_beside(specks: &[(f64, f64, f64)]) -> f64 {
    let mut random = Random(8);
    let mut scene = Scene::new();
    let specks = specks
        .iter()
        .map(|(x, y, contrast)| [*x, *y, *contrast, 1.5]);
    scene.specks.extend(specks);
    let mut tracker = tracker();
    let (mut most, mut x) = (0.0_f64, 60.0);
    for n in 0..120 {
        let flow = if n == 100 { -9000.0 } else { 0.0 };
        x += flow * DT_S;
        let frame = scene.draw(&[(x, 30.0, 1.0)], &mut random);
        let t = tracker.step(Some(&frame), f64::from(n) * DT_S, (flow, 0.0));
        most = most.max(t.fix.residual_ratio);
        if n > 5 {
            assert!(t.decision.is_accepted(), "{n} {t:?}");
        }
    }
    most
}

#[test]
fn a_bead_alone_is_not_refused_beside_a_speck_of_dust() {
    // The speck is part of the fit.
    let most = largest_residual_beside(&[(45.0, 34.0, -36.0)]);
    assert!(most < 2.0, "{most}");
    // Contrast and size stay as they are, the residual is over four times as large: no ellipse explains several grains.
    let grains = [
        (45.0, 34.0, -36.0),
        (41.0, 36.0, 30.0),
        (48.0, 38.0, 30.0),
        (44.0, 24.0, -30.0),
    ];
    let most = largest_residual_beside(&grains);
    assert!(most > 4.0, "{most}");
}
