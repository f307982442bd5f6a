//! Prints how well `reconcile` names effects that a simulator of another make hides: table, confusions, rates.
//!
//! `cargo run --release -p cellpos-tests --bin reconcile-table [GROUP|all|levels] [seed] [text]`, the last to run only cases
//! whose hidden effects, as printed, contain the text. Groups: see `GROUPS`; several at once with commas between them.

#![forbid(unsafe_code)]

use cellpos_reconcile::Verdict;
use cellpos_tests::truth::Excitation;
use cellpos_tests::truth::cases::{Case, further, nulls, pairs, seconds, singles};
use cellpos_tests::truth::draw::{actuators, floorless, noises, sets, strangers};
use cellpos_tests::truth::table::{Row, evaluate};
use cellpos_tests::truth::threshold::{above_threshold, weak};
use std::collections::{BTreeMap, BTreeSet};

/// Names of the groups of cases, in the order of their numbers.
const GROUPS: [&str; 11] = [
    "singles",
    "fixed",
    "nulls",
    "strangers",
    "further",
    "seconds",
    "pairs",
    "triples",
    "noises",
    "floorless",
    "actuators",
];

/// Amplitude over what can be detected at all, from which on a name is expected to carry.
const CLEAR: f64 = 4.0;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let which = args.first().map_or("all", String::as_str);
    let seed: u64 = args.get(1).and_then(|s| s.parse().ok()).unwrap_or(1);
    let mut cases = selected(which, seed);
    if which == "levels" {
        // How far each single lies above the threshold of detection, without running the search.
        for (case, seed) in cases {
            let times = above_threshold(&case.hidden, Excitation::Standard, seed);
            println!(
                "{:7} {:40} {times:6.1}",
                case.level,
                format!("{:?}", case.hidden)
            );
        }
        return;
    }
    if let Some(text) = args.get(2) {
        cases.retain(|(c, _)| format!("{:?}", c.hidden).contains(text.as_str()));
    }
    let rows = evaluated(&cases);
    let done: Vec<(&Case, &Row)> = rows
        .iter()
        .filter_map(|(i, r)| Some((&cases[*i].0, r.as_ref().ok()?)))
        .collect();
    summary(&cases, &done);
    figures(&done);
    confusions(&done);
}

fn group(name: &str, seed: u64) -> Vec<Case> {
    match name {
        "singles" => singles(),
        "fixed" => pairs(),
        "nulls" => nulls(40),
        "strangers" => strangers(seed),
        "further" => further(),
        "seconds" => seconds(),
        "pairs" => sets("pair", 2, 20, seed),
        "triples" => sets("triple", 3, 12, seed),
        "noises" => noises(seed),
        "floorless" => floorless(seed),
        _ => actuators(seed),
    }
}

/// The cases of a group, each with the seed of its random numbers.
fn selected(which: &str, seed: u64) -> Vec<(Case, u64)> {
    // A case keeps its random numbers, whatever other cases run.
    let mut cases: Vec<(Case, u64)> = Vec::new();
    let mut number = 0;
    for name in GROUPS {
        for mut case in group(name, seed) {
            let asked = which == "all" || which.split(',').any(|w| w == name);
            if asked || (which == "levels" && name == "singles") {
                if case.level == "weak" {
                    for h in &mut case.hidden {
                        *h = weak(*h, seed * 1000 + number);
                    }
                }
                cases.push((case, seed * 1000 + number));
            }
            number += 1;
        }
    }
    cases
}

/// Runs all cases on all cores and prints a line for each as it ends.
fn evaluated(cases: &[(Case, u64)]) -> BTreeMap<usize, Result<Row, String>> {
    let numbered: Vec<usize> = (0..cases.len()).collect();
    let rows =
        cellpos_numeric::parallel::map(&numbered, cellpos_numeric::parallel::threads(0), |&i| {
            let (case, seed) = &cases[i];
            let row = evaluate(case, *seed);
            println!("{}", line(case, &row));
            row
        });
    rows.into_iter().enumerate().collect()
}

/// Counts of every group that was run; a refusal counts as neither exact nor inside, and names nothing.
fn summary(cases: &[(Case, u64)], done: &[(&Case, &Row)]) {
    println!(
        "\n{:10} {:>5} {:>6} {:>7} {:>11} {:>8} {:>9} {:>8} {:>8}",
        "group",
        "cases",
        "exact",
        "inside",
        "false names",
        "unknown",
        "remainder",
        "nothing",
        "refused"
    );
    let mut groups: Vec<&str> = Vec::new();
    for (c, _) in cases {
        if !groups.contains(&c.group) {
            groups.push(c.group);
        }
    }
    for group in groups {
        let all = cases.iter().filter(|(c, _)| c.group == group).count();
        let rows: Vec<&Row> = done
            .iter()
            .filter(|(c, _)| c.group == group)
            .map(|(_, r)| *r)
            .collect();
        let count = |good: &dyn Fn(&Row) -> bool| rows.iter().filter(|r| good(r)).count();
        println!(
            "{group:10} {all:5} {:6} {:7} {:11} {:8} {:9} {:8} {:8}",
            count(&|r| r.named == r.hidden),
            count(&|r| r.hidden.is_subset(&r.inside)),
            count(&|r| !r.false_names.is_empty()),
            count(&|r| r.verdict == Verdict::Unknown),
            count(&|r| r.verdict == Verdict::NamedWithRemainder),
            count(&|r| r.verdict == Verdict::NothingMissing),
            all - rows.len()
        );
    }
}

/// Closures, intervals and times.
fn figures(done: &[(&Case, &Row)]) {
    let clear = |r: &Row| r.above_threshold >= CLEAR;
    let of = |f: &dyn Fn(&Row) -> Option<f64>| done.iter().filter_map(|(_, r)| f(r)).collect();
    println!("\nmedian, tenth percentile, count");
    spread("closure on held-out records", of(&|r| r.closure));
    spread(
        "free run on a fresh excitation, about its mean",
        of(&|r| r.fresh.map(|f| f.plain)),
    );
    spread(
        "the same about a straight line",
        of(&|r| r.fresh.map(|f| f.response)),
    );
    spread(
        "the same, effects of four times what can be detected",
        of(&|r| r.fresh.filter(|_| clear(r)).map(|f| f.response)),
    );
    let covered = done
        .iter()
        .fold((0, 0), |a, (_, r)| (a.0 + r.covered.0, a.1 + r.covered.1));
    println!("95 % intervals that hold the truth: {covered:?}");
    let slowest = done.iter().map(|(_, r)| r.seconds).fold(0.0, f64::max);
    println!("slowest case, time of one processor: {slowest:.1} s");
}

fn spread(what: &str, mut values: Vec<f64>) {
    values.sort_by(f64::total_cmp);
    if !values.is_empty() {
        println!(
            "{what}: {:.3} {:.3} {}",
            values[values.len() / 2],
            values[values.len() / 10],
            values.len()
        );
    }
}

fn confusions(done: &[(&Case, &Row)]) {
    println!("\nconfusions (hidden -> verdict and names)");
    let mut confusions: BTreeMap<(String, String), usize> = BTreeMap::new();
    for (_, r) in done.iter().filter(|(_, r)| r.named != r.hidden) {
        *confusions
            .entry((
                join(&r.hidden),
                format!("{} {}", r.verdict.word(), join(&r.named)),
            ))
            .or_default() += 1;
    }
    for ((hidden, named), n) in confusions {
        println!("{hidden:24} {named:40} {n}");
    }
}

fn join(s: &BTreeSet<String>) -> String {
    s.iter().cloned().collect::<Vec<_>>().join("+")
}

fn line(case: &Case, row: &Result<Row, String>) -> String {
    let hidden = case
        .hidden
        .iter()
        .map(|h| format!("{h:.4?}"))
        .collect::<Vec<_>>()
        .join(" + ");
    let figure = |x: Option<f64>| x.map_or_else(|| "-".to_owned(), |x| format!("{x:.3}"));
    match row {
        Err(e) => format!("{:9} {:8} {hidden:40} refused: {e}", case.group, case.level),
        Ok(r) => format!(
            "{:9} {:8} {hidden:40} {} {:16} {:40} closure {:6} fresh {:6} {:6} of {:6} um covered {}/{} threshold x {:5.1} {:5.1} s or: {} {} {} {}",
            case.group,
            case.level,
            if !r.false_names.is_empty() {
                "!!"
            } else if r.named == r.hidden {
                "  "
            } else {
                "<>"
            },
            r.verdict.word(),
            join(&r.named),
            figure(r.closure),
            figure(r.fresh.map(|f| f.plain)),
            figure(r.fresh.map(|f| f.response)),
            figure(r.fresh.map(|f| f.gap_um[0])),
            r.covered.0,
            r.covered.1,
            r.above_threshold,
            r.seconds,
            join(&r.alternatives),
            r.missed.join(", "),
            // One name that is right needs no more; of several it is asked what each is worth.
            if r.named == r.hidden && r.named.len() < 2 {
                ""
            } else {
                &r.numbers
            },
            if r.named == r.hidden { "" } else { &r.reason }
        ),
    }
}
