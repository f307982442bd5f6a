//! A first rig file: commented, with the devices that this machine offers.

use cellpos_drivers::socket::SocketCamera;
use cellpos_rig::Camera as _;
use std::path::Path;
use std::time::Duration;

/// Devices for the new file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Kind {
    /// Everything in this process.
    Emulated,
    /// A board behind a serial port and a camera.
    Real {
        /// Device of the board.
        port: String,
        /// Camera.
        camera: Camera,
    },
}

/// Where the frames come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Camera {
    /// A camera process behind a Unix socket.
    Socket(String),
    /// A GigE or USB3 Vision camera.
    Industrial(String),
}

/// Serial ports of this machine, by names that stay the same where there are such.
pub fn ports() -> Vec<String> {
    let list = |folder: &str, wanted: &dyn Fn(&str) -> bool| -> Vec<String> {
        let mut found: Vec<String> = std::fs::read_dir(folder)
            .into_iter()
            .flatten()
            .flatten()
            .filter(|entry| entry.file_name().to_str().is_some_and(wanted))
            .map(|entry| entry.path().display().to_string())
            .collect();
        found.sort();
        found
    };
    let lasting = list("/dev/serial/by-id", &|_| true);
    if lasting.is_empty() {
        let usb = |name: &str| name.starts_with("ttyACM") || name.starts_with("ttyUSB");
        list("/dev", &usb)
    } else {
        lasting
    }
}

/// Sockets in a folder, as camera servers make them.
pub fn sockets(folder: &Path) -> Vec<String> {
    use std::os::unix::fs::FileTypeExt;
    let mut found: Vec<String> = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_socket()))
        .filter_map(|entry| entry.file_name().into_string().ok())
        .collect();
    found.sort();
    found
}

/// What a machine offers.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Found {
    /// Serial ports.
    pub ports: Vec<String>,
    /// Cameras: sockets, addresses of industrial ones.
    pub cameras: Vec<String>,
    /// Width of the camera's pictures, px, if it is known.
    pub width_px: Option<usize>,
}

/// The devices found, as comments.
fn list(what: &str, found: &[String]) -> String {
    if found.is_empty() {
        return format!("# {what} found on this machine: none\n");
    }
    let lines: String = (found.iter())
        .map(|name| format!("#   {}\n", name.escape_debug()))
        .collect();
    format!("# {what} found on this machine:\n{lines}")
}

/// Column of position 0 um, the middle of the picture, with its comment.
fn origin(width_px: Option<usize>) -> String {
    let width = width_px.unwrap_or(256);
    let comment = match width_px {
        Some(_) => format!("column of position 0 um: the middle of {width} px"),
        None => "column of position 0 um: write the middle of your picture, (width - 1) / 2; calibrate writes it, too".to_string(),
    };
    let number = format!("{:?}", 0.5 * (width as f64 - 1.0));
    format!("origin_px = {number:<13}# {comment}\n")
}

/// The text of a rig file.
pub fn text(kind: &Kind, found: &Found) -> String {
    let devices = match kind {
        Kind::Emulated => "\
[actuator]
kind = \"emulated\"        # the board's state machine in this process; a real board: cellpos rig new --serial PORT

[camera]
kind = \"emulated\"        # rendered frames; a real camera: --camera PATH_OF_A_SOCKET or --camera ADDRESS

# [calibration]          # replaces that of the emulated camera: right, or wrong to rehearse
# pixel = \"0.1um\"
# origin_px = 127.5
# sign = 1.0
"
        .to_string(),
        Kind::Real { port, camera } => {
            let camera = match camera {
                Camera::Socket(path) => format!(
                    "kind = \"socket\"          # a camera server such as firmware-sim's\nsocket = {path:?}\nrate = \"1kHz\"\n"
                ),
                Camera::Industrial(address) => format!(
                    "kind = \"industrial\"      # program built with --features aravis\naddress = {address:?}\nrate = \"1kHz\"\n\
                     exposure = \"200us\"       # short: at 400 um/s a bead smears by 80 nm\n\
                     # region = {{ x_px = 0, y_px = 0, width_px = 256, height_px = 64 }}\n"
                ),
            };
            let origin = origin(found.width_px);
            format!(
                "\
[actuator]
kind = \"serial\"
port = {port:?}
baud = 3000000           # no effect on USB CDC and pseudo-terminals
hold_watchdog = \"2s\"     # holding time after which it parks

[camera]
{camera}
[calibration]            # cellpos calibrate replaces it by calibration_file = \"calibration.toml\"
pixel = \"0.1um\"          # a guess, until measured with a stage micrometer
{origin}sign = 1.0               # +1: the coordinate rises when the PZT extends

[vision]                 # beads of firmware-sim; for yours: cellpos camera --rig FILE --find-beads beads.png
window_px = 21
profile = {{ kind = \"ring\", edge_px = 5.0 }}
"
            )
        }
    };
    let (ports, cameras) = (
        list("Serial ports", &found.ports),
        list("Cameras", &found.cameras),
    );
    format!(
        "# A rig for cellpos. docs/rig-toml.md has every key; cellpos rig check FILE [--connect] checks it.
# park = \"20um\" and park_um = 20.0 mean the same.
{ports}{cameras}
first_neutral = \"20um\"   # first estimate of zero flow (the bead is at rest there); the loop refines it

{devices}
[limits]                 # of the command; the board's limits hold, too
low = \"0um\"
high = \"40um\"
slew = \"20um/ms\"
park = \"20um\"            # displacement of the PZT after a run

[timing]
period = \"1ms\"           # between two frames
camera_delay = \"2ms\"     # from mid-exposure to the tick that uses the frame; cellpos identify measures it
oldest = \"5ms\"           # older frames are not used
"
    )
}

/// The meaning of `--camera`: an existing socket or a path, else an address.
pub fn camera(text: &str) -> Camera {
    if Path::new(text).exists() || text.contains('/') || text.ends_with(".sock") {
        Camera::Socket(text.to_string())
    } else {
        Camera::Industrial(text.to_string())
    }
}

/// Width of the pictures that a camera server sends, px; `None` if none comes soon.
pub fn width_px(camera: &Camera) -> Option<usize> {
    const PATIENCE: Duration = Duration::from_millis(500);
    // Rate and delay are for its user.
    let (rate_hz, delay_ms) = (1000.0, 2.0);
    match camera {
        Camera::Socket(path) => {
            let camera = SocketCamera::connect(Path::new(path), rate_hz, delay_ms, PATIENCE);
            camera.ok().map(|camera| camera.info().width_px)
        }
        Camera::Industrial(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_link::frames::FrameHeader;
    use cellpos_session::RigFile;
    use std::io::Write;
    use std::os::unix::net::UnixListener;

    #[test]
    fn every_template_is_read_as_it_is_written() {
        let folder = tempfile::tempdir().expect("a folder");
        let found = Found {
            ports: vec!["/dev/ttyACM0".to_string(), "odd\nname".to_string()],
            ..Found::default()
        };
        let real = |camera| Kind::Real {
            port: "/dev/serial/by-id/usb-board".to_string(),
            camera,
        };
        for kind in [
            Kind::Emulated,
            real(camera("camera.sock")),
            real(camera("192.168.1.20")),
        ] {
            let path = folder.path().join("rig.toml");
            let text = text(&kind, &found);
            assert!(text.contains("#   /dev/ttyACM0\n") && text.contains("machine: none"));
            std::fs::write(&path, text).expect("written");
            let file = RigFile::load(Some(&path)).unwrap_or_else(|error| panic!("{error:?}"));
            assert_eq!((file.limits.park_um, file.timing.period_us), (20.0, 1000.0));
            assert_eq!(file.is_emulated(), kind == Kind::Emulated);
            if kind != Kind::Emulated {
                assert_eq!(file.watchdogs_ms(), [None, Some(2000)]);
            }
        }
    }

    #[test]
    fn the_origin_is_the_middle_of_the_pictures_that_the_camera_sends() {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("camera.sock");
        let camera = camera(&socket.display().to_string());
        assert_eq!(width_px(&camera), None, "nobody serves it");
        let listener = UnixListener::bind(&socket).expect("bound");
        let server = std::thread::spawn(move || {
            let header = FrameHeader {
                frame_id: 1,
                mid_exposure_ns: 1,
                sent_ns: 2,
                exposure_ns: 1,
                width: 128,
                height: 64,
                bits: 8,
            };
            let (mut stream, _) = listener.accept().expect("a client");
            let frame = [&header.to_bytes()[..], &[0; 128 * 64]].concat();
            stream.write_all(&frame).expect("sent");
        });
        let seen = width_px(&camera);
        server.join().expect("served");
        assert_eq!(seen, Some(128));
        let kind = Kind::Real {
            port: "pzt".to_string(),
            camera,
        };
        for (width_px, origin_px, comment) in [
            (seen, 63.5, "the middle of 128 px"),
            (None, 127.5, "write the middle of your picture"),
        ] {
            let found = Found {
                width_px,
                ..Found::default()
            };
            let path = folder.path().join("rig.toml");
            let text = text(&kind, &found);
            assert!(text.contains(comment), "{text}");
            std::fs::write(&path, text).expect("written");
            let file = RigFile::load(Some(&path)).unwrap_or_else(|error| panic!("{error:?}"));
            assert_eq!(file.calibration.expect("there").origin_px, origin_px);
        }
    }
}
