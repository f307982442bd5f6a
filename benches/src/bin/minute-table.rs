//! The loop at SCHED_FIFO compared with a bare absolute-sleep loop, idle and under load, as one table.
//!
//! ```text
//! cargo run --release -p cellpos-benches --bin minute-table          a minute of each
//! cargo run --release -p cellpos-benches --bin minute-table -- 10    ten seconds of each
//! cargo run --release -p cellpos-benches --bin minute-table -- 60 touched    of the loads with this in their name
//! cargo run --release -p cellpos-benches --bin minute-table -- 60 --bare 500us    the bare loop alone, at another period
//! ```
//!
//! Late: woken, or a command handed over, more than half a period after its time. Skipped: periods without a tick. Lost: the
//! two together, which is what both loops are compared by. If a wake-up is 0.7 periods late, the bare loop makes its tick and
//! counts it as late. cellpos makes the tick of the nearest period and counts one skipped.
//! Exit code 1: the loop lost more than the bare loop and one in ten thousand ticks.

use cellpos_benches::track;
use cellpos_rig::Clock;
use cellpos_runtime::realtime::{self, bare_loop_at};
use std::fs::File;
use std::hint::black_box;
use std::io::{Seek, Write};
use std::process::{Child, Command, ExitCode};
use std::time::Duration;

/// A load: its work until it is stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Load {
    Idle,
    BusyLoops,
    SyncedWrites,
    TouchedMemory,
}

impl Load {
    const ALL: [(Self, &'static str); 4] = [
        (Self::Idle, "idle"),
        (Self::BusyLoops, "4 busy loops"),
        (Self::SyncedWrites, "1 GB of synced writes"),
        (Self::TouchedMemory, "4 GB touched"),
    ];

    /// Goes on until the process is killed.
    fn go_on(self) -> std::io::Result<()> {
        match self {
            Self::Idle => Ok(()),
            Self::BusyLoops => {
                let threads: Vec<_> = (0..4).map(|_| std::thread::spawn(spin)).collect();
                threads.into_iter().for_each(|thread| drop(thread.join()));
                Ok(())
            }
            Self::SyncedWrites => write(),
            Self::TouchedMemory => touch(),
        }
    }
}

/// A load in a separate process, whose memory is not locked; ended when dropped.
struct Loading(Child);

impl Loading {
    fn start(name: &str) -> std::io::Result<Self> {
        let program = std::env::current_exe()?;
        Ok(Self(Command::new(program).args(["--load", name]).spawn()?))
    }
}

impl Drop for Loading {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn spin() {
    let mut sum = 0_u64;
    loop {
        sum = black_box(sum.wrapping_mul(31).wrapping_add(1));
    }
}

/// A gigabyte again and again, each megabyte synced.
fn write() -> std::io::Result<()> {
    let mut file: File = nameless()?;
    let block = vec![0xA5_u8; 1 << 20];
    loop {
        file.rewind()?;
        for _ in 0..1024 {
            file.write_all(&block)?;
            file.sync_data()?;
        }
    }
}

/// A file that has no name.
fn nameless() -> std::io::Result<File> {
    let path = std::env::temp_dir().join(format!("cellpos-minute-{}", std::process::id()));
    let file = File::options().write(true).create_new(true).open(&path)?;
    std::fs::remove_file(path)?;
    Ok(file)
}

/// Four gigabytes, a page after the other, given back and touched again.
fn touch() -> ! {
    const BLOCK: usize = 64 << 20;
    loop {
        let mut blocks = Vec::new();
        while blocks.len() < (4 << 30) / BLOCK {
            let mut block = vec![0_u8; BLOCK];
            block.iter_mut().step_by(4096).for_each(|byte| *byte = 1);
            blocks.push(black_box(block));
        }
    }
}

/// Period of the loop.
const LOOP: Duration = Duration::from_millis(1);

/// Late and skipped ticks of a number of ticks.
#[derive(Debug, Clone, Copy)]
struct Figures {
    ticks: u64,
    late: u64,
    skipped: u64,
    wake_us: [f64; 2],
}

impl Figures {
    fn line(&self, load: &str, name: &str) {
        let [p999, max] = self.wake_us;
        println!(
            "| {load} | {name} | {} | {} | {} | {} | {p999:.0} | {max:.0} |",
            self.ticks,
            self.late,
            self.skipped,
            self.lost()
        );
    }

    /// Ticks that were not made within half a period of their time.
    fn lost(&self) -> u64 {
        self.late + self.skipped
    }
}

/// The bare loop at a period.
fn bare(seconds: u64, period: Duration) -> Figures {
    let measured = std::thread::spawn(move || {
        let conditions = realtime::apply(&realtime::Request::control_thread());
        for line in &conditions.degraded {
            eprintln!("DEGRADED: {line}");
        }
        let mut late = 0;
        let much = period / 2;
        let (latency, skipped) = bare_loop_at(period, Duration::from_secs(seconds), |late_ns| {
            late += u64::from(u128::from(late_ns) > much.as_nanos());
            true
        });
        let wake = latency.quantiles_us();
        Figures {
            ticks: latency.count(),
            late,
            skipped,
            wake_us: [wake.p999, wake.max],
        }
    });
    measured.join().expect("a loop that only sleeps")
}

fn looped(seconds: u64) -> Figures {
    // On a separate thread: the thread that serves the board gets real-time rights, which loads must not inherit.
    let run = std::thread::spawn(move || track(Clock::Real, false, seconds * 1000));
    let (summary, _) = run.join().expect("the run is carried through");
    Figures {
        ticks: summary.counts.ticks,
        late: summary.counts.late,
        skipped: summary.counts.skipped,
        wake_us: [summary.wake_us.p999, summary.wake_us.max],
    }
}

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().skip(1).collect();
    if let [word, name] = words.as_slice()
        && word == "--load"
    {
        let load = Load::ALL.iter().find(|(_, known)| known == name);
        let load = load.expect("one of the loads").0;
        load.go_on()
            .expect("a gigabyte of room for temporary files");
        return ExitCode::SUCCESS;
    }
    let seconds: u64 = words
        .first()
        .and_then(|word| word.parse().ok())
        .unwrap_or(60);
    println!(
        "| load | loop | ticks | late | skipped | lost | wake-up, 99.9 % (us) | largest (us) |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    if let [_, word, period] = words.as_slice()
        && word == "--bare"
    {
        let period: u64 = (period.trim_end_matches("us").parse()).expect("microseconds");
        bare(seconds, Duration::from_micros(period)).line("idle", "bare");
        return ExitCode::SUCCESS;
    }
    let mut holds = true;
    let wanted = words.get(1).map_or("", String::as_str);
    for (load, name) in Load::ALL
        .into_iter()
        .filter(|(_, name)| name.contains(wanted))
    {
        let loading =
            (load != Load::Idle).then(|| Loading::start(name).expect("this program starts"));
        // Beside means in turn: half of the bare loop before, half after.
        let before = bare(seconds.div_ceil(2), LOOP);
        let ours = looped(seconds);
        let after = bare(seconds / 2, LOOP);
        drop(loading);
        let yardstick = Figures {
            ticks: before.ticks + after.ticks,
            late: before.late + after.late,
            skipped: before.skipped + after.skipped,
            wake_us: [0, 1].map(|k: usize| before.wake_us[k].max(after.wake_us[k])),
        };
        yardstick.line(name, "bare");
        ours.line(name, "cellpos");
        let more = (ours.ticks + ours.skipped) / 10_000;
        holds &= ours.lost() <= yardstick.lost() + more;
    }
    if holds {
        ExitCode::SUCCESS
    } else {
        println!("more than the bare loop and one in ten thousand");
        ExitCode::from(1)
    }
}
