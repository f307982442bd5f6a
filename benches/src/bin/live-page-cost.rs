//! Cost of a live page for the control thread: wake-up and computing time without a page, with one client, with a client that
//! stalls, with twenty that flood. All in one run on one machine, each compared with a bare loop.
//!
//!     cargo run --release -p cellpos-benches --bin live-page-cost                     5 rounds of 20 s each: nine minutes
//!     cargo run --release -p cellpos-benches --bin live-page-cost -- 3 2              3 s each, 2 rounds: to try it
//!
//! The conditions take turns, and each round begins with another one, so that other load of the machine affects all conditions
//! alike.
//! The clients are separate processes of the ordinary scheduler, as browsers are. On a machine with two CPUs they share the CPUs
//! with the loop. The yardstick is the bare loop: an absolute sleep of the same policy, priority and CPU.

use cellpos_benches::live_page::{Client, Running, hold, was_a_client};
use cellpos_runtime::realtime::{self, bare_loop};
use std::time::Duration;

/// Clients that flood.
const FLOOD: usize = 20;
/// How much of the figure without a page a client may cost.
const SHARE: f64 = 0.1;

/// What is compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Condition {
    Bare,
    NoPage,
    OneClient,
    OneStalled,
    Flooded,
}

impl Condition {
    const ALL: [Self; 5] = [
        Self::Bare,
        Self::NoPage,
        Self::OneClient,
        Self::OneStalled,
        Self::Flooded,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Bare => "bare loop",
            Self::NoPage => "no page",
            Self::OneClient => "one client",
            Self::OneStalled => "one stalled client",
            Self::Flooded => "20 flooding clients",
        }
    }

    fn clients(self) -> Vec<Client> {
        match self {
            Self::Bare | Self::NoPage => vec![],
            Self::OneClient => vec![Client::Reads],
            Self::OneStalled => vec![Client::Stalls],
            Self::Flooded => vec![Client::Floods; FLOOD],
        }
    }
}

/// Figures of one turn, us: wake-up p50 and p99.9, computing p50 and p99.9; and what went wrong.
#[derive(Debug, Clone, Copy)]
struct Turn {
    figures: [f64; 4],
    skipped: u64,
}

fn main() {
    if was_a_client() {
        return;
    }
    let numbers: Vec<u64> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let seconds = numbers.first().copied().unwrap_or(20).max(1);
    let rounds = numbers.get(1).copied().unwrap_or(5).max(1);
    println!(
        "{rounds} rounds of {seconds} s of each condition, holding with PI on frames of the emulated rig"
    );
    print!("{}", conditions());
    let mut turns: Vec<(Condition, Turn)> = vec![];
    for round in 0..rounds as usize {
        let mut order = Condition::ALL;
        order.rotate_left(round % Condition::ALL.len());
        for condition in order {
            let turn = turn(condition, seconds);
            let [wake, wake_tail, compute, compute_tail] = turn.figures.map(|us| {
                if us.is_nan() {
                    "-".to_string()
                } else {
                    format!("{us:.1}")
                }
            });
            println!(
                "  round {}: {:<20} wake-up {wake:>7} {wake_tail:>8}   computing {compute:>7} {compute_tail:>8} us, {} skipped",
                round + 1,
                condition.name(),
                turn.skipped
            );
            turns.push((condition, turn));
        }
    }
    tell(&turns);
}

fn conditions() -> String {
    let thread = std::thread::spawn(|| realtime::apply(&realtime::Request::control_thread()));
    thread
        .join()
        .map_or_else(|_| String::new(), |c| c.to_string())
}

fn turn(condition: Condition, seconds: u64) -> Turn {
    if condition == Condition::Bare {
        let bare = std::thread::spawn(move || {
            realtime::apply(&realtime::Request::control_thread());
            bare_loop(Duration::from_secs(seconds), |_| {})
        });
        let (latency, missed) = bare.join().expect("a loop that only sleeps");
        let wake = latency.quantiles_us();
        return Turn {
            figures: [wake.p50, wake.p999, f64::NAN, f64::NAN],
            skipped: missed,
        };
    }
    let mut clients: Vec<Running> = vec![];
    let page = condition != Condition::NoPage;
    let summary = hold(seconds, page, |url| {
        let Some(url) = url else { return };
        let wanted = condition.clients();
        let started = wanted.iter().map(|client| client.start(url, seconds));
        clients = started.collect::<Result<_, _>>().expect("clients start");
    })
    .expect("the default rig runs");
    drop(clients);
    Turn {
        figures: [
            summary.wake_us.p50,
            summary.wake_us.p999,
            summary.tick_us.p50,
            summary.tick_us.p999,
        ],
        skipped: summary.counts.skipped,
    }
}

/// Median, least and greatest of one figure over the rounds of a condition.
fn over_rounds(turns: &[(Condition, Turn)], condition: Condition, figure: usize) -> [f64; 3] {
    let mut values: Vec<f64> = (turns.iter())
        .filter(|(of, _)| *of == condition)
        .map(|(_, turn)| turn.figures[figure])
        .collect();
    values.sort_by(f64::total_cmp);
    let at = |n: usize| values.get(n).copied().unwrap_or(f64::NAN);
    [
        at(values.len() / 2),
        at(0),
        at(values.len().saturating_sub(1)),
    ]
}

fn tell(turns: &[(Condition, Turn)]) {
    println!("\nmedian of the rounds (least..greatest), us:");
    println!(
        "  {:<20} {:>24} {:>26} {:>24} {:>26}",
        "", "wake-up p50", "wake-up p99.9", "computing p50", "computing p99.9"
    );
    for condition in Condition::ALL {
        let cells: Vec<String> = (0..4)
            .map(|figure| {
                let [median, least, greatest] = over_rounds(turns, condition, figure);
                if median.is_nan() {
                    "-".to_string()
                } else {
                    format!("{median:.1} ({least:.1}..{greatest:.1})")
                }
            })
            .collect();
        println!(
            "  {:<20} {:>24} {:>26} {:>24} {:>26}",
            condition.name(),
            cells[0],
            cells[1],
            cells[2],
            cells[3]
        );
    }
    let [_, least, greatest] = over_rounds(turns, Condition::Bare, 1);
    let scatter_us = greatest - least;
    println!("\nscatter of the bare loop's p99.9 over the rounds: {scatter_us:.1} us");
    for (figure, what) in [(1, "wake-up p99.9"), (3, "computing p99.9")] {
        let [without_us, ..] = over_rounds(turns, Condition::NoPage, figure);
        for condition in Condition::ALL.into_iter().skip(2) {
            let [with_us, ..] = over_rounds(turns, condition, figure);
            let more_us = with_us - without_us;
            let verdict = if more_us <= SHARE * without_us {
                "within 10 %"
            } else if more_us <= scatter_us {
                "within the bare loop's scatter"
            } else {
                "MORE"
            };
            println!(
                "  {what:<16} {:<20} {with_us:8.1} us, without a page {without_us:8.1} us: {more_us:+7.1} us, {verdict}",
                condition.name()
            );
        }
    }
}
