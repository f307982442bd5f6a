//! A recording through the loop's tracker, frame by frame.

use super::{Args, out_folder, write};
use crate::commands::vision_summary::verdict_name;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use cellpos_drivers::sources::{self, Playback};
use cellpos_rig::Clock;
use cellpos_session::rig_file::RigFile;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// Time after which a recording that is read from a slow disk counts as stuck, ns.
const PATIENCE_NS: i64 = 10_000_000_000;

/// Result of the loop's tracker.
#[derive(Debug, Serialize)]
struct Seen {
    source: String,
    rig: String,
    rate_hz: f64,
    frames: usize,
    lost_frames: u64,
    /// Frames that gave the loop a position.
    positions: usize,
    /// Frames by the tracker's decision.
    decisions: BTreeMap<String, u64>,
    /// Median standard deviation of the positions, um.
    sd_um: Option<f64>,
    out: String,
}

/// Plays the recording on a virtual clock.
pub(super) fn run(args: &Args, rig: &Path) -> CommandResult {
    let file = RigFile::load(Some(rig))?;
    let recording = sources::open(&args.source).map_err(Failure::input)?;
    let info = recording.info().clone();
    let out = out_folder(args)?;
    let clock = Clock::virtual_at(0);
    let rate_hz = args.rate_hz.or(info.rate_hz).unwrap_or(1000.0);
    let playback = Playback::new(recording, Some(rate_hz), args.region, clock.clone())
        .map_err(Failure::input)?;
    let mut source = file.watch(playback, &clock)?;
    let frames = args.frames.unwrap_or(info.frames).min(info.frames);
    let mut csv = String::from(
        "frame,time_s,track,decision,verdict,bead_um,sd_um,snr,length_um,length_sd_um,area_um2,area_sd_um2\n",
    );
    let mut decisions = BTreeMap::new();
    let mut sds = Vec::new();
    for _ in 0..frames {
        // Frames that are missing leave a gap in time, in which the source returns without one.
        let deadline_ns = clock.now_ns() + PATIENCE_NS;
        let Some(m) = source.next(deadline_ns).map_err(Failure::failed)? else {
            continue;
        };
        let (state, decision) = m.track.map_or(
            ("none".to_string(), "none".to_string()),
            |(state, decision)| (format!("{state:?}"), format!("{decision:?}")),
        );
        let empty = |v: f64| {
            if v.is_finite() {
                format!("{v:.5}")
            } else {
                String::new()
            }
        };
        let _ = writeln!(
            csv,
            "{},{:.6},{state},{decision},{},{},{},{},{},{},{},{}",
            m.frame_id - 1,
            m.mid_exposure_ns as f64 * 1e-9,
            verdict_name(m.verdict),
            empty(m.position_um),
            empty(m.variance_um2.sqrt()),
            empty(m.snr),
            empty(m.length_um),
            empty(m.length_sd_um),
            empty(m.area_um2),
            empty(m.area_sd_um2),
        );
        *decisions.entry(decision).or_default() += 1;
        if m.is_usable() {
            sds.push(m.variance_um2.sqrt());
        }
    }
    sds.sort_by(f64::total_cmp);
    std::fs::create_dir_all(&out).map_err(|e| super::cannot_write(&out, &e))?;
    write(&out.join("as-loop.csv"), csv.as_bytes())?;
    let seen = Seen {
        source: info.path.display().to_string(),
        rig: rig.display().to_string(),
        rate_hz,
        frames,
        lost_frames: info.lost,
        positions: sds.len(),
        decisions,
        sd_um: sds.get(sds.len() / 2).copied(),
        out: out.display().to_string(),
    };
    let json = serde_json::to_string_pretty(&seen).map_err(Failure::failed)?;
    write(&out.join("summary.json"), json.as_bytes())?;
    if args.json {
        print_json(&seen)?;
    } else {
        print_text(&seen.to_string())?;
    }
    Ok(if seen.positions > 0 {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

impl std::fmt::Display for Seen {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(
            f,
            "{} as the loop of {} sees it, {} frames/s",
            self.source, self.rig, self.rate_hz
        )?;
        writeln!(
            f,
            "frames             {} ({} lost)",
            self.frames, self.lost_frames
        )?;
        writeln!(f, "positions          {}", self.positions)?;
        for (decision, count) in &self.decisions {
            writeln!(f, "{decision:19}{count}")?;
        }
        if let Some(sd_um) = self.sd_um {
            writeln!(f, "standard deviation {:.4} um (median)", sd_um)?;
        }
        writeln!(
            f,
            "written            {}/as-loop.csv, summary.json",
            self.out
        )
    }
}
