//! Cameras that misbehave over a real socket: a relay between the rig in a box and the program spoils the frames.

use super::{Attacked, Chance, OVER_THE_LINE, box_rig, emptied, holds_before, how, reads, run};
use crate::programs::RigInABox;
use cellpos_link::frames::{FrameGatherer, FrameHeader};
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Faults that a relay adds to the frames: rates in thousandths, and single events.
#[derive(Debug, Clone, Copy, Default)]
struct Spoils {
    lost: u64,
    doubled: u64,
    /// Stamped with a time that has not come, by up to an hour.
    future: u64,
    /// Exposed later than the loop was told to expect for when they arrive.
    early: u64,
    /// Exposed 20 ms before.
    old: u64,
    /// Held back, with all behind them, for up to half a second.
    stalls: u64,
    /// Cut in the middle, and the line closed.
    halves: u64,
    /// The line is closed between two frames.
    closes: u64,
    /// Ids restart at this frame.
    restarts: Option<u64>,
    /// Bytes that are no frame come at this one.
    garbage: Option<u64>,
    /// Frames of another size come from this one on.
    resized: Option<u64>,
}

impl Spoils {
    /// One kind by its number, or with number 0 some of several.
    fn of(number: u64, chance: &mut Chance) -> Self {
        let mut spoils = Self::default();
        let at = 200 + chance.below(1500);
        match number % 12 {
            0 => {
                spoils.lost = chance.below(100);
                spoils.doubled = chance.below(500);
                spoils.future = chance.below(50);
                spoils.early = chance.below(300);
                spoils.stalls = chance.below(3);
                spoils.closes = chance.below(3);
                spoils.restarts = Some(at);
            }
            1 => spoils.future = 1 + chance.below(1000),
            2 => spoils.doubled = 1000,
            3 => spoils.early = 1 + chance.below(1000),
            4 => spoils.restarts = Some(at),
            5 => spoils.garbage = Some(at),
            6 => spoils.stalls = 1 + chance.below(10),
            7 => spoils.halves = 1 + chance.below(5),
            8 => spoils.closes = 1 + chance.below(10),
            9 => spoils.old = 1 + chance.below(1000),
            10 => spoils.resized = Some(at),
            _ => spoils.lost = chance.below(1000),
        }
        spoils
    }

    fn hits(thousandths: u64, chance: &mut Chance) -> bool {
        chance.below(1000) < thousandths
    }

    /// Passes a frame on; an error is the end of the line to this client.
    fn pass(
        &self,
        mut header: FrameHeader,
        pixels: &[u8],
        client: &mut UnixStream,
        chance: &mut Chance,
    ) -> std::io::Result<()> {
        let frame = header.frame_id;
        if self.restarts.is_some_and(|first| frame >= first) {
            header.frame_id -= self.restarts.unwrap_or(0);
        }
        if Self::hits(self.lost, chance) {
            return Ok(());
        }
        if Self::hits(self.future, chance) {
            header.mid_exposure_ns += 10_000_000 * (1 + chance.below(360_000));
        }
        if Self::hits(self.early, chance) {
            header.mid_exposure_ns += 1_000 * chance.below(1900);
        }
        if Self::hits(self.old, chance) {
            header.mid_exposure_ns -= 20_000_000;
        }
        if Self::hits(self.stalls, chance) {
            std::thread::sleep(Duration::from_millis(1 + chance.below(500)));
        }
        if self.garbage == Some(frame) {
            let bytes: Vec<u8> = (0..1 + chance.below(500))
                .map(|_| chance.next() as u8)
                .collect();
            client.write_all(&bytes)?;
        }
        let mut bytes = header.to_bytes().to_vec();
        bytes.extend_from_slice(pixels);
        if self.resized.is_some_and(|first| frame >= first) && header.height > 8 {
            header.height /= 2;
            bytes = header.to_bytes().to_vec();
            bytes.extend_from_slice(&pixels[..header.pixel_bytes()]);
        }
        if Self::hits(self.halves, chance) {
            client.write_all(&bytes[..bytes.len() / 2])?;
            return Err(ErrorKind::ConnectionAborted.into());
        }
        client.write_all(&bytes)?;
        if Self::hits(self.doubled, chance) {
            client.write_all(&bytes)?;
        }
        if Self::hits(self.closes, chance) {
            return Err(ErrorKind::ConnectionAborted.into());
        }
        Ok(())
    }
}

/// The relay: serves `hostile.sock`, fed by `camera.sock`. Ended when dropped.
struct Relay {
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Relay {
    fn start(folder: &Path, spoils: Spoils, chance: Chance) -> std::io::Result<Self> {
        let path = folder.join("hostile.sock");
        let _ = std::fs::remove_file(&path);
        let listener = UnixListener::bind(path)?;
        listener.set_nonblocking(true)?;
        let camera = folder.join("camera.sock");
        let over = Arc::new(AtomicBool::new(false));
        let told = Arc::clone(&over);
        let serve = move || {
            let mut chance = chance;
            while !told.load(Ordering::Acquire) {
                match listener.accept() {
                    Ok((client, _)) => serve(client, &camera, spoils, &mut chance, &told),
                    Err(_) => std::thread::sleep(Duration::from_millis(2)),
                }
            }
        };
        Ok(Self {
            over,
            thread: Some(std::thread::spawn(serve)),
        })
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// One client, until it goes, the line is closed, or all is over.
fn serve(
    mut client: UnixStream,
    camera: &Path,
    spoils: Spoils,
    chance: &mut Chance,
    over: &AtomicBool,
) {
    let Ok(mut camera) = UnixStream::connect(camera) else {
        return;
    };
    let patience = Some(Duration::from_millis(50));
    let _ = client.set_nonblocking(false);
    let _ = client.set_write_timeout(patience);
    let _ = camera.set_read_timeout(patience);
    let mut gatherer = FrameGatherer::new();
    let mut chunk = vec![0; 1 << 16];
    while !over.load(Ordering::Acquire) {
        let length = match camera.read(&mut chunk) {
            Ok(0) => return,
            Ok(length) => length,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                continue;
            }
            Err(_) => return,
        };
        let mut bytes = &chunk[..length];
        while let Ok(Some((header, pixels))) = gatherer.next_frame(&mut bytes) {
            if spoils.pass(header, pixels, &mut client, chance).is_err() {
                return;
            }
        }
    }
}

/// Cameras behind a real socket that stamp frames wrongly, double, lose, delay and truncate them, restart their count, send
/// garbage, change their size and hang up.
pub fn hostile_camera_lines(folder: &Path, tries: u64, chance: &mut Chance) -> Attacked {
    let mut attacked = Attacked::default();
    if !holds_before(folder, &mut attacked) {
        return attacked;
    }
    for number in 0..tries {
        emptied(folder);
        box_rig(folder);
        let rig_file = folder.join("rig.toml");
        let text = std::fs::read_to_string(&rig_file).unwrap_or_default();
        let text = text.replace("camera.sock", "hostile.sock");
        std::fs::write(&rig_file, text).expect("rig.toml is written");
        let spoils = Spoils::of(number, chance);
        let what = format!("camera line {number}, {spoils:?}");
        let rig = RigInABox::start(folder, &[]);
        let relay = Relay::start(folder, spoils, Chance::new(chance.next()));
        let relay = relay.expect("a socket can be served");
        let began = Instant::now();
        if let Some(ended) = run(folder, OVER_THE_LINE, &what, &mut attacked) {
            attacked.end(how(folder, ended.code));
            account(
                &ended.out,
                ended.code,
                began.elapsed(),
                &what,
                &mut attacked,
            );
        }
        drop(relay);
        attacked.ends_within_range(rig, &what);
        reads(folder, &what, &mut attacked);
    }
    attacked
}

/// The program's report is consistent: every tick is on the disk or counted, time is the clock's, an end has a name.
fn account(out: &str, code: Option<i32>, took: Duration, what: &str, attacked: &mut Attacked) {
    let json: serde_json::Value = serde_json::from_str(out).unwrap_or_default();
    if json["ended"].is_null() {
        // It never came to a run: what is said must be a sentence.
        if json["error"]["message"].as_str().is_none_or(str::is_empty) {
            attacked.broken.push(format!("{what}: no sentence: {out}"));
        }
        return;
    }
    let kind = json["ended"]["kind"].as_str().unwrap_or_default();
    if (code == Some(0)) != (kind == "done") {
        attacked
            .broken
            .push(format!("{what}: exit {code:?} with {kind:?}"));
    }
    let duration_s = json["duration_s"].as_f64().unwrap_or(f64::INFINITY);
    if duration_s > took.as_secs_f64() || kind == "done" && (duration_s - 2.0).abs() > 0.1 {
        attacked.broken.push(format!(
            "{what}: {duration_s} s of a run that took {took:?}"
        ));
    }
}
