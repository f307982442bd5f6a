//! A camera at the other end of a Unix socket: framing as in [`cellpos_link::frames`].
//!
//! If the server disappears, the camera tries to connect again. So a restart of the camera process costs frames, but not the run.
//! The loop meanwhile sees silence and reacts to it.

use crate::port::{Search, connected};
use cellpos_link::frames::FrameGatherer;
use cellpos_rig::clock::{Clock, monotonic_ns};
use cellpos_rig::source::{Camera, CameraError, FrameBuffer, FrameStamp, SourceInfo};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::io::{ErrorKind, Read};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// One read: several small frames, or a piece of a large one.
const CHUNK: usize = 1 << 16;

/// The client of a socket camera.
#[derive(Debug)]
pub struct SocketCamera {
    path: PathBuf,
    stream: Option<UnixStream>,
    search: Search,
    gatherer: FrameGatherer,
    chunk: Vec<u8>,
    /// The part of `chunk` that has not been gathered yet.
    pending: std::ops::Range<usize>,
    info: SourceInfo,
}

impl SocketCamera {
    /// Connects, and waits for the first frame to learn its size and its exposure.
    ///
    /// # Errors
    /// Nobody serves the socket, or the data are not a camera stream.
    pub fn connect(
        path: &Path,
        rate_hz: f64,
        latency_ms: f64,
        patience: Duration,
    ) -> Result<Self, CameraError> {
        let stream = connected(path).map_err(|error| CameraError::Gone {
            camera: path.display().to_string(),
            problem: format!(
                "cannot connect: {error}; is the camera server (or firmware-sim) running?"
            ),
        })?;
        let mut camera = Self {
            path: path.to_path_buf(),
            stream: Some(stream),
            search: Search::begun(),
            gatherer: FrameGatherer::new(),
            chunk: vec![0; CHUNK],
            pending: 0..0,
            info: SourceInfo {
                name: format!("socket {}", path.display()),
                width_px: 0,
                height_px: 0,
                rate_hz,
                latency_ms,
                exposure_s: 0.0,
                field_um: [0.0, 0.0],
            },
        };
        let mut buffer = FrameBuffer::default();
        let deadline_ns = monotonic_ns() + patience.as_nanos() as i64;
        let Some(first) = camera.next_frame(&mut buffer, deadline_ns)? else {
            return Err(CameraError::Broken {
                camera: path.display().to_string(),
                problem: format!("no frame within {patience:?}"),
                remedy: "start the acquisition".to_string(),
            });
        };
        camera.info.exposure_s = first.exposure_ns as f64 * 1e-9;
        camera.info.width_px = buffer.width;
        camera.info.height_px = buffer.height;
        Ok(camera)
    }

    /// Looks for a lost server if it is time to, else waits for that time; `at_most` bounds the wait.
    fn reconnect(&mut self, at_most: Duration) {
        if !self.search.is_due() {
            Clock::Real.sleep(self.search.left().min(at_most));
            return;
        }
        self.pending = 0..0;
        self.gatherer = FrameGatherer::new();
        self.stream = connected(&self.path).ok();
    }

    /// Gathers a frame from the bytes at hand.
    fn gather(&mut self, buffer: &mut FrameBuffer) -> Result<Option<FrameStamp>, CameraError> {
        let mut bytes = &self.chunk[self.pending.clone()];
        let before = bytes.len();
        let gathered = self.gatherer.next_frame(&mut bytes);
        let left = bytes.len();
        self.pending.start += before - left;
        let (header, pixels) = match gathered {
            Ok(Some(frame)) => frame,
            Ok(None) => return Ok(None),
            Err(error) => {
                return Err(CameraError::Broken {
                    camera: self.path.display().to_string(),
                    problem: error.to_string(),
                    remedy: "check that the socket is a camera's, and that both programs are of one version".to_string(),
                });
            }
        };
        buffer.width = usize::from(header.width);
        buffer.height = usize::from(header.height);
        buffer.bits = header.bits;
        if header.bits > 8 {
            buffer.mono16.clear();
            let pairs = pixels.chunks_exact(2);
            buffer
                .mono16
                .extend(pairs.map(|pair| u16::from_le_bytes([pair[0], pair[1]])));
        } else {
            buffer.mono8.clear();
            buffer.mono8.extend_from_slice(pixels);
        }
        Ok(Some(FrameStamp {
            id: header.frame_id,
            mid_exposure_ns: i64::try_from(header.mid_exposure_ns).unwrap_or(i64::MAX),
            exposure_ns: i64::from(header.exposure_ns),
            arrival_ns: monotonic_ns(),
            true_um: f64::NAN,
            true_pzt_um: f64::NAN,
        }))
    }
}

/// Reads the bytes at hand. If nothing has arrived, waits for bytes for at most `ns`.
fn read_within(stream: &mut UnixStream, chunk: &mut [u8], ns: i64) -> std::io::Result<usize> {
    match stream.read(chunk) {
        Err(error) if error.kind() == ErrorKind::WouldBlock && ns > 0 => {
            let span = Timespec {
                tv_sec: ns / 1_000_000_000,
                tv_nsec: ns % 1_000_000_000,
            };
            poll(&mut [PollFd::new(stream, PollFlags::IN)], Some(&span))?;
            stream.read(chunk)
        }
        read => read,
    }
}

impl Camera for SocketCamera {
    fn next_frame(
        &mut self,
        buffer: &mut FrameBuffer,
        deadline_ns: i64,
    ) -> Result<Option<FrameStamp>, CameraError> {
        loop {
            if let Some(stamp) = self.gather(buffer)? {
                return Ok(Some(stamp));
            }
            let left_ns = deadline_ns - monotonic_ns();
            // Frames that have arrived are taken even without time to wait for more.
            let overdue = left_ns <= 0;
            let Some(stream) = &mut self.stream else {
                if overdue {
                    return Ok(None);
                }
                self.reconnect(Duration::from_nanos(left_ns as u64));
                continue;
            };
            match read_within(stream, &mut self.chunk, left_ns) {
                Ok(0) => self.stream = None,
                Ok(length) => self.pending = 0..length,
                Err(error) => match error.kind() {
                    ErrorKind::WouldBlock if overdue => return Ok(None),
                    ErrorKind::WouldBlock | ErrorKind::Interrupted => {}
                    _ => self.stream = None,
                },
            }
        }
    }

    fn info(&self) -> SourceInfo {
        self.info.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_link::frames::FrameHeader;
    use std::io::Write;
    use std::os::unix::net::UnixListener;

    fn header(id: u64, bits: u16) -> FrameHeader {
        FrameHeader {
            frame_id: id,
            mid_exposure_ns: 1_000_000 * id,
            sent_ns: 0,
            exposure_ns: 500_000,
            width: 4,
            height: 2,
            bits,
        }
    }

    /// A frame of 8 bits with one grey value, as it is sent.
    fn frame(id: u64, grey: u8) -> Vec<u8> {
        let mut bytes = header(id, 8).to_bytes().to_vec();
        bytes.extend([grey; 8]);
        bytes
    }

    #[test]
    fn frames_survive_being_torn_and_a_server_that_comes_back() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("camera.sock");
        let listener = UnixListener::bind(&path).expect("a socket");
        let server = std::thread::spawn(move || {
            let (mut client, _) = listener.accept().expect("a client");
            let mut bytes = header(1, 8).to_bytes().to_vec();
            bytes.extend(0..8);
            bytes.extend(header(2, 12).to_bytes());
            bytes.extend([1, 2].repeat(8));
            for piece in bytes.chunks(7) {
                client.write_all(piece).expect("the client reads");
            }
            drop(client);
            let (mut client, _) = listener.accept().expect("the client comes back");
            client.write_all(&frame(9, 5)).expect("the client reads");
        });
        let mut camera = SocketCamera::connect(&path, 1000.0, 2.0, Duration::from_secs(5))
            .expect("the first frame comes");
        assert_eq!((camera.info().width_px, camera.info().height_px), (4, 2));
        assert!((camera.info().exposure_s - 5e-4).abs() < 1e-12);
        let mut buffer = FrameBuffer::default();
        let deadline_ns = monotonic_ns() + 5_000_000_000;
        let stamp = camera
            .next_frame(&mut buffer, deadline_ns)
            .expect("a stream")
            .expect("a frame");
        assert_eq!(
            (stamp.id, stamp.mid_exposure_ns, buffer.bits),
            (2, 2_000_000, 12)
        );
        assert_eq!(buffer.mono16, [0x0201; 8]);
        let stamp = camera
            .next_frame(&mut buffer, deadline_ns)
            .expect("a stream")
            .expect("a frame");
        assert_eq!((stamp.id, buffer.mono8.as_slice()), (9, &[5; 8][..]));
        server.join().expect("the server ends");
    }

    #[test]
    fn a_server_that_ends_each_connection_is_asked_again_at_a_pace() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("camera.sock");
        let listener = UnixListener::bind(&path).expect("a socket");
        let server = std::thread::spawn(move || {
            let (mut client, _) = listener.accept().expect("a client");
            client.write_all(&frame(1, 1)).expect("the client reads");
            drop(client);
            listener.set_nonblocking(true).expect("a socket");
            let (until_ns, mut clients) = (monotonic_ns() + 400_000_000, 0);
            while monotonic_ns() < until_ns {
                clients += usize::from(listener.accept().is_ok());
                std::thread::sleep(Duration::from_micros(50));
            }
            clients
        });
        let mut camera = SocketCamera::connect(&path, 1000.0, 2.0, Duration::from_secs(5))
            .expect("the first frame comes");
        let mut buffer = FrameBuffer::default();
        let deadline_ns = monotonic_ns() + 300_000_000;
        let frame = camera.next_frame(&mut buffer, deadline_ns);
        assert!(frame.expect("a silent camera").is_none());
        // One at once, one every 20 ms, and one that the end of the time came between.
        let clients = server.join().expect("the server ends");
        assert!((2..=17).contains(&clients), "{clients} connections");
    }

    #[test]
    fn a_frame_that_has_arrived_is_taken_without_time_to_wait() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("camera.sock");
        let listener = UnixListener::bind(&path).expect("a socket");
        let server = std::thread::spawn(move || {
            let (mut client, _) = listener.accept().expect("a client");
            for id in 1..=3 {
                client
                    .write_all(&frame(id, id as u8))
                    .expect("the client reads");
            }
            client
        });
        let mut camera = SocketCamera::connect(&path, 1000.0, 2.0, Duration::from_secs(5))
            .expect("the first frame comes");
        let _client = server.join().expect("all is sent");
        let mut buffer = FrameBuffer::default();
        let mut next = || camera.next_frame(&mut buffer, 0).expect("a stream");
        let ids = [next(), next(), next()].map(|stamp| stamp.map(|stamp| stamp.id));
        assert_eq!(ids, [Some(2), Some(3), None]);
    }

    #[test]
    fn a_socket_without_server_and_a_stream_of_nonsense_are_named() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("camera.sock");
        let missing = SocketCamera::connect(&path, 1000.0, 2.0, Duration::from_millis(10))
            .expect_err("nobody there");
        assert!(missing.to_string().contains("cannot connect"), "{missing}");
        let listener = UnixListener::bind(&path).expect("a socket");
        let server = std::thread::spawn(move || {
            let (mut client, _) = listener.accept().expect("a client");
            client.write_all(&[b'x'; 200]).expect("the client reads");
        });
        let error = SocketCamera::connect(&path, 1000.0, 2.0, Duration::from_secs(5))
            .expect_err("no frames");
        assert!(
            error.to_string().contains("does not start with a frame"),
            "{error}"
        );
        server.join().expect("the server ends");
    }
}
