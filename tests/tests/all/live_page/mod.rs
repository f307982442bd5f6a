//! The live page in a real browser, on a real run of the emulated rig. Needs Debian's chromium and chromium-driver, which
//! `.ci/run` installs: `cargo test --workspace --test all live_page:: -- --ignored`.

mod last_word;
mod numbers;
mod other_commands;
mod watched;

use cellpos_tests::browser::Browser;
use cellpos_tests::programs;
use std::process::Command;
use std::time::{Duration, Instant};
use watched::{RUNNING, Watched, only_run, pictures, portraits, says_the_summary, shows};

/// Whether the bead came to a target of an exported record and stayed there: its mean over some 100 ms is within 0.1 um.
fn reached(csv: &str, target_um: f64) -> bool {
    let mut lines = csv.lines();
    let head: Vec<&str> = lines.next().expect("a head").split(',').collect();
    let at = |name: &str| head.iter().position(|column| *column == name);
    let (target, bead) = (
        at("target_um").expect("a target"),
        at("measured_um").expect("a position"),
    );
    let found: Vec<f64> = lines
        .filter_map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            let number = |n: usize| cells.get(n)?.parse::<f64>().ok();
            let on_target = number(target).is_some_and(|um| (um - target_um).abs() < 1e-9);
            on_target.then(|| number(bead)).flatten()
        })
        .filter(|um| um.is_finite())
        .collect();
    found.windows(100).any(|some| {
        let mean = some.iter().sum::<f64>() / some.len() as f64;
        (mean - target_um).abs() < 0.1
    })
}

const RUNNING_OR_OVER: &str =
    "return !['connecting', 'armed'].includes(document.body.dataset.state)";

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
cycles = 80
"#;

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn the_operator_sees_a_moving_bead_and_freezes_steers_and_parks_it() {
    let folder = tempfile::tempdir().unwrap();
    // The browser is there when the run begins, as an operator's is.
    let page = Browser::start(1400, 1500);
    let begun = Instant::now();
    let run = Watched::start(
        folder.path(),
        "track --target 0um --view --name watched --duration 120s",
    );
    page.open(&run.operator);
    page.wait_for(
        "return document.getElementById('picture').width > 200 && document.getElementById('picture-text').textContent.startsWith('Click')",
        programs::PATIENCE,
    );
    println!(
        "a bead is on the page {:?} after the command was given",
        begun.elapsed()
    );
    page.run("window.first = document.getElementById('picture').toDataURL()");
    page.wait_for(
        "return document.getElementById('picture').toDataURL() !== window.first",
        programs::PATIENCE,
    );
    println!(
        "it moves on the page {:?} after the command was given",
        begun.elapsed()
    );
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

    let (found, _) = only_run(folder.path());
    let events = std::fs::read_to_string(found.join("events.jsonl")).unwrap();
    assert!(events.contains("\"note\""), "{events}");
    let csv = folder.path().join("ticks.csv");
    let export = programs::cellpos(folder.path(), "export latest-watched --out ticks.csv")
        .output()
        .unwrap();
    assert!(export.status.success(), "{export:?}");
    assert!(reached(&std::fs::read_to_string(csv).unwrap(), 3.5));
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
        "track --target 0um --ideal --view --no-record --duration 60s",
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
    // The browsers are there when the run begins.
    let [page, other] = [0, 1].map(|_| Browser::start(1400, 1500));
    let run = Watched::start(folder.path(), "run script.toml --ideal --view --name shown");
    page.open(&run.operator);
    // First what leaves the list of events when the machine is late often.
    shows(&page, "events", "Mark: <b>waves<.b>");
    shows(&page, "script-text", "Cycle [0-9]+ of 80[.]");
    shows(&page, "cycles-text", "[0-9]+ cycles done");
    // The run waits while the second page comes.
    page.click_until("pause", &["paused"]);
    page.screenshot(&pictures().join("script.png"));
    // The same run, from its folder, in another program.
    let watch = Watched::looking(folder.path(), "watch latest-shown --for 300s");
    other.open(&watch.viewer);
    other.wait_for(
        "return ['frozen', 'disconnected'].includes(document.body.dataset.state)",
        programs::PATIENCE,
    );
    page.click_until("resume", &["running"]);
    other.wait_for(RUNNING, programs::PATIENCE);
    let status = run.ended();
    assert!(status.success(), "{status}");
    other.wait_for(
        "return document.body.dataset.state === 'over'",
        Duration::from_secs(20),
    );
    other.screenshot(&pictures().join("watch.png"));
    assert_eq!(other.console(), Vec::<String>::new());
    // At the end the page agrees with the run's summary.
    says_the_summary(&other, &only_run(folder.path()).1);
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn clips_are_played_and_a_name_of_evil_intent_is_text() {
    let folder = tempfile::tempdir().unwrap();
    let run = Watched::start(
        folder.path(),
        "track --target 0um --ideal --view --duration 120s --name clipped",
    );
    let page = Browser::start(1400, 2000);
    page.open(&run.operator);
    page.wait_for(RUNNING, programs::PATIENCE);
    // A freeze is worth a clip.
    page.click_until("freeze", &["frozen"]);
    shows(&page, "clips", "frozen");
    page.run("document.querySelector('#clips button').click()");
    shows(&page, "clip-text", "frozen: frame [0-9]+ of [0-9]+, at");
    page.run("document.getElementById('clip-on').click()");
    let text = page.text_of("clip-text");
    page.run("document.getElementById('clip-on').click()");
    assert_ne!(page.text_of("clip-text"), text, "stepped");
    page.screenshot(&pictures().join("clip.png"));
    portraits(&run.operator, "page");
    assert_eq!(page.console(), Vec::<String>::new());
    page.click_until("park", &["safe", "over"]);
    run.ended();
    // The same clips in the run's folder, whatever it is called, and in its report.
    let (made, _) = only_run(folder.path());
    let evil = "<img src=x onerror=\"document.title='evil'\">";
    let found = made.with_file_name(evil);
    std::fs::rename(made, &found).unwrap();
    let mut watch = programs::cellpos(folder.path(), "watch --for 300s");
    watch.arg(&found);
    let watch = Watched::printing(watch, &["to look:"]);
    page.open(&watch.viewer);
    page.wait_for(RUNNING_OR_OVER, programs::PATIENCE);
    assert_eq!(page.text_of("name"), evil);
    assert_eq!(
        page.run("return document.querySelectorAll('img').length"),
        0
    );
    assert_ne!(page.run("return document.title"), "evil");
    shows(&page, "clips", "frozen");
    page.run("document.querySelector('#clips button').click()");
    shows(&page, "clip-text", "frame [0-9]+ of [0-9]+, at");
    let report = programs::cellpos(folder.path(), "report")
        .arg(&found)
        .output()
        .unwrap();
    assert!(report.status.success(), "{report:?}");
    let text = std::fs::read_to_string(found.join("report.html")).unwrap();
    assert!(
        text.contains("data:image/png;base64,"),
        "the report shows the clip"
    );
    let report = folder.path().join("report.html");
    std::fs::rename(found.join("report.html"), &report).unwrap();
    page.open(&format!("file://{}", report.display()));
    page.run("document.querySelector('img.pixels').scrollIntoView()");
    page.screenshot(&pictures().join("report-clip.png"));
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
