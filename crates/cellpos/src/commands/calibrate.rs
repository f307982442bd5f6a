//! `cellpos calibrate`: axis, sign and pixel size of the camera's picture.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::rig_file::RigFile;
use cellpos_drivers::CalibrationFile;
use cellpos_numeric::units::Micrometers;
use cellpos_plant::Model;
use cellpos_workbench::Bench;
use cellpos_workbench::calibrate::{self, Pulses, Response};
use cellpos_workbench::snapshot;
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `cellpos calibrate`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Pulses move the PZT about its present displacement, within [limits]; then it is parked. Axis and sign come from the bead's answer, the pixel size from a stage micrometer or from you.\n\n\
    Examples:\n  cellpos calibrate --rig rig.toml --micrometer lines.png --spacing 10um --out calibration.toml\n  \
    cellpos calibrate --rig rig.toml --pixel 0.1um --out calibration.toml"
)]
pub(crate) struct Args {
    /// Rig.
    #[arg(long)]
    rig: PathBuf,
    /// New calibration file; the rig file will name it, in place of its [calibration].
    #[arg(long)]
    out: PathBuf,
    /// Picture of a stage micrometer, lines across the channel (cellpos camera --snapshot).
    #[arg(
        long,
        requires = "spacing",
        conflicts_with = "pixel",
        required_unless_present = "pixel"
    )]
    micrometer: Option<PathBuf>,
    /// Distance of its lines.
    #[arg(long, value_parser = crate::arguments::positive::<Micrometers>)]
    spacing: Option<Micrometers>,
    /// Pixel size in the object plane, if you know it.
    #[arg(long, value_parser = crate::arguments::positive::<Micrometers>)]
    pixel: Option<Micrometers>,
    /// Standard deviation of --pixel; default: 1 % of it.
    #[arg(long, requires = "pixel", value_parser = crate::arguments::positive::<Micrometers>)]
    pixel_sd: Option<Micrometers>,
    /// Model to compare the answer with: eq6 or a model.toml.
    #[arg(long, default_value = "eq6")]
    model: String,
    /// Amplitude of the pulses.
    #[arg(long, default_value = "0.2um", value_parser = crate::arguments::positive::<Micrometers>)]
    amplitude: Micrometers,
    /// Number of pulses to each side.
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u32).range(5..=10_000))]
    pairs: u32,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// What was measured.
#[derive(Debug, Serialize)]
struct Calibrated {
    out: PathBuf,
    calibration: CalibrationFile,
    response: Response,
    tilt_sd_deg: f64,
    /// Pixel size at which the bead's answer would be the model's, um.
    pixel_of_model_um: f64,
    /// The bead's answer over the model's, with the pixel size of the calibration.
    gain_ratio: f64,
    warnings: Vec<String>,
}

/// Measures, writes the file.
pub(crate) fn run(args: Args) -> CommandResult {
    crate::output::ready([&args.out])?;
    let (pixel_um, pixel_um_sd, source) = match (&args.micrometer, args.spacing, args.pixel) {
        (Some(picture), Some(spacing), _) => {
            let (px, sd_px) = snapshot::line_spacing(picture)?;
            let um = spacing.0 / px;
            (um, um * sd_px / px, "stage micrometer")
        }
        (_, _, Some(pixel)) => {
            let sd = args.pixel_sd.map_or(0.01 * pixel.0, |sd| sd.0);
            (pixel.0, sd, "pixel size given")
        }
        _ => {
            return Err(Failure::bad_input(
                "no pixel size",
                "give --micrometer PICTURE --spacing LENGTH, or --pixel LENGTH",
            ));
        }
    };
    let model = Model::load(&args.model).map_err(Failure::input)?;
    let mut file = RigFile::load(Some(&args.rig))?;
    // An earlier calibration is not used.
    file.calibration = None;
    let bench = Bench::of(file)?;
    let pulses = Pulses {
        amplitude_um: args.amplitude.0,
        pairs: args.pairs,
        ..Pulses::default()
    };
    let bar = crate::output::progress_bar(Some(100));
    let response = calibrate::measure(&bench, pulses, |part| {
        bar.set_position((100.0 * part) as u64)
    })?;
    bar.finish_and_clear();
    let calibration = response.calibration(
        pixel_um,
        pixel_um_sd,
        format!("{source}; axis and sign by PZT pulses"),
    );
    let gain_per_s = pulses.velocity_gain_per_s(&model.plant).abs();
    let pixel_of_model_um = gain_per_s / response.gain();
    let gain_ratio = pixel_um / pixel_of_model_um;
    let mut warnings = Vec::new();
    if !(1.0 / 1.3..=1.3).contains(&gain_ratio) {
        warnings.push(format!(
            "with {pixel_um:.4} um a pixel the bead moves {gain_ratio:.2} times as fast as the model {} says. Check the pixel size (the model would need {pixel_of_model_um:.4} um), the um per volt of the drive, and whether the model is of this chip",
            args.model
        ));
    }
    let (.., tilt_sd_deg) = response.direction();
    let text = format!(
        "# written by cellpos calibrate\npixel_um = {:?}\npixel_um_sd = {:?}\naxis = \"{}\"\nsign = {}\norigin_px = {:?}\n\
         tilt_deg = {:?}\norigin_across_px = {:?}\ndate = \"{}\"\nmethod = \"{}\"\n",
        calibration.pixel_um,
        calibration.pixel_um_sd,
        match calibration.axis {
            cellpos_drivers::Axis::X => "x",
            cellpos_drivers::Axis::Y => "y",
        },
        calibration.sign,
        calibration.origin_px,
        calibration.tilt_deg,
        calibration.origin_across_px,
        calibration.date,
        calibration.method
    );
    CalibrationFile::parse(&text, &args.out).map_err(Failure::failed)?;
    std::fs::write(&args.out, text).map_err(Failure::failed)?;
    calibrate::name_in_rig(&args.rig, &args.out)?;
    let done = Calibrated {
        out: args.out,
        calibration,
        response,
        tilt_sd_deg,
        pixel_of_model_um,
        gain_ratio,
        warnings,
    };
    if args.json {
        print_json(&done)?;
    } else {
        print_text(&done.to_string())?;
    }
    Ok(Outcome::Done)
}

impl std::fmt::Display for Calibrated {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (c, r) = (&self.calibration, &self.response);
        writeln!(
            f,
            "pixel   {:.5} um, standard deviation {:.5} um",
            c.pixel_um, c.pixel_um_sd
        )?;
        writeln!(
            f,
            "channel along {}, sign {:+}, tilt {:.2} degrees (standard deviation {:.2})",
            match c.axis {
                cellpos_drivers::Axis::X => "the rows (x)",
                cellpos_drivers::Axis::Y => "the columns (y)",
            },
            c.sign,
            c.tilt_deg,
            self.tilt_sd_deg
        )?;
        writeln!(
            f,
            "gain    {:.1} px/s per um of PZT, standard deviation {:.1}, from {} frames, {:.1} ms after the command; {:.2} times \
             the model's",
            r.gain(),
            r.sd_px_per_s,
            r.frames,
            r.lag_ms,
            self.gain_ratio
        )?;
        for warning in &self.warnings {
            writeln!(f, "warning: {warning}")?;
        }
        writeln!(
            f,
            "wrote   {}, which the rig file now names",
            self.out.display()
        )
    }
}
