//! A clip on disk: a TIFF with one page per frame, and a table of their times.

use super::moment::Moment;
use super::ring::Shot;
use std::fmt::Write;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::Path;
use tiff::encoder::{TiffEncoder, colortype};

/// Bytes that the pages of a clip take; `None`: it has none.
pub(super) fn bytes(shots: &[&Shot]) -> Option<u64> {
    let first = shots.first()?;
    let page = first.width * first.height * if first.deep { 2 } else { 1 };
    Some((page * shots.len()) as u64)
}

/// Writes `NAME.tif` and `NAME.csv` (time in the run, place of the crop in the camera's picture, centre of the bead or cell in
/// the crop). `offset_ns`: from the time of the run to that of the frames.
pub(super) fn write(
    folder: &Path,
    moment: &Moment,
    shots: &[&Shot],
    offset_ns: i64,
) -> io::Result<()> {
    std::fs::create_dir_all(folder)?;
    let path = |ending: &str| folder.join(format!("{}.{ending}", moment.name));
    let mut pages =
        TiffEncoder::new(BufWriter::new(File::create(path("tif"))?)).map_err(io::Error::other)?;
    let mut times =
        String::from("frame,time_s,frame_id,origin_x_px,origin_y_px,centre_x_px,centre_y_px\n");
    for (number, shot) in shots.iter().enumerate() {
        page(&mut pages, shot).map_err(io::Error::other)?;
        let number_or_nothing = |value: f64| match value.is_finite() {
            true => format!("{value:.4}"),
            false => String::new(),
        };
        // Writing to a String cannot fail.
        let _ = writeln!(
            times,
            "{number},{:.9},{},{},{},{},{}",
            shot.time_s(offset_ns),
            shot.id,
            shot.origin_px.0,
            shot.origin_px.1,
            number_or_nothing(shot.centre_px.0),
            number_or_nothing(shot.centre_px.1),
        );
    }
    // A reader that finds the table finds both files complete.
    let unfinished = path("csv.part");
    std::fs::write(&unfinished, times)?;
    std::fs::rename(unfinished, path("csv"))
}

fn page(pages: &mut TiffEncoder<BufWriter<File>>, shot: &Shot) -> tiff::TiffResult<()> {
    let (width, height) = (shot.width as u32, shot.height as u32);
    if shot.deep {
        return pages.write_image::<colortype::Gray16>(width, height, &shot.pixels);
    }
    let bytes: Vec<u8> = shot.pixels.iter().map(|v| (*v).min(255) as u8).collect();
    pages.write_image::<colortype::Gray8>(width, height, &bytes)
}
