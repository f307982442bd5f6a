//! Scripts changed at random: each is refused with a place, or runs as the check says.

use crate::common;
use cellpos_emulator::WorldConfig;
use cellpos_numeric::Random;
use cellpos_plant::Model;
use cellpos_runtime::Timing;
use cellpos_script::{CheckError, CheckLimits, Plan, Script, check};
use std::path::Path;

/// Bytes of every quantity (number and unit in quotes) of a text: of its number.
fn quantities(text: &str) -> Vec<std::ops::Range<usize>> {
    let mut found = Vec::new();
    for (at, _) in text
        .match_indices("= \"")
        .chain(text.match_indices(", \""))
        .chain(text.match_indices("[\""))
    {
        let from = at + text[at..].find('"').unwrap() + 1;
        let number = text[from..].find(|c: char| !(c.is_ascii_digit() || c == '.' || c == '-'));
        let length = number.unwrap_or(0);
        if length > 0 && text[from..from + length].parse::<f64>().is_ok() {
            found.push(from..from + length);
        }
    }
    found
}

/// One change at random.
fn mutate(text: &mut String, luck: &mut Random) {
    const WORDS: [&[&str]; 4] = [
        &[
            "\"sine\"",
            "\"triangle\"",
            "\"trapezoid\"",
            "\"waveform\"",
            "\"hold\"",
        ],
        &["\"minimum-jerk\"", "\"s-curve\"", "\"constant-velocity\""],
        &["um\"", "nm\"", "V\"", "mm\"", "\""],
        &["\"mean\"", "\"peak\"", "\"random\"", "\"reversed\""],
    ];
    let blocks: Vec<usize> = text.match_indices("[[step]]").map(|(at, _)| at).collect();
    let block = |luck: &mut Random| {
        let first = luck.below(blocks.len());
        let end = blocks.get(first + 1).copied().unwrap_or(text.len());
        blocks.get(first).copied().unwrap_or(0)..end
    };
    match luck.below(12) {
        // A quantity of another size, as a person may change it.
        0..=6 => {
            let all = quantities(text);
            if let Some(place) = all.get(luck.below(all.len())) {
                let value: f64 = text[place.clone()].parse().unwrap();
                let factor = (2.0 * luck.uniform() - 1.0) * 8f64.ln();
                let value = (value * factor.exp() * 1e4).round() / 1e4;
                text.replace_range(place.clone(), &format!("{value}"));
            }
        }
        7 => {
            let words = WORDS[luck.below(WORDS.len())];
            let (from, to) = (
                words[luck.below(words.len())],
                words[luck.below(words.len())],
            );
            *text = text.replacen(from, to, 1 + luck.below(2));
        }
        8 => {
            let place = block(luck);
            let copy = format!("\n{}", &text[place]);
            text.push_str(&copy);
        }
        9 => {
            let place = block(luck);
            text.replace_range(place, "");
        }
        10 => {
            let place = block(luck);
            let cut = text[place.clone()].to_owned();
            text.replace_range(place, "");
            text.push_str(&cut);
        }
        _ => {
            let lines: Vec<&str> = text.lines().collect();
            let gone = luck.below(lines.len());
            let rest = (0..).zip(lines).filter(|(number, _)| *number != gone);
            *text = rest.map(|(_, line)| format!("{line}\n")).collect();
        }
    }
}

/// Mutated examples: read, laid out, checked; those that pass run for some seconds on the emulated rig.
fn mutants(count: u32) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/scripts");
    let names = ["fatigue", "heartbeat", "sine-sweep", "staircase", "step"];
    let load =
        |name: &str| std::fs::read_to_string(folder.join(name)).map_err(|error| error.to_string());
    let limits = CheckLimits {
        slew_um_per_s: 20_000.0,
        view_um: 12.0,
        ..CheckLimits::default()
    };
    let mut luck = Random::new(17);
    let (mut errors, mut refused, mut run) = (0, 0, 0);
    let mut highest: f64 = 0.0;
    for number in 0..count {
        let name = names[luck.below(names.len())];
        let mut text = load(&format!("{name}.toml")).unwrap();
        // The stop conditions are this test's: a run of some seconds, whatever the bead does.
        if let Some(at) = text.find("[stop]") {
            let end = text[at..].find("\n\n").map_or(text.len(), |n| at + n);
            text.replace_range(at..end, "");
        }
        for _ in 0..1 + luck.below(5) {
            mutate(&mut text, &mut luck);
        }
        text = text.replacen("[[step]]", "[stop]\nafter = \"4s\"\n\n[[step]]", 1);
        let script = Script::parse_with(&text, "m.toml", &load);
        let checked = script.and_then(|script| {
            let plan = Plan::new(&script)?;
            assert!(plan.total_s().is_finite());
            match check(&script, &Model::eq6(), &limits) {
                Ok(check) => Ok((script, check)),
                Err(CheckError::Script(error)) => Err(error),
                Err(error) => panic!("{error}\n{text}"),
            }
        });
        let (script, check) = match checked {
            Ok(both) => both,
            Err(error) => {
                let lines = text.lines().count().max(1);
                assert!((1..=lines + 1).contains(&error.line), "{error}\n{text}");
                assert!(!error.message.is_empty());
                errors += 1;
                continue;
            }
        };
        if let Some(first) = check.violations.first() {
            assert!(first.line >= 1 && check.largest_factor < 1.0);
            refused += 1;
            continue;
        }
        run += 1;
        highest = highest.max((check.pzt_um.1 - 20.0).max(20.0 - check.pzt_um.0) / 20.0);
        let world = WorldConfig {
            seed: u64::from(number),
            ..WorldConfig::default()
        };
        let (summary, _) = common::run_script(&script, &world, Timing::default(), 0..0);
        assert_eq!(summary.safe_reason, None, "{text}");
        let counts = &summary.counts;
        assert_eq!(
            (counts.range_limited, counts.slew_limited),
            (0, 0),
            "{text}{:?}",
            (check.pzt_um, check.pzt_speed_um_per_s)
        );
    }
    eprintln!(
        "{count} scripts: {errors} with an error, {refused} refused by the check, {run} run; the highest asked for {:.0} % \
         of the range",
        100.0 * highest
    );
    assert!(errors > count / 20 && run > count / 5, "{errors} {run}");
}

#[test]
fn a_mutated_script_is_refused_with_its_place_or_runs_without_touching_a_limit() {
    mutants(60);
}

#[test]
#[ignore = "half an hour of the loop; for the figures"]
fn a_thousand_mutated_scripts_are_refused_with_their_place_or_run_without_touching_a_limit() {
    mutants(1000);
}
