//! Whether memory stays flat while a live page is open: the server's, and the browser's where chromium is there.
//!
//!     cargo run --release -p cellpos-benches --bin live-page-memory                   10 minutes, a reader that takes everything
//!     cargo run --release -p cellpos-benches --bin live-page-memory -- 10 browser     10 minutes, the page in chromium
//!     cargo run --release -p cellpos-benches --bin live-page-memory -- 1              1 minute: to try it
//!
//! The run is a separate process. Its RAM, the RAM of driver and browser together, and the page's heap after a collection are
//! sampled every five seconds. The slope is a least-squares line through all samples but those of the first fifth, in which rings
//! and histories fill. The page allocates ten minutes of rows at the start.

use cellpos_benches::live_page::{Client, Running, hold, now_s, slope, until_told, was_a_client};
use cellpos_tests::browser::{Browser, resident_kb};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

const SAMPLE_EVERY_S: f64 = 5.0;

/// What was measured at one time: name and MB.
type Sample = Vec<(&'static str, f64)>;

fn main() {
    if was_a_client() {
        return;
    }
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let [first, seconds] = arguments.as_slice()
        && first == "serve"
    {
        return serve(seconds.parse().expect("seconds"));
    }
    let minutes = arguments.iter().find_map(|a| a.parse().ok());
    let minutes: f64 = minutes.unwrap_or(10.0);
    let browser = arguments.iter().any(|argument| argument == "browser");
    let seconds = (60.0 * minutes) as u64;
    let mut server = Running(
        Command::new(std::env::current_exe().expect("a program knows its own path"))
            .args(["serve", &(seconds + 60).to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("the run starts"),
    );
    let mut lines = BufReader::new(server.0.stdout.take().expect("piped")).lines();
    let url = lines.next().expect("it says its link").expect("as text");
    let process = format!("/proc/{}", server.0.id());
    let shown = browser.then(|| {
        let shown = Browser::start(1400, 1500);
        shown.open(&url);
        shown
    });
    let reader = (!browser).then(|| Client::Reads.start(&url, seconds + 60).expect("a reader"));
    println!(
        "{minutes} min with {}",
        if browser {
            "the page in chromium"
        } else {
            "a reader"
        }
    );
    let samples = watch(seconds as f64, || {
        let mut sample: Sample = vec![("server", resident_kb(Path::new(&process)) as f64 / 1024.0)];
        if let Some(shown) = &shown {
            sample.push(("browser, all processes", shown.memory_kb() as f64 / 1024.0));
            sample.push(("the page's heap", shown.heap_bytes() / 1048576.0));
        }
        sample
    });
    drop((reader, shown, server));
    tell(&samples, minutes);
}

/// The run: prints its link, and continues until it is asked to end.
fn serve(seconds: u64) {
    let summary = hold(seconds, true, |url| {
        println!("{}", url.expect("it has a page"));
        std::io::stdout().flush().expect("whoever asked reads");
        std::thread::spawn(|| {
            until_told();
            // The parent is gone: the emulated rig ends with the process.
            std::process::exit(0);
        });
    });
    summary.expect("the default rig runs");
}

fn watch(seconds: f64, mut sample: impl FnMut() -> Sample) -> Vec<(f64, Sample)> {
    let start_s = now_s();
    let mut samples = vec![];
    let mut minute = 0.0;
    while now_s() - start_s < seconds {
        let at_s = now_s() - start_s;
        samples.push((at_s, sample()));
        if let Some((at_s, newest)) = samples.last()
            && *at_s >= minute
        {
            let cells: Vec<String> = newest
                .iter()
                .map(|(name, mb)| format!("{name} {mb:.1} MB"))
                .collect();
            println!("  {:5.1} min: {}", at_s / 60.0, cells.join(", "));
            minute += 60.0;
        }
        let next_s = start_s + samples.len() as f64 * SAMPLE_EVERY_S;
        std::thread::sleep(Duration::from_secs_f64(
            (next_s - now_s()).clamp(0.0, SAMPLE_EVERY_S),
        ));
    }
    samples
}

fn tell(samples: &[(f64, Sample)], minutes: f64) {
    let settled_s = 0.2 * 60.0 * minutes;
    let names: Vec<&str> =
        (samples.first()).map_or(vec![], |(_, s)| s.iter().map(|(n, _)| *n).collect());
    for (k, name) in names.iter().enumerate() {
        let points: Vec<(f64, f64)> = (samples.iter())
            .filter(|(at_s, _)| *at_s >= settled_s)
            .filter_map(|(at_s, sample)| Some((at_s / 60.0, sample.get(k)?.1)))
            .collect();
        let mean = points.iter().map(|p| p.1).sum::<f64>() / points.len() as f64;
        let per_minute = slope(&points);
        println!(
            "{name:<24} mean {mean:8.1} MB, slope {:+9.3} MB/min, over the time {:+6.2} %",
            per_minute,
            100.0 * per_minute * minutes / mean
        );
    }
}
