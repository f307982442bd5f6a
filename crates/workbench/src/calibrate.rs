//! Axis, sign and tilt of the channel in the picture, from pulses of the PZT in open loop.
//!
//! The PZT sets the bead's velocity, v = K (x1 - neutral): pulses to both sides move it to and fro. The part of its motion that
//! correlates with the pulses is a vector in the picture, independent of drift and Brownian motion. Its direction is axis, sign and
//! tilt. Its length is K in pixels. If the pixel size is known, it is compared with the model, so a pixel size that is wrong by a
//! factor is noticed.

mod fit;

use crate::bench::Bench;
use crate::mover::{Mover, stopped};
use crate::rig_text::change;
use crate::watch::{Sighting, Watch};
use cellpos_plant::{Hertz, TransferFunction};
use cellpos_rig::Clock;
use cellpos_runtime::realtime;
use cellpos_session::{Failure, signals};
pub use fit::Response;
use fit::fit;
use std::f64::consts::TAU;
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;
use toml_edit::value;

/// Amplitude, duration and number of the pulses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pulses {
    /// Amplitude to each side of the PZT's present displacement, um.
    pub amplitude_um: f64,
    /// Of each side, ms.
    pub length_ms: u32,
    /// Pairs of pulses.
    pub pairs: u32,
}

impl Default for Pulses {
    /// 0.2 um for 15 ms: the bead moves 1.3 um at the paper's gain, a tenth of the view.
    fn default() -> Self {
        Self {
            amplitude_um: 0.2,
            length_ms: 15,
            pairs: 40,
        }
    }
}

impl Pulses {
    /// Velocity per displacement that these pulses show of a plant, 1/s. The regression of a velocity on a square wave weighs the real parts
    /// of the response at its odd harmonics by their power.
    pub fn velocity_gain_per_s(&self, plant: &TransferFunction) -> f64 {
        const HARMONICS: u32 = 32;
        let first_hz = 1e3 / (2.0 * f64::from(self.length_ms));
        let (mut gain, mut power) = (0.0, 0.0);
        for n in (0..HARMONICS).map(|k| f64::from(2 * k + 1)) {
            let hz = n * first_hz;
            gain -= TAU * hz * plant.response(Hertz(hz)).im / (n * n);
            power += 1.0 / (n * n);
        }
        gain / power
    }
}

/// Moves the PZT by pulses about its displacement and records the bead. The board is parked on success, error and panic.
///
/// # Errors
/// No camera, no board, no bead, a bead that does not move with the PZT.
pub fn measure(
    bench: &Bench,
    pulses: Pulses,
    mut progress: impl FnMut(f64),
) -> Result<Response, Failure> {
    const TRIES: usize = 3;
    let mut tried = 1;
    let response = loop {
        match pulsed(bench, pulses, &mut progress)? {
            Ok(response) => break response,
            // The pulses moved the bead out of the picture: wait for the next one.
            Err(_) if tried < TRIES => tried += 1,
            Err(seen) => {
                return Err(Failure::bad_input(
                    format!("a bead was seen in {seen} frames: too few, {TRIES} times in a row"),
                    "look with cellpos camera --rig RIG --snapshot frame.png --overlay; if it marks no bead: cellpos camera --rig RIG --find-beads beads.png",
                ));
            }
        }
    };
    if response.gain() < 5.0 * response.sd_px_per_s {
        return Err(Failure::bad_input(
            format!(
                "the bead does not move with the PZT: {:.1} px/s per um, standard deviation {:.1}",
                response.gain(),
                response.sd_px_per_s
            ),
            "is the amplifier on, the syringe filled and coupled, the bead free? More pulses: --pairs; larger ones: --amplitude",
        ));
    }
    Ok(response)
}

/// One attempt: the response, or the number of frames with a bead if they are too few.
fn pulsed(
    bench: &Bench,
    pulses: Pulses,
    progress: &mut impl FnMut(f64),
) -> Result<Result<Response, usize>, Failure> {
    let mut watch = Watch::of(bench)?;
    let mut mover = Mover::arm(bench.board()?, bench.file())?;
    let centre_um = mover.at_um();
    let a_um = pulses.amplitude_um;
    let (low_um, high_um) = (mover.limits().low_um, mover.limits().high_um);
    if !(centre_um - a_um >= low_um && centre_um + a_um <= high_um) {
        return Err(Failure::bad_input(
            format!(
                "the PZT is at {centre_um:.2} um, within limits of {low_um} to {high_um} um: no room for {a_um} um to both sides"
            ),
            "set park_um in [limits] of rig.toml near the middle of the range, then move there: cellpos jog --to",
        ));
    }
    let (commands, end_ns) = on_a_thread_of_its_own(&mut watch, &mut mover, pulses, progress)?;
    let_go(mover, signals::stopped_by)?;
    let size_px = watch.size_px();
    let sightings = watch.finish(end_ns)?;
    Ok(fit(&commands, &sightings, size_px).ok_or(sightings.len()))
}

/// Parks the PZT. Until then a signal asks for a stop, which a step refuses; after the last step only this does. From here on a signal
/// ends the program.
fn let_go(mover: Mover, stopped_by: impl FnOnce() -> Option<&'static str>) -> Result<(), Failure> {
    drop(mover);
    stopped_by().map_or(Ok(()), |signal| Err(stopped(signal)))
}

/// The commands, as time (ns) and offset from the PZT's displacement (um), and the time of the end.
type Commanded = (Vec<(i64, f64)>, i64);

/// Sends the pulses on a thread with the rights of the control thread, so that a busy machine neither prolongs a pulse nor loses frames.
fn on_a_thread_of_its_own(
    watch: &mut Watch,
    mover: &mut Mover,
    pulses: Pulses,
    progress: &mut impl FnMut(f64),
) -> Result<Commanded, Failure> {
    const LOOK_EVERY: Duration = Duration::from_millis(20);
    let done = AtomicU32::new(0);
    std::thread::scope(|scope| {
        let moving = std::thread::Builder::new()
            .name("cellpos-pulses".to_string())
            .spawn_scoped(scope, || {
                realtime::apply(&realtime::Request::io_thread(70));
                pulse(watch, mover, pulses, &done)
            })
            .map_err(Failure::failed)?;
        while !moving.is_finished() {
            let steps = f64::from(2 * pulses.length_ms * pulses.pairs);
            progress(f64::from(done.load(Ordering::Relaxed)) / steps.max(1.0));
            std::thread::sleep(LOOK_EVERY);
        }
        moving.join().unwrap_or_else(|_| {
            let what = "the thread of the pulses panicked; the PZT is parked";
            Err(Failure::failed(std::io::Error::other(what)))
        })
    })
}

/// Waits for a bead that is well in view, then moves the PZT to and fro about its present displacement.
fn pulse(
    watch: &mut Watch,
    mover: &mut Mover,
    pulses: Pulses,
    done: &AtomicU32,
) -> Result<Commanded, Failure> {
    let clock = Clock::Real;
    let (centre_um, a_um) = (mover.at_um(), pulses.amplitude_um);
    // Nothing moves until a bead is well in view: a bead at the border would leave the picture with the first pulse.
    for step in 0..FIND_MS {
        mover.step(centre_um, f64::INFINITY)?;
        watch.glance()?;
        let now_ns = clock.now_ns();
        if step >= SURE_MS && is_well_in_view(&watch.sightings, watch.size_px(), now_ns) {
            break;
        }
    }
    watch.sightings.clear();
    let mut commands = Vec::new();
    for step in 0..2 * pulses.length_ms * pulses.pairs {
        // Half a pulse first: to and fro about the same place.
        let is_up = ((step + pulses.length_ms / 2) / pulses.length_ms).is_multiple_of(2);
        let offset_um = if is_up { a_um } else { -a_um };
        mover.step(centre_um + offset_um, f64::INFINITY)?;
        commands.push((clock.now_ns(), offset_um));
        watch.put_aside()?;
        done.store(step, Ordering::Relaxed);
    }
    mover.step(centre_um, f64::INFINITY)?;
    Ok((commands, clock.now_ns()))
}

/// Longest wait for a bead that is well in view, ms: time for one bead to drift out and the next one to come in. After that any bead is
/// used.
const FIND_MS: u32 = 8_000;
/// Shortest wait, ms.
const SURE_MS: u32 = 100;

/// Whether a bead has just been seen in the middle half of the picture, in some frames in a row.
fn is_well_in_view(sightings: &[Sighting], size_px: [usize; 2], now_ns: i64) -> bool {
    const FRAMES: usize = 10;
    const FRESH_NS: i64 = 100_000_000;
    let [width, height] = size_px.map(|px| px as f64);
    let is_inner = |at: f64, size: f64| (0.25 * size..=0.75 * size).contains(&at);
    let last = sightings.len().checked_sub(FRAMES);
    last.and_then(|from| sightings.get(from..))
        .is_some_and(|last| {
            last.iter().all(|seen| {
                now_ns - seen.at_ns < FRESH_NS
                    && is_inner(seen.x_px, width)
                    && is_inner(seen.y_px, height)
            })
        })
}

/// Names a calibration file in a rig file, and removes a table `[calibration]` or another file's name. A file in the same folder is named
/// without path, so that both can be moved; any other by its full path.
///
/// # Errors
/// Either file cannot be read, or the rig file cannot be written.
pub fn name_in_rig(rig: &Path, calibration: &Path) -> Result<(), Failure> {
    let whole = |path: &Path| path.canonicalize().map_err(Failure::failed);
    let (rig_at, at) = (whole(rig)?, whole(calibration)?);
    let name = match at.file_name() {
        Some(name) if at.parent() == rig_at.parent() => Path::new(name),
        _ => at.as_path(),
    };
    let name = name.to_string_lossy().into_owned();
    change(rig, "calibration_file", |document| {
        document.remove("calibration");
        document["calibration_file"] = value(name);
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gain_of_a_plant_is_that_which_its_pulses_show() {
        // The paper's plant, integrated in steps of 0.1 ms, frames each ms.
        let plant = TransferFunction::eq6();
        let pulses = Pulses::default();
        let (k, b1, b0, a1, a0) = (0.01872, 20_261.5, 1_745_041.0, 76.3, 0.13);
        let (mut state, mut commands, mut sightings) = ([0.0_f64; 2], Vec::new(), Vec::new());
        for ms in 0..2 * pulses.length_ms * pulses.pairs {
            let is_up = ((ms + pulses.length_ms / 2) / pulses.length_ms).is_multiple_of(2);
            let u = if is_up { 0.2 } else { -0.2 };
            let at_ns = i64::from(ms) * 1_000_000;
            commands.push((at_ns, u));
            let um = k * ((b0 - a0) * state[0] + (b1 - a1) * state[1] + u);
            sightings.push(Sighting {
                at_ns,
                x_px: 10.0 * um,
                y_px: 0.0,
            });
            for _ in 0..10 {
                let slope = [state[1], u - a1 * state[1] - a0 * state[0]];
                state = [0, 1].map(|i| state[i] + 1e-4 * slope[i]);
            }
        }
        let shown = fit(&commands, &sightings, [256, 64]).expect("enough frames");
        let ratio = shown.gain() / 10.0 / pulses.velocity_gain_per_s(&plant);
        assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
    }

    #[test]
    fn a_stop_after_the_last_pulse_is_an_end_as_one_before_it() {
        let mut file = cellpos_session::RigFile::default();
        file.board.power_up_um = 20.0;
        let bench = Bench::of(file).expect("a bench");
        for (signal, says) in [(None, None), (Some("SIGINT"), Some("stopped by SIGINT"))] {
            let mover = Mover::arm(bench.board().expect("a board"), bench.file()).expect("armed");
            let ended = let_go(mover, || signal);
            let said = ended.err().map(|failure| format!("{failure:?}"));
            let as_asked = said
                .as_deref()
                .zip(says)
                .map(|(all, part)| all.contains(part));
            assert_eq!(as_asked, says.map(|_| true), "{said:?}");
            assert_eq!(said.is_some(), says.is_some(), "{said:?}");
        }
    }

    #[test]
    fn a_rig_file_names_its_calibration_and_keeps_every_comment_elsewhere() {
        let folder = tempfile::tempdir().expect("a folder");
        let (rig, other) = (folder.path().join("rig.toml"), folder.path().join("other"));
        std::fs::create_dir(&other).expect("a folder");
        let text = "# my rig\n[camera]           # mine\nkind = \"emulated\"\n\n[calibration]      # a guess\npixel = \"0.1um\"\n\n\
                    [limits]           # of the command\npark = \"20um\"\n";
        std::fs::write(&rig, text).expect("written");
        for place in [folder.path(), &other, folder.path()] {
            let file = place.join("calibration.toml");
            std::fs::write(
                &file,
                "pixel_um = 0.11\npixel_um_sd = 0.001\naxis = \"x\"\nsign = 1\norigin_px = 100.5\ndate = \"2026-11-25\"\nmethod = \"test\"\n",
            )
            .expect("written");
            name_in_rig(&rig, &file).expect("named");
            let new = std::fs::read_to_string(&rig).expect("there");
            for kept in ["# my rig", "# mine", "# of the command"] {
                assert!(new.contains(kept), "lost {kept:?} in\n{new}");
            }
            assert!(!new.contains("[calibration]") && new.matches("calibration_file").count() == 1);
            let read = cellpos_session::RigFile::load(Some(&rig));
            let read = read.unwrap_or_else(|error| panic!("{error:?}\n{new}"));
            assert_eq!(read.calibration.expect("named").pixel_um, 0.11);
        }
    }

    #[test]
    fn only_a_bead_in_the_middle_half_that_is_seen_now_is_well_in_view() {
        let seen = |x_px: f64, y_px: f64| -> Vec<Sighting> {
            let at = |k: i64| Sighting {
                at_ns: k * 1_000_000,
                x_px,
                y_px,
            };
            (0..20).map(at).collect()
        };
        let is_well = |sightings: &[Sighting], now_ms: i64| {
            is_well_in_view(sightings, [256, 32], now_ms * 1_000_000)
        };
        assert!(is_well(&seen(100.0, 15.0), 25));
        assert!(!is_well(&seen(100.0, 15.0), 500), "long ago");
        assert!(!is_well(&seen(230.0, 15.0), 25), "at the right border");
        assert!(!is_well(&seen(100.0, 3.0), 25), "at the upper border");
        assert!(!is_well(&seen(100.0, 15.0)[..5], 25), "too few");
        let mut moving = seen(100.0, 15.0);
        moving.extend(seen(250.0, 15.0));
        assert!(!is_well(&moving, 25));
    }
}
