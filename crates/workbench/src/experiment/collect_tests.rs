//! What `cellpos reconcile --collect` says of an emulated rig that hides one effect: values and intervals against the truth.
//!
//!     cargo test -p cellpos-workbench --lib table_of_hidden_effects -- --ignored --nocapture
//!
//! `HIDDEN=leak` runs one row, `SEEDS=5` the seeds 1 to 5 (2 without it). The rig has all imperfections of a real one.

use super::{Collecting, look};
use crate::experiment::on_rig::OnRig;
use cellpos_plant::Model;
use cellpos_plant::effects::{self, Effect};
use cellpos_reconcile::{Options, Reconciliation};
use cellpos_session::Failure;
use cellpos_session::rig_file::{Frames, RigFile};
use std::path::Path;

/// An id, what is hidden, and the numbers that must be inside their intervals.
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
    ]
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
    let mut file = RigFile::default();
    file.emulator.model = path.display().to_string();
    file.emulate_as(Some(seed), Some(false))?;
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
    let seeds = std::env::var("SEEDS").map_or(2, |s| s.parse().unwrap_or(2));
    let (mut right, mut runs) = (0, 0);
    for (id, hidden, truth) in rows() {
        if !id.contains(&asked) {
            continue;
        }
        for seed in 1..=seeds {
            let folder = tempfile::tempdir().unwrap_or_else(|e| panic!("{e}"));
            let start = std::time::Instant::now();
            runs += 1;
            match collected(&hidden, seed, folder.path()) {
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

/// Prints a row. Whether it is right: the delay and what is hidden are named, nothing else, with the truth inside every interval.
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
    if let Some(left) = &r.remainder {
        println!("{:>21} left {:.4}: {}", "", left.share, left.how);
    }
    right && (truth.is_empty() || r.effects.iter().any(|e| e.id == id))
}
