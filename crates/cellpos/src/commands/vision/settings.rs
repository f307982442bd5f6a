//! Settings for beads: given, of a rig, or found in the recording.

use super::advice::Advice;
use super::{Args, Reader};
use crate::outcome::Failure;
use cellpos_rig::FrameBuffer;
use cellpos_session::rig_file::RigFile;
use cellpos_vision::suggest::{refine, suggest};
use cellpos_vision::{Frame, Learning, Localiser, LocaliserConfig, Polarity, ProfileSpec};

/// Frames that settings are found in, spread over the recording.
const LOOKED_AT: usize = 20;
/// Farthest that a bead moves between frames where nobody says, px.
const MAX_STEP_PX: f64 = 6.0;

/// Settings of the search for beads.
#[derive(Debug)]
pub(super) struct BeadSettings {
    pub config: LocaliserConfig,
    pub max_step_px: f64,
    /// What is to be said of settings that were found.
    pub advice: Option<Advice>,
}

/// The settings for the beads of this recording.
pub(super) fn of_beads(args: &Args, reader: &mut Reader) -> Result<BeadSettings, Failure> {
    if let Some(step) = args.max_step_px
        && !(step.is_finite() && step > 0.0)
    {
        let error = format!("--max-step-px {step}: a bead must be allowed to move");
        return Err(Failure::bad_input(error, "give a distance above 0 px"));
    }
    if let Some(path) = &args.rig {
        let file = RigFile::load(Some(path))?;
        return Ok(BeadSettings {
            config: file.bead_settings()?,
            max_step_px: args.max_step_px.unwrap_or(MAX_STEP_PX),
            advice: None,
        });
    }
    let given = match (args.edge_px, args.sigma_px) {
        (Some(edge_px), _) => Some((ProfileSpec::Ring { edge_px }, edge_px)),
        (None, Some(sigma_px)) => Some((ProfileSpec::Gaussian { sigma_px }, 2.0 * sigma_px)),
        (None, None) => None,
    };
    let Some((profile, radius_px)) = given else {
        return found(args, reader, None);
    };
    let mut config = LocaliserConfig::new(profile);
    config.window_px = args.window_px.unwrap_or(config.window_px);
    if args.dark {
        config.polarity = Polarity::Dark;
    }
    config.template_tolerance = args.template_tolerance.unwrap_or(0.15);
    // Checked before a frame is read: the settings are the user's.
    let rough = Localiser::new(config.clone()).map_err(Failure::input)?;
    if !args.no_learning {
        // Where nothing can be learnt the given profile stays, and learns as it goes.
        if let Ok(settings) = found(args, reader, Some((&rough, radius_px))) {
            return Ok(settings);
        }
        config.learning = Some(Learning::default());
    }
    Ok(BeadSettings {
        config,
        max_step_px: args.max_step_px.unwrap_or(MAX_STEP_PX),
        advice: None,
    })
}

/// Settings out of frames spread over the recording, near those given if any are.
fn found(
    args: &Args,
    reader: &mut Reader,
    given: Option<(&Localiser, f64)>,
) -> Result<BeadSettings, Failure> {
    let stride = reader.frames.div_ceil(LOOKED_AT).max(1);
    let mut buffers = Vec::new();
    for n in (0..reader.frames).step_by(stride) {
        let mut buffer = FrameBuffer::default();
        reader.read(n, &mut buffer)?;
        buffers.push(buffer);
    }
    let frames: Vec<Frame> = buffers.iter().map(FrameBuffer::frame).collect();
    let found = match given {
        Some((rough, _)) => refine(&frames, rough),
        None => suggest(&frames),
    }
    .map_err(|error| {
        Failure::bad_input(
            format!("{}: {error}", args.source.display()),
            "give the size of the beads with --edge-px or --sigma-px, a part of the frame with --region, or look for --cells",
        )
    })?;
    let mut config = found.config.clone();
    if let Some(window_px) = args.window_px {
        config.window_px = window_px;
    }
    if let Some(tolerance) = args.template_tolerance {
        config.template_tolerance = tolerance;
    }
    Ok(BeadSettings {
        max_step_px: args.max_step_px.unwrap_or(found.max_step_px),
        advice: Some(Advice::of(&found, given.map(|g| g.1))),
        config,
    })
}
