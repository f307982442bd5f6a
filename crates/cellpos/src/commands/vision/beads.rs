//! All beads of a recording.

use super::settings::BeadSettings;
use super::{Reader, end_row};
use crate::commands::vision_sheet::Sheet;
use crate::commands::vision_summary::{Tally, verdict_name};
use crate::outcome::Failure;
use cellpos_drivers::CalibrationFile;
use cellpos_rig::FrameBuffer;
use cellpos_vision::{FixQuality, LinkConfig, Localiser, ManyTracker};
use std::fmt::Write as _;
use std::time::Instant;

/// Most beads in a frame; a frame with more is counted as `crowded`.
const MOST_BEADS: usize = 20_000;

/// Follows all beads; gives the table of their positions.
pub(super) fn find(
    settings: &BeadSettings,
    calibration: Option<&CalibrationFile>,
    reader: &mut Reader,
    sheet: &mut Sheet,
    tally: &mut Tally,
) -> Result<String, Failure> {
    let localiser = Localiser::new(settings.config.clone()).map_err(Failure::input)?;
    let radius_px = localiser.template().radius_px();
    let link = LinkConfig {
        max_step_px: settings.max_step_px,
        memory_frames: 5,
        max_beads: MOST_BEADS,
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
    for n in 0..reader.frames {
        reader.read(n, &mut buffer)?;
        let number = reader.number(n);
        let frame = buffer.frame();
        let start = Instant::now();
        tracker.step(&frame);
        tally.time_us.push(start.elapsed().as_secs_f64() * 1e6);
        let sights = tracker.sights();
        for s in sights {
            let f = &s.fix;
            let _ = write!(
                csv,
                "{number},{},{:.5},{:.5},{:.5},{:.5},{:.2},{:.2},{:.2},{:.3},{}",
                s.bead,
                f.x_px,
                f.y_px,
                f.var_x_px2.sqrt(),
                f.var_y_px2.sqrt(),
                f.amplitude,
                f.background,
                f.snr,
                f.residual_ratio,
                verdict_name(f.verdict)
            );
            end_row(&mut csv, calibration, f.x_px, f.y_px);
            tally.fix(n, s.bead, f);
        }
        for fix in tracker.refused() {
            tally.refuse(verdict_name(fix.verdict));
        }
        if tracker.is_crowded() {
            tally.refuse("crowded");
        }
        let good = sights.iter().filter(|s| s.fix.verdict == FixQuality::Good);
        tally.frame(good.count());
        let marks = sights
            .iter()
            .map(|s| (Some(s.bead), s.fix))
            .chain(tracker.refused().iter().map(|fix| (None, *fix)))
            .map(|(bead, fix)| {
                let good = fix.verdict == FixQuality::Good;
                (bead, fix.x_px, fix.y_px, radius_px, good)
            });
        sheet.add(n, &frame, marks);
    }
    Ok(csv)
}
