//! Signals to a program that holds a rig: freeze, keep what is finished, park; and none that ends it half-way.

use cellpos_numeric::parallel::map;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(60);

fn start(folder: &Path, line: &str) -> Child {
    start_with(folder, line, "--default-signal=HUP")
}

/// Signals are as they are in a terminal, but for HUP as said: the tests themselves may run in the background or under `nohup`, where they
/// are ignored.
fn start_with(folder: &Path, line: &str, hang_up: &str) -> Child {
    let child = Command::new("env")
        .args(["--default-signal=INT,QUIT", hang_up])
        .arg(env!("CARGO_BIN_EXE_cellpos"))
        .args(line.split_whitespace())
        .current_dir(folder)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // Until `env` has done its part a signal that the tests ignore is lost, and the program goes on to its end.
    while ignores(&child, Signal::INT) {
        std::thread::sleep(Duration::from_millis(1));
    }
    child
}

fn ignores(child: &Child, signal: Signal) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{}/status", child.id()));
    let ignored = status.ok().and_then(|text| {
        let mask = text.lines().find_map(|line| line.strip_prefix("SigIgn:"))?;
        u64::from_str_radix(mask.trim(), 16).ok()
    });
    ignored.is_some_and(|mask| mask >> (signal.as_raw() - 1) & 1 == 1)
}

fn tell(child: &Child, signal: Signal) {
    kill_process(Pid::from_child(child), signal).unwrap();
}

/// Waits for an action of the child; if the child ends before, the reason appears here.
fn until<T>(child: &mut Child, what: &str, mut there: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = there() {
            return found;
        }
        if let Some(status) = child.try_wait().unwrap() {
            let mut said = String::new();
            child
                .stdout
                .take()
                .unwrap()
                .read_to_string(&mut said)
                .unwrap();
            if let Some(mut pipe) = child.stderr.take() {
                pipe.read_to_string(&mut said).unwrap();
            }
            panic!("{status} without a {what}:\n{said}");
        }
        assert!(start.elapsed() < PATIENCE, "no {what} in time");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Files of a name in the folders below runs/.
fn in_runs(folder: &Path, name: &str) -> Option<PathBuf> {
    let entries = std::fs::read_dir(folder.join("runs")).ok()?;
    entries
        .flatten()
        .map(|entry| entry.path().join(name))
        .find(|path| path.exists())
}

/// Waits until the loop is closed, as the events say.
fn running(child: &mut Child, folder: &Path) {
    until(child, "closed loop", || {
        let text = std::fs::read_to_string(in_runs(folder, "events.jsonl")?).ok()?;
        text.contains("\"running\"").then_some(())
    });
}

fn end(child: Child) -> (Output, Value) {
    let out = child.wait_with_output().unwrap();
    let json = serde_json::from_slice(&out.stdout).unwrap_or(Value::Null);
    (out, json)
}

const TRACK: &str =
    "track --target 0um --duration 60s --frames off --best-effort --json --name held";

#[test]
fn the_first_signal_freezes_the_second_parks_and_both_are_ends_as_asked() {
    for (signals, state) in [(1, "running"), (2, "safe")] {
        let folder = tempfile::tempdir().unwrap();
        let mut child = start(folder.path(), TRACK);
        running(&mut child, folder.path());
        for _ in 0..signals {
            tell(&child, Signal::TERM);
            std::thread::sleep(Duration::from_millis(50));
        }
        let (out, json) = end(child);
        assert_eq!(out.status.code(), Some(0), "{json}");
        assert_eq!(json["ended"]["kind"], "operator", "{json}");
        assert_eq!(json["state"], state, "{json}");
    }
}

#[test]
fn usr1_pauses_and_goes_on_and_ctrl_z_does_not_stop_a_program_that_holds_a_bead() {
    let folder = tempfile::tempdir().unwrap();
    let mut child = start(folder.path(), TRACK);
    running(&mut child, folder.path());
    for signal in [Signal::USR1, Signal::TSTP, Signal::USR1, Signal::USR2] {
        tell(&child, signal);
        std::thread::sleep(Duration::from_millis(200));
    }
    tell(&child, Signal::INT);
    let (out, json) = end(child);
    assert_eq!(out.status.code(), Some(0), "{json}");
    assert_eq!(json["ended"]["kind"], "operator", "{json}");
    assert_eq!(json["safe_reason"], Value::Null, "{json}");
    assert!(json["frozen"].as_f64().unwrap() > 500.0, "{json}");
}

#[test]
fn nohup_holds_and_without_it_the_end_of_a_terminal_is_an_orderly_end() {
    for ignored in [true, false] {
        let folder = tempfile::tempdir().unwrap();
        let hang_up = if ignored { "ignore" } else { "default" };
        let hang_up = format!("--{hang_up}-signal=HUP");
        let mut child = start_with(folder.path(), TRACK, &hang_up);
        running(&mut child, folder.path());
        tell(&child, Signal::HUP);
        if ignored {
            std::thread::sleep(Duration::from_millis(1500));
            assert!(child.try_wait().unwrap().is_none(), "it ended");
            tell(&child, Signal::INT);
        }
        let (out, json) = end(child);
        assert_eq!(out.status.code(), Some(0), "{json}");
        assert_eq!(json["ended"]["kind"], "operator", "{json}");
    }
}

#[test]
fn a_signal_in_the_first_moments_leaves_no_run_half_way() {
    for delay_ms in [0, 6, 15, 30, 50, 90] {
        let folder = tempfile::tempdir().unwrap();
        let child = start(folder.path(), TRACK);
        std::thread::sleep(Duration::from_millis(delay_ms));
        tell(&child, Signal::INT);
        let (out, _) = end(child);
        let killed = out.status.signal().is_some();
        let ticks = in_runs(folder.path(), "ticks.arrow");
        let rows = ticks.and_then(|path| path.metadata().ok()).map(|m| m.len());
        if killed {
            // The rig was not held: nothing ran, so nothing can be cut off.
            assert!(rows.is_none_or(|bytes| bytes < 20_000), "{rows:?} bytes");
        } else if let Some(toml) = in_runs(folder.path(), "run.toml") {
            let text = std::fs::read_to_string(toml).unwrap();
            assert!(text.contains("outcome"), "after {delay_ms} ms: {text}");
        }
    }
}

#[test]
fn a_circle_and_a_collection_that_are_interrupted_keep_what_is_recorded_and_say_where() {
    // On the virtual clock, so that a busy machine loses no bead; long enough to be interrupted.
    let on_the_rig = "--rig rig.toml --frames off --seed 3 --effort 1 --max-effects 1 --json";
    for line in [
        format!("circle {on_the_rig} --rounds 0 --out a.toml --report a.html"),
        format!("reconcile --model eq6 --collect more {on_the_rig} --rounds 1 --out a.toml"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("rig.toml"), "[emulator]\nseed = 3\n").unwrap();
        let mut child = start(folder.path(), &line);
        let kept = until(&mut child, "finished segment", || {
            let partial = in_runs(folder.path(), "partial.json");
            let record = Some(folder.path().join("more/survey-1.csv"));
            partial.or(record.filter(|path| path.exists()))
        });
        tell(&child, Signal::INT);
        let (out, json) = end(child);
        assert_eq!(out.status.code(), Some(1), "{line}\n{json}");
        let error = &json["error"];
        assert_eq!(error["message"], "the operator ended the run", "{json}");
        let name = kept.file_name().unwrap().to_str().unwrap();
        let help = error["help"].as_str().unwrap();
        assert!(help.contains(name), "{help}");
        let text = std::fs::read_to_string(&kept).unwrap();
        if name == "partial.json" {
            let kept: Value = serde_json::from_str(&text).unwrap();
            assert!(!kept["segments"].as_array().unwrap().is_empty());
        } else {
            assert!(text.starts_with("time_s,pzt_um,bead_um"));
            assert!(text.lines().count() > 500);
        }
    }
}

#[test]
fn a_script_of_sixteen_thousand_steps_starts_on_the_clock_of_the_machine() {
    let folder = tempfile::tempdir().unwrap();
    let step = "[[step]]\ndo = \"hold\"\nduration = \"10ms\"\n";
    let text = format!("name = \"long\"\n{}", step.repeat(16_000));
    std::fs::write(folder.path().join("long.toml"), text).unwrap();
    let mut child = start(
        folder.path(),
        "run long.toml --clock real --frames off --best-effort --json",
    );
    until(&mut child, "closed loop", || {
        let text = std::fs::read_to_string(in_runs(folder.path(), "events.jsonl")?).ok()?;
        text.contains("\"stage\":\"running\"").then_some(())
    });
    tell(&child, Signal::INT);
    let (out, json) = end(child);
    assert_eq!(out.status.code(), Some(1), "{json}");
    assert_eq!(json["stage"], "by the operator", "{json}");
    assert_eq!(json["summary"]["safe_reason"], Value::Null, "{json}");
}

const IDENTIFY: &str = "identify --rig rig.toml --clock real --frames off --best-effort \
     --frequency 20Hz,40Hz,80Hz,160Hz --led-edges 0 --bootstrap 0 --json";

#[test]
fn an_identification_keeps_its_segments_as_they_end_whatever_ends_it() {
    map(&[Signal::INT, Signal::KILL], 2, |&signal| {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("rig.toml"), "[emulator]\nseed = 3\n").unwrap();
        let mut child = start(folder.path(), IDENTIFY);
        let partial = until(&mut child, "finished segment", || {
            in_runs(folder.path(), "partial.json")
        });
        tell(&child, signal);
        let (out, _) = end(child);
        let kept: Value = serde_json::from_slice(&std::fs::read(&partial).unwrap()).unwrap();
        assert!(!kept["segments"].as_array().unwrap().is_empty());
        if signal == Signal::INT {
            let text = String::from_utf8_lossy(&out.stderr).into_owned()
                + &String::from_utf8_lossy(&out.stdout);
            assert_eq!(out.status.code(), Some(1), "{text}");
            assert!(text.contains("--resume"), "{text}");
        }
    });
}

/// A command that holds a rig, the files that it needs, and a sign from outside that it holds the rig.
struct Holding {
    line: &'static str,
    /// A file whose appearing says so, in the folder or in its run; without one, that Ctrl-Z is refused.
    sign: &'static str,
    /// Content of that file then.
    text: &'static str,
    /// Whether it lets go of the rig in between, to compute on the virtual clock or before another run where a stall ended one: then a
    /// stop ends it as it ends any program.
    lets_go: bool,
}

/// Every command that holds a rig, on the clock of the machine if it has a choice.
const HOLDING: [Holding; 7] = [
    Holding {
        line: "track --target 0um --rig rig.toml --duration 60s --frames off --best-effort --json",
        sign: "events.jsonl",
        text: "\"running\"",
        lets_go: false,
    },
    Holding {
        line: "run sine.toml --rig rig.toml --clock real --frames off --best-effort --json",
        sign: "events.jsonl",
        text: "\"stage\":\"running\"",
        lets_go: false,
    },
    Holding {
        line: IDENTIFY,
        sign: "partial.json",
        text: "segments",
        lets_go: true,
    },
    Holding {
        line: "circle --rig rig.toml --frames off --seed 3 --effort 1 --max-effects 1 --rounds 0 --out a.toml --report a.html \
               --json",
        sign: "",
        text: "",
        lets_go: true,
    },
    Holding {
        line: "reconcile --model eq6 --collect more --rig rig.toml --frames off --seed 3 --effort 1 --max-effects 1 --rounds 1 \
               --out a.toml --json",
        sign: "",
        text: "",
        lets_go: true,
    },
    Holding {
        line: "jog --rig rig.toml --to 8um --to 12um --to 8um --to 12um --to 8um --to 12um --to 8um --speed 2um/s --blind --json",
        sign: "",
        text: "",
        lets_go: false,
    },
    Holding {
        line: "calibrate --rig rig.toml --pixel 0.1um --pairs 4000 --out calibration.toml --json",
        sign: "",
        text: "",
        lets_go: false,
    },
];

fn prepared() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rig.toml"), "[emulator]\nseed = 3\n").unwrap();
    let script = "name = \"sine\"\n[[step]]\ndo = \"sine\"\namplitude = \"1um\"\nfrequency = \"5Hz\"\ncycles = 300\n";
    std::fs::write(folder.path().join("sine.toml"), script).unwrap();
    folder
}

/// The lines that a pipe gives, as they come.
fn lines(pipe: impl Read + Send + 'static) -> Receiver<String> {
    let (sender, received) = channel();
    std::thread::spawn(move || {
        let lines = BufReader::new(pipe).lines().map_while(Result::ok);
        // The receiver goes when the test has heard enough; the pipe is read on, so that the program is not held.
        lines.for_each(|line| drop(sender.send(line)));
    });
    received
}

/// State of a process by its letter, as the system has it.
fn state(process: Pid) -> Option<char> {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    stat.rsplit_once(") ")?.1.chars().next()
}

#[test]
fn no_command_that_holds_a_rig_is_ended_or_stopped_by_a_signal_that_is_no_stop() {
    map(&HOLDING, 3, |holding| {
        let &Holding {
            line,
            sign,
            text,
            lets_go,
        } = holding;
        let folder = prepared();
        let mut child = start_with(folder.path(), line, "--ignore-signal=HUP");
        if sign.is_empty() {
            // Nothing is written until later; before the rig is held, Ctrl-Z stops the program as any other.
            let pid = Pid::from_child(&child);
            let heard = lines(child.stderr.take().unwrap());
            until(&mut child, line, || {
                kill_process(pid, Signal::TSTP).unwrap();
                std::thread::sleep(Duration::from_millis(60));
                kill_process(pid, Signal::CONT).unwrap();
                heard.try_iter().find(|text| text.contains("refused"))
            });
        } else {
            until(&mut child, line, || {
                let path = in_runs(folder.path(), sign).unwrap_or(folder.path().join(sign));
                let there = std::fs::read_to_string(path).is_ok_and(|all| all.contains(text));
                there.then_some(())
            });
        }
        for signal in [Signal::TSTP, Signal::USR1, Signal::HUP, Signal::USR1] {
            tell(&child, signal);
            std::thread::sleep(Duration::from_millis(60));
            if state(Pid::from_child(&child)) == Some('T') {
                assert!(lets_go, "{line}: stopped by {signal:?}");
                // It refused Ctrl-Z before, and has let go of the rig since.
                tell(&child, Signal::CONT);
                break;
            }
            let ended = child.try_wait().unwrap();
            assert!(
                ended.is_none_or(|status| status.signal().is_none()),
                "{line}: ended by {signal:?}"
            );
        }
        tell(&child, Signal::INT);
        let (out, _) = end(child);
        // An orderly end: not by a signal, with a documented exit code.
        assert!(
            matches!(out.status.code(), Some(0 | 1)) || lets_go && out.status.signal() == Some(2),
            "{line}: {:?}\n{}",
            out.status,
            String::from_utf8_lossy(&out.stderr)
        );
    });
}

#[test]
fn a_stop_in_the_first_moments_of_any_command_that_holds_a_rig_is_an_end() {
    map(&HOLDING, 3, |Holding { line, .. }| {
        for delay_ms in [5, 40] {
            let folder = prepared();
            let child = start(folder.path(), line);
            std::thread::sleep(Duration::from_millis(delay_ms));
            tell(&child, Signal::INT);
            let (out, _) = end(child);
            // Before a rig is held the signal ends the program as always; afterwards the end is its own.
            let ended = (out.status.signal(), out.status.code());
            assert!(
                matches!(ended, (Some(2), None) | (None, Some(0..=2))),
                "{line} after {delay_ms} ms: {ended:?}"
            );
            if let Some(toml) = in_runs(folder.path(), "run.toml") {
                let text = std::fs::read_to_string(toml).unwrap();
                let rows = in_runs(folder.path(), "ticks.arrow")
                    .and_then(|path| path.metadata().ok())
                    .map_or(0, |meta| meta.len());
                assert!(
                    text.contains("outcome") || rows < 20_000,
                    "{line} after {delay_ms} ms: cut off with {rows} bytes"
                );
            }
        }
    });
}

/// A measurement of a night that is ended in the morning prints its result.
#[test]
fn doctor_that_is_interrupted_says_what_it_has() {
    let folder = tempfile::tempdir().unwrap();
    let mut child = start(folder.path(), "doctor --for 99999999999999999999h --json");
    let threads = format!("/proc/{}/task", child.id());
    until(&mut child, "measuring thread", || {
        let all = std::fs::read_dir(&threads).ok()?;
        let mut names = all
            .flatten()
            .filter_map(|task| std::fs::read_to_string(task.path().join("comm")).ok());
        names
            .any(|name| name.trim() == "cellpos-doctor")
            .then_some(())
    });
    tell(&child, Signal::INT);
    let (out, json) = end(child);
    assert!(matches!(out.status.code(), Some(0 | 1)), "{out:?}");
    assert_eq!(json["schema"], "cellpos.doctor", "{out:?}");
    assert!(json["seconds"].as_f64().unwrap() < PATIENCE.as_secs_f64());
    assert!(json["wakeups"].as_u64().unwrap() >= 1);
}
