//! The rows of the table with their seeds, on every core, and what to say of each row.

use super::held::{Held, Row, hold};
use super::rows::Limits;
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;

/// Seeds of the environment: `KEEPING_SEEDS=a..b`, both of them among it, or `n` for the first n.
pub(super) fn seeds(usual: u64) -> RangeInclusive<u64> {
    let Ok(text) = std::env::var("KEEPING_SEEDS") else {
        return 1..=usual;
    };
    let number = |text: &str| -> u64 { text.parse().expect("KEEPING_SEEDS is n or a..b") };
    match text.split_once("..") {
        Some((first, last)) => number(first)..=number(last),
        None => 1..=number(&text),
    }
}

/// Runs each row with each seed; prints each row with its worst seed and how many went beyond the bound, and gives what broke a limit.
pub(super) fn run(rows: &[Row], seeds: RangeInclusive<u64>, limits: &Limits) -> Vec<String> {
    let seeds: Vec<u64> = seeds.collect();
    let jobs = rows.len() * seeds.len();
    let next = AtomicUsize::new(0);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut broken = Vec::new();
    println!("{}", Held::HEAD);
    std::thread::scope(|scope| {
        let (done, results) = mpsc::channel();
        for _ in 0..cores.min(jobs) {
            let (next, seeds, done) = (&next, &seeds, done.clone());
            scope.spawn(move || {
                loop {
                    let job = next.fetch_add(1, Ordering::Relaxed);
                    let Some(row) = rows.get(job / seeds.len()) else {
                        break;
                    };
                    let seed = seeds[job % seeds.len()];
                    done.send((job, hold(row, seed))).expect("a table");
                }
            });
        }
        drop(done);
        let mut waiting = BTreeMap::new();
        for (number, row) in rows.iter().enumerate() {
            let first = number * seeds.len();
            let all = || first..first + seeds.len();
            while !all().all(|job| waiting.contains_key(&job)) {
                let (job, held) = results.recv().expect("a run: a thread of the table died");
                waiting.insert(job, held);
            }
            let held: Vec<Held> = all().filter_map(|job| waiting.remove(&job)).collect();
            broken.extend(judged(row, &seeds, &held, limits));
        }
    });
    println!("{} limits broken in {jobs} runs", broken.len());
    broken
}

/// Prints how the runs of a row went, and gives what they broke.
fn judged(row: &Row, seeds: &[u64], held: &[Held], limits: &Limits) -> Vec<String> {
    let mut broken = Vec::new();
    let runs = || seeds.iter().zip(held);
    let worst = runs().max_by(|a, b| a.1.worst_um().total_cmp(&b.1.worst_um()));
    if let Some((seed, worst)) = worst {
        println!("{row} | {worst}, seed {seed}");
    }
    for (seed, held) in runs() {
        let found = limits.broken(row, held).into_iter();
        broken.extend(found.map(|what| format!("{row}, seed {seed}: {what}")));
    }
    let all: Vec<&Held> = held.iter().collect();
    if held.len() > 1 {
        println!("    {}", limits.counts(row, &all));
    }
    broken.extend((limits.stated(row, &all)).map(|what| format!("{row}: {what}")));
    broken
}
