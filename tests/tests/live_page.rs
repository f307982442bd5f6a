//! The live page in a real browser, on a real run of the emulated rig. Needs Debian's chromium and chromium-driver, which
//! `.ci/run` installs: `cargo test -p cellpos-tests --test live_page -- --ignored`.

use cellpos_tests::browser::Browser;
use cellpos_tests::programs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

/// A `track` with a live page.
struct Watched {
    child: Child,
    operator: String,
    viewer: String,
}

impl Watched {
    fn start(folder: &Path, line: &str) -> Self {
        let mut child = programs::cellpos(folder, line)
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .expect("cellpos starts");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let mut link = |what: &str| {
            lines
                .find_map(|line| {
                    let line = line.ok()?;
                    let (_, url) = line.split_once(what)?;
                    Some(url.trim().to_string())
                })
                .expect("cellpos prints its links")
        };
        let (operator, viewer) = (link("to act:"), link("to look:"));
        std::thread::spawn(move || lines.for_each(drop));
        Self {
            child,
            operator,
            viewer,
        }
    }

    /// `cellpos watch`: a page that may look only.
    fn looking(folder: &Path, line: &str) -> Self {
        let mut child = programs::cellpos(folder, line)
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .expect("cellpos starts");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let viewer = lines
            .find_map(|line| Some(line.ok()?.split_once("to look:")?.1.trim().to_string()))
            .expect("cellpos prints its link");
        std::thread::spawn(move || lines.for_each(drop));
        Self {
            child,
            operator: String::new(),
            viewer,
        }
    }

    fn ended(mut self) -> ExitStatus {
        let deadline = Instant::now() + programs::PATIENCE;
        loop {
            if let Some(status) = self.child.try_wait().expect("a child") {
                return status;
            }
            assert!(Instant::now() < deadline, "the run did not end");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Where pictures of the page are kept, to be looked at.
fn pictures() -> std::path::PathBuf {
    let folder = programs::folder().join("live-page");
    std::fs::create_dir_all(&folder).expect("a folder for pictures");
    folder
}

const SCRIPT: &str = r#"
name = "shown"
[[step]]
do = "hold"
duration = "1s"
[[step]]
do = "mark"
text = "<b>waves</b>"
[[step]]
do = "sine"
amplitude = "2um"
frequency = "4Hz"
cycles = 40
"#;

const RUNNING: &str = "return document.body.dataset.state === 'running'";

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn the_operator_sees_a_moving_bead_and_freezes_steers_and_parks_it() {
    let folder = tempfile::tempdir().unwrap();
    let run = Watched::start(
        folder.path(),
        "track --target 0um --view --name watched --duration 120s",
    );
    let page = Browser::start(1400, 1500);
    page.open(&run.operator);
    let shown = page.wait_for(
        "return document.getElementById('f-time').textContent !== '-' && document.getElementById('picture').width > 200",
        programs::PATIENCE,
    );
    println!("the bead is on the page {shown:?} after it was opened");
    page.wait_for(RUNNING, programs::PATIENCE);
    let first = page.text_of("gauge-text");
    page.wait_for(
        &format!("return document.getElementById('gauge-text').textContent !== '{first}'"),
        Duration::from_secs(2),
    );
    std::thread::sleep(Duration::from_secs(3));
    page.screenshot(&pictures().join("hold.png"));

    println!(
        "frozen on the page {} ms after the click",
        page.click_until("freeze", &["frozen"])
    );
    page.click("resume");
    page.wait_for(RUNNING, Duration::from_secs(3));

    page.run(
        "const t = document.getElementById('target'); t.value = '3.5'; t.form.requestSubmit();",
    );
    page.wait_for(
        "return [...document.querySelectorAll('#events li')].length > 0",
        Duration::from_secs(3),
    );
    page.run("const n = document.getElementById('note'); n.value = '<img src=x onerror=\"document.title=1\">'; n.form.requestSubmit();");
    page.wait_for(
        "return document.getElementById('events').textContent.includes('<img src=x')",
        Duration::from_secs(3),
    );
    assert_eq!(
        page.run("return document.querySelectorAll('#events img').length"),
        0
    );
    std::thread::sleep(Duration::from_secs(2));
    page.screenshot(&pictures().join("steered.png"));
    assert_eq!(page.console(), Vec::<String>::new());

    println!(
        "parked on the page {} ms after the click",
        page.click_until("park", &["safe", "over"])
    );
    page.screenshot(&pictures().join("parked.png"));
    let status = run.ended();
    assert!(status.code().is_some(), "{status}");
    drop(page);

    let found: Vec<_> = std::fs::read_dir(folder.path().join("runs"))
        .unwrap()
        .flatten()
        .collect();
    let events = std::fs::read_to_string(found[0].path().join("events.jsonl")).unwrap();
    assert!(events.contains("\"note\""), "{events}");
    let csv = folder.path().join("ticks.csv");
    let export = programs::cellpos(folder.path(), "export latest-watched --out ticks.csv")
        .output()
        .unwrap();
    assert!(export.status.success(), "{export:?}");
    let text = std::fs::read_to_string(csv).unwrap();
    assert!(text.contains("3.5"), "the target was reached in the record");
    let replay = programs::cellpos(folder.path(), "replay latest-watched")
        .output()
        .unwrap();
    assert!(replay.status.success(), "a steered run replays: {replay:?}");
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn a_viewer_looks_on_and_a_page_from_elsewhere_gets_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let run = Watched::start(
        folder.path(),
        "track --target 0um --view --no-record --duration 60s",
    );
    let page = Browser::start(500, 1800);
    page.open(&run.viewer);
    page.wait_for(RUNNING, programs::PATIENCE);
    assert_eq!(
        page.run("return document.getElementById('park').disabled"),
        true
    );
    std::thread::sleep(Duration::from_secs(2));
    page.screenshot(&pictures().join("phone.png"));
    // Another origin, in the same browser, with the right word: refused by the server.
    let (host, word) = run.operator.split_once("/?").unwrap();
    page.open("data:text/html,<title>elsewhere</title>");
    let script = format!(
        "window.answer = 'none'; const s = new WebSocket('{}/live?{word}'); s.onopen = () => window.answer = 'open'; s.onerror = () => window.answer = 'refused';",
        host.replace("http", "ws")
    );
    page.run(&script);
    page.wait_for("return window.answer === 'refused'", Duration::from_secs(5));
    // Without the word there is no page.
    page.open(&format!("{host}/"));
    page.wait_for(
        "return document.body.innerText.includes('it carries a word')",
        Duration::from_secs(5),
    );
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn a_script_and_its_folder_show_the_same_run() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("script.toml"), SCRIPT).unwrap();
    let run = Watched::start(folder.path(), "run script.toml --view --name shown");
    let page = Browser::start(1400, 1500);
    page.open(&run.operator);
    page.wait_for(
        "return /Cycle [0-9]+ of 40[.]/.test(document.getElementById('script-text').textContent)",
        programs::PATIENCE,
    );
    page.wait_for(
        "return /[0-9]+ cycles done/.test(document.getElementById('cycles-text').textContent)",
        programs::PATIENCE,
    );
    page.wait_for(
        "return document.getElementById('events').textContent.includes('Mark: <b>waves</b>')",
        programs::PATIENCE,
    );
    // The same run, from its folder, in another program.
    let watch = Watched::looking(folder.path(), "watch latest-shown --for 300s");
    let other = Browser::start(1400, 1500);
    other.open(&watch.viewer);
    other.wait_for(RUNNING, programs::PATIENCE);
    page.click_until("pause", &["paused"]);
    other.wait_for(
        "return ['frozen', 'disconnected'].includes(document.body.dataset.state)",
        Duration::from_secs(20),
    );
    page.screenshot(&pictures().join("script.png"));
    page.click_until("resume", &["running"]);
    let status = run.ended();
    assert!(status.success(), "{status}");
    other.wait_for(
        "return document.body.dataset.state === 'over'",
        Duration::from_secs(20),
    );
    other.screenshot(&pictures().join("watch.png"));
    assert_eq!(other.console(), Vec::<String>::new());
    // What the page says at the end is what the run's summary says.
    let found = std::fs::read_dir(folder.path().join("runs"))
        .unwrap()
        .flatten()
        .next()
        .expect("one run");
    let meta: toml::Table = std::fs::read_to_string(found.path().join("run.toml"))
        .unwrap()
        .parse()
        .unwrap();
    let summary = &meta["end"]["summary"];
    for (id, key) in [
        ("f-late", "late"),
        ("f-skipped", "skipped"),
        ("f-lost", "frames_lost"),
    ] {
        assert_eq!(
            other.text_of(id),
            summary[key].as_integer().unwrap().to_string(),
            "{key}"
        );
    }
    let rms = summary["rms_measured_nm"].as_float().unwrap();
    assert_eq!(other.text_of("f-rms"), format!("{rms:.1} nm"));
}

#[test]
fn without_view_there_is_no_page_and_on_the_virtual_clock_it_is_refused_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let output: std::process::Output = Command::output(&mut programs::cellpos(
        folder.path(),
        "track --target 0um --view --clock virtual --duration 1s --no-record",
    ))
    .unwrap();
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(text.contains("virtual clock"), "{text}");
    let output = programs::cellpos(
        folder.path(),
        "track --target 0um --view 0.0.0.0:0 --duration 1s --no-record --best-effort",
    )
    .output()
    .unwrap();
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(text.contains("--view-unsafe-address"), "{text}");
}
