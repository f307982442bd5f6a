//! Cost of a live page for the control thread: wake-up, computing time and lost ticks without a page, with one client, with the page
//! in a browser, with a client that stalls, with twenty that flood.
//!
//!     cargo run --release -p cellpos-benches --bin live-page-cost                     5 rounds of 20 s each: twelve minutes
//!     cargo run --release -p cellpos-benches --bin live-page-cost -- 3 2              3 s each, 2 rounds: to try it
//!
//! The conditions take turns, and each round begins with another one, so that other load of the machine affects all conditions
//! alike. Each round has the loop without a page twice. Every condition is compared with the first of them in its own round; the
//! second one shows how much such a difference scatters by chance.
//! The clients are separate processes of the ordinary scheduler, as browsers are. On a machine with two CPUs they share the CPUs
//! with the loop. The bare loop is an absolute sleep of the same policy, priority and CPU. Without `chromedriver` the browser is left
//! out.

use cellpos_benches::live_page::{Client, Running, hold, was_a_client};
use cellpos_runtime::realtime::{self, bare_loop};
use cellpos_tests::browser::Browser;
use std::time::Duration;

/// Clients that flood.
const FLOOD: usize = 20;
/// What is compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Condition {
    Bare,
    NoPage,
    NoPageAgain,
    OneClient,
    Browser,
    OneStalled,
    Flooded,
}

impl Condition {
    const ALL: [Self; 7] = [
        Self::Bare,
        Self::NoPage,
        Self::NoPageAgain,
        Self::OneClient,
        Self::Browser,
        Self::OneStalled,
        Self::Flooded,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Bare => "bare loop",
            Self::NoPage => "no page",
            Self::NoPageAgain => "no page, again",
            Self::OneClient => "one client",
            Self::Browser => "browser",
            Self::OneStalled => "one stalled client",
            Self::Flooded => "20 flooding clients",
        }
    }

    fn clients(self) -> Vec<Client> {
        match self {
            Self::Bare | Self::NoPage | Self::NoPageAgain | Self::Browser => vec![],
            Self::OneClient => vec![Client::Reads],
            Self::OneStalled => vec![Client::Stalls],
            Self::Flooded => vec![Client::Floods; FLOOD],
        }
    }
}

const FIGURES: [&str; 6] = [
    "wake-up p50, us",
    "wake-up p99.9, us",
    "computing p50, us",
    "computing p99.9, us",
    "late of 1000 ticks",
    "lost of 1000 ticks",
];

/// The [`FIGURES`] of one turn.
type Turn = [f64; FIGURES.len()];

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
    let mut browser = has_browser().then(|| Browser::start(1400, 1000));
    if browser.is_none() {
        println!("no chromedriver: without a browser");
    }
    let mut table: Vec<[Turn; Condition::ALL.len()]> = vec![];
    for round in 0..rounds as usize {
        let mut turns = [[f64::NAN; FIGURES.len()]; Condition::ALL.len()];
        for n in 0..Condition::ALL.len() {
            let at = (n + round) % Condition::ALL.len();
            let condition = Condition::ALL[at];
            if condition == Condition::Browser && browser.is_none() {
                continue;
            }
            turns[at] = turn(condition, seconds, browser.as_mut());
            let said: Vec<String> = (turns[at].iter()).map(|value| shown(*value)).collect();
            println!(
                "  round {}: {:<20} {}",
                round + 1,
                condition.name(),
                said.join("  ")
            );
        }
        table.push(turns);
    }
    tell(&table);
}

fn has_browser() -> bool {
    let asked = std::process::Command::new("chromedriver")
        .arg("--version")
        .output();
    asked.is_ok()
}

fn shown(value: f64) -> String {
    if value.is_nan() {
        format!("{:>8}", "-")
    } else {
        format!("{value:>8.2}")
    }
}

fn conditions() -> String {
    let thread = std::thread::spawn(|| realtime::apply(&realtime::Request::control_thread()));
    thread
        .join()
        .map_or_else(|_| String::new(), |c| c.to_string())
}

fn turn(condition: Condition, seconds: u64, browser: Option<&mut Browser>) -> Turn {
    if condition == Condition::Bare {
        let bare = std::thread::spawn(move || {
            realtime::apply(&realtime::Request::control_thread());
            bare_loop(Duration::from_secs(seconds), |_| {})
        });
        let (latency, missed) = bare.join().expect("a loop that only sleeps");
        let wake = latency.quantiles_us();
        let lost = missed as f64 / seconds as f64;
        return [wake.p50, wake.p999, f64::NAN, f64::NAN, f64::NAN, lost];
    }
    let mut clients: Vec<Running> = vec![];
    let page = !matches!(condition, Condition::NoPage | Condition::NoPageAgain);
    let summary = hold(seconds, page, |url| {
        let Some(url) = url else { return };
        let wanted = condition.clients();
        let started = wanted.iter().map(|client| client.start(url, seconds));
        clients = started.collect::<Result<_, _>>().expect("clients start");
        if let (Condition::Browser, Some(browser)) = (condition, browser) {
            browser.open(url);
        }
    })
    .expect("the default rig runs");
    drop(clients);
    let of_1000 = |count: u64| 1e3 * count as f64 / summary.counts.ticks.max(1) as f64;
    [
        summary.wake_us.p50,
        summary.wake_us.p999,
        summary.tick_us.p50,
        summary.tick_us.p999,
        of_1000(summary.counts.late),
        of_1000(summary.counts.skipped),
    ]
}

/// Least, median and greatest.
fn spread(mut values: Vec<f64>) -> [f64; 3] {
    values.retain(|value| value.is_finite());
    values.sort_by(f64::total_cmp);
    let (Some(least), Some(greatest)) = (values.first(), values.last()) else {
        return [f64::NAN; 3];
    };
    let half = values.len() / 2;
    let upper = values.get(half).copied().unwrap_or(f64::NAN);
    let lower = values.get((values.len() - 1) / 2).copied();
    [*least, 0.5 * (upper + lower.unwrap_or(f64::NAN)), *greatest]
}

fn tell(table: &[[Turn; Condition::ALL.len()]]) {
    let without = Condition::NoPage as usize;
    for (figure, name) in FIGURES.iter().enumerate() {
        let of = |at: usize| table.iter().map(move |turns| turns[at][figure]);
        let more = |at: usize| spread(of(at).zip(of(without)).map(|(a, b)| a - b).collect());
        let chance = more(Condition::NoPageAgain as usize);
        println!(
            "\n{name}: median of the rounds (least..greatest); more than without a page in the same round"
        );
        for (at, condition) in Condition::ALL.iter().enumerate() {
            let [least, median, greatest] = spread(of(at).collect());
            if median.is_nan() {
                continue;
            }
            let mut line = format!(
                "  {:<20} {median:9.2} ({least:.2}..{greatest:.2})",
                condition.name()
            );
            if !matches!(condition, Condition::Bare | Condition::NoPage) {
                let [least, median, greatest] = more(at);
                line.push_str(&format!("   {median:+9.2} ({least:+.2}..{greatest:+.2})"));
                if *condition != Condition::NoPageAgain {
                    line.push_str(match median <= chance[2].max(0.0) {
                        true => "   within chance",
                        false => "   MORE",
                    });
                }
            }
            println!("{line}");
        }
    }
}
