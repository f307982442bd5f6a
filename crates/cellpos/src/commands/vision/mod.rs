//! `cellpos vision`: positions and their quality from a recording, and the settings that it needs.

mod advice;
mod as_loop;
mod beads;
mod cells;
mod settings;

pub(crate) use advice::Advice;
pub(super) use advice::vision_table;

use super::vision_sheet::Sheet;
use super::vision_summary::{Summary, Tally};
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_drivers::CalibrationFile;
use cellpos_drivers::sources::{self, Recording, Region, SourceError};
use cellpos_rig::FrameBuffer;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Arguments of `cellpos vision`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  cellpos vision beads/                                 # finds the settings and prints them\n  \
    cellpos vision beads/ --edge-px 6.4 --out beads-positions\n  \
    cellpos vision beads/ --as-loop rig.toml              # what the loop would have seen\n  \
    cellpos vision recording.cihx --region 64x64+200+120 --calibration calibration.toml\n  \
    cellpos vision cells.tif --cells --background-frames 50"
)]
pub(crate) struct Args {
    /// Folder of PNG, TIFF or JPEG pictures, TIFF stack, Photron recording (.cihx, .cih, .mraw), AVI film, NumPy stack (.npy), or .rtdc
    /// file.
    source: PathBuf,
    /// Radius at which a bead with a ring (bright core, dark ring) first crosses the background, px. Without size and rig the profile is learnt from the recording.
    #[arg(long, conflicts_with_all = ["sigma_px", "cells"])]
    edge_px: Option<f64>,
    /// Standard deviation of a Gaussian spot, px.
    #[arg(long, conflicts_with = "cells")]
    sigma_px: Option<f64>,
    /// Use the tables vision, cell and tracking of this rig.toml.
    #[arg(long, conflicts_with_all = ["edge_px", "sigma_px", "as_loop"])]
    rig: Option<PathBuf>,
    /// Replay the recording through the tracker of this rig.toml: one bead or cell, frame by frame.
    #[arg(long, conflicts_with_all = ["edge_px", "sigma_px", "cells", "background"])]
    as_loop: Option<PathBuf>,
    /// Side of the fitted window, px; default: the width of the bead with its ring.
    #[arg(long)]
    window_px: Option<usize>,
    /// The beads' core is darker than the background.
    #[arg(long)]
    dark: bool,
    /// Use the profile of the given size, without learning it from the recording.
    #[arg(long)]
    no_learning: bool,
    /// Allowed error of the template, as a fraction of the amplitude; default: as the beads need.
    #[arg(long)]
    template_tolerance: Option<f64>,
    /// Largest step of a bead between frames, px; default: as measured.
    #[arg(long)]
    max_step_px: Option<f64>,
    /// Use this part of each frame: WIDTHxHEIGHT+X+Y, px.
    #[arg(long)]
    region: Option<Region>,
    /// Calibration file: adds positions in micrometres.
    #[arg(long)]
    calibration: Option<PathBuf>,
    /// Find cells against a background, instead of beads.
    #[arg(long)]
    cells: bool,
    /// Frames without a cell at the start, averaged into the background.
    #[arg(long, default_value_t = 20, conflicts_with = "background")]
    background_frames: usize,
    /// Frame rate for --as-loop; default: that of the recording, else 1000.
    #[arg(long)]
    rate_hz: Option<f64>,
    /// Recording of the empty channel (cellpos background), instead of frames at the start.
    #[arg(long, requires = "cells")]
    background: Option<PathBuf>,
    /// Stop after this many frames.
    #[arg(long)]
    frames: Option<usize>,
    /// New folder for positions.csv, sheet.png and summary.json; default: vision-NAME.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Reads the recording, writes the folder, prints the summary.
pub(crate) fn run(args: Args) -> CommandResult {
    if let Some(rig) = &args.as_loop {
        return as_loop::run(&args, rig);
    }
    let calibration = match &args.calibration {
        Some(path) => Some(CalibrationFile::read(path).map_err(Failure::input)?),
        None => None,
    };
    let recording = sources::open(&args.source).map_err(Failure::input)?;
    let info = recording.info().clone();
    if let Some(region) = args.region {
        region
            .check(info.width_px, info.height_px)
            .map_err(Failure::input)?;
    }
    let frames = args.frames.unwrap_or(info.frames).min(info.frames);
    if frames == 0 {
        return Err(Failure::bad_input(
            "--frames 0: nothing to do",
            "give a number of frames above 0",
        ));
    }
    let out = out_folder(&args)?;
    let mut reader = Reader {
        recording,
        region: args.region,
        frames,
    };
    let mut sheet = Sheet::new(frames);
    let mut tally = Tally::default();
    let calibrated = calibration.as_ref();
    let (csv, advice) = if args.cells {
        (
            cells::find(&args, calibrated, &mut reader, &mut sheet, &mut tally)?,
            None,
        )
    } else {
        let settings = settings::of_beads(&args, &mut reader)?;
        let csv = beads::find(&settings, calibrated, &mut reader, &mut sheet, &mut tally)?;
        (csv, settings.advice)
    };
    let mut summary = tally.summary(&info, frames, calibrated, &out);
    summary.settings = advice;
    // Made last: a recording that turns out to be damaged leaves nothing behind.
    std::fs::create_dir_all(&out).map_err(|e| cannot_write(&out, &e))?;
    write(&out.join("positions.csv"), csv.as_bytes())?;
    sheet
        .save(&out.join("sheet.png"))
        .map_err(Failure::failed)?;
    let json = serde_json::to_string_pretty(&summary).map_err(Failure::failed)?;
    write(&out.join("summary.json"), json.as_bytes())?;
    if args.json {
        print_json(&summary)?;
    } else {
        print_text(&summary.to_string())?;
    }
    Ok(if summary.fixes > 0 {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

/// Frames of the recording, cut to the region.
struct Reader {
    recording: Box<dyn Recording>,
    region: Option<Region>,
    frames: usize,
}

impl Reader {
    fn read(&mut self, n: usize, buffer: &mut FrameBuffer) -> Result<(), Failure> {
        let cut = |buffer: &mut FrameBuffer| -> Result<(), SourceError> {
            self.region.map_or(Ok(()), |region| region.cut(buffer))
        };
        self.recording.read(n, buffer).map_err(Failure::input)?;
        cut(buffer).map_err(Failure::input)
    }

    /// Number of a frame in the recording's own count, lost ones included.
    fn number(&self, n: usize) -> u64 {
        self.recording.number(n)
    }
}

fn end_row(csv: &mut String, calibration: Option<&CalibrationFile>, x_px: f64, y_px: f64) {
    if let Some(file) = calibration {
        let _ = write!(csv, ",{:.5}", file.calibration().position_um(x_px, y_px));
    }
    csv.push('\n');
}

fn out_folder(args: &Args) -> Result<PathBuf, Failure> {
    let stem = args
        .source
        .file_stem()
        .map(|s| s.to_string_lossy().into_owned())
        .unwrap_or_else(|| "source".into());
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from(format!("vision-{stem}")));
    if out.exists() {
        let error = format!("{}: exists already; nothing is overwritten", out.display());
        return Err(Failure::bad_input(error, "give another folder with --out"));
    }
    Ok(out)
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    std::fs::write(path, bytes).map_err(|e| cannot_write(path, &e))
}

fn cannot_write(path: &Path, error: &std::io::Error) -> Failure {
    Failure::bad_input(
        format!("{}: cannot write: {error}", path.display()),
        "give a folder that can be written",
    )
}

impl std::fmt::Display for Summary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(
            f,
            "{}: {} x {} px, {} bits",
            self.source, self.width_px, self.height_px, self.bits
        )?;
        writeln!(f, "frames             {}", self.frames)?;
        writeln!(f, "objects            {}", self.objects)?;
        writeln!(f, "good fixes         {}", self.fixes)?;
        writeln!(f, "frames without any {}", self.frames_without)?;
        if self.lost_frames > 0 {
            writeln!(
                f,
                "frames lost        {} (numbers that are missing)",
                self.lost_frames
            )?;
        }
        if let Some(note) = self.note {
            writeln!(f, "read as            {note}")?;
        }
        for (verdict, n) in &self.refused {
            writeln!(f, "refused {verdict:14}{n}")?;
        }
        if let Some(b) = &self.beads {
            writeln!(
                f,
                "SNR                median {:.1}, least {:.1}",
                b.snr_median, b.snr_min
            )?;
            writeln!(
                f,
                "residual ratio     median {:.2}, largest {:.2}",
                b.residual_median, b.residual_max
            )?;
            writeln!(
                f,
                "bound              {:.4} px (median standard deviation from the Fisher information)",
                b.bound_px
            )?;
            match b.noise_px {
                Some(noise) => writeln!(
                    f,
                    "localisation noise {noise:.4} px (from the covariance of successive steps)"
                )?,
                None => writeln!(f, "localisation noise below what successive steps can show")?,
            }
            writeln!(
                f,
                "sub-pixel places   {:?} (uniform when there is no pixel locking; chi2/dof {:.2})",
                b.subpixel_counts, b.subpixel_chi2
            )?;
        }
        if let Some(c) = &self.cells {
            writeln!(f, "area               median {:.0} px", c.area_median_px)?;
            writeln!(
                f,
                "length x width     median {:.1} x {:.1} px",
                c.length_median_px, c.width_median_px
            )?;
        }
        writeln!(
            f,
            "time per frame     median {:.1} us, p99 {:.1} us, max {:.1} us",
            self.time_us.p50, self.time_us.p99, self.time_us.max
        )?;
        writeln!(
            f,
            "written            {}/positions.csv, sheet.png, summary.json",
            self.out
        )?;
        match &self.settings {
            Some(s) => writeln!(f, "\n{}", s.text()),
            None => Ok(()),
        }
    }
}
