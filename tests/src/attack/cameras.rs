//! Cameras that lose, double, reorder and stall, on the virtual clock: judged by where the bead truly was.

use super::{Attacked, Chance, Ended, emptied, only_run, run};
use serde_json::Value;
use std::path::Path;

/// Least diffusion of a bead that nobody sees, um^2/s, and the drift of a zero flow that wanders, um/s: what it may be off by itself.
const WALK_UM2_PER_S: f64 = 0.33;
const DRIFT_UM_PER_S: f64 = 4.0;
/// RMS of a hold on such a camera, um: with three frames in ten lost.
const HOLD_UM: f64 = 0.09;
/// A loop that has its bead in view has it back by then, s.
const BACK_S: f64 = 0.2;
/// The loop is closed, and its bead has come to the target, s.
const SETTLED_S: f64 = 1.2;

/// What the camera does in a time.
struct Trouble {
    kind: &'static str,
    at_s: f64,
    for_s: f64,
}

/// Where the bead was in a tick.
#[derive(Debug, Clone, Copy)]
struct Row {
    time_s: f64,
    off_um: f64,
    running: bool,
}

fn rig_toml(number: u64, chance: &mut Chance) -> (String, Vec<Trouble>) {
    let mut share = |most: u64| chance.below(most) as f64 / 1000.0;
    let mut text = format!(
        "[emulator]\nseed = {number}\n[emulator.faults]\ndrop_rate = {}\nstale_rate = {}\ndouble_rate = {}\nreorder_rate = {}\n",
        share(300),
        share(50),
        share(500),
        share(100),
    );
    let mut troubles = Vec::new();
    for kind in ["stall-camera", "lose-bead", "double-frames"] {
        if chance.below(3) == 0 {
            let trouble = Trouble {
                kind,
                at_s: 1.5 + chance.below(3) as f64,
                for_s: 0.1 * (1 + chance.below(9)) as f64,
            };
            text.push_str(&format!(
                "[[emulator.faults.event]]\nkind = \"{kind}\"\nat_s = {:.1}\nfor_s = {:.1}\n",
                trouble.at_s, trouble.for_s
            ));
            troubles.push(trouble);
        }
    }
    (text, troubles)
}

/// The rows of an exported run.
fn rows(csv: &str) -> Option<Vec<Row>> {
    let mut lines = csv.lines();
    let names: Vec<&str> = lines.next()?.split(',').collect();
    let place = |name: &str| names.iter().position(|n| *n == name);
    let [time, target, truth, life] = ["time_s", "target_um", "true_um", "life"].map(place);
    let (time, target, truth, life) = (time?, target?, truth?, life?);
    lines
        .map(|line| {
            let fields: Vec<&str> = line.split(',').collect();
            // An empty field is a number that there is not.
            let number = |at: usize| match *fields.get(at)? {
                "" => Some(f64::NAN),
                text => text.parse::<f64>().ok(),
            };
            Some(Row {
                time_s: number(time)?,
                off_um: number(truth)? - number(target)?,
                running: *fields.get(life)? == "running",
            })
        })
        .collect()
}

/// Furthest that a bead may be off at a time: its hold, and its way while nobody sees it and until it is back.
fn most_um(time_s: f64, troubles: &[Trouble]) -> f64 {
    let unseen = |t: &&Trouble| t.kind != "double-frames";
    let blind_s: f64 = (troubles.iter().filter(unseen))
        .filter(|t| (t.at_s..t.at_s + t.for_s + BACK_S).contains(&time_s))
        .map(|t| t.for_s)
        .sum();
    let walk_um = (2.0 * WALK_UM2_PER_S * blind_s).sqrt();
    0.3 + 5.0 * f64::hypot(HOLD_UM, walk_um) + DRIFT_UM_PER_S * blind_s
}

/// What the last word says, against the truth.
fn judge(rows: &[Row], troubles: &[Trouble], code: Option<i32>, result: &Value) -> Vec<String> {
    let mut broken = Vec::new();
    let settled = || {
        rows.iter()
            .filter(|row| row.running && row.time_s > SETTLED_S)
    };
    let strays = settled().find(|row| row.off_um.abs() > most_um(row.time_s, troubles));
    let kind = result["ended"]["kind"].as_str().unwrap_or_default();
    let said = format!("exit {code:?}, {kind:?}");
    match strays {
        Some(row) if code == Some(0) => broken.push(format!(
            "{said}, but the bead was {:.2} um off at {:.3} s",
            row.off_um, row.time_s
        )),
        // The picture without the bead went on: nobody can say then that it is the same.
        None if kind == "not-kept" && troubles.iter().all(|t| t.kind != "lose-bead") => {
            broken.push(format!("{said}, but the bead was kept"));
        }
        _ => {}
    }
    let truth = result["rms_true_nm"].as_f64();
    let stated = result["kept"]["rms_nm"].as_f64();
    let all_seen = troubles.iter().all(|t| t.kind == "double-frames");
    if let (Some(truth), Some(stated), true) = (truth, stated, all_seen)
        && !(0.9..1.1).contains(&(stated / truth))
    {
        broken.push(format!("{said}: {stated:.1} nm stated of {truth:.1}"));
    }
    broken
}

/// Every tick is on the disk or counted.
fn account(rows: Option<u64>, ended: &Ended, result: &Value) -> Option<String> {
    let count = |name: &str| result[name].as_u64().or(result["summary"][name].as_u64());
    let (Some(ticks), Some(lost), Some(rows)) = (count("ticks"), count("records_lost"), rows)
    else {
        return Some(format!("no account of ticks: {}", ended.out));
    };
    (rows + lost != ticks).then(|| format!("{rows} rows and {lost} lost of {ticks} ticks"))
}

/// Cameras that lose, double, reorder and stall, on the virtual clock, every other one with pictures: every tick is on the disk or counted,
/// and the last word is that of the true position.
pub fn hostile_cameras(folder: &Path, tries: u64, chance: &mut Chance) -> Attacked {
    let mut attacked = Attacked::default();
    for number in 0..tries {
        emptied(folder);
        let what = format!("camera {number}");
        let (text, troubles) = rig_toml(number, chance);
        std::fs::write(folder.join("hostile.toml"), text).expect("hostile.toml is written");
        let frames = if number % 2 == 0 { "off" } else { "on" };
        let line = format!(
            "track --target 1um --rig hostile.toml --duration 5s --clock virtual --frames {frames} --json"
        );
        let Some(ended) = run(folder, &line, &what, &mut attacked) else {
            continue;
        };
        attacked.end(format!("exit {}", ended.code.unwrap_or(-1)));
        let result: Value = serde_json::from_str(&ended.out).unwrap_or_default();
        let Some(left) = only_run(folder) else {
            if ended.code == Some(0) {
                attacked.broken.push(format!("{what}: left no run"));
            }
            continue;
        };
        let line = format!("export {} --out all.csv --force --json", left.display());
        let exported = run(folder, &line, &what, &mut attacked)
            .and_then(|ended| serde_json::from_str::<Value>(&ended.out).ok())
            .and_then(|export| export["rows"].as_u64());
        let mut broken: Vec<String> = account(exported, &ended, &result).into_iter().collect();
        let csv = std::fs::read_to_string(folder.join("all.csv")).unwrap_or_default();
        match rows(&csv) {
            Some(rows) => broken.extend(judge(&rows, &troubles, ended.code, &result)),
            None => broken.push("the true positions do not read".to_owned()),
        }
        (attacked.broken).extend(broken.into_iter().map(|why| format!("{what}: {why}")));
    }
    attacked
}

#[cfg(test)]
mod tests {
    use super::*;

    fn held(off_um: impl Fn(f64) -> f64) -> Vec<Row> {
        let row = |k: u32| {
            let time_s = f64::from(k) * 1e-3;
            Row {
                time_s,
                off_um: off_um(time_s),
                running: true,
            }
        };
        (0..5000).map(row).collect()
    }

    #[test]
    fn a_last_word_that_the_truth_does_not_bear_out_is_broken() {
        let done = serde_json::json!({"ended": {"kind": "done"}});
        let not_kept = serde_json::json!({"ended": {"kind": "not-kept"}});
        let stall = [Trouble {
            kind: "stall-camera",
            at_s: 2.5,
            for_s: 0.2,
        }];
        let broken = |rows: &[Row], troubles: &[Trouble], code, result| {
            judge(rows, troubles, Some(code), result).len()
        };
        let (kept, strayed) = (held(|_| 0.05), held(|t| if t > 4.0 { 36.0 } else { 0.05 }));
        assert_eq!(broken(&kept, &[], 0, &done), 0);
        assert_eq!(broken(&strayed, &[], 0, &done), 1);
        assert_eq!(broken(&strayed, &[], 1, &not_kept), 0);
        assert_eq!(broken(&kept, &[], 1, &not_kept), 1);
        // What a bead walks while nobody sees it is not the loop's doing.
        let walked = held(|t| if (2.6..2.8).contains(&t) { 1.5 } else { 0.05 });
        assert_eq!(broken(&walked, &stall, 0, &done), 0);
        assert_eq!(broken(&walked, &[], 0, &done), 1);
        let wrong = serde_json::json!({"ended": {"kind": "done"}, "rms_true_nm": 60.0, "kept": {"rms_nm": 50.0}});
        assert_eq!(broken(&kept, &[], 0, &wrong), 1);
    }
}
