//! Readers of recordings: the content comes back; a damaged file gives an error, never a panic.

use cellpos_drivers::sources::{self, Playback, Region, SourceError};
use cellpos_rig::{Camera, CameraError, Clock, FrameBuffer};
use proptest::prelude::*;
use std::fs;
use std::path::{Path, PathBuf};
use tiff::encoder::{TiffEncoder, colortype};

const WIDTH: usize = 12;
const HEIGHT: usize = 8;

fn pixel(frame: usize, k: usize, most: usize) -> usize {
    (k * 37 + frame * 101 + 5) % (most + 1)
}

fn grey8(frame: usize) -> Vec<u8> {
    (0..WIDTH * HEIGHT)
        .map(|k| pixel(frame, k, 255) as u8)
        .collect()
}

fn grey16(frame: usize, most: usize) -> Vec<u16> {
    (0..WIDTH * HEIGHT)
        .map(|k| pixel(frame, k * 91, most) as u16)
        .collect()
}

fn write_tiff(path: &Path, frames: usize, bits: u16) {
    let mut encoder = TiffEncoder::new(fs::File::create(path).unwrap()).unwrap();
    for n in 0..frames {
        let (w, h) = (WIDTH as u32, HEIGHT as u32);
        if bits == 8 {
            encoder
                .write_image::<colortype::Gray8>(w, h, &grey8(n))
                .unwrap();
        } else {
            encoder
                .write_image::<colortype::Gray16>(w, h, &grey16(n, 65_535))
                .unwrap();
        }
    }
}

fn write_pngs(folder: &Path, frames: usize) {
    for n in 0..frames {
        let picture = image::GrayImage::from_raw(WIDTH as u32, HEIGHT as u32, grey8(n)).unwrap();
        picture.save(folder.join(format!("frame_{n}.png"))).unwrap();
    }
}

fn cihx(bits: u16, depth: u16, side: &str, frames: usize) -> String {
    format!(
        "\u{1}binary line\n<cih>\n<fileInfo><date>2026/11/20</date></fileInfo>\n\
         <recordInfo><recordRate>1000</recordRate><shutterSpeed>2000</shutterSpeed></recordInfo>\n\
         <frameInfo><totalFrame>{frames}</totalFrame></frameInfo>\n\
         <imageDataInfo><resolution><width>{WIDTH}</width><height>{HEIGHT}</height></resolution>\
         <effectiveBit><depth>{depth}</depth><side>{side}</side></effectiveBit>\
         <colorInfo><type>Mono</type><bit>{bits}</bit></colorInfo></imageDataInfo>\n\
         <imageFileInfo><fileFormat>MRaw</fileFormat></imageFileInfo>\n</cih>\ntrailer"
    )
}

/// Frames as Photron writes them, and the values that must come back.
fn write_photron(
    folder: &Path,
    bits: u16,
    depth: u16,
    side: &str,
    frames: usize,
) -> (PathBuf, Vec<Vec<u16>>) {
    let most = (1_usize << depth) - 1;
    let values: Vec<Vec<u16>> = (0..frames).map(|n| grey16(n, most)).collect();
    let shift = if side == "Higher" { bits - depth } else { 0 };
    let mut bytes = Vec::new();
    for frame in &values {
        match bits {
            8 => bytes.extend(frame.iter().map(|v| *v as u8)),
            16 => bytes.extend(frame.iter().flat_map(|v| (v << shift).to_le_bytes())),
            _ => {
                for pair in frame.chunks(2) {
                    let packed = u32::from(pair[0]) << 12 | u32::from(pair[1]);
                    bytes.extend(&packed.to_be_bytes()[1..]);
                }
            }
        }
    }
    let header = folder.join("recording.cihx");
    fs::write(&header, cihx(bits, depth, side, frames)).unwrap();
    fs::write(folder.join("recording.mraw"), bytes).unwrap();
    (header, values)
}

fn read(path: &Path, index: usize) -> Result<FrameBuffer, SourceError> {
    let mut buffer = FrameBuffer::default();
    sources::open(path)?.read(index, &mut buffer)?;
    Ok(buffer)
}

#[test]
fn png_folders_come_back_in_the_order_of_their_numbers() {
    let folder = tempfile::tempdir().unwrap();
    write_pngs(folder.path(), 12);
    let mut recording = sources::open(folder.path()).unwrap();
    assert_eq!((recording.info().frames, recording.info().bits), (12, 8));
    let mut buffer = FrameBuffer::default();
    for n in 0..12 {
        recording.read(n, &mut buffer).unwrap();
        assert_eq!(buffer.mono8, grey8(n), "frame {n}");
    }
}

#[test]
fn tiff_stacks_come_back_in_any_order() {
    let folder = tempfile::tempdir().unwrap();
    for bits in [8, 16] {
        let path = folder.path().join(format!("stack{bits}.tif"));
        write_tiff(&path, 5, bits);
        let mut recording = sources::open(&path).unwrap();
        assert_eq!((recording.info().frames, recording.info().bits), (5, bits));
        let mut buffer = FrameBuffer::default();
        for n in [0, 1, 2, 4, 0, 3, 3] {
            recording.read(n, &mut buffer).unwrap();
            if bits == 8 {
                assert_eq!(buffer.mono8, grey8(n), "frame {n}");
            } else {
                assert_eq!(buffer.mono16, grey16(n, 65_535), "frame {n}");
            }
        }
        let beyond = recording.read(5, &mut buffer);
        assert!(matches!(
            beyond,
            Err(SourceError::NoSuchFrame {
                frame: 5,
                frames: 5,
                ..
            })
        ));
    }
}

#[test]
fn photron_recordings_come_back_at_every_depth_and_side_from_either_file() {
    let kinds = [
        (8, 8, "Lower"),
        (12, 12, "Lower"),
        (16, 12, "Lower"),
        (16, 12, "Higher"),
        (16, 16, "Lower"),
    ];
    for (bits, depth, side) in kinds {
        let folder = tempfile::tempdir().unwrap();
        let (header, values) = write_photron(folder.path(), bits, depth, side, 3);
        for path in [header.clone(), header.with_extension("mraw")] {
            let mut recording = sources::open(&path).unwrap();
            assert_eq!(recording.info().rate_hz, Some(1000.0));
            let mut buffer = FrameBuffer::default();
            for n in [2, 0, 1] {
                recording.read(n, &mut buffer).unwrap();
                let got: Vec<u16> = match bits {
                    8 => buffer.mono8.iter().map(|v| u16::from(*v)).collect(),
                    _ => buffer.mono16.clone(),
                };
                assert_eq!(got, values[n], "{bits} bits, {depth} {side}, frame {n}");
            }
        }
    }
}

#[test]
fn the_older_photron_header_is_read_too() {
    let folder = tempfile::tempdir().unwrap();
    let (header, values) = write_photron(folder.path(), 16, 12, "Lower", 2);
    fs::remove_file(&header).unwrap();
    let text = format!(
        "#Camera Information Header\nRecord Rate(fps) : 1000\nTotal Frame : 2\nImage Width : {WIDTH}\n\
         Image Height : {HEIGHT}\nColor Bit : 16\nFile Format : MRaw\nEffectiveBit Depth : 12\nEffectiveBit Side : Lower\n"
    );
    fs::write(header.with_extension("cih"), text).unwrap();
    assert_eq!(
        read(&header.with_extension("mraw"), 1).unwrap().mono16,
        values[1]
    );
}

#[test]
fn truncated_files_are_damaged_and_name_the_frame() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stack.tif");
    write_tiff(&path, 1, 16);
    let whole = fs::read(&path).unwrap();
    for keep in [3, 20, whole.len() / 2, whole.len() - 30] {
        fs::write(&path, &whole[..keep]).unwrap();
        assert!(
            matches!(read(&path, 0), Err(SourceError::Damaged { frame: 0, .. })),
            "{keep} bytes kept"
        );
    }
    let (header, _) = write_photron(folder.path(), 12, 12, "Lower", 3);
    let mraw = header.with_extension("mraw");
    let whole = fs::read(&mraw).unwrap();
    fs::write(&mraw, &whole[..whole.len() - 1]).unwrap();
    let error = read(&header, 1).unwrap_err();
    assert!(matches!(error, SourceError::Damaged { frame: 2, .. }));
    let text = error.to_string();
    assert!(text.contains("2 of the 3 frames"), "{text}");
    let png = folder.path().join("a.png");
    image::GrayImage::from_raw(WIDTH as u32, HEIGHT as u32, grey8(0))
        .unwrap()
        .save(&png)
        .unwrap();
    let whole = fs::read(&png).unwrap();
    fs::write(&png, &whole[..whole.len() / 2]).unwrap();
    assert!(matches!(read(&png, 0), Err(SourceError::Damaged { .. })));
}

#[test]
fn wrong_pixel_kinds_and_missing_files_are_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("colour.png");
    let mut colour = image::RgbImage::new(4, 4);
    colour.put_pixel(2, 1, image::Rgb([7, 8, 7]));
    colour.save(&path).unwrap();
    let error = read(&path, 0).unwrap_err();
    assert!(matches!(error, SourceError::PixelKind { .. }));
    let text = error.to_string();
    assert!(text.contains("channels of 7 and 8 in pixel 6"), "{text}");

    let path = folder.path().join("float.tif");
    let mut encoder = TiffEncoder::new(fs::File::create(&path).unwrap()).unwrap();
    encoder
        .write_image::<colortype::Gray32Float>(2, 2, &[0.0; 4])
        .unwrap();
    assert!(matches!(read(&path, 0), Err(SourceError::PixelKind { .. })));

    let empty = tempfile::tempdir().unwrap();
    assert!(matches!(
        read(empty.path(), 0),
        Err(SourceError::Empty { .. })
    ));
    assert!(matches!(
        read(&empty.path().join("none.tif"), 0),
        Err(SourceError::Unreadable { .. })
    ));
    assert!(matches!(
        read(&empty.path().join("none.avi"), 0),
        Err(SourceError::Unreadable { .. })
    ));
    let text = empty.path().join("notes.txt");
    fs::write(&text, "no pictures").unwrap();
    assert!(matches!(
        read(&text, 0),
        Err(SourceError::UnknownKind { .. })
    ));
}

#[test]
fn bad_photron_headers_are_refused_by_their_key() {
    let folder = tempfile::tempdir().unwrap();
    let (header, _) = write_photron(folder.path(), 16, 12, "Lower", 2);
    let good = fs::read_to_string(&header).unwrap();
    for (from, to, key) in [
        (
            "<bit>16</bit>",
            "<bit>10</bit>",
            "imageDataInfo/colorInfo/bit",
        ),
        (
            "<depth>12</depth>",
            "<depth>0</depth>",
            "imageDataInfo/effectiveBit/depth",
        ),
        (
            "<recordRate>1000</recordRate>",
            "<recordRate>0</recordRate>",
            "recordInfo/recordRate",
        ),
        ("<totalFrame>2</totalFrame>", "", "frameInfo/totalFrame"),
        ("MRaw", "Tiff", "imageFileInfo/fileFormat"),
        ("</cih>", "", "<cih>"),
    ] {
        fs::write(&header, good.replace(from, to)).unwrap();
        let error = read(&header, 0).unwrap_err();
        assert!(
            matches!(&error, SourceError::Header { key: k, .. } if *k == key),
            "{error}"
        );
    }
    fs::write(
        &header,
        good.replace("<width>12</width>", "<width>0</width>"),
    )
    .unwrap();
    assert!(matches!(
        read(&header, 0),
        Err(SourceError::Size { width: 0, .. })
    ));
}

#[test]
fn frames_of_another_size_than_the_first_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    write_pngs(folder.path(), 2);
    image::GrayImage::new(5, 5)
        .save(folder.path().join("frame_1.png"))
        .unwrap();
    assert!(matches!(
        read(folder.path(), 1),
        Err(SourceError::SizeChanges {
            frame: 1,
            width: 5,
            ..
        })
    ));
}

#[test]
fn regions_are_cut_out_and_impossible_ones_refused() {
    let folder = tempfile::tempdir().unwrap();
    write_pngs(folder.path(), 1);
    let mut buffer = read(folder.path(), 0).unwrap();
    let region: Region = "5x3+2+4".parse().unwrap();
    region.cut(&mut buffer).unwrap();
    let whole = grey8(0);
    let expected: Vec<u8> = (4..7)
        .flat_map(|j| whole[j * WIDTH + 2..j * WIDTH + 7].to_vec())
        .collect();
    assert_eq!(
        (buffer.width, buffer.height, &buffer.mono8),
        (5, 3, &expected)
    );
    for bad in [
        "0x3+0+0",
        "3x0+0+0",
        "12x9+0+0",
        "5x3+8+0",
        "1x1+18446744073709551615+0",
    ] {
        let region: Region = bad.parse().unwrap();
        let recording = sources::open(folder.path()).unwrap();
        let refused = Playback::new(recording, None, Some(region), Clock::virtual_at(0));
        assert!(matches!(refused, Err(SourceError::Region { .. })), "{bad}");
    }
    assert!("64x64".parse::<Region>().is_err() && "ax3+0+0".parse::<Region>().is_err());
}

#[test]
fn a_recording_plays_at_its_rate_and_then_the_camera_is_gone() {
    let folder = tempfile::tempdir().unwrap();
    write_pngs(folder.path(), 3);
    let recording = sources::open(folder.path()).unwrap();
    let mut camera = Playback::new(recording, Some(100.0), None, Clock::virtual_at(1_000)).unwrap();
    let mut buffer = FrameBuffer::default();
    for n in 0..3_i64 {
        let due_ns = 1_000 + n * 10_000_000;
        if n > 0 {
            assert_eq!(
                camera.next_frame(&mut buffer, due_ns - 1).unwrap(),
                None,
                "not before its time"
            );
        }
        let stamp = camera
            .next_frame(&mut buffer, due_ns + 5_000_000)
            .unwrap()
            .unwrap();
        assert_eq!((stamp.id, stamp.mid_exposure_ns), (n as u64 + 1, due_ns));
        assert_eq!(buffer.mono8, grey8(n as usize));
    }
    assert!(matches!(
        camera.next_frame(&mut buffer, i64::MAX),
        Err(CameraError::Gone { .. })
    ));
}

/// Reads everything that a file claims to hold; a frame that is not whole, or a panic, fails.
fn read_all(path: &Path) {
    let mut buffer = FrameBuffer::default();
    if let Ok(mut recording) = sources::open(path) {
        for n in 0..recording.info().frames.min(20) {
            if recording.read(n, &mut buffer).is_ok() {
                let held = if buffer.bits > 8 {
                    buffer.mono16.len()
                } else {
                    buffer.mono8.len()
                };
                assert_eq!(held, buffer.width * buffer.height, "a frame must be whole");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_damage_to_a_recording_makes_a_reader_panic(
        changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..12),
        keep in any::<prop::sample::Index>(),
        cut in any::<bool>(),
        kind in 0..4_usize,
    ) {
        let folder = tempfile::tempdir().unwrap();
        let path = match kind {
            0 => { let p = folder.path().join("a.tif"); write_tiff(&p, 3, 16); p }
            1 => { write_pngs(folder.path(), 1); folder.path().join("frame_0.png") }
            2 => write_photron(folder.path(), 12, 12, "Lower", 2).0,
            _ => write_photron(folder.path(), 16, 12, "Higher", 2).0,
        };
        let mut bytes = fs::read(&path).unwrap();
        for (at, value) in changes {
            let k = at.index(bytes.len());
            bytes[k] = value;
        }
        if cut {
            bytes.truncate(keep.index(bytes.len()));
        }
        fs::write(&path, bytes).unwrap();
        read_all(&path);
    }

    #[test]
    fn no_byte_string_makes_a_reader_panic(
        bytes in proptest::collection::vec(any::<u8>(), 0..400),
        kind in 0..4_usize,
    ) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(["a.tif", "a.png", "a.cihx", "a.cih"][kind]);
        fs::write(&path, &bytes).unwrap();
        fs::write(folder.path().join("a.mraw"), &bytes).unwrap();
        read_all(&path);
    }
}
