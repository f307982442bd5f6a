//! The loop: speed of the virtual clock, and cost of a tick in real time.
//!
//!     cargo bench -p cellpos-benches --bench the_loop               both, the real-time run for 60 s
//!     cargo bench -p cellpos-benches --bench the_loop -- virtual    the virtual clock only
//!     cargo bench -p cellpos-benches --bench the_loop -- 10         both, the real-time run for 10 s
//!
//! The competitor of the real-time run is a bare absolute-sleep loop of the same policy, priority and CPU. It is timed before and
//! after the run: a stall there comes from the machine.

use cellpos_benches::track;
use cellpos_rig::Clock;
use cellpos_runtime::latency::Quantiles;
use cellpos_runtime::realtime::{self, bare_loop};
use std::time::{Duration, Instant};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    virtual_clock();
    if !arguments.iter().any(|argument| argument == "virtual") {
        let seconds = arguments.iter().find_map(|argument| argument.parse().ok());
        real_time(seconds.unwrap_or(60));
    }
}

fn virtual_clock() {
    println!("virtual clock, 30 s of holding with PI, median of 5 (lowest..highest):");
    for (name, frames) in [("positions", false), ("frames", true)] {
        let mut ratios: Vec<f64> = (0..5)
            .map(|_| {
                let start = Instant::now();
                let (summary, _) = track(Clock::virtual_at(0), frames, 30_000);
                assert_eq!(summary.counts.ticks, 30_000);
                30.0 / start.elapsed().as_secs_f64()
            })
            .collect();
        ratios.sort_by(f64::total_cmp);
        println!(
            "  {name:<10} {:6.0} x real time ({:.0}..{:.0})",
            ratios[2], ratios[0], ratios[4]
        );
    }
}

fn real_time(seconds: u64) {
    println!("real time, {seconds} s of holding with PI on positions:");
    bare();
    let (summary, conditions) = track(Clock::Real, false, seconds * 1000);
    print!("{conditions}");
    line("tick, compute", &summary.tick_us);
    line("tick, wake-up", &summary.wake_us);
    println!(
        "  {} ticks, {} late, {} skipped, {} by the timer",
        summary.counts.ticks, summary.counts.late, summary.counts.skipped, summary.counts.timer
    );
    bare();
}

fn bare() {
    let handle = std::thread::spawn(|| {
        realtime::apply(&realtime::Request::control_thread());
        bare_loop(Duration::from_secs(10), |_| {})
    });
    let (latency, missed) = handle.join().expect("a loop that only sleeps");
    line("bare, wake-up", &latency.quantiles_us());
    if missed > 0 {
        println!("  {missed} periods missed by the bare loop");
    }
}

fn line(name: &str, q: &Quantiles) {
    println!(
        "  {name:<14} p50 {:6.1} us  p99 {:6.1} us  p99.9 {:6.1} us  max {:7.1} us",
        q.p50, q.p99, q.p999, q.max
    );
}
