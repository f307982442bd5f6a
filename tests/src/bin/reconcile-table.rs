//! Prints how well `reconcile` names effects that a simulator of another make hides: table, confusions, rates.
//!
//! `cargo run --release -p cellpos-tests --bin reconcile-table [all|singles|pairs|nulls|outside|further|levels] [seed] [text]`, the
//! last to run only cases whose hidden effects, as printed, contain the text

#![forbid(unsafe_code)]

use cellpos_reconcile::Verdict;
use cellpos_tests::truth::cases::{Case, further, nulls, outside, pairs, singles};
use cellpos_tests::truth::table::{Row, evaluate};
use cellpos_tests::truth::threshold::{above_threshold, weak};
use std::collections::{BTreeMap, BTreeSet};

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let which = args.first().map_or("all", String::as_str);
    let seed: u64 = args.get(1).and_then(|s| s.parse().ok()).unwrap_or(1);
    let mut cases = selected(which, seed);
    if which == "levels" {
        // How far each single lies above the threshold of detection, without running the search.
        for (case, seed) in cases {
            let times = above_threshold(&case.hidden, seed);
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
    confusions(&done);
}

/// The cases of a group, each with the seed of its random numbers.
fn selected(which: &str, seed: u64) -> Vec<(Case, u64)> {
    // A case keeps its random numbers whatever else is run beside it.
    let mut cases: Vec<(Case, u64)> = Vec::new();
    let mut number = 0;
    for (name, group) in [
        ("singles", singles()),
        ("pairs", pairs()),
        ("nulls", nulls(40)),
        ("outside", outside()),
        ("further", further()),
    ] {
        for mut case in group {
            if which == "all" || which == name || (which == "levels" && name == "singles") {
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
    let rows = cellpos_parallel::map(&numbered, cellpos_parallel::threads(0), |&i| {
        let (case, seed) = &cases[i];
        let row = evaluate(case, *seed);
        println!("{}", line(case, &row));
        row
    });
    rows.into_iter().enumerate().collect()
}

fn summary(cases: &[(Case, u64)], done: &[(&Case, &Row)]) {
    let rate = |group: &str, good: &dyn Fn(&Row) -> bool| {
        let n = done
            .iter()
            .filter(|(c, r)| c.group == group && good(r))
            .count();
        (n, cases.iter().filter(|(c, _)| c.group == group).count())
    };
    println!("\nsummary (good, all)");
    println!(
        "singles, exact names       {:?}",
        rate("single", &|r| r.named == r.hidden)
    );
    println!(
        "singles, truth inside set  {:?}",
        rate("single", &|r| r.hidden.is_subset(&r.inside))
    );
    println!(
        "pairs, exact names         {:?}",
        rate("pair", &|r| r.named == r.hidden)
    );
    println!(
        "nulls with a false name    {:?}",
        rate("null", &|r| !r.named.is_empty())
    );
    println!(
        "further, exact names       {:?}",
        rate("further", &|r| r.named == r.hidden)
    );
    println!(
        "outside, called unknown    {:?}",
        rate("outside", &|r| r.verdict == Verdict::Unknown)
    );
    let closures = done
        .iter()
        .filter(|(c, _)| c.group == "single")
        .filter_map(|(_, r)| r.closure)
        .collect();
    let fresh = done.iter().filter_map(|(_, r)| r.fresh).collect();
    for (what, values) in [
        ("closure on held-out records", closures),
        ("fall of the RMS error on a fresh excitation", fresh),
    ] {
        let mut values: Vec<f64> = values;
        values.sort_by(f64::total_cmp);
        if !values.is_empty() {
            println!(
                "median over singles: {what}: {:.3}",
                values[values.len() / 2]
            );
        }
    }
    let covered = done
        .iter()
        .filter(|(c, _)| c.group == "single" || c.group == "pair")
        .fold((0, 0), |a, (_, r)| (a.0 + r.covered.0, a.1 + r.covered.1));
    println!("95 % intervals that hold the truth: {covered:?}");
    let slowest = done.iter().map(|(_, r)| r.seconds).fold(0.0, f64::max);
    println!("slowest case, time of one processor: {slowest:.1} s");
}

fn confusions(done: &[(&Case, &Row)]) {
    println!("\nconfusions (hidden -> verdict and names)");
    let mut confusions: BTreeMap<(String, String), usize> = BTreeMap::new();
    for (_, r) in done
        .iter()
        .filter(|(c, r)| c.group == "single" && r.named != r.hidden)
    {
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
        .map(|h| format!("{h:?}"))
        .collect::<Vec<_>>()
        .join(" + ");
    match row {
        Err(e) => format!("{:8} {:7} {hidden:40} refused: {e}", case.group, case.level),
        Ok(r) => format!(
            "{:8} {:7} {hidden:40} {} {:16} {:40} closure {:6} fresh {:6} covered {}/{} threshold x {:5.1} {:5.1} s or: {} {} {}",
            case.group,
            case.level,
            if r.named == r.hidden { "  " } else { "<>" },
            r.verdict.word(),
            join(&r.named),
            r.closure
                .map_or_else(|| "-".to_owned(), |c| format!("{c:.3}")),
            r.fresh
                .map_or_else(|| "-".to_owned(), |f| format!("{f:.3}")),
            r.covered.0,
            r.covered.1,
            r.above_threshold,
            r.seconds,
            join(&r.alternatives),
            r.missed.join(", "),
            if r.named == r.hidden { "" } else { &r.reason }
        ),
    }
}
