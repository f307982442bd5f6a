//! Damaged files, each read by the command that reads it.

use super::{Attacked, Chance, quick_script, run};
use std::path::{Path, PathBuf};

/// A copy of some bytes with a few changed, removed, doubled or truncated.
fn mutated(bytes: &[u8], chance: &mut Chance) -> Vec<u8> {
    let mut out = bytes.to_vec();
    for _ in 0..=chance.below(4) {
        let length = out.len() as u64;
        if length == 0 {
            break;
        }
        let at = chance.below(length) as usize;
        let span = (1 + chance.below(64) as usize).min(out.len() - at);
        match chance.below(6) {
            0 => out[at] = chance.next() as u8,
            1 => out[at] ^= 1 << chance.below(8),
            2 => drop(out.drain(at..at + span)),
            3 => {
                let again: Vec<u8> = out[at..at + span].to_vec();
                out.splice(at..at, again);
            }
            4 => out.truncate(at),
            _ => out[at..at + span].fill(0),
        }
    }
    out
}

/// Damaged scripts, rig files, models, records and run folders, each read by the command that reads it.
pub fn damaged_inputs(folder: &Path, tries: u64, chance: &mut Chance) -> Attacked {
    let mut attacked = Attacked::default();
    quick_script(folder, 20);
    let mut needed = |line: &str| {
        run(folder, line, "before the attack", &mut attacked);
    };
    needed("run quick.toml --clock virtual --frames off --json");
    needed("track --target 0um --duration 500ms --clock virtual --frames off --name held --json");
    let mut runs: Vec<PathBuf> = std::fs::read_dir(folder.join("runs"))
        .map(|entries| entries.flatten().map(|entry| entry.path()).collect())
        .unwrap_or_default();
    runs.sort();
    let (Some(held), Some(scripted)) = (
        runs.iter()
            .find(|run| run.to_string_lossy().contains("held")),
        runs.iter()
            .find(|run| run.to_string_lossy().contains("quick")),
    ) else {
        attacked.broken.push("no runs to attack".to_owned());
        return attacked;
    };
    let line = format!("export {} --out held.csv --json", held.display());
    run(folder, &line, "before the attack", &mut attacked);
    std::fs::write(
        folder.join("rig.toml"),
        "[timing]\nperiod_us = 1000.0\ncamera_delay_ms = 2.0\n[emulator]\nseed = 3\n[limits]\nlow_um = 0.0\nhigh_um = 40.0\n",
    )
    .expect("rig.toml is written");
    let read = |path: PathBuf| std::fs::read(path).unwrap_or_default();
    let inputs = [
        (folder.join("quick.toml"), "check quick.toml".to_owned()),
        (
            folder.join("rig.toml"),
            "track --target 0um --duration 5ms --rig rig.toml --clock virtual --frames off --no-record".to_owned(),
        ),
        (
            folder.join("held.csv"),
            "simulate --model eq6 --input held.csv --out sim.csv --force".to_owned(),
        ),
        (held.join("ticks.arrow"), format!("export {} --out all.csv --force", held.display())),
        (held.join("run.toml"), format!("replay {}", held.display())),
        (scripted.join("cycles.csv"), format!("report {} --out page.html --force", scripted.display())),
        (scripted.join("events.jsonl"), format!("report {} --out page.html --force", scripted.display())),
    ];
    let inputs = inputs.map(|(path, line)| (read(path.clone()), path, line));
    for number in 0..tries {
        let (bytes, path, line) = &inputs[number as usize % inputs.len()];
        let damaged = mutated(bytes, chance);
        std::fs::write(path, &damaged).expect("an input is written");
        let what = format!("damaged {} ({number})", path.display());
        let before = attacked.broken.len();
        if let Some(ended) = run(folder, line, &what, &mut attacked) {
            attacked.end(format!("exit {}", ended.code.unwrap_or(-1)));
            if ended.out.contains('\u{7}') || ended.err.contains("\u{1b}]") {
                attacked
                    .broken
                    .push(format!("{what}: orders to the terminal"));
            }
        }
        if attacked.broken.len() > before {
            // To be looked at: the input that did it.
            let _ = std::fs::write(folder.join(format!("broken-{number}")), &damaged);
        }
        std::fs::write(path, bytes).expect("an input is written back");
    }
    attacked
}
