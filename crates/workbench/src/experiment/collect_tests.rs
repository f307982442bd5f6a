//! Verdicts of `cellpos reconcile --collect` on an emulated rig that hides one effect: values and intervals against the truth.
//!
//!     cargo test -p cellpos-workbench --lib table_of_hidden_effects -- --ignored --nocapture
//!
//! `HIDDEN=leak` runs the rows whose id contains it, `SEEDS=5` the seeds 1 to 5 (2 without it), `FIRST=100` the seeds from 100 on.
//! `KEEP=DIR` keeps the collected records there and, if they are there already, reconciles these in place of a new collection.
//!
//! Every seed is a different rig. Its zero flow wanders by 2 to 20 nm in 5 to 50 s and drifts by up to 5 nm/s. Its camera's clock is up
//! to 15 ppm off and stalls now and then. Light and focus differ.

use super::{
    Collecting, EXPOSURE, FRAME_AGE, FRAME_CAME, LATE_COMMAND, LATE_MOTION, SLEW, look, neutral_um,
    refused,
};
use crate::experiment::on_rig::OnRig;
use cellpos_emulator::{FaultEvent, FaultKind, WorldConfig};
use cellpos_numeric::Random;
use cellpos_plant::effects::{self, Effect};
use cellpos_plant::{Hertz, Model};
use cellpos_reconcile::{Options, Reconciliation, Record, reconcile};
use cellpos_session::Failure;
use cellpos_session::rig_file::{Frames, RigFile};
use std::path::Path;

/// An id, the hidden effect, and the numbers that must be inside their intervals.
type Row = (&'static str, Option<Effect>, &'static [(&'static str, f64)]);

/// One effect each, and nothing.
fn rows() -> Vec<Row> {
    vec![
        ("nothing", None, &[]),
        (
            "gain-error",
            Some(effects::gain_error(0.8)),
            &[("factor", 0.8)],
        ),
        (
            "driver-lag",
            Some(effects::driver_lag(120.0)),
            &[("bandwidth_hz", 120.0)],
        ),
        (
            "pzt-resonance",
            Some(effects::pzt_resonance(280.0, 0.1)),
            &[("frequency_hz", 280.0), ("damping", 0.1)],
        ),
        (
            "pzt-hysteresis",
            Some(effects::bouc_wen(0.3, 5.0, 0.0)),
            &[("fraction", 0.3)],
        ),
        (
            "pdms-relaxation",
            Some(effects::pdms_relaxation(0.3, 0.2)),
            &[("time_s", 0.3), ("strength", 0.2)],
        ),
        (
            "pzt-creep",
            Some(effects::pzt_creep(0.06)),
            &[("per_decade", 0.06)],
        ),
        (
            "saturation",
            Some(effects::saturation(19.4, 20.6)),
            &[("low_um", 19.4), ("high_um", 20.6)],
        ),
        (
            "leak",
            Some(effects::leak(2.0)),
            &[("corner_rad_per_s", 2.0)],
        ),
        (
            "backlash",
            Some(effects::backlash(0.1)),
            &[("width_um", 0.1)],
        ),
        (
            "mains-hum",
            Some(effects::mains_hum(50.0, 0.1, 0.0)),
            &[("hz", 50.0), ("um", 0.1)],
        ),
        (
            "frame-drops",
            Some(effects::frame_drops(0.05)),
            &[("rate", 0.05)],
        ),
        (
            "wall-adhesion",
            Some(effects::wall_adhesion(40.0)),
            &[("speed_um_per_s", 40.0)],
        ),
        (
            "slew-limit",
            Some(effects::slew_limit(1500.0)),
            &[("rate_um_per_s", 1500.0)],
        ),
        (
            "frame-repeats",
            Some(effects::frame_repeats(0.05)),
            &[("rate", 0.05)],
        ),
        (
            "stiffening",
            Some(effects::stiffening(0.1)),
            &[("per_um2", 0.1)],
        ),
        (
            "pump-pulsation",
            Some(effects::pump_pulsation(3.0, 0.2, 0.3, 40.0)),
            &[("hz", 3.0), ("um", 0.2)],
        ),
        (
            "camera-shake",
            Some(effects::camera_shake(30.0, 0.1, 0.3)),
            &[("frequency_hz", 30.0), ("damping", 0.1), ("share", 0.3)],
        ),
        (
            "gain-drift",
            Some(effects::gain_drift(-0.004)),
            &[("per_s", -0.004)],
        ),
    ]
}

/// A different imperfect rig for every seed.
fn rig_of(seed: u64, model: String) -> WorldConfig {
    let mut random = Random::stream(seed, 77);
    let mut between = |low: f64, high: f64| low * (high / low).powf(random.uniform());
    let (wander_um, time_s) = (between(0.002, 0.02), between(5.0, 50.0));
    let (focus, slope) = (between(0.002, 0.01), between(0.05, 0.2));
    let stall_s = between(0.002, 0.02);
    let mut sign = || if random.uniform() < 0.5 { -1.0 } else { 1.0 };
    let (drift_sign, clock_sign) = (sign(), sign());
    let mut config = WorldConfig {
        model,
        seed,
        zero_flow_wander_um: Some(wander_um),
        zero_flow_wander_time_s: Some(time_s),
        zero_flow_drift_um_per_s: Some(drift_sign * 0.005 * random.uniform()),
        camera_clock_ppm: Some(15.0 * clock_sign),
        focus_wander: Some(focus),
        light_slope: Some(slope),
        ..WorldConfig::real()
    };
    println!(
        "{:>21} rig: {:.1} nm in {time_s:.0} s, drift {:.1} nm/s, clock {:.0} ppm, stalls {:.0} ms",
        "",
        1e3 * wander_um,
        1e3 * config.zero_flow_drift_um_per_s.unwrap_or(0.0),
        15.0 * clock_sign,
        1e3 * stall_s
    );
    config.faults.event = (0..8)
        .map(|k| FaultEvent {
            kind: FaultKind::StallCamera,
            at_s: 4.0 + 6.0 * f64::from(k) + 4.0 * random.uniform(),
            for_s: Some(stall_s),
        })
        .collect();
    config
}

/// Records that an earlier run kept in a folder.
fn kept(folder: &Path) -> Vec<Record> {
    let mut files: Vec<_> = std::fs::read_dir(folder).map_or_else(
        |_| Vec::new(),
        |entries| entries.flatten().map(|e| e.path()).collect(),
    );
    files.retain(|p| p.extension().is_some_and(|e| e == "csv"));
    // In the order in which they were collected.
    files.sort_by_key(|p| std::fs::metadata(p).and_then(|m| m.modified()).ok());
    files
        .iter()
        .map(|path| {
            let read = cellpos_table::Record::read(path, &cellpos_table::Mapping::default())
                .unwrap_or_else(|e| panic!("{e}"));
            let time_s: Vec<f64> = (0..read.len()).map(|k| read.time_s(k)).collect();
            let mut record = Record::from_rows(&read.name, &time_s, &read.pzt_um, &read.bead_um)
                .unwrap_or_else(|e| panic!("{e}"));
            record.frame_age_s = read.column(FRAME_AGE).unwrap_or_default().to_vec();
            if let Some(late) = read.column(LATE_COMMAND) {
                record.late_command = late.iter().map(|late| *late == 1.0).collect();
            }
            record.late_motion_um = read.column(LATE_MOTION).unwrap_or_default().to_vec();
            record.exposure_s = read.column(EXPOSURE).map_or(0.0, |c| c[0]);
            record.slew_um_per_s = read.column(SLEW).map_or(0.0, |c| c[0]);
            if let Some(came) = read.column(FRAME_CAME) {
                record.unseen = (came.iter().zip(&record.bead_um))
                    .map(|(came, bead)| *came == 1.0 && bead.is_nan())
                    .collect();
            }
            record
        })
        .collect()
}

/// Reconciles the records of an earlier run.
fn again(records: &[Record]) -> Result<Reconciliation, Failure> {
    let mut model = Model::eq6();
    let options = Options {
        free_working_point: true,
        ..Options::default()
    };
    if let Some(first) = records.first() {
        model.working_point_um = neutral_um(first, model.plant.velocity_gain_at(Hertz(2.0)));
    }
    reconcile(&model, records, &options, &mut |_| {}).map_err(refused)
}

/// Collects and reconciles, as the command does.
fn collected(hidden: &Option<Effect>, seed: u64, folder: &Path) -> Result<Reconciliation, Failure> {
    let mut world = Model {
        working_point_um: 20.0,
        ..Model::eq6()
    };
    world.effects.extend(hidden.clone());
    let path = folder.join("hidden.toml");
    std::fs::write(&path, world.to_toml_string()).map_err(Failure::failed)?;
    let file = RigFile {
        emulator: rig_of(seed, path.display().to_string()),
        ..RigFile::default()
    };
    let mut model = Model::eq6();
    let rig = OnRig::new(file, model.clone(), None, Frames::On, false)?;
    let collecting = Collecting {
        rig: &rig,
        folder,
        rounds: 2,
        share: 1.0,
        seed,
    };
    let mut records = Vec::new();
    let options = Options::default();
    look(&mut model, &mut records, &options, &collecting, &mut |_| {}).map(|found| found.0)
}

#[test]
#[ignore = "a table: twelve effects and none, some minutes"]
fn table_of_hidden_effects() {
    let asked = std::env::var("HIDDEN").unwrap_or_default();
    let number = |name: &str, or: u64| {
        std::env::var(name).map_or(or, |s| s.parse().unwrap_or_else(|e| panic!("{name}: {e}")))
    };
    let (seeds, from) = (number("SEEDS", 2), number("FIRST", 1));
    let keep = std::env::var_os("KEEP");
    let (mut right, mut runs) = (0, 0);
    for (id, hidden, truth) in rows() {
        if !id.contains(&asked) {
            continue;
        }
        for seed in from..from + seeds {
            let own = tempfile::tempdir().unwrap_or_else(|e| panic!("{e}"));
            let folder = keep.as_ref().map_or(own.path().to_owned(), |keep| {
                Path::new(keep).join(format!("{id}-{seed}"))
            });
            std::fs::create_dir_all(&folder).unwrap_or_else(|e| panic!("{e}"));
            let start = std::time::Instant::now();
            runs += 1;
            let records = kept(&folder);
            let result = if records.is_empty() {
                collected(&hidden, seed, &folder)
            } else {
                rig_of(seed, String::new());
                again(&records)
            };
            match result {
                Ok(r) => right += u32::from(row(id, truth, seed, &r)),
                Err(failure) => println!("{id:<16} {seed:>2}  FAILED: {}", failure.text()),
            }
            println!("{:>21} {:.0} s", "", start.elapsed().as_secs_f64());
        }
    }
    println!(
        "{right} of {runs}: the delay and what is hidden, nothing else, every number inside its interval"
    );
}

/// Prints a row. True if the verdict is right: it names the delay and the hidden effect, nothing else, and every interval contains the
/// truth.
fn row(id: &str, truth: &[(&str, f64)], seed: u64, r: &Reconciliation) -> bool {
    let mut right = r.verdict.word().starts_with("named");
    println!("{id:<16} {seed:>2}  {}", r.verdict.word());
    for e in &r.effects {
        let hidden = e.id == id;
        right &= hidden || e.id == "time-delay";
        let numbers: Vec<String> = (e.parameters.iter())
            .map(|(name, p)| {
                let [low, high] = p.ci95;
                let stated = truth.iter().find(|(n, _)| hidden && n == name);
                let mark = match stated {
                    Some((_, v)) if (low..=high).contains(v) => " inside",
                    Some(_) => {
                        right = false;
                        " OUTSIDE"
                    }
                    None => "",
                };
                format!("{name} {:.5} [{low:.5} {high:.5}]{mark}", p.value)
            })
            .collect();
        let or = match e.alternatives.is_empty() {
            true => String::new(),
            false => format!(" or {}", e.alternatives.join(", ")),
        };
        println!("{:>21} {}: {}{or}", "", e.id, numbers.join(", "));
    }
    if r.effects.is_empty() {
        println!("{:>21} {:?}", "", r.places);
    }
    if let Some(left) = &r.remainder {
        println!("{:>21} left {:.4}: {}", "", left.share, left.how);
    }
    right && (truth.is_empty() || r.effects.iter().any(|e| e.id == id))
}
