//! Attacks on the program in the numbers of a night, as one table. Exit code 1: something broke.
//!
//! ```text
//! cargo build --workspace --bins && target/debug/attack --kills 50 --inputs 100000 --boards 100 --cameras 60 --lines 60 --actuators 25 --signals 20
//! ```

use cellpos_tests::attack::{self, Attacked, Chance};
use std::process::ExitCode;

/// The number after an option, or its default.
fn option(name: &str, without: u64) -> u64 {
    let words: Vec<String> = std::env::args().collect();
    let at = words.iter().position(|word| word == name);
    let given = at.and_then(|at| words.get(at + 1)?.parse().ok());
    given.unwrap_or(without)
}

fn main() -> ExitCode {
    if std::env::args().any(|word| word == "--help") {
        println!(
            "attack [--kills 50] [--inputs 100000] [--boards 100] [--cameras 60] [--lines 60] [--actuators 25] [--signals 20] [--seed 1]\n\
             kills: of the program, and of the rig, so many each; 0 leaves an attack out"
        );
        return ExitCode::SUCCESS;
    }
    let mut chance = Chance::new(option("--seed", 1));
    type Attack = fn(&std::path::Path, u64, &mut Chance) -> Attacked;
    let attacks: [(&str, &str, u64, Attack); 8] = [
        ("program killed", "--kills", 50, attack::kill_the_program),
        ("rig killed", "--kills", 50, attack::kill_the_rig),
        (
            "damaged inputs",
            "--inputs",
            100_000,
            attack::inputs::damaged_inputs,
        ),
        ("hostile boards", "--boards", 100, attack::hostile_boards),
        (
            "hostile cameras",
            "--cameras",
            60,
            attack::cameras::hostile_cameras,
        ),
        (
            "hostile camera lines",
            "--lines",
            60,
            attack::sockets::hostile_camera_lines,
        ),
        (
            "served actuators",
            "--actuators",
            25,
            attack::actuators::hostile_actuators,
        ),
        (
            "stalls and signals",
            "--signals",
            20,
            attack::stalls_and_signals,
        ),
    ];
    println!("| attack | tries | broken | how they ended |\n|---|---|---|---|");
    let mut broken = Vec::new();
    for (name, counted_by, without, attack) in attacks {
        let tries = option(counted_by, without);
        if tries == 0 {
            continue;
        }
        let folder = tempfile::tempdir().expect("a folder for the attack");
        let attacked = attack(folder.path(), tries, &mut chance);
        println!("{}", attacked.line(name));
        if !attacked.broken.is_empty() {
            // Kept, to be looked at.
            let kept = folder.keep();
            broken.push(format!("{name}, in {}:", kept.display()));
            broken.extend(attacked.broken);
        }
    }
    for line in &broken {
        println!("{line}");
    }
    if broken.is_empty() {
        ExitCode::SUCCESS
    } else {
        ExitCode::from(1)
    }
}
