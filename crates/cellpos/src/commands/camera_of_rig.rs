//! What `cellpos camera` does with the camera of a rig file: a picture, a recording, the settings of vision.

use super::vision::vision_table;
use crate::outcome::{CommandResult, Failure, Outcome, print_json, print_text};
use crate::rig_file::RigFile;
use cellpos_workbench::beads::{self, FoundBeads};
use cellpos_workbench::capture::{self, Capture, Recorded};
use cellpos_workbench::{Bench, snapshot};
use image::RgbImage;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What is asked for; one of the three, as the command line sees to.
pub(super) struct Job<'a> {
    pub(super) rig: &'a Path,
    pub(super) snapshot: Option<&'a Path>,
    pub(super) overlay: bool,
    pub(super) record: Option<&'a Path>,
    pub(super) find_beads: Option<&'a Path>,
    pub(super) duration_s: f64,
    pub(super) json: bool,
}

/// Does it.
pub(super) fn run(job: &Job) -> CommandResult {
    match (job.record, job.find_beads, job.snapshot) {
        (Some(folder), ..) => record(job, folder),
        (_, Some(path), _) => find_beads(job, path),
        (_, _, Some(path)) => take_snapshot(job, path),
        _ => Err(Failure::bad_input(
            "--rig: say what to do with its camera",
            "add --snapshot FILE, --record FOLDER or --find-beads FILE",
        )),
    }
}

fn bench(job: &Job) -> Result<Bench, Failure> {
    Bench::of(RigFile::load(Some(job.rig))?)
}

fn save(picture: &RgbImage, path: &Path) -> Result<(), Failure> {
    picture.save(path).map_err(|error| {
        Failure::bad_input(
            format!("{}: {error}", path.display()),
            "name a file that ends in .png",
        )
    })
}

/// A picture is written last: a name that cannot be one is refused first.
fn picture_ready(path: &Path) -> Result<(), Failure> {
    if path
        .extension()
        .is_none_or(|ending| !ending.eq_ignore_ascii_case("png"))
    {
        return Err(Failure::bad_input(
            format!("{}: not the name of a picture", path.display()),
            "name a file that ends in .png",
        ));
    }
    crate::output::ready([&path.to_path_buf()])
}

/// Name of a recording in JSON.
#[derive(Debug, Serialize)]
struct Recording {
    folder: PathBuf,
    #[serde(flatten)]
    recorded: Recorded,
}

/// Records every frame.
fn record(job: &Job, folder: &Path) -> CommandResult {
    capture::new_folder(folder)?;
    let bench = bench(job)?;
    let recorded = Capture::of(&bench, job.duration_s)?.write(folder)?;
    let lost = recorded.lost;
    let recording = Recording {
        folder: folder.to_path_buf(),
        recorded,
    };
    if job.json {
        print_json(&recording)?;
    } else {
        let r = &recording.recorded;
        print_text(&format!(
            "{}: {} frames of {} x {} px, {} bits, in {:.2} s ({:.1} Hz) of {}\nlost        {} (their numbers are left out), {} came twice\n\
             next        cellpos vision {}\n",
            folder.display(),
            r.frames,
            r.width_px,
            r.height_px,
            r.bits,
            r.duration_s,
            r.rate_hz,
            r.camera,
            r.lost,
            r.repeated,
            folder.display()
        ))?;
    }
    Ok(if lost == 0 {
        Outcome::Done
    } else {
        Outcome::Broken
    })
}

/// What was found, and where it was written.
#[derive(Debug, Serialize)]
struct Found {
    rig: PathBuf,
    picture: PathBuf,
    /// Whether the rig file had a table `[vision]`.
    replaced: bool,
    #[serde(flatten)]
    found: FoundBeads,
}

/// Finds the settings of vision with the live camera and writes them.
fn find_beads(job: &Job, path: &Path) -> CommandResult {
    picture_ready(path)?;
    let bench = bench(job)?;
    let (found, picture) = beads::find(&bench, job.duration_s)?;
    save(&picture, path)?;
    let found = found?;
    let replaced = beads::write_vision(job.rig, &found.vision)?;
    let found = Found {
        rig: job.rig.to_path_buf(),
        picture: path.to_path_buf(),
        replaced,
        found,
    };
    if job.json {
        print_json(&found)?;
    } else {
        print_text(&found.to_string())?;
    }
    Ok(Outcome::Done)
}

impl std::fmt::Display for Found {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (found, sight) = (&self.found, &self.found.sight);
        let [at_border, other, bad_fit] = found.refused;
        writeln!(
            f,
            "{}: {} of {} objects are beads; {other} of another size or contrast, {at_border} at the border, {bad_fit} not round like \
             these",
            found.camera, found.taken, found.objects
        )?;
        writeln!(
            f,
            "seen        in {} of {} frames by the loop's tracker, {:.0} times the noise, to {:.3} px",
            sight.seen, sight.frames, sight.snr, sight.stated_px
        )?;
        let rests = if found.rests {
            ", less than its radius, as dirt would: move it (cellpos jog) and look again"
        } else {
            ""
        };
        writeln!(f, "moved       by {:.1} px{rests}", sight.way_px)?;
        writeln!(
            f,
            "picture     {}: is the marked object the bead?",
            self.picture.display()
        )?;
        writeln!(
            f,
            "written     {}: [vision]{}\n\n{}",
            self.rig.display(),
            if self.replaced {
                ", in place of the one that was there"
            } else {
                ""
            },
            vision_table(&found.vision)
        )
    }
}

/// Writes a frame of a rig's camera as a picture.
fn take_snapshot(job: &Job, path: &Path) -> CommandResult {
    picture_ready(path)?;
    let overlay = job.overlay;
    let (snapshot, picture) = snapshot::take(&bench(job)?, overlay)?;
    save(&picture, path)?;
    if job.json {
        print_json(&snapshot)?;
        return Ok(Outcome::Done);
    }
    let [low, high, full] = snapshot.grey;
    let mut text = format!(
        "{}: {} x {} px of {}, grey levels {low} to {high} of {full}\n",
        path.display(),
        snapshot.width_px,
        snapshot.height_px,
        snapshot.camera
    );
    match (&snapshot.seen, overlay) {
        (Some(seen), _) => {
            text += &format!(
                "seen at column {:.1}, row {:.1}, {:.0} times the noise",
                seen.x_px, seen.y_px, seen.snr
            );
            if let Some(um) = seen.position_um {
                text += &format!(", {um:.2} um along the channel");
            }
            text.push('\n');
        }
        (None, true) => {
            text += &format!(
                "no bead or cell was seen for 5 s. With a bead in view and in focus:\n\
                 cellpos camera --rig {rig} --find-beads beads.png    finds what it looks like and writes [vision]\n\
                 cellpos camera --rig {rig} --record beads/ --duration 5s    records frames for cellpos vision beads/\n\
                 docs/rig.md, Light and focus, says what a good picture is\n",
                rig = job.rig.display()
            );
        }
        (None, false) => {}
    }
    if high >= full {
        text += "some pixels are white: less light, or a shorter exposure\n";
    }
    print_text(&text)?;
    let wanted_in_vain = overlay && snapshot.seen.is_none();
    Ok(if wanted_in_vain {
        Outcome::Broken
    } else {
        Outcome::Done
    })
}
