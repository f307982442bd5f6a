//! Films, arrays, JPEG pictures and packed TIFF pages: the content comes back, and an unreadable file gets an error with a remedy.

use cellpos_drivers::sources::{self, SourceError};
use cellpos_rig::FrameBuffer;
use std::fs;
use std::path::Path;

const WIDTH: usize = 13;
const HEIGHT: usize = 6;

fn grey(frame: usize) -> Vec<u8> {
    (0..WIDTH * HEIGHT)
        .map(|k| ((k * 37 + frame * 101 + 5) % 256) as u8)
        .collect()
}

fn read(path: &Path, index: usize) -> Result<FrameBuffer, SourceError> {
    let mut buffer = FrameBuffer::default();
    sources::open(path)?.read(index, &mut buffer)?;
    Ok(buffer)
}

fn chunk(name: &[u8; 4], body: &[u8]) -> Vec<u8> {
    let mut bytes = name.to_vec();
    bytes.extend((body.len() as u32).to_le_bytes());
    bytes.extend(body);
    bytes.extend(vec![0; body.len() % 2]);
    bytes
}

fn list(kind: &[u8; 4], name: &[u8; 4], parts: &[Vec<u8>]) -> Vec<u8> {
    chunk(kind, &[name.to_vec(), parts.concat()].concat())
}

/// A film with a stream of sound before that of the pictures, at 1500 frames/s.
fn avi(compression: [u8; 4], bits: u16, height: i32, frames: &[Vec<u8>]) -> Vec<u8> {
    let mut video = vec![0; 56];
    video[..4].copy_from_slice(b"vids");
    video[20..24].copy_from_slice(&2_u32.to_le_bytes());
    video[24..28].copy_from_slice(&3000_u32.to_le_bytes());
    let mut format = vec![0; 40];
    format[0] = 40;
    format[4..8].copy_from_slice(&(WIDTH as i32).to_le_bytes());
    format[8..12].copy_from_slice(&height.to_le_bytes());
    format[14..16].copy_from_slice(&bits.to_le_bytes());
    format[16..20].copy_from_slice(&compression);
    if bits == 8 && compression == [0; 4] {
        format.extend((0..=255_u8).flat_map(|v| [v, v, v, 0]));
    }
    let mut sound = vec![0; 56];
    sound[..4].copy_from_slice(b"auds");
    let streams = [
        chunk(b"avih", &[0; 56]),
        list(
            b"LIST",
            b"strl",
            &[chunk(b"strh", &sound), chunk(b"strf", &[0; 16])],
        ),
        list(
            b"LIST",
            b"strl",
            &[chunk(b"strh", &video), chunk(b"strf", &format)],
        ),
    ];
    let parts: Vec<Vec<u8>> = frames
        .iter()
        .flat_map(|f| [chunk(b"00wb", &[1, 2, 3]), chunk(b"01dc", f)])
        .collect();
    let film = [
        list(b"LIST", b"hdrl", &streams),
        list(b"LIST", b"movi", &parts),
        chunk(b"idx1", &[0; 16]),
    ];
    list(b"RIFF", b"AVI ", &film)
}

/// Rows from the bottom, each filled up to four bytes, of `channels` bytes a pixel.
fn bitmap(grey: &[u8], channels: usize) -> Vec<u8> {
    let rows = grey.chunks(WIDTH).rev().map(|row| {
        let mut row: Vec<u8> = row.iter().flat_map(|v| vec![*v; channels]).collect();
        row.resize(row.len().next_multiple_of(4), 0);
        row
    });
    rows.collect::<Vec<_>>().concat()
}

#[test]
fn uncompressed_films_come_back_with_their_rate_and_what_was_dropped() {
    let folder = tempfile::tempdir().unwrap();
    let height = HEIGHT as i32;
    let frames: Vec<Vec<u8>> = (0..4).map(grey).collect();
    let bitmaps = |channels| {
        frames
            .iter()
            .map(|f| bitmap(f, channels))
            .collect::<Vec<_>>()
    };
    let films = [
        ("y800", avi(*b"Y800", 8, height, &frames)),
        ("palette", avi([0; 4], 8, height, &bitmaps(1))),
        ("colour", avi(*b"DIB ", 24, height, &bitmaps(3))),
    ];
    for (name, bytes) in films {
        let path = folder.path().join(format!("{name}.avi"));
        fs::write(&path, bytes).unwrap();
        let info = sources::open(&path).unwrap().info().clone();
        assert_eq!(
            (info.width_px, info.height_px, info.bits),
            (WIDTH, HEIGHT, 8)
        );
        assert_eq!((info.frames, info.rate_hz, info.lost), (4, Some(1500.0), 0));
        for n in [3, 0, 2] {
            assert_eq!(read(&path, n).unwrap().mono8, grey(n), "{name}, frame {n}");
        }
        assert!(matches!(
            read(&path, 4),
            Err(SourceError::NoSuchFrame { .. })
        ));
    }
    let words: Vec<Vec<u8>> = (0..2)
        .map(|n| {
            grey(n)
                .iter()
                .flat_map(|v| (u16::from(*v) * 257).to_le_bytes())
                .collect()
        })
        .collect();
    let path = folder.path().join("y16.avi");
    fs::write(&path, avi(*b"Y16 ", 16, height, &words)).unwrap();
    let expected: Vec<u16> = grey(1).iter().map(|v| u16::from(*v) * 257).collect();
    assert_eq!(read(&path, 1).unwrap().mono16, expected);
    // An empty chunk stands for a frame that was dropped.
    let dropped = [grey(0), Vec::new(), Vec::new(), grey(1)];
    let path = folder.path().join("dropped.avi");
    fs::write(&path, avi(*b"GREY", 8, height, &dropped)).unwrap();
    let mut film = sources::open(&path).unwrap();
    assert_eq!((film.info().frames, film.info().lost), (2, 2));
    assert_eq!([film.number(0), film.number(1)], [0, 3]);
    let mut buffer = FrameBuffer::default();
    film.read(1, &mut buffer).unwrap();
    assert_eq!(buffer.mono8, grey(1));
}

/// A smooth picture, as JPEG keeps it.
fn smooth(width: usize, height: usize) -> image::GrayImage {
    image::GrayImage::from_fn(width as u32, height as u32, |x, y| {
        let r = f64::hypot(f64::from(x) - 20.3, f64::from(y) - 14.8);
        image::Luma([(90.0 + 120.0 * (-0.02 * r * r).exp()) as u8])
    })
}

fn jpeg(picture: &image::GrayImage) -> Vec<u8> {
    let mut bytes = Vec::new();
    let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95);
    picture.write_with_encoder(encoder).unwrap();
    bytes
}

fn most_off(frame: &FrameBuffer, picture: &image::GrayImage) -> u8 {
    let pairs = frame.mono8.iter().zip(picture.as_raw());
    assert_eq!(frame.mono8.len(), picture.as_raw().len());
    pairs.map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

#[test]
fn jpeg_folders_and_films_without_code_tables_come_back_to_the_rounding_of_the_format() {
    let folder = tempfile::tempdir().unwrap();
    let (width, height) = (WIDTH, HEIGHT);
    let picture = smooth(40, 32);
    for n in [8, 9, 11] {
        fs::write(folder.path().join(format!("f_{n}.jpg")), jpeg(&picture)).unwrap();
    }
    let mut recording = sources::open(folder.path()).unwrap();
    assert_eq!(
        (
            recording.info().kind,
            recording.info().frames,
            recording.info().lost
        ),
        ("JPEG folder", 3, 1)
    );
    let mut buffer = FrameBuffer::default();
    recording.read(2, &mut buffer).unwrap();
    assert!(
        most_off(&buffer, &picture) <= 3,
        "{}",
        most_off(&buffer, &picture)
    );
    // The same in colour: the channels differ by the rounding of the format.
    let colour = image::DynamicImage::ImageLuma8(picture.clone()).to_rgb8();
    let path = folder.path().join("colour.jpeg");
    let encoder =
        image::codecs::jpeg::JpegEncoder::new_with_quality(fs::File::create(&path).unwrap(), 95);
    colour.write_with_encoder(encoder).unwrap();
    assert!(most_off(&read(&path, 0).unwrap(), &picture) <= 3);
    let text = folder.path().join("text.jpg");
    fs::write(&text, "no picture").unwrap();
    assert!(matches!(read(&text, 0), Err(SourceError::Damaged { .. })));
    // A film's frames have no tables.
    let picture = smooth(width, height);
    let whole = jpeg(&picture);
    let mut bare = whole.clone();
    while let Some(at) = bare.windows(2).position(|w| w == [0xFF, 0xC4]) {
        let length = usize::from(u16::from_be_bytes([bare[at + 2], bare[at + 3]]));
        bare.drain(at..at + 2 + length);
    }
    assert!(bare.len() < whole.len());
    let path = folder.path().join("film.avi");
    fs::write(&path, avi(*b"MJPG", 24, height as i32, &[whole, bare])).unwrap();
    let (first, second) = (read(&path, 0).unwrap(), read(&path, 1).unwrap());
    assert_eq!(first.mono8, second.mono8);
    assert!(most_off(&second, &picture) <= 3);
}

#[test]
fn other_codecs_and_other_films_are_refused_with_the_command_that_converts_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("it's here.avi");
    fs::write(&path, avi(*b"H264", 24, HEIGHT as i32, &[vec![1, 2, 3]])).unwrap();
    let error = sources::open(&path).unwrap_err().to_string();
    assert!(
        error.contains("H264") && error.contains("ffmpeg -i '"),
        "{error}"
    );
    assert!(error.contains("it'\\''s here.grey.avi"), "{error}");
    for name in ["a.mp4", "a.MOV", "a.mkv", "a.webm", "a.gif"] {
        let path = folder.path().join(name);
        fs::write(&path, "film").unwrap();
        let error = sources::open(&path).unwrap_err();
        assert!(matches!(error, SourceError::Film { .. }), "{error}");
        assert!(error.to_string().contains("-pix_fmt gray"), "{error}");
    }
    for (name, bytes) in [
        ("text.avi", b"no film".to_vec()),
        ("cut.avi", avi(*b"Y800", 8, 6, &[grey(0)])[..60].to_vec()),
    ] {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        let error = sources::open(&path).unwrap_err().to_string();
        assert!(error.contains(name), "{error}");
    }
    // A film that breaks off within a frame: the frames before it are read, that one is reported.
    let whole = avi(*b"Y800", 8, HEIGHT as i32, &[grey(0), grey(1)]);
    let path = folder.path().join("broken.avi");
    fs::write(&path, &whole[..whole.len() - 24 - 40]).unwrap();
    assert_eq!(read(&path, 0).unwrap().mono8, grey(0));
    assert!(matches!(read(&path, 1), Err(SourceError::Damaged { .. })));
}

#[test]
fn a_file_is_what_its_first_bytes_say_and_not_its_name() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        path
    };
    let film = avi(*b"Y800", 8, HEIGHT as i32, &[grey(0), grey(1)]);
    for name in ["film.mp4", "film.tif", "film", "film.npy"] {
        assert_eq!(
            read(&write(name, &film), 0).unwrap().mono8,
            grey(0),
            "{name}"
        );
    }
    let mp4 = b"\0\0\0\x20ftypisom\0\0\x02\0isomiso2";
    for (name, bytes, way) in [
        (
            "film.tif",
            &mp4[..],
            "MP4 is not read here: convert it without loss with `ffmpeg -i",
        ),
        ("film.rtdc", b"\x1A\x45\xDF\xA3....", "Matroska"),
        ("stack.nd2", b"\xDA\xCE\xBE\x0A....", "bfconvert '"),
        ("stack.tiff", b"ZISRAWFILE......", "Zeiss CZI"),
        ("a.cine", b"CI\x2C\0....", "-pix_fmt gray"),
        ("a.png", b"BM......", "ffmpeg -i '"),
        ("it's.npz", b"PK\x03\x04....", "numpy.save"),
    ] {
        let error = sources::open(&write(name, bytes)).unwrap_err();
        assert!(matches!(error, SourceError::Film { .. }), "{name}: {error}");
        assert!(error.to_string().contains(way), "{name}: {error}");
    }
    let error = sources::open(&write("notes.txt", b"text")).unwrap_err();
    assert!(matches!(error, SourceError::UnknownKind { .. }), "{error}");
}

fn npy(descr: &str, order: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let mut header =
        format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': {shape}, }}");
    while (10 + header.len() + 1) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

#[test]
fn arrays_of_frames_come_back_and_others_are_refused_by_the_key_of_their_header() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stack.npy");
    let frames: Vec<u8> = (0..3).flat_map(grey).collect();
    fs::write(&path, npy("|u1", "False", "(3, 6, 13)", &frames)).unwrap();
    let info = sources::open(&path).unwrap().info().clone();
    assert_eq!((info.width_px, info.height_px, info.frames), (13, 6, 3));
    assert_eq!(read(&path, 2).unwrap().mono8, grey(2));
    let words: Vec<u8> = grey(0)
        .iter()
        .flat_map(|v| (u16::from(*v) * 17).to_be_bytes())
        .collect();
    fs::write(&path, npy(">u2", "False", "(6, 13)", &words)).unwrap();
    let expected: Vec<u16> = grey(0).iter().map(|v| u16::from(*v) * 17).collect();
    assert_eq!(read(&path, 0).unwrap().mono16, expected);
    for (bytes, key) in [
        (npy("<f8", "False", "(3, 6, 13)", &frames), "descr"),
        (npy("|u1", "True", "(3, 6, 13)", &frames), "fortran_order"),
        (npy("|u1", "False", "(3, 6, 13, 1)", &frames), "shape"),
        (b"no array at all".to_vec(), "magic"),
    ] {
        fs::write(&path, bytes).unwrap();
        let error = sources::open(&path).unwrap_err();
        assert!(
            matches!(&error, SourceError::Header { key: k, .. } if *k == key),
            "{error}"
        );
    }
    fs::write(&path, npy("|u1", "False", "(4, 6, 13)", &frames)).unwrap();
    let error = sources::open(&path).unwrap_err();
    assert!(
        matches!(error, SourceError::Damaged { frame: 3, .. }),
        "{error}"
    );
}

/// A page of packed pixels, by hand: no encoder writes them.
fn packed_tiff(bits: u16, values: &[u16], compression: u32) -> Vec<u8> {
    let mut data = Vec::new();
    for row in values.chunks(WIDTH) {
        let text: String = row
            .iter()
            .map(|v| format!("{v:0width$b}", width = usize::from(bits)))
            .collect();
        let text = format!("{text:0<width$}", width = text.len().next_multiple_of(8));
        data.extend(
            (0..text.len())
                .step_by(8)
                .map(|k| u8::from_str_radix(&text[k..k + 8], 2).unwrap()),
        );
    }
    let half = data.len() / HEIGHT * (HEIGHT / 2);
    let entries: Vec<(u16, u16, Vec<u32>)> = vec![
        (256, 4, vec![WIDTH as u32]),
        (257, 4, vec![HEIGHT as u32]),
        (258, 3, vec![u32::from(bits)]),
        (259, 3, vec![compression]),
        (262, 3, vec![1]),
        (273, 4, vec![0, 0]),
        (277, 3, vec![1]),
        (278, 4, vec![HEIGHT as u32 / 2]),
        (279, 4, vec![half as u32, (data.len() - half) as u32]),
    ];
    let directory = 8 + 2 + 12 * entries.len() as u32 + 4;
    let (offsets, counts, start) = (directory, directory + 8, directory + 16);
    let mut bytes = b"II\x2A\x00\x08\x00\x00\x00".to_vec();
    bytes.extend((entries.len() as u16).to_le_bytes());
    for (tag, kind, values) in &entries {
        bytes.extend(tag.to_le_bytes());
        bytes.extend(kind.to_le_bytes());
        bytes.extend((values.len() as u32).to_le_bytes());
        let value = match tag {
            273 => offsets,
            279 => counts,
            _ => values[0],
        };
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend([0; 4]);
    for value in [
        start,
        start + half as u32,
        half as u32,
        (data.len() - half) as u32,
    ] {
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend(data);
    bytes
}

#[test]
fn packed_tiff_pages_of_ten_twelve_and_fourteen_bits_come_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("packed.tif");
    for bits in [10, 12, 14] {
        let values: Vec<u16> = (0..WIDTH * HEIGHT)
            .map(|k| (k * 991 % (1 << bits)) as u16)
            .collect();
        let whole = packed_tiff(bits, &values, 1);
        fs::write(&path, &whole).unwrap();
        let frame = read(&path, 0).unwrap();
        assert_eq!(
            (frame.width, frame.height, frame.bits),
            (WIDTH, HEIGHT, bits)
        );
        assert_eq!(frame.mono16, values, "{bits} bits");
        fs::write(&path, &whole[..whole.len() - 5]).unwrap();
        assert!(matches!(read(&path, 0), Err(SourceError::Damaged { .. })));
        fs::write(&path, packed_tiff(bits, &values, 5)).unwrap();
        let error = read(&path, 0).unwrap_err();
        assert!(error.to_string().contains("16 bits"), "{error}");
    }
}
