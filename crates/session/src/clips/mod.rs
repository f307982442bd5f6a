//! Clips: the frames around events, and at chosen phases of chosen cycles, kept with the run.
//!
//! ```text
//! camera thread -> full buffers -> clip thread (ring of the last seconds -> TIFF) -> empty buffers -> camera thread
//! recorder thread -> what happened (a channel) --^
//! ```
//!
//! The camera thread copies each frame into an existing buffer. If none is empty, it drops and counts the frame. The clip thread
//! does everything slow.

mod film;
mod moment;
mod ring;
mod sink;
mod tiff_stack;

pub use cellpos_live::FilmFrame;
pub use film::{Film, list, read, read_at};
pub use sink::{Clipped, Schedule};

use crate::crop::{self, Crop};
use crate::failure::Failure;
use cellpos_live::ClipLine;
use cellpos_rig::{FrameWatch, SeenFrame};
use cellpos_vision::Pixels;
use moment::Moment;
use ring::{Ring, Shot};
use rtrb::{Consumer, Producer, RingBuffer};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// Memory of the buffers at most, bytes.
const MOST_MEMORY: usize = 256 << 20;
/// Longest time from a frame until the clip thread hears of its events, s: the recorder looks some ten times a second.
const HEARD_AFTER_S: f64 = 0.7;
/// Name of the folder of clips in a run folder.
pub const CLIPS: &str = "clips";

/// How much is kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClipConfig {
    /// Time before the event, s.
    pub before_s: f64,
    /// Time after the event, s.
    pub after_s: f64,
    /// All clips of a run together, bytes at most.
    pub most_bytes: u64,
}

impl Default for ClipConfig {
    fn default() -> Self {
        Self {
            before_s: 0.25,
            after_s: 0.25,
            most_bytes: 200_000_000,
        }
    }
}

/// The outcome of the clips of a run.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ClipReport {
    /// Files written, in the run folder's `clips`.
    pub written: Vec<String>,
    /// Moments without a clip, because the limit of disk space was reached.
    pub no_room: u64,
    /// Frames that found no empty buffer.
    pub frames_left_out: u64,
    /// The error of the first clip that could not be written.
    pub first_error: Option<String>,
}

/// The clips of a run; dropping it ends its thread.
pub struct Clips {
    moments: Option<Sender<Moment>>,
    kept: Receiver<ClipLine>,
    left_out: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<ClipReport>>,
}

impl Clips {
    /// Writes clips into `folder/clips`; also returns the watch that shows them the frames of a camera of `width_px` x
    /// `height_px` at `rate_hz`.
    ///
    /// # Errors
    /// The thread could not be started.
    pub fn open(
        folder: &Path,
        config: ClipConfig,
        (width_px, height_px): (usize, usize),
        rate_hz: f64,
    ) -> Result<(Self, Box<dyn FrameWatch>), Failure> {
        let crop = (width_px.min(crop::MOST.0), height_px.min(crop::MOST.1));
        let pixels = (crop.0 * crop.1).max(1);
        let wanted = (config.before_s + config.after_s + HEARD_AFTER_S) * rate_hz;
        // Two bytes per pixel for any camera.
        let count = (wanted.ceil() as usize).clamp(1, (MOST_MEMORY / (2 * pixels)).max(1));
        let (full, full_out) = RingBuffer::new(count);
        let (mut empty, empty_out) = RingBuffer::new(count);
        for _ in 0..count {
            // As many as fit into the ring.
            let _ = empty.push(Shot::with_room(pixels));
        }
        let left_out = Arc::new(AtomicU64::new(0));
        let stop = Arc::new(AtomicBool::new(false));
        let (moments, heard) = channel();
        let (told, kept) = channel();
        let keeper = Keeper {
            ring: Ring::new(config.before_s, config.after_s, count),
            full: full_out,
            empty,
            heard,
            told,
            folder: folder.join(CLIPS),
            room: config.most_bytes,
            report: ClipReport::default(),
        };
        let thread = std::thread::Builder::new()
            .name("cellpos-clips".to_string())
            .spawn({
                let stop = Arc::clone(&stop);
                move || keeper.serve(&stop)
            })
            .map_err(Failure::failed)?;
        let taker = Taker {
            full,
            empty: empty_out,
            crop,
            left_out: Arc::clone(&left_out),
        };
        let clips = Self {
            moments: Some(moments),
            kept,
            left_out,
            stop,
            thread: Some(thread),
        };
        Ok((clips, Box::new(taker)))
    }

    /// The next newly written clip.
    pub fn next_kept(&self) -> Option<ClipLine> {
        self.kept.try_recv().ok()
    }

    /// Ends the thread after the announced clips are written, and returns their outcome.
    pub fn finish(mut self) -> ClipReport {
        self.end()
    }

    fn end(&mut self) -> ClipReport {
        self.moments = None;
        self.stop.store(true, Ordering::Release);
        let report = self.thread.take().and_then(|thread| thread.join().ok());
        ClipReport {
            frames_left_out: self.left_out.load(Ordering::Relaxed),
            ..report.unwrap_or_default()
        }
    }
}

impl Drop for Clips {
    fn drop(&mut self) {
        self.end();
    }
}

/// On the camera's thread: copies, and neither waits nor allocates.
struct Taker {
    full: Producer<Shot>,
    empty: Consumer<Shot>,
    crop: (usize, usize),
    left_out: Arc<AtomicU64>,
}

impl FrameWatch for Taker {
    fn frame(&mut self, seen: &SeenFrame<'_>) {
        let Ok(mut shot) = self.empty.pop() else {
            self.left_out.fetch_add(1, Ordering::Relaxed);
            return;
        };
        fill(seen, self.crop, &mut shot);
        // There are as many buffers as fit into the ring.
        let _ = self.full.push(shot);
    }
}

fn fill(seen: &SeenFrame<'_>, most: (usize, usize), shot: &mut Shot) {
    let crop = Crop::about(seen, most, usize::MAX);
    shot.pixels.clear();
    shot.deep = matches!(seen.frame.pixels, Pixels::Mono16(_));
    for span in crop.rows() {
        match seen.frame.pixels {
            Pixels::Mono8(pixels) => {
                let row = pixels.get(span).unwrap_or(&[]);
                shot.pixels.extend(row.iter().map(|v| u16::from(*v)));
            }
            Pixels::Mono16(pixels) => {
                shot.pixels
                    .extend_from_slice(pixels.get(span).unwrap_or(&[]));
            }
        }
    }
    (shot.width, shot.height) = crop.size;
    (shot.id, shot.stamp_ns) = (seen.stamp.id, seen.stamp.mid_exposure_ns);
    shot.origin_px = crop.origin;
    let centre = seen.centre_px.map(|centre| crop.place(centre));
    shot.centre_px = centre.unwrap_or((f64::NAN, f64::NAN));
}

/// On the clip thread: keeps the last seconds, and writes the clips.
struct Keeper {
    ring: Ring,
    full: Consumer<Shot>,
    empty: Producer<Shot>,
    heard: Receiver<Moment>,
    told: Sender<ClipLine>,
    folder: PathBuf,
    room: u64,
    report: ClipReport,
}

impl Keeper {
    fn serve(mut self, stop: &AtomicBool) -> ClipReport {
        loop {
            let last = stop.load(Ordering::Acquire);
            while let Ok(shot) = self.full.pop() {
                if let Some(oldest) = self.ring.push(shot) {
                    // It came out of this ring.
                    let _ = self.empty.push(oldest);
                }
            }
            while let Ok(moment) = self.heard.try_recv() {
                self.ring.expect(moment);
            }
            // At the end of the run no further frame comes.
            while let Some(moment) = self.ring.next_ready(last) {
                self.write(&moment);
            }
            if last {
                return self.report;
            }
            std::thread::sleep(Duration::from_millis(4));
        }
    }

    fn write(&mut self, moment: &Moment) {
        let shots = self.ring.about(moment);
        let Some(bytes) = tiff_stack::bytes(&shots) else {
            return;
        };
        if bytes > self.room {
            self.report.no_room += 1;
            return;
        }
        let offset_ns = self.ring.offset_ns(moment);
        match tiff_stack::write(&self.folder, moment, &shots, offset_ns) {
            Ok(()) => {
                // No receiver: no page is open.
                let _ = self.told.send(ClipLine {
                    name: moment.name.clone(),
                    time_s: shots
                        .first()
                        .map_or(f64::NAN, |shot| shot.time_s(offset_ns)),
                    frames: shots.len() as u64,
                });
                self.room -= bytes;
                self.report
                    .written
                    .push(format!("{CLIPS}/{}.tif", moment.name));
            }
            Err(error) => {
                let said = format!("{}: {error}", self.folder.join(&moment.name).display());
                self.report.first_error.get_or_insert(said);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_rig::{FrameStamp, PictureScale};
    use cellpos_vision::Frame;

    fn show(watch: &mut dyn FrameWatch, id: u64) {
        let pixels: Vec<u8> = (0..64 * 16).map(|n| (n as u64 + id) as u8).collect();
        watch.frame(&SeenFrame {
            frame: Frame {
                width: 64,
                height: 16,
                pixels: Pixels::Mono8(&pixels),
            },
            bits: 8,
            stamp: FrameStamp {
                id,
                // The camera's clock began long before the run.
                mid_exposure_ns: 5_000_000_000 + id as i64 * 1_000_000,
                exposure_ns: 0,
                arrival_ns: 0,
                true_um: f64::NAN,
                true_pzt_um: f64::NAN,
            },
            centre_px: Some((32.0, 8.0)),
            half_px: (5.0, 5.0),
            outline_px: &[],
            expected_px: (32.0, 8.0),
            expected_sd_px: 1.0,
            scale: PictureScale {
                first_um: 0.0,
                um_per_px: 0.1,
                upright: false,
            },
        });
    }

    fn moment(id: u64, name: &str) -> Moment {
        Moment {
            frame: (id, id as i64 * 1_000_000),
            at_ns: id as i64 * 1_000_000,
            name: name.to_string(),
        }
    }

    #[test]
    fn a_clip_holds_the_frames_around_what_happened_with_their_times_in_the_run() {
        let folder = tempfile::tempdir().unwrap();
        let config = ClipConfig {
            before_s: 0.02,
            after_s: 0.03,
            ..ClipConfig::default()
        };
        let (clips, mut watch) = Clips::open(folder.path(), config, (64, 16), 1000.0).unwrap();
        for id in 0..400 {
            show(watch.as_mut(), id);
            if id == 200 {
                let heard = clips.moments.as_ref().unwrap();
                heard.send(moment(180, "lost")).unwrap();
            }
            std::thread::sleep(Duration::from_micros(200));
        }
        let report = clips.finish();
        assert_eq!(report.written, ["clips/lost.tif"]);
        assert_eq!((report.frames_left_out, report.first_error), (0, None));
        let times = std::fs::read_to_string(folder.path().join("clips/lost.csv")).unwrap();
        let first = times.lines().nth(1).unwrap();
        assert!(first.starts_with("0,0.160000000,"), "{first}");
        assert_eq!(times.lines().count(), 1 + 51);
        let file = std::fs::File::open(folder.path().join("clips/lost.tif")).unwrap();
        let mut stack = tiff::decoder::Decoder::new(file).unwrap();
        let mut pages = 0;
        loop {
            let tiff::decoder::DecodingResult::U8(pixels) = stack.read_image().unwrap() else {
                panic!("8 bits stay 8 bits");
            };
            assert_eq!(pixels[0], (160 + pages) as u8);
            pages += 1;
            if !stack.more_images() {
                break;
            }
            stack.next_image().unwrap();
        }
        assert_eq!(pages, 51);
        // As the live page and the report read it back.
        let found = list(folder.path());
        assert_eq!((found.len(), found[0].frames), (1, 51));
        assert_eq!((found[0].name.as_str(), found[0].time_s), ("lost", 0.16));
        let film = read(folder.path(), "lost", 6).unwrap();
        let times: Vec<f64> = film.frames.iter().map(|frame| frame.time_s).collect();
        assert_eq!(times, [0.16, 0.17, 0.18, 0.19, 0.2, 0.21]);
        assert_eq!((film.width, film.height), (64, 16));
        assert_eq!(film.frames[5].pixels[0], 210);
        assert!(read(folder.path(), "../lost", 6).is_err());
    }

    #[test]
    fn nobody_waits_for_a_disk_and_what_finds_no_room_is_counted() {
        let folder = tempfile::tempdir().unwrap();
        let config = ClipConfig {
            before_s: 0.01,
            after_s: 0.01,
            most_bytes: 30_000,
        };
        let (clips, mut watch) = Clips::open(folder.path(), config, (64, 16), 1000.0).unwrap();
        // Far more frames than buffers, at once.
        for id in 0..20_000 {
            show(watch.as_mut(), id);
        }
        std::thread::sleep(Duration::from_millis(50));
        for id in 20_000..20_100 {
            show(watch.as_mut(), id);
        }
        for (n, id) in [20_020, 20_050, 20_080].into_iter().enumerate() {
            let heard = clips.moments.as_ref().unwrap();
            heard.send(moment(id, &format!("m{n}"))).unwrap();
        }
        let report = clips.finish();
        assert!(report.frames_left_out > 0);
        assert_eq!(report.written.len(), 1, "{report:?}");
        assert_eq!(report.no_room, 2);
    }

    #[test]
    fn a_folder_that_is_a_file_is_said() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(CLIPS), "no folder").unwrap();
        let (clips, mut watch) =
            Clips::open(folder.path(), ClipConfig::default(), (64, 16), 100.0).unwrap();
        (0..30).for_each(|id| show(watch.as_mut(), id));
        clips
            .moments
            .as_ref()
            .unwrap()
            .send(moment(5, "a"))
            .unwrap();
        let report = clips.finish();
        assert!(report.first_error.unwrap().contains("clips"));
    }
}
