//! Industrial cameras (GigE Vision and USB3 Vision) through Aravis.
//!
//! Built only with the feature `aravis`, which needs the system libraries libaravis and libusb. GigE cameras are addressed by
//! their IP address: a search of the network by name takes seconds, and may find the wrong one of two. As root, Aravis would use
//! its packet socket, which delivers frames in bursts of five; this module turns it off.

use super::Region;
use aravis::prelude::*;
use aravis::{AcquisitionMode, BufferStatus, GvStreamOption, PixelFormat, Stream};
use cellpos_rig::clock::monotonic_ns;
use cellpos_rig::freshness::{FrameAccount, FrameCounts, IdKind};
use cellpos_rig::source::{Camera, CameraError, FrameBuffer, FrameStamp, SourceInfo};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Time without a frame after which the driver checks that the camera still answers.
const SILENCE: Duration = Duration::from_millis(1000);
/// Frames older than this on arrival are stale, ns.
const MAX_AGE_NS: i64 = 1_000_000_000;
/// After a step of the calendar clock, frames stamped before it may be in the queue for this time, ns.
const STEP_FORGOTTEN_NS: i64 = 1_000_000_000;
/// Rate at which the estimate of the clocks' offset may rise: cameras' clocks are off by less.
const CLOCK_SKEW: f64 = 200e-6;

/// Settings of a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct IndustrialSettings {
    /// IP address of a GigE camera, or the identifier of a USB3 camera.
    pub address: String,
    /// Part of the sensor that is read out; left out: the camera's own setting.
    pub region: Option<Region>,
    /// Frame rate, Hz.
    pub rate_hz: f64,
    /// Exposure, us; left out: the camera's own setting.
    pub exposure_us: Option<f64>,
    /// 8 or 16 bits per pixel.
    pub bits: u16,
    /// From the middle of an exposure to its fastest arrival, ms.
    pub latency_ms: f64,
    /// Frames that may wait in memory.
    pub buffers: usize,
}

/// A camera found on the network or the bus.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct FoundCamera {
    /// Identifier.
    pub id: String,
    /// Address.
    pub address: String,
    /// Maker.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Protocol.
    pub protocol: String,
}

/// Losses and failures of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct StreamCounts {
    /// Frames accepted.
    pub new: u64,
    /// Ids that never came.
    pub dropped: u64,
    /// Frames that came twice.
    pub doubled: u64,
    /// Frames that came out of order.
    pub reordered: u64,
    /// Frames too old, or with a time stamp that stood still.
    pub stale: u64,
    /// Frames that came with packets missing.
    pub incomplete: u64,
}

/// Lists the cameras that answer; `None` when another part of this process is listing already.
pub fn list() -> Option<Vec<FoundCamera>> {
    let aravis = aravis::Aravis::initialize().ok()?;
    let text = |s: &std::ffi::CStr| s.to_string_lossy().into_owned();
    let found = aravis.get_device_list().into_iter().map(|d| FoundCamera {
        id: text(&d.id),
        address: text(&d.address),
        vendor: text(&d.vendor),
        model: text(&d.model),
        protocol: text(&d.protocol),
    });
    Some(found.collect())
}

/// A running industrial camera.
#[derive(Debug)]
pub struct IndustrialCamera {
    camera: aravis::Camera,
    stream: Stream,
    settings: IndustrialSettings,
    info: SourceInfo,
    account: FrameAccount,
    kind: IdKind,
    incomplete: u64,
    /// Smallest difference between arrival and the camera's time stamp, ns, and when it was seen.
    offset: Option<(f64, i64)>,
    last_frame_ns: i64,
    calendar: Calendar,
}

impl IndustrialCamera {
    /// Opens a camera, sets it and starts the acquisition.
    ///
    /// # Errors
    /// The camera does not answer or refuses a setting.
    pub fn open(settings: IndustrialSettings) -> Result<Self, CameraError> {
        let name = settings.address.clone();
        let gone = |e: aravis::glib::Error| CameraError::Gone {
            camera: name.clone(),
            problem: format!(
                "{}: is it plugged in and powered, and is this its address?",
                e.message()
            ),
        };
        let refused = |what: &str, remedy: &str| {
            let (camera, what, remedy) = (name.clone(), what.to_string(), remedy.to_string());
            move |e: aravis::glib::Error| CameraError::Broken {
                camera,
                problem: format!("refuses {what}: {}", e.message()),
                remedy,
            }
        };
        check(&settings)?;
        let camera = aravis::Camera::new(Some(&settings.address)).map_err(gone)?;
        let is_gv = camera.is_gv_device();
        if is_gv {
            camera.gv_set_stream_options(GvStreamOption::PACKET_SOCKET_DISABLED);
        }
        let format = if settings.bits > 8 {
            PixelFormat::MONO_16
        } else {
            PixelFormat::MONO_8
        };
        camera
            .set_pixel_format(format)
            .map_err(refused("this pixel format", "set bits to 8, or to 16"))?;
        if let Some(r) = settings.region {
            let pixels = |n: usize| i32::try_from(n).unwrap_or(i32::MAX);
            let [x, y, width, height] = [r.x_px, r.y_px, r.width_px, r.height_px].map(pixels);
            camera.set_region(x, y, width, height).map_err(refused(
                &format!("the region {r}"),
                "give one that its sensor and its steps allow",
            ))?;
        }
        if let Some(exposure_us) = settings.exposure_us {
            let remedy = "give an exposure shorter than the frame interval";
            camera
                .set_exposure_time(exposure_us)
                .map_err(refused(&format!("{exposure_us} us of exposure"), remedy))?;
        }
        let rate = format!("{} frames/s", settings.rate_hz);
        camera
            .set_frame_rate(settings.rate_hz)
            .map_err(refused(&rate, "give a lower rate or a smaller region"))?;
        camera
            .set_acquisition_mode(AcquisitionMode::Continuous)
            .map_err(refused(
                "continuous acquisition",
                "use a camera that runs freely",
            ))?;
        let (_, _, width, height) = camera
            .region()
            .map_err(refused("to tell its region", "restart it"))?;
        let payload = camera
            .payload()
            .map_err(refused("to tell its payload", "restart it"))? as usize;
        let stream = camera
            .create_stream()
            .map_err(refused("a stream", "close other programs that use it"))?;
        for _ in 0..settings.buffers {
            stream.push_buffer(aravis::Buffer::new_allocate(payload));
        }
        camera
            .start_acquisition()
            .map_err(refused("to start", "restart it"))?;
        let kind = if is_gv {
            IdKind::Wrapping16SkippingZero
        } else {
            IdKind::Wide
        };
        let info = SourceInfo {
            name: format!("industrial camera {name}"),
            width_px: usize::try_from(width).unwrap_or(0),
            height_px: usize::try_from(height).unwrap_or(0),
            rate_hz: settings.rate_hz,
            latency_ms: settings.latency_ms,
            exposure_s: 0.0,
            field_um: [0.0, 0.0],
        };
        let account = account(kind, settings.rate_hz);
        Ok(IndustrialCamera {
            camera,
            stream,
            settings,
            info,
            account,
            calendar: Calendar::now(),
            kind,
            incomplete: 0,
            offset: None,
            last_frame_ns: monotonic_ns(),
        })
    }

    /// Losses and failures so far.
    pub fn counts(&self) -> StreamCounts {
        let FrameCounts {
            new,
            lost,
            doubled,
            late,
            stale,
            future,
            invalid,
            ..
        } = self.account.counts();
        StreamCounts {
            new,
            dropped: lost,
            doubled,
            reordered: late,
            stale: stale + future + invalid,
            incomplete: self.incomplete,
        }
    }

    /// Copies a frame and stamps it; `None` if it is not a new, complete picture.
    fn take(&mut self, packet: &aravis::Buffer, buffer: &mut FrameBuffer) -> Option<FrameStamp> {
        if packet.status() != BufferStatus::Success {
            self.incomplete += 1;
            return None;
        }
        let now_ns = monotonic_ns();
        // Frames may have waited in memory: the library stamps their arrival with the calendar clock.
        let arrival_ns = now_ns - self.calendar.since_ns(packet.system_timestamp(), now_ns);
        let camera_ns = packet.timestamp() as f64;
        let offset_ns = self.clock_offset(arrival_ns, camera_ns);
        let latency_ns = self.settings.latency_ms * 1e6;
        let mid_exposure_ns = (camera_ns + offset_ns - latency_ns) as i64;
        let raw_id = packet.frame_id();
        if raw_id > u64::from(u16::MAX) && self.kind == IdKind::Wrapping16SkippingZero {
            // GigE Vision 2 has ids of 64 bits.
            self.kind = IdKind::Wide;
            self.account = account(self.kind, self.settings.rate_hz);
        }
        let judged = self.account.step(raw_id, mid_exposure_ns, arrival_ns);
        if !judged.kind.is_new() {
            return None;
        }
        let width = usize::try_from(packet.image_width()).unwrap_or(0);
        let height = usize::try_from(packet.image_height()).unwrap_or(0);
        let pixels = packet.image_data();
        (buffer.width, buffer.height, buffer.bits) = (width, height, self.settings.bits);
        let bytes_per_pixel = if self.settings.bits > 8 { 2 } else { 1 };
        if pixels.len() < width * height * bytes_per_pixel {
            self.incomplete += 1;
            return None;
        }
        if bytes_per_pixel == 2 {
            buffer.mono16.clear();
            buffer.mono16.extend(
                pixels
                    .as_chunks::<2>()
                    .0
                    .iter()
                    .take(width * height)
                    .map(|b| u16::from_le_bytes(*b)),
            );
        } else {
            buffer.mono8.clear();
            buffer.mono8.extend(pixels.iter().take(width * height));
        }
        self.last_frame_ns = now_ns;
        Some(FrameStamp {
            id: judged.id,
            mid_exposure_ns,
            exposure_ns: (self.settings.exposure_us.unwrap_or(0.0) * 1e3) as i64,
            arrival_ns,
            true_um: f64::NAN,
            true_pzt_um: f64::NAN,
        })
    }

    /// Offset from the camera's clock to this machine's: the smallest seen, because delays only add. It rises slowly, to follow a
    /// camera whose clock runs slow.
    fn clock_offset(&mut self, arrival_ns: i64, camera_ns: f64) -> f64 {
        let now = arrival_ns as f64 - camera_ns;
        let offset = match self.offset {
            Some((least, seen_ns)) => {
                now.min(least + CLOCK_SKEW * (arrival_ns - seen_ns).max(0) as f64)
            }
            None => now,
        };
        self.offset = Some((offset, arrival_ns));
        offset
    }
}

fn check(settings: &IndustrialSettings) -> Result<(), CameraError> {
    let refuse = |problem: String, remedy: &str| {
        Err(CameraError::Broken {
            camera: settings.address.clone(),
            problem,
            remedy: remedy.to_string(),
        })
    };
    if settings.address.trim().is_empty() {
        return refuse(
            "no address".to_string(),
            "give the IP address of a GigE camera, or the identifier of another",
        );
    }
    if let Some(r) = settings
        .region
        .filter(|r| r.width_px == 0 || r.height_px == 0)
    {
        return refuse(
            format!("the region {r} holds no pixel"),
            "give a region of 1 x 1 px or more",
        );
    }
    if !(settings.rate_hz.is_finite() && settings.rate_hz > 0.0) {
        return refuse(
            format!("rate_hz = {}", settings.rate_hz),
            "give a frame rate above 0 Hz",
        );
    }
    if settings
        .exposure_us
        .is_some_and(|e| !e.is_finite() || e <= 0.0)
    {
        return refuse(
            format!("exposure_us = {:?}", settings.exposure_us),
            "give an exposure above 0 us",
        );
    }
    if ![8, 16].contains(&settings.bits) {
        return refuse(
            format!("bits = {}", settings.bits),
            "set bits to 8 or to 16",
        );
    }
    if !(2..=10_000).contains(&settings.buffers) {
        return refuse(
            format!("buffers = {}", settings.buffers),
            "set 2 to 10000 buffers",
        );
    }
    Ok(())
}

/// The account of a camera's own ids.
fn account(kind: IdKind, rate_hz: f64) -> FrameAccount {
    FrameAccount::new(kind, (1e9 / rate_hz) as i64, MAX_AGE_NS)
}

/// Turns calendar stamps into time spans, without the steps of the calendar clock.
#[derive(Debug, Clone, Copy)]
struct Calendar {
    /// Calendar less monotonic clock, ns.
    ahead_ns: i64,
    /// When it was last seen to step, ns of the monotonic clock.
    stepped_ns: Option<i64>,
}

impl Calendar {
    fn read_ns() -> i64 {
        let since = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default();
        i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
    }

    fn now() -> Self {
        Self {
            ahead_ns: Self::read_ns().saturating_sub(monotonic_ns()),
            stepped_ns: None,
        }
    }

    /// Age of a calendar stamp, ns; 0 while a step of the calendar clock makes it unknown.
    fn since_ns(&mut self, stamp_ns: u64, now_ns: i64) -> i64 {
        /// The clock is slewed by less than this between two frames, ns.
        const STEP_NS: u64 = 1_000_000;
        let calendar_ns = Self::read_ns();
        let ahead_ns = calendar_ns.saturating_sub(now_ns);
        if ahead_ns.abs_diff(self.ahead_ns) > STEP_NS {
            self.stepped_ns = Some(now_ns);
        }
        self.ahead_ns = ahead_ns;
        if self
            .stepped_ns
            .is_some_and(|stepped_ns| now_ns - stepped_ns < STEP_FORGOTTEN_NS)
        {
            return 0;
        }
        let stamp_ns = i64::try_from(stamp_ns).unwrap_or(i64::MAX);
        calendar_ns
            .saturating_sub(stamp_ns)
            .clamp(0, STEP_FORGOTTEN_NS)
    }
}

impl Camera for IndustrialCamera {
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError> {
        loop {
            let left_ns = deadline_ns.saturating_sub(monotonic_ns());
            let packet = match u64::try_from(left_ns / 1000) {
                Ok(left_us) if left_us > 0 => self.stream.timeout_pop_buffer(left_us),
                _ => self.stream.try_pop_buffer(),
            };
            let Some(packet) = packet else { break };
            let stamp = self.take(&packet, buffer);
            self.stream.push_buffer(packet);
            if stamp.is_some() {
                return Ok(stamp);
            }
        }
        let silent_ns = monotonic_ns() - self.last_frame_ns;
        if silent_ns > SILENCE.as_nanos() as i64 {
            // A stall is not an error; a camera that does not answer is.
            if let Err(error) = self.camera.frame_rate() {
                return Err(CameraError::Gone {
                    camera: self.settings.address.clone(),
                    problem: format!(
                        "no frame for {} ms and no answer: unplugged? ({})",
                        silent_ns / 1_000_000,
                        error.message()
                    ),
                });
            }
            self.last_frame_ns = monotonic_ns();
        }
        Ok(None)
    }

    fn info(&self) -> SourceInfo {
        self.info.clone()
    }
}

impl Drop for IndustrialCamera {
    fn drop(&mut self) {
        if let Err(error) = self.camera.stop_acquisition() {
            tracing::warn!(
                "camera {}: did not stop: {}",
                self.settings.address,
                error.message()
            );
        }
    }
}
