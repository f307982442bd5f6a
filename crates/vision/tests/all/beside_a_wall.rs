//! A wall stands in the window of a bead: a window that just holds the bead does, and the whole one again once the wall is gone.

use crate::common::{Random, SIDE, frame, known_noise, render};
use cellpos_vision::{FixQuality, Localiser, LocaliserConfig, ProfileSpec, RingProfile};

const NOISE: f64 = 100.0;
const SNR: f64 = 40.0;
const RING: f64 = 5.0;
/// Rows of the window that the wall darkens, and by how much.
const WALL: (usize, u16) = (3, 2_500);

fn localiser() -> Localiser {
    let config = LocaliserConfig {
        window_px: SIDE,
        noise: known_noise(NOISE),
        ..LocaliserConfig::new(ProfileSpec::Ring { edge_px: RING })
    };
    Localiser::new(config).expect("valid settings")
}

#[test]
fn a_bead_beside_a_wall_is_measured_as_the_narrow_window_allows_and_one_without_by_the_whole() {
    let profile = RingProfile::new(RING).expect("a size");
    let mut random = Random(41);
    let (mut tried, mut without) = (localiser(), localiser());
    for beside in [true, false] {
        let (mut z2, mut count, mut over) = (0.0, 0.0, 1.0);
        for _ in 0..300 {
            let (x, y) = (11.7 + 0.6 * random.uniform(), 11.7 + 0.6 * random.uniform());
            let mut pixels = render(&profile, x, y, SNR * NOISE, NOISE, &mut random);
            if beside {
                for grey in pixels.iter_mut().take(WALL.0 * SIDE) {
                    *grey -= WALL.1;
                }
            }
            let fix = tried.locate(&frame(&pixels), Some((12.0, 12.0)));
            assert_eq!(fix.verdict, FixQuality::Good, "{fix:?}");
            z2 += 0.5
                * ((fix.x_px - x).powi(2) / fix.var_x_px2 + (fix.y_px - y).powi(2) / fix.var_y_px2);
            count += 1.0;
            if !beside {
                let other = without.locate(&frame(&pixels), Some((12.0, 12.0)));
                over = (fix.var_x_px2 / other.var_x_px2).sqrt();
            }
        }
        let z = f64::sqrt(z2 / count);
        println!(
            "wall {beside}: errors over stated ones {z:.3}, stated over that of the whole window {over:.4}"
        );
        assert!((0.85..1.15).contains(&z), "{z}");
        assert!((0.99..1.01).contains(&over), "{over}");
    }
}
