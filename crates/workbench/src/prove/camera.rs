//! Frames and fixes of a camera, through the drivers of the loop.

use super::sheet::Sheet;
use crate::bench::Bench;
use crate::capture::Capture;
use crate::line_test::Quantiles;
use crate::sight::Sight;
use crate::snapshot::next_frame;
use cellpos_rig::{Camera, Clock, FrameBuffer};
use cellpos_session::Failure;
use cellpos_session::connect::describe;

const CAMERA: [&str; 5] = [
    "frames come",
    "rate",
    "frames lost",
    "jitter of arrival",
    "age on arrival",
];
const VISION: [&str; 3] = ["recall", "noise", "time of a look"];

/// Records the camera of a rig for a time.
pub fn camera(sheet: &mut Sheet, bench: &Bench, duration_s: f64) {
    if let Err(failure) = watched(sheet, bench, duration_s) {
        sheet.judge(
            ("camera", "frames come"),
            false,
            (None, ""),
            "frames for the whole time",
            describe(&failure),
        );
    }
    sheet.complete("camera", &CAMERA, "not reached: a line above says why");
}

fn watched(sheet: &mut Sheet, bench: &Bench, duration_s: f64) -> Result<(), Failure> {
    let period_ms = bench.file().timing.period_us * 1e-3;
    let mut camera = bench.camera()?;
    let mut buffer = FrameBuffer::default();
    next_frame(camera.as_mut(), &mut buffer)?;
    let clock = Clock::Real;
    while camera
        .next_frame(&mut buffer, clock.now_ns())
        .map_err(Failure::failed)?
        .is_some()
    {}
    let (mut intervals_ms, mut ages_ms) = (Vec::new(), Vec::new());
    let (mut lost, mut repeated) = (0, 0);
    let mut span: Option<[(u64, i64); 2]> = None;
    let mut last: Option<(u64, i64)> = None;
    let end_ns = clock.now_ns() + (duration_s * 1e9) as i64;
    while clock.now_ns() < end_ns {
        let Some(stamp) = camera
            .next_frame(&mut buffer, end_ns)
            .map_err(Failure::failed)?
        else {
            break;
        };
        ages_ms.push((stamp.arrival_ns - stamp.mid_exposure_ns) as f64 * 1e-6);
        if let Some((id, at_ns)) = last {
            if stamp.id <= id {
                repeated += 1;
                continue;
            }
            lost += stamp.id - id - 1;
            if stamp.id == id + 1 {
                intervals_ms.push((stamp.arrival_ns - at_ns) as f64 * 1e-6);
            }
        }
        last = Some((stamp.id, stamp.arrival_ns));
        let here = (stamp.id, stamp.mid_exposure_ns);
        span = Some([span.map_or(here, |[first, _]| first), here]);
    }
    let [(first, from_ns), (newest, to_ns)] = span.unwrap_or_default();
    let exposed = newest.saturating_sub(first) as f64;
    sheet.judge(
        ("camera", "frames come"),
        exposed > 0.0,
        (ages_ms.len() as f64, "frames"),
        format!("frames for {duration_s} s"),
        format!(
            "{}: {} x {} px, {} bits",
            camera.info().name,
            buffer.width,
            buffer.height,
            buffer.bits
        ),
    );
    let rate_hz = exposed / ((to_ns - from_ns) as f64 * 1e-9);
    let promised_hz = 1e3 / period_ms;
    sheet.judge(
        ("camera", "rate"),
        (rate_hz / promised_hz - 1.0).abs() < 0.01,
        (rate_hz, "Hz"),
        format!("{promised_hz:.1} Hz to a hundredth: [timing] period_us"),
        "exposures by the camera's own numbers and stamps",
    );
    // One lost frame in ten thousand has no visible effect on a held bead; the loop coasts over it.
    let share = lost as f64 / (exposed + 1.0);
    sheet.judge(
        ("camera", "frames lost"),
        share < 1e-4 && repeated == 0,
        (lost as f64, "frames"),
        format!(
            "fewer than one in ten thousand of {:.0}, none twice",
            exposed + 1.0
        ),
        format!("{repeated} came twice"),
    );
    let off: Vec<f64> = intervals_ms
        .iter()
        .map(|ms| (ms - period_ms).abs())
        .collect();
    let jitter = Quantiles::of(&off);
    sheet.judge(
        ("camera", "jitter of arrival"),
        jitter.p99 < 0.5 * period_ms,
        (jitter.p99, "ms"),
        format!("99 of 100 below {:.2} ms: half a period", 0.5 * period_ms),
        format!(
            "median {:.3} ms, largest {:.3} ms off a period",
            jitter.p50, jitter.max
        ),
    );
    let age = Quantiles::of(&ages_ms);
    let oldest_ms = bench.file().timing.oldest_ms;
    sheet.judge(
        ("camera", "age on arrival"),
        age.p99 < oldest_ms && age.p50 > 0.0,
        (age.p50, "ms"),
        format!("99 of 100 below {oldest_ms} ms: [timing] oldest_ms"),
        format!(
            "by the camera's own stamps; 99 of 100 below {:.3} ms, largest {:.3} ms",
            age.p99, age.max
        ),
    );
    Ok(())
}

/// Tracks a bead or cell at rest as the loop does.
pub fn vision(sheet: &mut Sheet, bench: &Bench, duration_s: f64) {
    let sight =
        Capture::of(bench, duration_s).and_then(|capture| Sight::of(bench, &capture.frames));
    match sight {
        Ok(sight) => judge_sight(sheet, bench, &sight),
        Err(failure) => sheet.judge(
            ("vision", "recall"),
            false,
            (None, "%"),
            "a bead or cell in view",
            describe(&failure),
        ),
    }
    sheet.complete("vision", &VISION, "not reached: a line above says why");
}

fn judge_sight(sheet: &mut Sheet, bench: &Bench, sight: &Sight) {
    let recall = sight.recall();
    sheet.judge(
        ("vision", "recall"),
        sight.seen > 0 && recall >= 0.99,
        (100.0 * recall, "%"),
        "99 of 100 frames, from the first sight on",
        match sight.seen {
            0 => "nothing that vision believes in: cellpos camera --rig RIG --find-beads beads.png"
                .to_string(),
            seen => format!(
                "{seen} of {} frames, contrast {:.0} times the noise; {} more after it had drifted out",
                sight.frames, sight.snr, sight.left
            ),
        },
    );
    let scale = bench.file().calibration.map(|c| c.pixel_um * 1e3);
    let (per_px, unit) = scale.map_or((1.0, "px"), |nm| (nm, "nm"));
    let measured = match sight.measured_px {
        Some(px) => format!("the steps between frames show {:.3} {unit}", px * per_px),
        None => "the steps between frames show none: the bead's own motion hides it".to_string(),
    };
    // The steps give a lower bound, uncertain by some tens of percent. If they exceed the stated noise by half, the fit
    // claims too much.
    let honest = sight
        .measured_px
        .is_none_or(|px| px < 1.5 * sight.stated_px);
    sheet.judge(
        ("vision", "noise"),
        sight.stated_px.is_finite() && honest,
        (sight.stated_px * per_px, unit),
        "as stated by the fit; the steps between frames show no more than half as much again",
        measured,
    );
    let period_us = bench.file().timing.period_us;
    let [median_us, p99_us] = sight.look_us;
    sheet.judge(
        ("vision", "time of a look"),
        p99_us < period_us,
        (p99_us, "us"),
        format!("99 of 100 within a period of {period_us} us"),
        format!("median {median_us:.0} us"),
    );
}
