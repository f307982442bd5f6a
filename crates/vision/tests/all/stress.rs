//! Pictures that a camera has spoilt: no fix of what is no bead, and none that is off by more than it says.

use crate::common::Random;
use crate::learnt::{AMPLITUDE, BACKGROUND, Field, SIDE, bound, disc, gaussian, measured_in, ring};
use cellpos_vision::suggest::suggest;
use cellpos_vision::{
    Detector, Fix, FixQuality, Frame, Localiser, LocaliserConfig, Pixels, ProfileSpec,
};

/// Sets one pixel in a hundred, the same in every frame, to something between black and twice as bright as a bead.
fn hot_pixels(seed: u64) -> impl Fn(&mut [u16]) {
    let mut random = Random(seed);
    let hot: Vec<(usize, u16)> = (0..SIDE * SIDE / 100)
        .map(|_| {
            let at = (random.uniform() * (SIDE * SIDE) as f64) as usize;
            let grey = 16_000.0 + 3.0 * AMPLITUDE * random.uniform();
            (at, grey as u16)
        })
        .collect();
    move |pixels| hot.iter().for_each(|(at, grey)| pixels[*at] = *grey)
}

#[test]
fn hot_pixels_are_no_beads_and_move_none() {
    // A narrow one and a disc, at one ratio each: the others differ from them in their size.
    hot_pixels_beside(|profile, ratio| [(1, 1), (4, 0)].contains(&(profile, ratio)));
}

#[test]
#[ignore = "slow: every profile at both ratios; the fast one has two profiles once each"]
fn hot_pixels_are_no_beads_at_either_ratio() {
    hot_pixels_beside(|_, _| true);
}

fn hot_pixels_beside(take: impl Fn(usize, usize) -> bool) {
    let profiles = [
        gaussian(1.0),
        gaussian(1.5),
        gaussian(3.0),
        ring(6.4),
        disc(4.0),
    ];
    let mut failed = Vec::new();
    for (of, (name, profile)) in profiles.iter().enumerate() {
        for (at, snr) in [10.0, 40.0].into_iter().enumerate() {
            if !take(of, at) {
                continue;
            }
            let mut random = Random(29);
            let spoil = hot_pixels(31);
            let fields: Vec<Field> = (0..20)
                .map(|_| {
                    let mut field = Field::new(profile.as_ref(), snr, &mut random);
                    spoil(&mut field.pixels);
                    field
                })
                .collect();
            let frames: Vec<Frame> = fields.iter().map(Field::frame).collect();
            let found = match suggest(&frames) {
                Ok(found) => found,
                Err(error) => {
                    failed.push(format!("{name} at SNR {snr}: {error}"));
                    continue;
                }
            };
            let mut localiser = Localiser::new(found.config.clone()).unwrap();
            let score = measured_in(
                &mut localiser,
                profile.as_ref(),
                snr,
                &mut random,
                750,
                &spoil,
            );
            let bound_px = bound(profile.as_ref(), snr);
            println!(
                "{name:14} SNR {snr:3}: recall {:.3}, {} of {} lie, {} phantoms, RMS/bound {:.2}, stated/RMS {:.2} {:?}",
                score.good / score.beads,
                score.lies,
                score.good,
                score.phantoms,
                score.rms() / bound_px,
                score.stated() / score.rms(),
                found.config.profile,
            );
            // A hot pixel next to the centre of a narrow bead does not show in one frame if it is weaker than six standard
            // deviations and than what the template may be wrong by.
            let hidden = name == "Gaussian 1 px";
            let fine = score.lies <= if hidden { 5e-3 } else { 1e-3 } * score.good
                // Two hot pixels next to each other are the picture of such a bead.
                && score.phantoms <= if hidden { 3.0 } else { 0.0 }
                && score.good >= 0.9 * score.beads;
            if !fine {
                failed.push(format!("{name} at SNR {snr}"));
            }
        }
    }
    assert!(failed.is_empty(), "{failed:?}");
}

/// Noise of the rows, the same along each, standard deviation in that of a pixel.
fn row_noise(pixels: &mut [u16], sd: f64, random: &mut Random) {
    for row in pixels.chunks_exact_mut(SIDE) {
        let offset = sd * random.normal();
        row.iter_mut()
            .for_each(|v| *v = (f64::from(*v) + offset).round() as u16);
    }
}

#[test]
fn frames_without_beads_have_none() {
    let noise = AMPLITUDE / 40.0;
    let mut failed = Vec::new();
    for sigma_px in [1.0, 1.5, 3.0] {
        for rows in [0.0, 0.5, 1.0] {
            let config = LocaliserConfig::new(ProfileSpec::Gaussian { sigma_px });
            let mut localiser = Localiser::new(config).unwrap();
            let mut detector = Detector::thorough(&localiser, 1000);
            let mut random = Random(37);
            let spoil = hot_pixels(41);
            let (mut good, mut seen, frames) = (0, 0, 40);
            for _ in 0..frames {
                let mut pixels: Vec<u16> = (0..SIDE * SIDE)
                    .map(|_| (BACKGROUND + noise * random.normal()).round() as u16)
                    .collect();
                row_noise(&mut pixels, rows * noise, &mut random);
                spoil(&mut pixels);
                let frame = Frame {
                    width: SIDE,
                    height: SIDE,
                    pixels: Pixels::Mono16(&pixels),
                };
                for blob in detector.detect(&frame).to_vec() {
                    seen += 1;
                    let fix = localiser.locate(&frame, Some((blob.x_px, blob.y_px)));
                    good += usize::from(fix.verdict == FixQuality::Good);
                }
            }
            println!(
                "Gaussian {sigma_px} px, rows with {rows} of the noise: {seen} regions, {good} good fixes in {frames} frames"
            );
            if good > 0 {
                failed.push(format!("{sigma_px} px, rows {rows}: {good}"));
            }
        }
    }
    assert!(failed.is_empty(), "{failed:?}");
}

/// Good fixes within a few px of the places, in fields of faint objects.
fn seen_at(places: &[(f64, f64)], pixels: &[u16]) -> usize {
    let spec = ProfileSpec::Gaussian { sigma_px: 1.0 };
    let mut localiser = Localiser::new(LocaliserConfig::new(spec)).unwrap();
    let frame = Frame {
        width: SIDE,
        height: SIDE,
        pixels: Pixels::Mono16(pixels),
    };
    let mut detector = Detector::thorough(&localiser, 1000);
    let blobs = detector.detect(&frame).iter().map(|b| (b.x_px, b.y_px));
    let mut fixes = Vec::new();
    localiser.locate_all(&frame, blobs, &mut fixes);
    fixes.retain(|fix| fix.verdict == FixQuality::Good);
    let seen = |p: &&(f64, f64)| {
        let near = |f: &Fix| f64::hypot(f.x_px - p.0, f.y_px - p.1) < 6.0;
        fixes.iter().any(near)
    };
    places.iter().filter(seen).count()
}

#[test]
fn faint_fibres_are_no_beads_and_faint_beads_are_no_fibres() {
    // Fibres are 3.5 times as long as the beads and a little wider, and not as bright.
    let (along_px, across_px, contrast) = (3.5, 1.3, 0.8 * AMPLITUDE);
    let noise = AMPLITUDE / 5.0;
    let (_, profile) = gaussian(1.0);
    let mut random = Random(43);
    let (mut objects, mut beads, mut fibres) = (0, 0, 0);
    for _ in 0..10 {
        let field = Field::new(profile.as_ref(), AMPLITUDE / noise, &mut random);
        objects += field.places.len();
        beads += seen_at(&field.places, &field.pixels);
        let mut grey: Vec<f64> = (0..SIDE * SIDE)
            .map(|_| BACKGROUND + noise * random.normal())
            .collect();
        for (x, y) in &field.places {
            let (sin, cos) = (core::f64::consts::PI * random.uniform()).sin_cos();
            for (k, grey) in grey.iter_mut().enumerate() {
                let (dx, dy) = ((k % SIDE) as f64 - x, (k / SIDE) as f64 - y);
                let u = (cos * dx + sin * dy) / along_px;
                let v = (cos * dy - sin * dx) / across_px;
                *grey += contrast * (-0.5 * (u * u + v * v)).exp();
            }
        }
        let pixels: Vec<u16> = grey.iter().map(|v| v.round() as u16).collect();
        fibres += seen_at(&field.places, &pixels);
    }
    println!("{beads} beads and {fibres} fibres are good, of {objects} each");
    assert!(100 * beads >= 95 * objects, "{beads} of {objects} beads");
    assert!(50 * fibres <= objects, "{fibres} of {objects} fibres");
}
