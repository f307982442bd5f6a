//! A command with a live page, and the questions of its tests to the page.

use cellpos_tests::browser::Browser;
use cellpos_tests::programs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, mpsc};
use std::time::{Duration, Instant};

/// The page says that the loop is closed, or that the PZT is moved.
pub(super) const RUNNING: &str = "return document.body.dataset.state === 'running'";

/// A rig file for what is shown in a browser. The browser shares the machine with the loop: frames may be old and ticks late for seconds, in
/// arming, too, and a bead that drifts has left the view before a busy machine begins to look. The tables that are left out are emulated.
pub(super) const PATIENT: &str = "first_neutral_um = 20.0\n[timing]\noldest_ms = 1000.0\nfaults_in_a_row = 100000\n\
     budget_us = 1000.0\nlost_ticks = 20000\n[arming]\ncheck = false\npatience_ticks = 20000\n\
     [emulator]\nideal = true\ndrift_um_per_s = 0.0\n";

/// A command with a live page.
pub(super) struct Watched {
    pub child: Child,
    /// The link to act; none of a page that may look only.
    pub operator: String,
    /// The link to look.
    pub viewer: String,
    /// What the command has printed so far: why it ended, where a test waits in vain for its page.
    printed: Arc<Mutex<String>>,
}

impl Watched {
    /// A command that prints both links, on the folder's `rig.toml`, or on a patient one where there is none.
    pub(super) fn start(folder: &Path, line: &str) -> Self {
        let mut command = on_a_rig(folder, line);
        command.stdin(Stdio::null());
        Self::printing(command, &["to act:", "to look:"])
    }

    /// `cellpos watch`: a page that may look only.
    pub(super) fn looking(folder: &Path, line: &str) -> Self {
        let mut command = programs::cellpos(folder, line);
        command.stdin(Stdio::null());
        Self::printing(command, &["to look:"])
    }

    /// As [`Watched::start`]; the command reads standard input, which stays open.
    pub(super) fn open(folder: &Path, line: &str) -> Self {
        let mut command = on_a_rig(folder, line);
        command.stdin(Stdio::piped());
        Self::printing(command, &["to act:", "to look:"])
    }

    /// A command that prints the links behind these words.
    pub(super) fn printing(mut command: Command, links: &[&str]) -> Self {
        let mut child = command
            .stderr(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("cellpos starts");
        let printed = Arc::new(Mutex::new(String::new()));
        keep(child.stdout.take().expect("piped"), &printed, |_| ());
        let (lines, said) = mpsc::channel();
        keep(child.stderr.take().expect("piped"), &printed, move |line| {
            // Nobody listens once the links are known.
            let _ = lines.send(line.to_owned());
        });
        let mut found: Vec<String> = (links.iter())
            .map(|what| {
                said.iter()
                    .find_map(|line| Some(line.split_once(what)?.1.trim().to_string()))
                    .unwrap_or_else(|| panic!("no link: {}", printed.lock().expect("a text")))
            })
            .collect();
        Self {
            child,
            viewer: found.pop().expect("a link to look"),
            operator: found.pop().unwrap_or_default(),
            printed,
        }
    }

    /// Waits for the end of the program. It may take its time as long as it works: a table of all ticks is written at the end.
    pub(super) fn ended(mut self) -> ExitStatus {
        let mut deadline = Instant::now() + programs::PATIENCE;
        let mut worked = String::new();
        loop {
            if let Some(status) = self.child.try_wait().expect("a child") {
                return status;
            }
            let threads = threads(self.child.id());
            if threads != worked && threads.contains("cellpos-finish") {
                (deadline, worked) = (Instant::now() + programs::PATIENCE, threads.clone());
            }
            assert!(
                Instant::now() < deadline,
                "the run did not end; its threads: {threads}"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

/// Names and states of the threads of a process (R: runs, S: waits, D: waits for a disk), and their time on a processor, ticks.
fn threads(process: u32) -> String {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task"));
    let of = |task: std::fs::DirEntry| {
        let stat = std::fs::read_to_string(task.path().join("stat")).ok()?;
        let (name, rest) = stat.split_once('(')?.1.rsplit_once(')')?;
        let words: Vec<&str> = rest.split_whitespace().collect();
        Some(format!("{name} {} {}", words.first()?, words.get(11)?))
    };
    let said = tasks.into_iter().flatten().flatten().filter_map(of);
    said.collect::<Vec<_>>().join(", ")
}

impl Drop for Watched {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let printed = self.printed.lock().expect("a text");
            println!("the command printed:\n{printed}");
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Reads all that a program prints, so that it never waits for a full pipe.
fn keep(
    from: impl Read + Send + 'static,
    printed: &Arc<Mutex<String>>,
    also: impl Fn(&str) + Send + 'static,
) {
    let printed = Arc::clone(printed);
    std::thread::spawn(move || {
        for line in BufReader::new(from).lines().map_while(Result::ok) {
            also(&line);
            let mut printed = printed.lock().expect("a text");
            printed.push_str(&line);
            printed.push('\n');
        }
    });
}

fn on_a_rig(folder: &Path, line: &str) -> Command {
    let rig = folder.join("rig.toml");
    if !rig.exists() {
        std::fs::write(rig, PATIENT).expect("a rig file");
    }
    programs::cellpos(folder, &format!("{line} --rig rig.toml"))
}

/// Waits until something on the page says so.
pub(super) fn shows(page: &Browser, id: &str, pattern: &str) {
    page.wait_for(
        &format!("return /{pattern}/.test(document.getElementById('{id}').textContent)"),
        programs::PATIENCE,
    );
}

/// Pictures of a page as it is, light and dark, on a wide and a narrow window, to be looked at.
pub(super) fn portraits(url: &str, name: &str) {
    for (width, height) in [(1400, 1900), (400, 3600)] {
        let page = Browser::start(1400, 1000);
        page.resize(width, height);
        page.open(url);
        page.wait_for(
            "return document.getElementById('f-time').textContent !== '-'",
            programs::PATIENCE,
        );
        for theme in ["light", "dark"] {
            page.run(&format!(
                "document.documentElement.dataset.theme = '{theme}'"
            ));
            page.wait_for(
                &format!("return document.body.dataset.painted === '{theme}'"),
                programs::PATIENCE,
            );
            page.screenshot(&pictures().join(format!("{name}-{width}-{theme}.png")));
            let wide = page.run("return document.documentElement.scrollWidth <= innerWidth");
            assert_eq!(wide, true, "{name}: wider than {width} px");
        }
        assert_eq!(page.console(), Vec::<String>::new());
    }
}

/// The folder of the only run below `runs`, and the summary in its `run.toml`.
pub(super) fn only_run(folder: &Path) -> (std::path::PathBuf, toml::Table) {
    let runs = std::fs::read_dir(folder.join("runs")).unwrap().flatten();
    let found: Vec<_> = runs.map(|entry| entry.path()).collect();
    let [run] = found.as_slice() else {
        panic!("{found:?}");
    };
    let text = std::fs::read_to_string(run.join("run.toml")).unwrap();
    let meta: toml::Table = text.parse().unwrap();
    let summary = meta["end"]["summary"].as_table().unwrap().clone();
    (run.clone(), summary)
}

/// The page agrees with the run's summary: counts, error, and the tails of the ticks' times.
pub(super) fn says_the_summary(page: &Browser, summary: &toml::Table) {
    for (id, key) in [
        ("f-late", "late"),
        ("f-skipped", "skipped"),
        ("f-lost", "frames_lost"),
        ("f-stale", "stale"),
        ("f-coasted", "coasted"),
    ] {
        let counted = summary[key].as_integer().unwrap().to_string();
        assert_eq!(page.text_of(id), counted, "{key}");
    }
    let rms = summary["rms_measured_nm"].as_float().unwrap();
    assert_eq!(page.text_of("f-rms"), format!("{rms:.1} nm"));
    let tail = |key: &str| {
        let value = &summary[key]["p999"];
        let us = value.as_float().or(value.as_integer().map(|n| n as f64));
        us.expect("a time").round()
    };
    let text = page.text_of("lateness-text");
    let told: Vec<f64> = (text.split_whitespace())
        .filter_map(|word| word.parse().ok())
        .filter(|number| *number != 99.9)
        .collect();
    let expected = [tail("wake_us"), tail("tick_us")];
    assert!(
        told.len() == 2 && told.iter().zip(expected).all(|(a, b)| (a - b).abs() <= 1.0),
        "{text}: {expected:?}"
    );
}

/// Where pictures of the page are kept, to be looked at.
pub(super) fn pictures() -> std::path::PathBuf {
    let folder = programs::folder().join("live-page");
    std::fs::create_dir_all(&folder).expect("a folder for pictures");
    folder
}
