//! Five measured beads in bright field, against positions found by another program.

use cellpos_vision::{
    FixQuality, Frame, Learning, LinkConfig, Localiser, LocaliserConfig, ManyTracker, Pixels,
    ProfileSpec, RingProfile,
};
use std::path::Path;

const DATA: &str = concat!(env!("MEASURED_DATA"), "/beads-brightfield");
const FRAMES: usize = 50;
const BEADS: usize = 5;

/// x_tm and y_tm of reference.csv, by frame and bead.
fn reference(folder: &Path) -> Vec<Vec<(f64, f64)>> {
    let text = std::fs::read_to_string(folder.join("reference.csv"))
        .expect("reference.csv lies beside the pictures");
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let column = |name: &str| {
        header
            .iter()
            .position(|h| *h == name)
            .expect("the column is there")
    };
    let (frame, bead, x, y) = (
        column("frame"),
        column("particle"),
        column("x_tm"),
        column("y_tm"),
    );
    let mut positions = vec![vec![(f64::NAN, f64::NAN); BEADS]; FRAMES];
    for line in lines {
        let cells: Vec<&str> = line.split(',').collect();
        let number = |k: usize| cells[k].parse::<f64>().expect("a number");
        positions[number(frame) as usize][number(bead) as usize] = (number(x), number(y));
    }
    positions
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/beads-brightfield")]
fn all_five_measured_beads_keep_their_numbers_and_move_as_the_reference_says() {
    let folder = Path::new(DATA);
    let reference = reference(folder);
    let spec = ProfileSpec::Ring {
        edge_px: RingProfile::MEASURED_EDGE_PX,
    };
    let learning = Learning {
        first_fixes: 50,
        ..Learning::default()
    };
    for (name, learning) in [
        ("configured template", None),
        ("learnt template", Some(learning)),
    ] {
        // Beads of different size and focus: the shared template fits none of them exactly.
        let config = LocaliserConfig {
            learning,
            template_tolerance: 0.15,
            ..LocaliserConfig::new(spec)
        };
        let localiser = Localiser::new(config).unwrap();
        let link = LinkConfig {
            max_step_px: 6.0,
            memory_frames: 3,
            max_beads: 20,
        };
        let mut tracker = ManyTracker::new(localiser, link);
        let mut positions = vec![vec![(f64::NAN, f64::NAN); BEADS]; FRAMES];
        // Numbers of ours by number of the reference, from the first frame.
        let mut ours = [u32::MAX; BEADS];
        let (mut worst_ratio, mut least_snr) = (0.0_f64, f64::INFINITY);
        for n in 0..FRAMES {
            let picture = image::open(folder.join(format!("bf_{n:04}.png")))
                .expect("a PNG")
                .into_luma8();
            let (width, height) = (picture.width() as usize, picture.height() as usize);
            let frame = Frame {
                width,
                height,
                pixels: Pixels::Mono8(picture.as_raw()),
            };
            let sights = tracker.step(&frame);
            assert_eq!(sights.len(), BEADS, "{name}, frame {n}: {sights:?}");
            for s in sights {
                assert_eq!(s.fix.verdict, FixQuality::Good, "{name}, frame {n}: {s:?}");
                worst_ratio = worst_ratio.max(s.fix.residual_ratio);
                least_snr = least_snr.min(s.fix.snr);
                let distance = |b: usize| {
                    let (x, y) = reference[n][b];
                    f64::hypot(s.fix.x_px - x, s.fix.y_px - y)
                };
                let nearest = (0..BEADS)
                    .min_by(|a, b| distance(*a).total_cmp(&distance(*b)))
                    .unwrap();
                if n == 0 {
                    ours[nearest] = s.bead;
                }
                assert_eq!(ours[nearest], s.bead, "{name}, frame {n}: wrong identity");
                assert!(
                    distance(nearest) < 1.0,
                    "{name}, frame {n}, bead {nearest}: {} px off",
                    distance(nearest)
                );
                positions[n][nearest] = (s.fix.x_px, s.fix.y_px);
            }
        }
        let mut all = 0.0;
        for b in 0..BEADS {
            let mut squares = 0.0;
            for n in 1..FRAMES {
                let step = |p: &Vec<Vec<(f64, f64)>>| {
                    (p[n][b].0 - p[n - 1][b].0, p[n][b].1 - p[n - 1][b].1)
                };
                let (own, other) = (step(&positions), step(&reference));
                squares += ((own.0 - other.0).powi(2) + (own.1 - other.1).powi(2))
                    / (2 * (FRAMES - 1)) as f64;
            }
            println!(
                "{name}, bead {b}: displacement differs by {:.4} px RMS",
                squares.sqrt()
            );
            assert!(squares.sqrt() <= 0.03, "{name}, bead {b}");
            all += squares / BEADS as f64;
        }
        let report = tracker.localiser().learning();
        println!(
            "{name}: all beads {:.4} px RMS, least SNR {least_snr:.1}, largest residual ratio {worst_ratio:.1}, {report:?}",
            all.sqrt()
        );
        assert!(all.sqrt() <= 0.03);
    }
}
