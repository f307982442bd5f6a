//! `cellpos background`: frames of the empty channel, for following cells.

use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::rig_file::{CameraConfig, RigFile};
use cellpos_drivers::background;
use cellpos_rig::{Camera, Clock, FrameBuffer};
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `cellpos background`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  cellpos background --rig rig.toml --out empty.tif\n\n\
    The channel must be empty and lit as in the experiment; then write into rig.toml:\n  [cell]\n  background = \"empty.tif\""
)]
pub(crate) struct Args {
    /// Camera of this rig.toml.
    #[arg(long)]
    rig: PathBuf,
    /// New TIFF stack.
    #[arg(long)]
    out: PathBuf,
    /// Frames to take.
    #[arg(long, default_value_t = 100)]
    frames: usize,
    /// Print one JSON object on standard output.
    #[arg(long)]
    json: bool,
}

/// What was taken.
#[derive(Debug, Serialize)]
struct Taken {
    camera: String,
    out: PathBuf,
    frames: usize,
    width_px: usize,
    height_px: usize,
    bits: u16,
    /// Noise of a pixel, grey levels RMS.
    noise_grey: f64,
    /// Contrast that a pixel of a cell must have at least, grey levels.
    threshold_grey: f64,
}

/// How long a frame may let wait.
const PATIENCE_NS: i64 = 2_000_000_000;

/// Takes the frames, looks whether the channel is empty, writes the stack.
pub(crate) fn run(args: Args) -> CommandResult {
    if args.frames < 2 {
        return Err(Failure::bad_input(
            format!("--frames {}: 2 or more are needed", args.frames),
            "100 are better: their mean is what cells are compared with",
        ));
    }
    if args.out.exists() {
        return Err(Failure::bad_input(
            format!(
                "{}: exists already; nothing is overwritten",
                args.out.display()
            ),
            "give another file with --out",
        ));
    }
    let file = RigFile::load(Some(&args.rig))?;
    if matches!(file.camera, CameraConfig::Emulated {}) {
        return Err(Failure::bad_input(
            format!(
                "{}: the emulated camera brings its own background",
                args.rig.display()
            ),
            "leave [cell] background out; this command is for [camera] kind = \"socket\" or \"industrial\"",
        ));
    }
    let mut camera = file.open_camera()?;
    let frames = take(camera.as_mut(), args.frames)?;
    let name = camera.info().name;
    let config = file.cell.unwrap_or_default().finder;
    let finder = background::finder(&frames, &name, config).map_err(|error| {
        Failure::bad_input(
            error,
            "flush the channel, let the light settle, and record again",
        )
    })?;
    background::save(&args.out, &frames).map_err(Failure::failed)?;
    let first = frames.first();
    let taken = Taken {
        camera: name,
        out: args.out,
        frames: frames.len(),
        width_px: first.map_or(0, |frame| frame.width),
        height_px: first.map_or(0, |frame| frame.height),
        bits: first.map_or(0, |frame| frame.bits),
        noise_grey: finder.noise_grey(),
        threshold_grey: config.threshold_sigma * finder.noise_grey(),
    };
    if args.json {
        print_json(&taken)?;
    } else {
        print_text(&format!(
            "{}: {} frames of {} x {} px, {} bits, of {}\nnoise {:.2} grey levels; a pixel belongs to a cell from {:.1} on\n",
            taken.out.display(),
            taken.frames,
            taken.width_px,
            taken.height_px,
            taken.bits,
            taken.camera,
            taken.noise_grey,
            taken.threshold_grey,
        ))?;
    }
    Ok(Outcome::Done)
}

fn take(camera: &mut dyn Camera, count: usize) -> Result<Vec<FrameBuffer>, Failure> {
    let clock = Clock::Real;
    let mut frames = Vec::with_capacity(count);
    while frames.len() < count {
        let mut frame = FrameBuffer::default();
        let deadline_ns = clock.now_ns() + PATIENCE_NS;
        match camera.next_frame(&mut frame, deadline_ns) {
            Ok(Some(_)) => frames.push(frame),
            Ok(None) => {
                return Err(Failure::bad_input(
                    format!(
                        "{}: no frame for {} s, {} of {count} taken",
                        camera.info().name,
                        PATIENCE_NS / 1_000_000_000,
                        frames.len()
                    ),
                    "test it with cellpos camera",
                ));
            }
            Err(error) => return Err(Failure::failed(error)),
        }
    }
    Ok(frames)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::Value;

    /// The output of `--json` follows its schema (tested here, because this command needs a camera).
    #[test]
    fn the_object_fits_its_schema() {
        let taken = Taken {
            camera: "a camera".to_owned(),
            out: "empty.tif".into(),
            frames: 100,
            width_px: 256,
            height_px: 32,
            bits: 8,
            noise_grey: 1.5,
            threshold_grey: 6.0,
        };
        let object = serde_json::to_value(&taken).unwrap();
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../docs/schemas/cellpos.background.json"
        );
        let schema: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
        let properties = schema["properties"].as_object().unwrap();
        assert_eq!(properties.len(), 2 + object.as_object().unwrap().len());
        for (key, value) in object.as_object().unwrap() {
            let kind = if value.is_number() {
                "number"
            } else {
                "string"
            };
            assert_eq!(properties[key]["type"][0], kind, "{key}");
            let required = schema["required"].as_array().unwrap();
            assert!(required.iter().any(|name| name == key), "{key}");
        }
    }
}
