//! `cellpos vision`: positions and their quality from a recording.

use super::vision_sheet::Sheet;
use super::vision_summary::{Summary, Tally};
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_rig::sources::{self, Region, SourceError};
use cellpos_rig::{CalibrationFile, FrameBuffer, background};
use cellpos_vision::{
    CellConfig, CellFinder, Learning, LinkConfig, Localiser, LocaliserConfig, ManyTracker,
    Polarity, ProfileSpec, RingProfile, Verdict,
};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Arguments of `cellpos vision`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  cellpos vision beads/ --edge-px 6.4 --out beads-positions\n  \
    cellpos vision recording.cihx --region 64x64+200+120 --calibration calibration.toml\n  \
    cellpos vision cells.tif --cells --background-frames 50"
)]
pub struct Args {
    /// Folder of PNG pictures, TIFF stack, or Photron recording (.cihx, .cih, .mraw).
    source: PathBuf,
    /// Profile of the beads.
    #[arg(long, value_enum, default_value = "ring")]
    profile: Profile,
    /// Radius at which a ring-profile bead first crosses the background, px.
    #[arg(long, default_value_t = RingProfile::MEASURED_EDGE_PX)]
    edge_px: f64,
    /// Standard deviation of a Gaussian spot, px.
    #[arg(long, default_value_t = 3.0)]
    sigma_px: f64,
    /// Side of the fitted window, px; left out: just wide enough for the bead with its ring.
    #[arg(long)]
    window_px: Option<usize>,
    /// The beads' core is darker than the background.
    #[arg(long)]
    dark: bool,
    /// Keep the configured profile; else the template is learnt from the first good fixes.
    #[arg(long)]
    no_learning: bool,
    /// Template error tolerated before a fit counts as bad, as a fraction of the amplitude.
    #[arg(long, default_value_t = 0.15)]
    template_tolerance: f64,
    /// Farthest that a bead moves between frames, px.
    #[arg(long, default_value_t = 6.0)]
    max_step_px: f64,
    /// Look only at this part of each frame: WIDTHxHEIGHT+X+Y, px.
    #[arg(long)]
    region: Option<Region>,
    /// Calibration file: adds positions along the channel in micrometres.
    #[arg(long)]
    calibration: Option<PathBuf>,
    /// Look for cells against a background instead of beads.
    #[arg(long)]
    cells: bool,
    /// Frames at the start that show no cell, averaged into the background.
    #[arg(long, default_value_t = 20, conflicts_with = "background")]
    background_frames: usize,
    /// Recording of the empty channel, as `cellpos background` writes it, instead of frames at the start.
    #[arg(long, requires = "cells")]
    background: Option<PathBuf>,
    /// Stop after this many frames.
    #[arg(long)]
    frames: Option<usize>,
    /// New folder for positions.csv, sheet.png and summary.json; left out: vision-NAME in this folder.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// Profiles on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Profile {
    /// Bright core, dark ring.
    Ring,
    /// Gaussian spot.
    Gaussian,
}

/// Reads the recording, writes the folder, prints the summary.
pub fn run(args: Args) -> CommandResult {
    let calibration = match &args.calibration {
        Some(path) => Some(CalibrationFile::read(path).map_err(Failure::input)?),
        None => None,
    };
    let mut recording = sources::open(&args.source).map_err(Failure::input)?;
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
    let mut reader = |n: usize, buffer: &mut FrameBuffer| -> Result<(), SourceError> {
        recording.read(n, buffer)?;
        args.region.map_or(Ok(()), |r| r.cut(buffer))
    };
    let mut sheet = Sheet::new(frames);
    let mut tally = Tally::default();
    let csv = if args.cells {
        find_cells(
            &args,
            frames,
            calibration.as_ref(),
            &mut reader,
            &mut sheet,
            &mut tally,
        )?
    } else {
        find_beads(
            &args,
            frames,
            calibration.as_ref(),
            &mut reader,
            &mut sheet,
            &mut tally,
        )?
    };
    let summary = tally.summary(&info, frames, calibration.as_ref(), &out);
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

type Reader<'a> = dyn FnMut(usize, &mut FrameBuffer) -> Result<(), SourceError> + 'a;

fn localiser(args: &Args) -> Result<Localiser, Failure> {
    let profile = match args.profile {
        Profile::Ring => ProfileSpec::Ring {
            edge_px: args.edge_px,
        },
        Profile::Gaussian => ProfileSpec::Gaussian {
            sigma_px: args.sigma_px,
        },
    };
    let mut config = LocaliserConfig::new(profile);
    config.window_px = args.window_px.unwrap_or(config.window_px);
    config.polarity = if args.dark {
        Polarity::Dark
    } else {
        Polarity::Bright
    };
    config.template_tolerance = args.template_tolerance;
    config.learning = (!args.no_learning).then(Learning::default);
    Localiser::new(config).map_err(Failure::input)
}

fn find_beads(
    args: &Args,
    frames: usize,
    calibration: Option<&CalibrationFile>,
    read: &mut Reader<'_>,
    sheet: &mut Sheet,
    tally: &mut Tally,
) -> Result<String, Failure> {
    if !(args.max_step_px.is_finite() && args.max_step_px > 0.0) {
        let error = format!(
            "--max-step-px {}: a bead must be allowed to move",
            args.max_step_px
        );
        return Err(Failure::bad_input(error, "give a distance above 0 px"));
    }
    let localiser = localiser(args)?;
    let radius_px = localiser.template().radius_px();
    let link = LinkConfig {
        max_step_px: args.max_step_px,
        memory_frames: 5,
        max_beads: 200,
    };
    let mut tracker = ManyTracker::new(localiser, link);
    let mut csv = String::from(
        "frame,bead,x_px,y_px,sd_x_px,sd_y_px,amplitude_grey,background_grey,snr,residual_ratio,verdict",
    );
    csv.push_str(if calibration.is_some() {
        ",bead_um\n"
    } else {
        "\n"
    });
    let mut buffer = FrameBuffer::default();
    for n in 0..frames {
        read(n, &mut buffer).map_err(Failure::input)?;
        let frame = buffer.frame();
        let start = Instant::now();
        let sights = tracker.step(&frame);
        tally.time_us.push(start.elapsed().as_secs_f64() * 1e6);
        for s in sights {
            let f = &s.fix;
            let _ = write!(
                csv,
                "{n},{},{:.5},{:.5},{:.5},{:.5},{:.2},{:.2},{:.2},{:.3},{}",
                s.bead,
                f.x_px,
                f.y_px,
                f.var_x_px2.sqrt(),
                f.var_y_px2.sqrt(),
                f.amplitude,
                f.background,
                f.snr,
                f.residual_ratio,
                name(f.verdict)
            );
            end_row(&mut csv, calibration, f.x_px, f.y_px);
            tally.fix(n, s.bead, f);
        }
        tally.frame(
            sights
                .iter()
                .filter(|s| s.fix.verdict == Verdict::Good)
                .count(),
        );
        let marks = sights.iter().map(|s| {
            (
                s.bead,
                s.fix.x_px,
                s.fix.y_px,
                radius_px,
                s.fix.verdict == Verdict::Good,
            )
        });
        sheet.add(n, &frame, marks);
    }
    Ok(csv)
}

fn find_cells(
    args: &Args,
    frames: usize,
    calibration: Option<&CalibrationFile>,
    read: &mut Reader<'_>,
    sheet: &mut Sheet,
    tally: &mut Tally,
) -> Result<String, Failure> {
    let mut buffer = FrameBuffer::default();
    let (mut finder, background) = match &args.background {
        Some(path) => {
            let finder = background::load(path, CellConfig::default()).map_err(|error| {
                Failure::bad_input(error, "record the empty channel again: cellpos background")
            })?;
            (finder, 0)
        }
        None => {
            let background = args.background_frames;
            if background < 2 || background >= frames {
                return Err(Failure::bad_input(
                    format!("--background-frames {background}: not possible with {frames} frames"),
                    "give 2 or more frames without a cell, and leave some to look at",
                ));
            }
            read(0, &mut buffer).map_err(Failure::input)?;
            let finder = CellFinder::new(buffer.width, buffer.height, CellConfig::default())
                .map_err(Failure::input)?;
            (finder, background)
        }
    };
    let mut csv = String::from(
        "frame,cell,x_px,y_px,area_px,length_px,width_px,angle_deg,mean_contrast_grey,peak_contrast_grey,at_border",
    );
    csv.push_str(if calibration.is_some() {
        ",bead_um\n"
    } else {
        "\n"
    });
    for n in 0..frames {
        read(n, &mut buffer).map_err(Failure::input)?;
        let frame = buffer.frame();
        if n < background {
            finder.take_background(&frame).map_err(Failure::input)?;
            continue;
        }
        let start = Instant::now();
        let cells = finder.find(&frame).map_err(Failure::input)?;
        tally.time_us.push(start.elapsed().as_secs_f64() * 1e6);
        for (k, c) in cells.iter().enumerate() {
            let (length_px, width_px) = c.axes_px();
            let _ = write!(
                csv,
                "{n},{k},{:.3},{:.3},{:.1},{length_px:.2},{width_px:.2},{:.1},{:.2},{:.2},{}",
                c.x_px,
                c.y_px,
                c.area_px,
                c.angle_rad().to_degrees(),
                c.mean_grey,
                c.peak_grey,
                c.at_border
            );
            end_row(&mut csv, calibration, c.x_px, c.y_px);
            tally.cell(c);
        }
        tally.frame(cells.len());
        let marks = cells
            .iter()
            .zip(0..)
            .map(|(c, k)| (k, c.x_px, c.y_px, 0.5 * c.axes_px().0, !c.at_border));
        sheet.add(n, &frame, marks);
    }
    Ok(csv)
}

fn end_row(csv: &mut String, calibration: Option<&CalibrationFile>, x_px: f64, y_px: f64) {
    if let Some(file) = calibration {
        let _ = write!(csv, ",{:.5}", file.calibration().position_um(x_px, y_px));
    }
    csv.push('\n');
}

fn name(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Good => "good",
        Verdict::NoSignal => "no-signal",
        Verdict::BadFit => "bad-fit",
        Verdict::AtBorder => "at-border",
        Verdict::NotConverged => "not-converged",
    }
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
        )
    }
}
