//! A camera: frames of 8 bits with a bright spot where the bead is, 2 ms after their exposure.

use crate::bench::{Bench, PERIOD_NS};
use cellpos_drivers::Calibration;
use cellpos_rig::{Camera, CameraError, FrameBuffer, FrameStamp, SourceInfo};

/// Pixels per row.
const WIDTH: usize = 128;
/// Rows.
const HEIGHT: usize = 24;
/// Size of a pixel, um.
pub const PIXEL_UM: f64 = 0.2;
/// Standard deviation of the spot, px.
pub const SIGMA_PX: f64 = 2.0;
/// From an exposure to the arrival of its frame, ns.
const LATENCY_NS: i64 = 2_000_000;

/// The camera of the bench.
#[derive(Debug)]
pub struct SpotCamera(pub Bench);

/// From pixels to um: the middle of the picture is 0 um.
pub fn calibration() -> Calibration {
    Calibration::along_rows(PIXEL_UM, 0.5 * (WIDTH - 1) as f64, 1.0)
}

fn draw(buffer: &mut FrameBuffer, bead_um: f64) {
    let centre = [
        bead_um / PIXEL_UM + 0.5 * (WIDTH - 1) as f64,
        0.5 * (HEIGHT - 1) as f64,
    ];
    (buffer.width, buffer.height, buffer.bits) = (WIDTH, HEIGHT, 8);
    buffer.mono8.resize(WIDTH * HEIGHT, 0);
    for (k, pixel) in buffer.mono8.iter_mut().enumerate() {
        let (x, y) = ((k % WIDTH) as f64, (k / WIDTH) as f64);
        let r2 = (x - centre[0]).powi(2) + (y - centre[1]).powi(2);
        // A little texture instead of noise: no pixel is exactly its neighbour.
        let texture = (7 * k % 5) as f64;
        *pixel = (40.0 + texture + 150.0 * (-0.5 * r2 / SIGMA_PX.powi(2)).exp()) as u8;
    }
}

impl Camera for SpotCamera {
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError> {
        loop {
            let exposed = self.0.now().exposed.front().copied();
            let clock = self.0.clock();
            let due_ns = exposed.map_or(clock.now_ns() + PERIOD_NS, |e| e.at_ns + LATENCY_NS);
            if due_ns > deadline_ns {
                clock.sleep_until_ns(deadline_ns);
                return Ok(None);
            }
            clock.sleep_until_ns(due_ns);
            let Some(exposed) = exposed else {
                continue;
            };
            self.0.now().exposed.pop_front();
            draw(buffer, exposed.bead_um);
            return Ok(Some(FrameStamp {
                id: exposed.id,
                mid_exposure_ns: exposed.at_ns,
                exposure_ns: 0,
                arrival_ns: due_ns,
                true_um: f64::NAN,
                true_pzt_um: f64::NAN,
            }));
        }
    }

    fn info(&self) -> SourceInfo {
        let half_um = 0.5 * WIDTH as f64 * PIXEL_UM;
        SourceInfo {
            name: "spot camera".to_string(),
            width_px: WIDTH,
            height_px: HEIGHT,
            rate_hz: 1e9 / PERIOD_NS as f64,
            latency_ms: LATENCY_NS as f64 * 1e-6,
            exposure_s: 0.0,
            field_um: [-half_um, half_um],
        }
    }
}
