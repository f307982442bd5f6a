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

/// 95 % interval of a probability by which something happened `k` times in `n` (Clopper and Pearson).
pub(super) fn interval(k: usize, n: usize) -> [f64; 2] {
    if 2 * k > n {
        let [low, high] = interval(n - k, n);
        return [1.0 - high, 1.0 - low];
    }
    // Probability of at most `most` in n.
    let at_most = |most: usize, p: f64| -> f64 {
        let mut term = (1.0 - p).powi(n as i32);
        let mut sum = term;
        for i in 0..most {
            term *= (n - i) as f64 / (i + 1) as f64 * p / (1.0 - p);
            sum += term;
        }
        sum
    };
    let solve = |is_below: &dyn Fn(f64) -> bool| -> f64 {
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            if is_below(middle) {
                low = middle;
            } else {
                high = middle;
            }
        }
        low
    };
    let low = if k == 0 {
        0.0
    } else {
        solve(&|p| 1.0 - at_most(k - 1, p) < 0.025)
    };
    [low, solve(&|p| at_most(k, p) > 0.025)]
}

#[test]
fn the_interval_of_a_probability_is_that_of_the_tables() {
    for (k, n, [low, high]) in [
        (0, 10, [0.0, 0.3085]),
        (1, 10, [0.0025, 0.4450]),
        (5, 10, [0.1871, 0.8129]),
        (0, 200, [0.0, 0.0183]),
        (200, 200, [0.9817, 1.0]),
    ] {
        let [from, to] = interval(k, n);
        assert!(
            (from - low).abs() < 1e-4 && (to - high).abs() < 1e-4,
            "{k} of {n}: {from} to {to}"
        );
    }
}
