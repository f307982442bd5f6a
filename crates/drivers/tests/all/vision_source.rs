//! From a camera's frames to the positions of one bead: what is taken, what is not, and that nothing is allocated.

use cellpos_counting_alloc::allocations;
use cellpos_drivers::{Axis, Calibration, CommandedFlow, VisionSource};
use cellpos_rig::{
    Camera, CameraError, Clock, FrameBuffer, FrameStamp, FrameWatch, Measurement, PositionSource,
    SeenFrame, SourceInfo,
};
use cellpos_vision::{
    Decision, Localiser, LocaliserConfig, PixelResponse, ProfileSpec, Template, TrackState,
    Tracker, TrackerConfig,
};
use std::sync::{Arc, Mutex};

const WIDTH: usize = 160;
const HEIGHT: usize = 64;
const EDGE_PX: f64 = 5.0;
const PERIOD_NS: i64 = 1_000_000;

fn ring() -> ProfileSpec {
    ProfileSpec::Ring { edge_px: EDGE_PX }
}

/// Frames drawn in advance, delivered one by one with the given stamps.
struct Scripted {
    frames: Vec<(FrameStamp, Vec<u8>)>,
    next: usize,
    rate_hz: f64,
}

impl Scripted {
    fn new() -> Self {
        Self {
            frames: Vec::new(),
            next: 0,
            rate_hz: 1000.0,
        }
    }

    /// A frame with beads at the places given: x, y (px), brightness.
    fn frame(&mut self, template: &Template, id: u64, at_ns: i64, beads: &[(f64, f64, f64)]) {
        let mut image = vec![100.0_f32; WIDTH * HEIGHT];
        for (x, y, brightness) in beads {
            template.draw(&mut image, WIDTH, *x, *y, 80.0 * brightness);
        }
        let mut ripple = 0.3 + 0.4 * ((id * 2_654_435_761) % 997) as f32 / 997.0;
        let pixels = image
            .iter()
            .map(|v| {
                ripple = 3.9 * ripple * (1.0 - ripple);
                (v + 4.0 * (ripple - 0.5)).round() as u8
            })
            .collect();
        let stamp = FrameStamp {
            id,
            mid_exposure_ns: at_ns,
            exposure_ns: 0,
            arrival_ns: at_ns + 2 * PERIOD_NS,
            true_um: f64::NAN,
            true_pzt_um: f64::NAN,
        };
        self.frames.push((stamp, pixels));
    }
}

impl Camera for Scripted {
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        _: i64,
    ) -> Result<Option<FrameStamp>, CameraError> {
        let Some((stamp, pixels)) = self.frames.get(self.next) else {
            return Err(CameraError::Gone {
                camera: "script".to_string(),
                problem: "over".to_string(),
            });
        };
        self.next += 1;
        (buffer.width, buffer.height, buffer.bits) = (WIDTH, HEIGHT, 8);
        buffer.mono8.clear();
        buffer.mono8.extend_from_slice(pixels);
        Ok(Some(*stamp))
    }

    fn info(&self) -> SourceInfo {
        SourceInfo {
            name: "script".to_string(),
            width_px: WIDTH,
            height_px: HEIGHT,
            rate_hz: self.rate_hz,
            latency_ms: 2.0,
            exposure_s: 0.0,
            field_um: [0.0, 0.0],
        }
    }
}

fn template() -> Template {
    ring().template(PixelResponse::Point).unwrap()
}

fn source(camera: Scripted, calibration: Calibration) -> VisionSource<Scripted> {
    let localiser = Localiser::new(LocaliserConfig::new(ring())).unwrap();
    let tracker = Tracker::new(localiser, TrackerConfig::default()).unwrap();
    VisionSource::new(camera, tracker, calibration, Clock::virtual_at(0))
}

fn all(source: &mut VisionSource<Scripted>) -> Vec<Measurement> {
    std::iter::from_fn(|| source.next(0).ok().flatten()).collect()
}

/// A bead in whose place one of another brightness is from frame 20 on.
fn half_as_bright_from_frame_20(frames: i64) -> Scripted {
    let template = template();
    let mut camera = Scripted::new();
    for n in 0..frames {
        let brightness = if n < 20 { 1.0 } else { 0.5 };
        let bead = (60.0, 32.0, brightness);
        camera.frame(&template, n as u64, n * PERIOD_NS, &[bead]);
    }
    camera
}

fn straight() -> Calibration {
    Calibration::along_rows(0.1, 0.0, 1.0)
}

#[test]
fn a_bead_that_is_alone_is_followed_whether_a_command_or_a_step_of_the_flow_flings_it() {
    let template = template();
    // At rest for 10 frames, then 6 px in each frame: 600 um/s, as 1.5 um of PZT displacement do.
    let place = |n: i64| 30.0 + 6.0 * (n - 9).max(0) as f64;
    for commanded in [true, false] {
        let mut camera = Scripted::new();
        for n in 0..20 {
            camera.frame(&template, n as u64, n * PERIOD_NS, &[(place(n), 32.0, 1.0)]);
        }
        let flow = CommandedFlow::new(400.0);
        flow.note(9 * PERIOD_NS, if commanded { 1.5 } else { 0.0 });
        let seen = all(&mut source(camera, straight()).with_flow(flow));
        assert_eq!(seen.len(), 20);
        assert!(seen[5].is_usable() && seen[9].is_usable());
        for (n, m) in seen.iter().enumerate().skip(10) {
            assert_eq!(m.track.unwrap().0, TrackState::Tracking, "frame {n}: {m:?}");
            assert!((m.position_um - 0.1 * place(n as i64)).abs() < 0.01);
        }
    }
}

#[test]
fn what_no_flow_can_have_carried_there_is_not_the_bead() {
    let template = template();
    let config = TrackerConfig {
        // 60 px in a frame.
        fastest_flow_px_per_s: 60_000.0,
        ..TrackerConfig::default()
    };
    // The bead is gone, and another of its kind shows up 70 px further.
    let mut camera = Scripted::new();
    for n in 0..11 {
        let x_px = if n < 10 { 30.0 } else { 100.0 };
        camera.frame(&template, n as u64, n * PERIOD_NS, &[(x_px, 32.0, 1.0)]);
    }
    let localiser = Localiser::new(LocaliserConfig::new(ring())).unwrap();
    let tracker = Tracker::new(localiser, config).unwrap();
    let mut source = VisionSource::new(camera, tracker, straight(), Clock::virtual_at(0));
    let seen = all(&mut source);
    assert!(seen[9].is_usable());
    assert!(!seen[10].is_usable());
    assert_eq!(seen[10].track.unwrap().0, TrackState::Coasting);
}

#[test]
fn a_bead_of_another_brightness_in_the_same_place_gives_no_position() {
    let camera = half_as_bright_from_frame_20(40);
    let seen = all(&mut source(camera, straight()));
    assert!(seen[5..20].iter().all(Measurement::is_usable));
    for m in &seen[20..] {
        assert!(!m.is_usable(), "{m:?}");
        assert_eq!(m.track.unwrap().1, Decision::OtherBead);
    }
}

#[test]
fn a_run_that_begins_after_the_bead_was_lost_takes_the_one_that_is_there() {
    let camera = half_as_bright_from_frame_20(200);
    let mut source = source(camera, straight());
    source.begin();
    let seen: Vec<_> = (0..150).filter_map(|_| source.next(0).ok()?).collect();
    // A run that goes on keeps to its bead.
    assert!(seen[19].is_usable() && seen[20..].iter().all(|m| !m.is_usable()));
    assert_eq!(seen[149].track.unwrap().0, TrackState::Lost);
    source.begin();
    let seen: Vec<_> = (0..20).filter_map(|_| source.next(0).ok()?).collect();
    assert!(seen[10..].iter().all(Measurement::is_usable));
    // A bead that is followed when a run begins is followed on.
    source.begin();
    assert!(source.next(0).ok().flatten().unwrap().is_usable());
}

#[test]
fn frames_that_come_twice_late_or_with_an_old_stamp_are_not_looked_at() {
    let template = template();
    let here = &[(60.0, 32.0, 1.0)];
    let mut camera = Scripted::new();
    for n in 0..10 {
        camera.frame(&template, n as u64, n * PERIOD_NS, here);
    }
    camera.frame(&template, 9, 9 * PERIOD_NS, here);
    camera.frame(&template, 7, 7 * PERIOD_NS, here);
    camera.frame(&template, 10, 5 * PERIOD_NS, here);
    camera.frame(&template, 11, 11 * PERIOD_NS, here);
    let seen = all(&mut source(camera, straight()));
    for m in &seen[10..13] {
        assert_eq!(
            m.track,
            Some((TrackState::Tracking, Decision::Stale)),
            "{m:?}"
        );
        assert!(!m.is_usable() && m.position_um.is_nan());
    }
    assert!(seen[13].is_usable(), "{:?}", seen[13]);
}

#[test]
fn positions_follow_the_axis_and_the_sign_of_the_calibration() {
    let template = template();
    let mut camera = Scripted::new();
    for n in 0..30 {
        let y = 25.0 + 0.5 * n as f64;
        camera.frame(&template, n as u64, n * PERIOD_NS, &[(60.0, y, 1.0)]);
    }
    let calibration = Calibration {
        axis: Axis::Y,
        sign: -1.0,
        origin_px: 30.0,
        ..straight()
    };
    let mut source = source(camera, calibration);
    assert_eq!(source.info().field_um, [-0.1 * (HEIGHT as f64 - 31.0), 3.0]);
    let seen = all(&mut source);
    for (n, m) in seen.iter().enumerate().skip(3) {
        let expected_um = -0.1 * (25.0 + 0.5 * n as f64 - 30.0);
        assert!((m.position_um - expected_um).abs() < 0.01, "{n}: {m:?}");
        assert!(m.variance_um2 > 0.0 && m.variance_um2 < 1e-4);
    }
}

/// A frame's id and the place seen in it, um.
type Note = (u64, Option<f64>);

/// What a watch was shown.
#[derive(Clone, Default)]
struct Notes(Arc<Mutex<Vec<Note>>>);

impl FrameWatch for Notes {
    fn frame(&mut self, seen: &SeenFrame<'_>) {
        let place_um = |(x, _): (f64, f64)| seen.scale.first_um + seen.scale.um_per_px * x;
        let note = (seen.stamp.id, seen.centre_px.map(place_um));
        self.0.lock().unwrap().push(note);
    }
}

#[test]
fn a_watch_sees_each_new_frame_once_with_the_place_that_the_loop_gets() {
    let template = template();
    let mut camera = Scripted::new();
    for n in [0, 1, 2, 3, 4, 5, 5, 6, 7, 8_u64] {
        let beads: &[_] = if n == 8 { &[] } else { &[(60.0, 32.0, 1.0)] };
        camera.frame(&template, n, n as i64 * PERIOD_NS, beads);
    }
    let notes = Notes::default();
    let calibration = Calibration::along_rows(0.1, 40.0, -1.0);
    let mut source = source(camera, calibration);
    assert!(source.watch(Box::new(notes.clone())));
    let mut positions = all(&mut source);
    // A doubled frame gives no position, and is not shown again.
    positions.remove(6);
    let notes = notes.0.lock().unwrap();
    assert_eq!(notes.len(), 9);
    for (n, (note, position)) in notes.iter().zip(&positions).enumerate() {
        assert_eq!(note.0, n as u64);
        assert_eq!(note.1.is_some(), position.is_usable(), "{position:?}");
        if let Some(um) = note.1 {
            assert!(
                (um - position.position_um).abs() < 1e-9,
                "{um} {position:?}"
            );
        }
    }
    assert!(notes[7].1.is_some() && notes[8].1.is_none());
}

#[test]
fn nothing_is_allocated_per_frame_in_any_state() {
    let template = template();
    let mut camera = Scripted::new();
    for n in 0..300_i64 {
        // Alone, then lost, then back with another bead that crosses its way.
        let own = (60.0, 32.0, 1.0);
        let other = (0.6 * (n - 160) as f64, 34.0, 1.0);
        let beads: &[_] = match n {
            0..40 => &[own],
            40..120 => &[],
            _ => &[own, other],
        };
        camera.frame(&template, n as u64, n * PERIOD_NS, beads);
    }
    let flow = CommandedFlow::new(400.0);
    let mut source = source(camera, straight()).with_flow(flow.clone());
    // The first two frames make the buffers as large as they are.
    let mut states = [0_u32; 4];
    for _ in 0..2 {
        let (state, _) = source.next(0).unwrap().unwrap().track.unwrap();
        states[state as usize] += 1;
    }
    let before = allocations();
    for n in 2..300_i64 {
        flow.note(n * PERIOD_NS, 1e-4);
        if let Ok(Some(m)) = source.next(0) {
            let (state, _) = m.track.unwrap_or((TrackState::Lost, Decision::NoFrame));
            states[state as usize] += 1;
        }
    }
    assert_eq!(allocations(), before);
    assert!(
        states.iter().all(|n| *n > 0),
        "every state must have been passed through: {states:?}"
    );
    drop(std::hint::black_box(vec![0_u8; 100]));
    assert_eq!(allocations(), before + 1, "the counter must count");
}

#[test]
fn the_same_picture_under_new_numbers_is_stale() {
    let template = template();
    let mut camera = Scripted::new();
    // It hangs for frames 5 to 8.
    for n in 0..12_i64 {
        camera.frame(&template, n as u64, n * PERIOD_NS, &[(30.0, 32.0, 1.0)]);
        if (5..9).contains(&n) {
            camera.frames[n as usize].1 = camera.frames[4].1.clone();
        }
    }
    let localiser = Localiser::new(LocaliserConfig::new(ring())).unwrap();
    let tracker = Tracker::new(localiser, TrackerConfig::default()).unwrap();
    let mut source = VisionSource::new(camera, tracker, straight(), Clock::virtual_at(0));
    let seen = all(&mut source);
    for (n, m) in seen.iter().enumerate().skip(4) {
        let stale = matches!(m.track, Some((_, Decision::Stale)));
        assert_eq!(stale, (5..9).contains(&n), "frame {n}: {m:?}");
        assert_eq!(m.is_usable(), !stale, "frame {n}: {m:?}");
    }
}

/// Counts the frames that it is shown, and those with a fix.
struct Counting(Arc<Mutex<(u32, u32)>>);

impl FrameWatch for Counting {
    fn frame(&mut self, seen: &SeenFrame) {
        let mut counted = self.0.lock().unwrap();
        counted.0 += 1;
        counted.1 += u32::from(seen.centre_px.is_some());
    }
}

#[test]
fn of_the_frames_that_came_during_a_long_look_the_newest_is_looked_at_and_none_is_lost() {
    let template = template();
    // A camera so fast that each look takes longer than a frame; all frames have come.
    let mut camera = Scripted::new();
    camera.rate_hz = 1e9;
    for n in 0..20 {
        camera.frame(&template, n as u64, n * PERIOD_NS, &[(30.0, 32.0, 1.0)]);
    }
    let localiser = Localiser::new(LocaliserConfig::new(ring())).unwrap();
    let tracker = Tracker::new(localiser, TrackerConfig::default()).unwrap();
    let mut source = VisionSource::new(camera, tracker, straight(), Clock::Real);
    let counted = Arc::default();
    assert!(source.watch(Box::new(Counting(Arc::clone(&counted)))));
    let seen = all(&mut source);
    assert_eq!(
        seen.iter().map(|m| m.frame_id).collect::<Vec<_>>(),
        (0..20).collect::<Vec<_>>()
    );
    for (n, m) in seen.iter().enumerate() {
        let passed = matches!(m.track, Some((_, Decision::PassedOver)));
        assert_eq!(passed, !(n == 0 || n == 19), "frame {n}: {m:?}");
        assert!(!(passed && m.is_usable()), "frame {n}: {m:?}");
    }
    // The first look finds the bead, the next confirms it.
    assert_eq!(seen[19].track.unwrap().1, Decision::Confirming);
    let shown = *counted.lock().unwrap();
    assert_eq!(shown, (20, 0));
}
