//! Industrial cameras against Aravis' fake GigE Vision camera on loopback: run by `scripts/fake-camera.sh`.
// The library has no safe way to draw into the fake camera's stream.
#![allow(unsafe_code)]

use aravis::glib::translate::ToGlibPtr;
use cellpos_drivers::sources::Region;
use cellpos_drivers::sources::industrial::{IndustrialCamera, IndustrialSettings};
use cellpos_rig::clock::monotonic_ns;
use cellpos_rig::{Camera, CameraError, FrameBuffer, FrameStamp};
use cellpos_vision::{
    Localiser, LocaliserConfig, PixelResponse, ProfileSpec, Template, TrackState, Tracker,
    TrackerConfig,
};
use std::ffi::c_void;
use std::process::{Child, Command};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, OnceLock};
use std::time::Duration;

const SIDE: usize = 64;
const WATCHED_S: i64 = 10;
/// What the driver is told of the way from the middle of an exposure to its fastest arrival.
const LATENCY_MS: f64 = 0.5;

/// The server is killed when the test ends, however it ends.
struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn settings(address: &str) -> IndustrialSettings {
    IndustrialSettings {
        address: address.to_string(),
        region: Some(Region {
            x_px: 0,
            y_px: 0,
            width_px: SIDE,
            height_px: SIDE,
        }),
        rate_hz: 1000.0,
        exposure_us: Some(500.0),
        bits: 8,
        latency_ms: LATENCY_MS,
        buffers: 200,
    }
}

fn open(address: &str) -> IndustrialCamera {
    for _ in 0..30 {
        match IndustrialCamera::open(settings(address)) {
            Ok(camera) => return camera,
            Err(error) => eprintln!("waiting for the fake camera: {error}"),
        }
        std::thread::sleep(Duration::from_millis(200));
    }
    panic!("the fake camera does not answer at {address}");
}

#[test]
#[ignore = "needs Aravis' fake camera: run scripts/fake-camera.sh"]
fn every_frame_of_the_fake_camera_arrives_or_is_counted_and_one_that_is_gone_is_told() {
    let server = Command::new("arv-fake-gv-camera-0.8")
        .args(["-i", "127.0.0.1", "-s", "CP1"])
        .spawn();
    let server = Server(server.expect("aravis-tools is installed"));
    let mut camera = open("127.0.0.1");
    let mut buffer = FrameBuffer::default();
    let (mut frames, mut last, mut longest_ms, mut lost) = (0_u64, None::<(u64, i64)>, 0.0_f64, 0);
    let end_ns = monotonic_ns() + WATCHED_S * 1_000_000_000;
    while monotonic_ns() < end_ns {
        let Some(stamp) = camera
            .next_frame(&mut buffer, monotonic_ns() + 5_000_000)
            .unwrap()
        else {
            continue;
        };
        assert_eq!(
            (buffer.width, buffer.height, buffer.mono8.len()),
            (SIDE, SIDE, SIDE * SIDE)
        );
        if let Some((id, arrival_ns)) = last {
            assert!(stamp.id > id);
            lost += stamp.id - id - 1;
            longest_ms = longest_ms.max((stamp.arrival_ns - arrival_ns) as f64 * 1e-6);
        }
        last = Some((stamp.id, stamp.arrival_ns));
        frames += 1;
    }
    let rate_hz = frames as f64 / WATCHED_S as f64;
    let counts = camera.counts();
    println!("{rate_hz:.1} frames/s, longest gap {longest_ms:.1} ms, {lost} lost, {counts:?}");
    assert!(frames > 0);
    assert_eq!((counts.new, counts.dropped), (frames, lost));

    // Unplugged: the server goes away, and after the silence the camera is gone, not silent for ever.
    drop(server);
    let give_up_ns = monotonic_ns() + 20_000_000_000;
    let gone = loop {
        match camera.next_frame(&mut buffer, monotonic_ns() + 50_000_000) {
            Err(error) => break error,
            Ok(_) => assert!(
                monotonic_ns() < give_up_ns,
                "a camera that is gone must be told"
            ),
        }
    };
    println!("unplugged: {gone}");
    assert!(matches!(gone, CameraError::Gone { .. }));
}

static TEMPLATE: OnceLock<Template> = OnceLock::new();
static DRAWN: AtomicU32 = AtomicU32::new(0);
/// When each picture was made, on this machine's clock, ns: the truth of its time stamp.
static MADE_NS: Mutex<Vec<i64>> = Mutex::new(vec![]);
/// Longest that a time stamp may be off, ns. A picture is stamped just before it is drawn, to the microsecond; a tenth of a
/// millisecond is what a delay may be off without a word.
const STAMP_OFF_NS: i64 = 100_000;
/// The clocks of a camera and of a computer run apart by less than this.
const CLOCKS_APART: f64 = 200e-6;

/// Where the bead is drawn in picture `n`, px: slow circles, 300 px/s at most.
fn place(n: u32) -> (f64, f64) {
    let angle = std::f64::consts::TAU * f64::from(n) / 400.0;
    (32.0 + 14.0 * angle.cos(), 30.0 + 10.0 * angle.sin())
}

/// Draws a bead, and the picture's number into four pixels of the last row.
unsafe extern "C" fn draw(
    buffer: *mut aravis_sys::ArvBuffer,
    _: *mut c_void,
    _: u32,
    _: u32,
    _: aravis_sys::ArvPixelFormat,
) {
    let n = DRAWN.fetch_add(1, Ordering::Relaxed);
    MADE_NS.lock().unwrap().push(monotonic_ns());
    let mut size = 0_usize;
    // SAFETY: the fake camera hands over a valid buffer of its own, made for its region of SIDE x SIDE pixels of one
    // byte, which is checked here; the buffer's own count of bytes is set only after this call. Nobody else touches the
    // memory during it.
    let pixels = unsafe {
        let side = SIDE as i32;
        let (width, height) = (
            aravis_sys::arv_buffer_get_image_width(buffer),
            aravis_sys::arv_buffer_get_image_height(buffer),
        );
        let data = aravis_sys::arv_buffer_get_data(buffer, &mut size).cast::<u8>();
        if data.is_null() || (width, height) != (side, side) {
            return;
        }
        std::slice::from_raw_parts_mut(data, SIDE * SIDE)
    };
    let Some(template) = TEMPLATE.get() else {
        return;
    };
    let mut image = vec![110.0_f32; SIDE * SIDE];
    let (x, y) = place(n);
    template.draw(&mut image, SIDE, x, y, 80.0);
    let mut noise = u64::from(n) * 2 + 1;
    for (p, v) in pixels.iter_mut().zip(&image) {
        // The sum of four bytes of a generator: nearly normal, 2 grey levels.
        noise = noise
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        let sum: u32 = noise.to_be_bytes()[..4].iter().map(|b| u32::from(*b)).sum();
        *p = (v + 2.0 * (sum as f32 - 510.0) / 147.8).round() as u8;
    }
    pixels[(SIDE - 1) * SIDE..][..4].copy_from_slice(&n.to_be_bytes());
}

#[test]
#[ignore = "needs Aravis: run scripts/fake-camera.sh"]
fn a_bead_drawn_into_the_stream_is_tracked_and_its_frames_are_stamped_with_the_time_they_were_made()
{
    let spec = ProfileSpec::Ring { edge_px: 4.5 };
    TEMPLATE
        .set(spec.template(PixelResponse::Point).unwrap())
        .unwrap();
    let server = aravis::GvFakeCamera::new(Some("127.0.0.1"), Some("CP2"));
    assert!(server.is_running(), "the fake camera's port is taken");
    let fake = server.fake_camera().unwrap();
    // SAFETY: `fake` lives as long as `server`; the callback uses no data.
    unsafe {
        aravis_sys::arv_fake_camera_set_fill_pattern(
            fake.to_glib_none().0,
            Some(draw),
            std::ptr::null_mut(),
        );
    }
    let mut camera = open("127.0.0.1");
    let localiser = Localiser::new(LocaliserConfig::new(spec)).unwrap();
    // Stalls of about 100 ms are to be coasted through.
    let config = TrackerConfig {
        coast_limit_s: 0.3,
        ..TrackerConfig::default()
    };
    let mut tracker = Tracker::new(localiser, config).unwrap();
    let mut buffer = FrameBuffer::default();
    let mut states = [0_u32; 4];
    let (mut squares, mut fixes, mut longest_ms, mut last_ns) = (0.0, 0_u32, 0.0_f64, None::<i64>);
    let mut stamps = vec![];
    let end_ns = monotonic_ns() + WATCHED_S * 1_000_000_000;
    while monotonic_ns() < end_ns {
        let stamp = camera
            .next_frame(&mut buffer, monotonic_ns() + 3_000_000)
            .unwrap();
        let step = match stamp {
            Some(s) => {
                if let Some(last_ns) = last_ns {
                    longest_ms = longest_ms.max((s.arrival_ns - last_ns) as f64 * 1e-6);
                }
                last_ns = Some(s.arrival_ns);
                stamps.push((number(&buffer), s));
                let time_s = s.mid_exposure_ns as f64 * 1e-9;
                tracker.step(Some(&buffer.frame()), time_s, (0.0, 0.0))
            }
            None => tracker.step(None, monotonic_ns() as f64 * 1e-9, (0.0, 0.0)),
        };
        states[step.state as usize] += 1;
        if step.state == TrackState::Tracking {
            let (x, y) = place(number(&buffer));
            squares += (step.fix.x_px - x).powi(2) + (step.fix.y_px - y).powi(2);
            fixes += 1;
        }
    }
    let rms_px = (squares / f64::from(2 * fixes)).sqrt();
    let rate_hz = f64::from(fixes) / WATCHED_S as f64;
    println!(
        "tracked {rate_hz:.1} frames/s, RMS error {rms_px:.4} px, longest gap {longest_ms:.1} ms, \
         searching/tracking/coasting/lost {states:?}, {:?}",
        camera.counts()
    );
    assert!(rms_px < 0.05, "{rms_px}");
    // A machine that stood still for longer than the tracker coasts has lost the bead by right.
    let stalled = longest_ms > 1e3 * config.coast_limit_s;
    assert!(
        stalled || states[TrackState::Lost as usize] == 0,
        "stalls must be coasted through"
    );
    judge(&stamps);
}

/// The number that was drawn into a picture.
fn number(buffer: &FrameBuffer) -> u32 {
    let bytes = buffer.mono8[(SIDE - 1) * SIDE..][..4].try_into();
    u32::from_be_bytes(bytes.unwrap())
}

/// Judges the time stamps by when the pictures were made, however late they came. [`LATENCY_MS`] is told to be the time from the middle of
/// the exposure to the fastest arrival. What the machine let the driver know of the fastest way is the least that it saw, aged by
/// [`CLOCKS_APART`]; a stamp is the picture's time, plus that, minus the latency. So a slow machine makes no stamp wrong.
fn judge(stamps: &[(u32, FrameStamp)]) {
    let made_ns = MADE_NS.lock().unwrap();
    let made = |n: u32| made_ns[n as usize];
    let ways = stamps.iter().map(|&(n, s)| s.arrival_ns - made(n));
    let (fastest_ns, slowest_ns) = (ways.clone().min().unwrap(), ways.clone().max().unwrap());
    let mut known: Option<(f64, i64)> = None;
    let known_ns: Vec<i64> = ways
        .zip(stamps)
        .map(|(way_ns, &(_, s))| {
            let aged = known.map_or(f64::INFINITY, |(least, at_ns)| {
                least + CLOCKS_APART * (s.arrival_ns - at_ns) as f64
            });
            let least = aged.min(way_ns as f64);
            known = Some((least, s.arrival_ns));
            least as i64
        })
        .collect();
    // The first half second at most teaches the offset of the two clocks.
    let settled = (stamps.len() / 2).min(500);
    let mut off_ns: Vec<i64> = (stamps.iter().zip(known_ns).skip(settled))
        .map(|(&(n, s), way_ns)| s.mid_exposure_ns - made(n) - way_ns + (LATENCY_MS * 1e6) as i64)
        .collect();
    off_ns.sort_unstable();
    let at = |share: f64| off_ns[((off_ns.len() - 1) as f64 * share) as usize];
    println!(
        "time stamps off by {:.1} us (median), {:.1} to {:.1} (95 %); ways {:.2} to {:.2} ms",
        at(0.5) as f64 * 1e-3,
        at(0.025) as f64 * 1e-3,
        at(0.975) as f64 * 1e-3,
        fastest_ns as f64 * 1e-6,
        slowest_ns as f64 * 1e-6,
    );
    for share in [0.1, 0.5, 0.9] {
        assert!(at(share).abs() <= STAMP_OFF_NS, "{share}: {} ns", at(share));
    }
}

#[test]
#[ignore = "needs Aravis: run scripts/fake-camera.sh"]
fn a_camera_that_is_not_there_and_an_empty_region_are_clear_errors() {
    let absent = IndustrialCamera::open(settings("127.0.0.99")).unwrap_err();
    println!("absent: {absent}");
    assert!(matches!(absent, CameraError::Gone { .. }));
    let region = Some(Region {
        x_px: 0,
        y_px: 0,
        width_px: 0,
        height_px: 64,
    });
    let empty = IndustrialCamera::open(IndustrialSettings {
        region,
        ..settings("127.0.0.1")
    })
    .unwrap_err();
    println!("empty region: {empty}");
    assert!(matches!(empty, CameraError::Broken { .. }));
}
