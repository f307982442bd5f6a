//! `cellpos vision` and `cellpos camera` as a user runs them: what they find, what they write, what they refuse.

use crate::common::{Ran, cellpos, number, succeed};
use crate::schemas::hold;
use cellpos_vision::{PixelResponse, ProfileSpec, Template};
use std::path::{Path, PathBuf};

const WIDTH: usize = 96;
const HEIGHT: usize = 48;

fn template() -> Template {
    ProfileSpec::Ring { edge_px: 5.0 }
        .template(PixelResponse::Point)
        .unwrap()
}

/// Where the two beads of the test recording are in frame `n`, px.
fn places(n: usize) -> [(f64, f64); 2] {
    let k = n as f64;
    [
        (20.0 + 0.83 * k, 16.0 + 0.11 * k),
        (70.0 - 0.37 * k, 31.0 - 0.23 * k),
    ]
}

fn picture(n: usize) -> Vec<u8> {
    let mut image = vec![100.0_f32; WIDTH * HEIGHT];
    for (x, y) in places(n) {
        template().draw(&mut image, WIDTH, x, y, 80.0);
    }
    let mut state = n as u64 * 1_000_003;
    image
        .iter()
        .map(|v| {
            // Splitmix64; the sum of eight bytes is nearly normal, here of 1.5 grey levels.
            state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut z = state;
            z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            z ^= z >> 31;
            let sum: u32 = z.to_be_bytes().iter().map(|b| u32::from(*b)).sum();
            (v + 1.5 * (sum as f32 - 1020.0) / 209.0).round() as u8
        })
        .collect()
}

fn recording(folder: &Path, frames: usize) -> PathBuf {
    let beads = folder.join("beads");
    std::fs::create_dir(&beads).unwrap();
    for n in 0..frames {
        image::GrayImage::from_raw(WIDTH as u32, HEIGHT as u32, picture(n))
            .unwrap()
            .save(beads.join(format!("frame_{n:03}.png")))
            .unwrap();
    }
    beads
}

const CALIBRATION: &str = "pixel_um = 0.2\npixel_um_sd = 0.001\naxis = \"y\"\nsign = -1\norigin_px = 10.0\n\
    date = \"2026-11-20\"\nmethod = \"stage micrometer\"\n";

/// Rows of a CSV as named numbers; words become NaN.
fn rows(path: &Path) -> (Vec<String>, Vec<Vec<f64>>) {
    let text = std::fs::read_to_string(path).unwrap();
    let mut lines = text.lines();
    let names = lines
        .next()
        .unwrap()
        .split(',')
        .map(str::to_owned)
        .collect();
    let rows = lines
        .map(|line| {
            line.split(',')
                .map(|c| c.parse().unwrap_or(f64::NAN))
                .collect()
        })
        .collect();
    (names, rows)
}

/// The message of a refusal on one line, without the frame that a terminal gets.
fn message(ran: &Ran) -> String {
    let text = ran.err.replace(['│', '\n'], " ");
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn a_recording_gives_positions_micrometres_a_sheet_and_a_summary() {
    let folder = tempfile::tempdir().unwrap();
    recording(folder.path(), 30);
    std::fs::write(folder.path().join("calibration.toml"), CALIBRATION).unwrap();
    let r = succeed(
        folder.path(),
        "vision beads --edge-px 5 --calibration calibration.toml --out result --json",
    )
    .json();
    hold("vision", &r);
    assert_eq!(number(&r, "frames"), 30.0);
    assert_eq!(number(&r, "objects"), 2.0, "{r}");
    assert_eq!(number(&r, "fixes"), 60.0);
    assert_eq!(number(&r, "frames_without"), 0.0);
    let beads = &r["beads"];
    // 80 grey levels over 1.5, at the window's own estimate of the noise.
    assert!((number(beads, "snr_median") - 53.0).abs() < 8.0, "{beads}");
    assert!(
        (number(beads, "residual_median") - 1.0).abs() < 0.2,
        "{beads}"
    );
    let counts = beads["subpixel_counts"].as_array().unwrap();
    let counted: f64 = counts.iter().map(|c| c.as_f64().unwrap()).sum();
    assert_eq!(counted, 120.0);
    let bound_px = number(beads, "bound_px");

    let result = folder.path().join("result");
    let (names, rows) = rows(&result.join("positions.csv"));
    let column = |name: &str| names.iter().position(|n| n == name).unwrap();
    assert_eq!(rows.len(), 60);
    let (mut squares, mut n_squares) = (0.0, 0.0);
    for row in &rows {
        let (x, y) = (row[column("x_px")], row[column("y_px")]);
        let place = places(row[column("frame")] as usize)
            .into_iter()
            .min_by(|a, b| f64::hypot(a.0 - x, a.1 - y).total_cmp(&f64::hypot(b.0 - x, b.1 - y)))
            .unwrap();
        squares += (x - place.0).powi(2) + (y - place.1).powi(2);
        n_squares += 2.0;
        let expected_um = -0.2 * (y - 10.0);
        assert!((row[column("bead_um")] - expected_um).abs() < 1e-4);
    }
    let rms_px = f64::sqrt(squares / n_squares);
    // 120 numbers show a standard deviation to 7 %; rounding to whole grey levels adds a little.
    assert!(rms_px < 1.3 * bound_px, "{rms_px} against {bound_px} px");

    let sheet = image::open(result.join("sheet.png")).unwrap();
    assert!(sheet.width() as usize > WIDTH && sheet.height() as usize > HEIGHT);
    let summary: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(result.join("summary.json")).unwrap())
            .unwrap();
    assert_eq!(summary["beads"], r["beads"]);
    assert_eq!(summary["calibration"]["date"], "2026-11-20");

    // Nothing is overwritten.
    let again = cellpos(folder.path(), "vision beads --out result");
    assert_eq!(again.code, Some(2));
    assert!(message(&again).contains("nothing is overwritten"));
}

#[test]
#[cfg_attr(no_shared_data, ignore = "needs ../shared/data/beads-brightfield")]
fn the_measured_beads_are_found_in_every_frame() {
    let data = Path::new(env!("MEASURED_DATA")).join("beads-brightfield");
    let folder = tempfile::tempdir().unwrap();
    let r = succeed(
        folder.path(),
        &format!("vision {} --out result --json", data.display()),
    )
    .json();
    hold("vision", &r);
    println!(
        "{} objects, {} fixes, noise {} px, bound {} px, sub-pixel chi2/dof {}, {} us per frame",
        r["objects"],
        r["fixes"],
        r["beads"]["noise_px"],
        r["beads"]["bound_px"],
        r["beads"]["subpixel_chi2"],
        r["time_us"]["p50"]
    );
    assert_eq!(number(&r, "frames"), 50.0);
    assert_eq!(number(&r, "objects"), 5.0, "{r}");
    assert_eq!(number(&r, "fixes"), 250.0);
    assert_eq!(number(&r, "frames_without"), 0.0);
}

#[test]
fn settings_come_out_of_the_recording_and_go_into_a_rig_whose_loop_sees_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    let beads = recording(root, 30);
    // A frame that was lost.
    std::fs::remove_file(beads.join("frame_012.png")).unwrap();
    let text = succeed(root, "vision beads --out found").out;
    assert!(text.contains("frames lost        1"), "{text}");
    assert!(
        text.contains(" of 28 objects are beads of radius 5.0"),
        "{text}"
    );
    let at = text.find("[vision]").expect("a table to paste");
    let mut rig = text[at..].to_string();
    rig.push_str("\n[calibration]\npixel_um = 0.2\norigin_px = 48.0\nsign = 1.0\n[camera]\nkind = \"socket\"\n");
    rig.push_str("socket = \"camera.sock\"\n[actuator]\nkind = \"serial\"\nport = \"pzt\"\n");
    std::fs::write(root.join("rig.toml"), &rig).unwrap();
    let r = succeed(
        root,
        "vision beads --as-loop rig.toml --rate-hz 200 --out loop --json",
    )
    .json();
    hold("vision", &r);
    assert_eq!(
        (number(&r, "frames"), number(&r, "lost_frames")),
        (29.0, 1.0)
    );
    // All but the two frames that confirm the bead.
    assert_eq!(number(&r, "positions"), 27.0, "{r}");
    let (names, rows) = rows(&root.join("loop/as-loop.csv"));
    let column = |name: &str| names.iter().position(|n| n == name).unwrap();
    let last = rows.last().unwrap();
    assert_eq!(last[column("frame")], 29.0);
    let um = places(29).map(|(x, _)| 0.2 * (x - 48.0));
    assert!(
        um.iter()
            .any(|um| (um - last[column("bead_um")]).abs() < 0.02),
        "{last:?}"
    );
    // The same settings for all beads, and a rig without a look of its beads.
    let r = succeed(root, "vision beads --rig rig.toml --out again --json").json();
    hold("vision", &r);
    assert_eq!(number(&r, "fixes"), 58.0, "{r}");
    let (_, rest) = rig.split_once("[calibration]").unwrap();
    std::fs::write(root.join("bare.toml"), format!("[calibration]{rest}")).unwrap();
    let ran = cellpos(root, "vision beads --as-loop bare.toml --out none");
    assert_eq!(ran.code, Some(2));
    assert!(message(&ran).contains("--find-beads"), "{}", ran.err);
}

#[test]
fn cells_are_measured_against_the_background() {
    let folder = tempfile::tempdir().unwrap();
    let cells = folder.path().join("cells");
    std::fs::create_dir(&cells).unwrap();
    for n in 0..16_u32 {
        let picture = image::GrayImage::from_fn(80, 60, |x, y| {
            let grain = ((x * 7919 + y * 104_729 + n * 15_485_863) >> 3) % 5;
            let cell = n >= 8 && (20 + n..44 + n).contains(&x) && (20..32).contains(&y);
            image::Luma([(120 + grain + if cell { 40 } else { 0 }) as u8])
        });
        picture.save(cells.join(format!("{n}.png"))).unwrap();
    }
    let r = succeed(
        folder.path(),
        "vision cells --cells --background-frames 8 --out result --json",
    )
    .json();
    hold("vision", &r);
    assert_eq!(number(&r, "fixes"), 8.0, "{r}");
    let (names, rows) = rows(&folder.path().join("result/positions.csv"));
    let column = |name: &str| names.iter().position(|n| n == name).unwrap();
    for row in &rows {
        let expected_x = 20.0 + row[column("frame")] + 11.5;
        assert!((row[column("x_px")] - expected_x).abs() < 0.2, "{row:?}");
        assert!((row[column("y_px")] - 25.5).abs() < 0.2);
        assert!((row[column("area_px")] - 288.0).abs() < 15.0);
        assert!((row[column("length_px")] / row[column("width_px")] - 2.0).abs() < 0.15);
        assert!((row[column("rim_grey")] - 40.0).abs() < 4.0, "{row:?}");
        assert!(row[column("sd_area_px")] > 0.0 && row[column("sd_length_px")] < 0.2);
        assert_eq!(row[column("cell")], 0.0, "the number stays with the cell");
    }
    // The same against a recording of the empty channel.
    let empty = folder.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    for n in 0..8 {
        let name = format!("{n}.png");
        std::fs::rename(cells.join(&name), empty.join(&name)).unwrap();
    }
    let apart = succeed(
        folder.path(),
        "vision cells --cells --background empty --out apart --json",
    )
    .json();
    hold("vision", &apart);
    assert_eq!(apart["cells"], r["cells"]);
    let refused = cellpos(
        folder.path(),
        "vision cells --cells --background cells --out third",
    );
    assert_eq!(refused.code, Some(2));
    assert!(
        message(&refused).contains("the channel was not empty"),
        "{}",
        refused.err
    );
}

/// An uncompressed grey TIFF of one picture, as little-endian bytes.
fn tiff(width: u16, height: u16, bits: u16) -> Vec<u8> {
    let bytes = u32::from(width) * u32::from(height) * u32::from(bits) / 8;
    let mut out = b"II*\0".to_vec();
    out.extend((8 + bytes).to_le_bytes());
    out.extend((0..bytes).map(|k| (k % 251) as u8));
    let entries: [(u16, u16, u32); 9] = [
        (256, 3, width.into()),
        (257, 3, height.into()),
        (258, 3, bits.into()),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 8),
        (277, 3, 1),
        (278, 3, height.into()),
        (279, 4, bytes),
    ];
    out.extend((entries.len() as u16).to_le_bytes());
    for (tag, kind, value) in entries {
        out.extend(tag.to_le_bytes());
        out.extend(kind.to_le_bytes());
        out.extend(1_u32.to_le_bytes());
        out.extend(value.to_le_bytes());
    }
    out.extend(0_u32.to_le_bytes());
    out
}

#[test]
fn every_recording_that_cannot_be_used_is_refused_with_what_would_be_right() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    recording(root, 3);
    let whole = tiff(64, 48, 8);
    std::fs::write(root.join("whole.tif"), &whole).unwrap();
    // The pixels are cut off, the directory in front of them is not.
    let mut front = b"II*\0\x08\0\0\0".to_vec();
    let directory = &whole[8 + 64 * 48..];
    front.extend(directory);
    let strip = front.len() as u32;
    let at = front.windows(4).position(|w| w == [17, 1, 4, 0]).unwrap() + 8;
    front[at..at + 4].copy_from_slice(&strip.to_le_bytes());
    front.extend(vec![90; 64 * 20]);
    std::fs::write(root.join("truncated.tif"), &front).unwrap();
    std::fs::write(root.join("headless.tif"), &whole[..200]).unwrap();
    std::fs::write(root.join("deep.tif"), tiff(64, 48, 32)).unwrap();
    std::fs::write(root.join("empty.tif"), tiff(0, 48, 8)).unwrap();
    let mut colour = image::RgbImage::new(64, 48);
    colour.put_pixel(3, 2, image::Rgb([9, 9, 8]));
    colour.save(root.join("colour.png")).unwrap();
    std::fs::write(root.join("notes.txt"), "no picture").unwrap();
    std::fs::create_dir(root.join("nothing")).unwrap();
    std::fs::write(
        root.join("sign.toml"),
        CALIBRATION.replace("sign = -1", "sign = 3"),
    )
    .unwrap();
    std::fs::write(
        root.join("undated.toml"),
        CALIBRATION.replace("date = \"2026-11-20\"\n", ""),
    )
    .unwrap();

    let whole = cellpos(
        root,
        "vision whole.tif --edge-px 5 --no-learning --out whole --json",
    );
    assert_eq!(number(&whole.json(), "frames"), 1.0, "{}", whole.err);
    for (line, says) in [
        (
            "vision truncated.tif",
            "truncated.tif: frame 0 is cut off or damaged",
        ),
        ("vision headless.tif", "headless.tif"),
        ("vision deep.tif", "deep.tif: frame 0 has"),
        ("vision empty.tif", "empty.tif"),
        ("vision colour.png", "colour.png: frame 0 has"),
        ("vision notes.txt", "not a recording"),
        ("vision nothing", "no frames"),
        ("vision nowhere", "nowhere: cannot read"),
        ("vision beads --region 0x10+4+4", "region 0x10+4+4"),
        ("vision beads --region 64x64+80+4", "region 64x64+80+4"),
        ("vision beads --region here", "WIDTHxHEIGHT+X+Y"),
        ("vision beads --frames 0", "--frames 0"),
        ("vision beads --edge-px 0", "edge_px"),
        ("vision beads --max-step-px nan", "--max-step-px"),
        (
            "vision beads --cells --background-frames 9",
            "--background-frames 9",
        ),
        (
            "vision beads --calibration none.toml",
            "none.toml: cannot read",
        ),
        ("vision beads --calibration sign.toml", "sign = 3"),
        (
            "vision beads --calibration undated.toml",
            "missing field `date`",
        ),
    ] {
        let ran = cellpos(root, line);
        assert_eq!(ran.code, Some(2), "{line}\n{}\n{}", ran.out, ran.err);
        let text = message(&ran);
        assert!(text.contains(says), "{line}: no `{says}` in\n{}", ran.err);
        assert!(!text.contains("panicked"), "{text}");
    }
    let left = std::fs::read_dir(root)
        .unwrap()
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().starts_with("vision-"));
    assert_eq!(left.count(), 0, "a refused command left a folder");
}

#[test]
fn a_recording_plays_as_a_camera_and_what_it_delivered_is_told() {
    let folder = tempfile::tempdir().unwrap();
    recording(folder.path(), 40);
    let ran = cellpos(
        folder.path(),
        "camera --recording beads --rate-hz 200 --duration 3s --json",
    );
    let r = ran.json();
    hold("vision", &r);
    // Frames that a loaded machine is too late for are skipped, as a camera would, and counted.
    assert_eq!(number(&r, "frames") + number(&r, "dropped"), 40.0, "{r}");
    assert_eq!(number(&r, "doubled_or_stale"), 0.0);
    assert_eq!(
        (number(&r, "width_px"), number(&r, "height_px")),
        (96.0, 48.0)
    );
    assert!(number(&r["interval_ms"], "p50") > 0.0);
    let intervals: f64 = r["intervals"]
        .as_array()
        .unwrap()
        .iter()
        .map(|class| class[1].as_f64().unwrap())
        .sum();
    assert_eq!(intervals, number(&r, "frames") - 1.0);
    // Over before the time is: a camera that is unplugged looks the same.
    assert!(r["ended"].as_str().unwrap().contains("beads"), "{r}");
    assert!(number(&r, "watched_s") < 2.9);
}

#[test]
fn cameras_that_are_not_there_are_clear_errors() {
    let folder = tempfile::tempdir().unwrap();
    recording(folder.path(), 2);
    let listing = succeed(folder.path(), "camera --json").json();
    assert!(listing["cameras"].is_array() && listing["hint"].is_string());
    for (line, code, says) in [
        ("camera --socket none.sock", 1, "is the camera server"),
        ("camera --recording nowhere", 2, "nowhere: cannot read"),
        (
            "camera --recording beads --region 0x8+0+0",
            2,
            "region 0x8+0+0",
        ),
        ("camera --recording beads --rate-hz 0", 2, "--rate-hz 0"),
        ("camera --recording beads --duration 0s", 2, "above zero"),
    ] {
        let ran = cellpos(folder.path(), line);
        assert_eq!(ran.code, Some(code), "{line}\n{}\n{}", ran.out, ran.err);
        assert!(
            message(&ran).contains(says),
            "{line}: no `{says}` in\n{}",
            ran.err
        );
    }
    if !cfg!(feature = "aravis") {
        let ran = cellpos(folder.path(), "camera --address 192.0.2.1");
        assert_eq!(ran.code, Some(2));
        assert!(message(&ran).contains("--features aravis"), "{}", ran.err);
    }
}

#[test]
fn a_camera_that_is_unplugged_ends_the_watch_with_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("camera.sock");
    let server = std::os::unix::net::UnixListener::bind(&path).unwrap();
    // It takes the connection and goes away without a frame.
    let gone = std::thread::spawn(move || drop(server.accept().unwrap()));
    let ran = cellpos(folder.path(), "camera --socket camera.sock --duration 1s");
    gone.join().unwrap();
    assert_eq!(ran.code, Some(1), "{}\n{}", ran.out, ran.err);
    assert!(message(&ran).contains("camera"), "{}\n{}", ran.out, ran.err);
    assert!(!ran.err.contains("panicked"));
}

#[test]
fn a_rig_with_an_industrial_camera_that_does_not_answer_is_told_by_its_address() {
    let folder = tempfile::tempdir().unwrap();
    let rig = "[actuator]\nkind = \"emulated\"\n[camera]\nkind = \"industrial\"\naddress = \"127.0.0.99\"\nregion = { x_px = 0, y_px = 0, width_px = 64, height_px = 64 }\n";
    std::fs::write(folder.path().join("mixed.toml"), rig).unwrap();
    let ran = cellpos(
        folder.path(),
        "track --target 0um --rig mixed.toml --duration 1s",
    );
    assert_eq!(ran.code, Some(2), "{}", ran.err);
    assert!(
        message(&ran).contains("must both be emulated, or neither"),
        "{}",
        ran.err
    );
    let misspelt = rig.replace("address", "adress");
    std::fs::write(folder.path().join("misspelt.toml"), misspelt).unwrap();
    let ran = cellpos(
        folder.path(),
        "track --target 0um --rig misspelt.toml --duration 1s",
    );
    assert_eq!(ran.code, Some(2), "{}", ran.err);
    assert!(message(&ran).contains("misspelt.toml"), "{}", ran.err);
}
