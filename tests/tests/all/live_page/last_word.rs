//! The last word of a run on the page: it is true, and it stays; a line that is lost without one is another picture.

use super::watched::{PATIENT, RUNNING, Watched, pictures, shows};
use cellpos_tests::browser::Browser;
use cellpos_tests::programs;
use std::process::Command;
use std::time::Duration;

/// Added to a rig file: the bead is gone after six seconds.
const LOSES: &str = "[[emulator.faults.event]]\nkind = \"lose-bead\"\nat_s = 6.0\n";

/// The page when its program is gone for a while: state, banner, reason, what to do, where the PZT is.
fn when_gone(page: &Browser) -> [String; 5] {
    page.wait_for(
        "return !['running', 'frozen', 'armed', 'connecting'].includes(document.body.dataset.state)",
        programs::PATIENCE,
    );
    // Longer than the page waits before it tries again for the first time.
    std::thread::sleep(Duration::from_secs(2));
    let state = page.run("return document.body.dataset.state");
    let [word, reason, to_do, pzt] =
        ["state", "reason", "to-do", "pzt-word"].map(|id| page.text_of(id));
    [
        state.as_str().expect("a state").to_string(),
        word,
        reason,
        to_do,
        pzt,
    ]
}

fn start(rig: &str, more: &str) -> (tempfile::TempDir, Browser, Watched) {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
    let page = Browser::start(1400, 1000);
    let line = format!("track --target 0um --view --name word {more}");
    let run = Watched::start(folder.path(), &line);
    page.open(&run.operator);
    page.wait_for(RUNNING, programs::PATIENCE);
    (folder, page, run)
}

fn signal(run: &Watched, signal: &str) {
    let status = Command::new("kill")
        .args([signal, &run.child.id().to_string()])
        .status();
    assert!(status.expect("kill").success());
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn a_run_that_comes_to_its_end_says_so_and_it_stays() {
    // Long enough for a busy browser to come in time.
    let (_folder, page, run) = start(PATIENT, "--duration 15s");
    assert!(run.ended().success());
    let [state, word, reason, _, pzt] = when_gone(&page);
    assert_eq!((state.as_str(), word.as_str()), ("over", "run over"));
    assert!(reason.contains("time of the run was over"), "{reason}");
    assert!(pzt.contains("at park"), "{pzt}");
    page.screenshot(&pictures().join("word-done.png"));
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn a_run_that_the_operator_parks_or_interrupts_says_so_and_it_stays() {
    let (_folder, page, run) = start(PATIENT, "--duration 120s");
    page.click("park");
    run.ended();
    let [state, word, reason, _, pzt] = when_gone(&page);
    assert_eq!((state.as_str(), word.as_str()), ("over", "stopped"));
    assert!(reason.contains("operator ended the run"), "{reason}");
    assert!(pzt.contains("at park"), "{pzt}");
    page.screenshot(&pictures().join("word-park.png"));

    let (_folder, page, run) = start(PATIENT, "--duration 120s");
    signal(&run, "-INT");
    run.ended();
    let [state, word, _, _, pzt] = when_gone(&page);
    assert_eq!((state.as_str(), word.as_str()), ("over", "stopped"));
    assert!(pzt.contains("at park"), "{pzt}");
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn a_run_that_goes_safe_says_why_and_what_to_do_and_it_stays() {
    let rig = format!("{PATIENT}{LOSES}");
    let (folder, page, run) = start(&rig, "--duration 120s");
    assert_eq!(run.ended().code(), Some(1));
    page.wait_for(
        "return !document.getElementById('last-word').hidden",
        programs::PATIENCE,
    );
    let [state, word, reason, to_do, pzt] = when_gone(&page);
    assert_eq!((state.as_str(), word.as_str()), ("safe", "safe"));
    assert!(reason.contains("bead"), "{reason}");
    assert!(to_do.contains("start again"), "{to_do}");
    assert!(pzt.contains("at park"), "{pzt}");
    page.screenshot(&pictures().join("word-safe.png"));
    // Whoever looks at the folder afterwards reads the same.
    let watch = Watched::looking(folder.path(), "watch latest-word --for 60s");
    page.open(&watch.viewer);
    page.wait_for(
        "return document.body.dataset.state === 'safe' && !document.getElementById('last-word').hidden",
        programs::PATIENCE,
    );
    assert_eq!(page.text_of("reason"), reason);
    assert_eq!(page.text_of("to-do"), to_do);
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn a_program_that_is_killed_leaves_no_last_word_and_the_page_says_that() {
    let (_folder, page, run) = start(PATIENT, "--duration 120s");
    signal(&run, "-KILL");
    let [state, word, reason, _, _] = when_gone(&page);
    assert_eq!((state.as_str(), word.as_str()), ("disconnected", "no line"));
    assert!(reason.contains("left no last word"), "{reason}");
    page.screenshot(&pictures().join("word-killed.png"));
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn the_picture_is_most_of_the_page_on_every_screen_and_every_theme() {
    let (_folder, page, run) = start(PATIENT, "--duration 300s");
    for (width, height) in [(400, 2800), (1400, 1500), (2560, 1400)] {
        page.resize(width, height);
        page.open(&run.viewer);
        page.wait_for(
            "return document.getElementById('picture').width > 200",
            programs::PATIENCE,
        );
        // Some seconds of traces.
        page.wait_for("return +document.body.dataset.held > 3", programs::PATIENCE);
        // As a fault leaves the page: held.
        page.run("document.getElementById('hold').click()");
        for theme in ["light", "dark", "red"] {
            page.run(&format!(
                "document.documentElement.dataset.theme = '{theme}'"
            ));
            page.wait_for(
                &format!("return document.body.dataset.painted === '{theme}'"),
                programs::PATIENCE,
            );
            page.screenshot(&pictures().join(format!("screen-{width}-{theme}.png")));
            let wide = page.run("return document.documentElement.scrollWidth <= innerWidth");
            assert_eq!(wide, true, "wider than {width} px");
            // No button is a lamp in the dark.
            let brightest = page.run(
                "return Math.max(...[...document.querySelectorAll('button')].map(b => { \
                   const [r, g, b_] = getComputedStyle(b).backgroundColor.match(/[0-9.]+/g).map(Number); \
                   return 0.2126 * r + 0.7152 * g + 0.0722 * b_; }))",
            );
            let brightest = brightest.as_f64().expect("a brightness");
            assert!(theme == "light" || brightest < 80.0, "{theme}: {brightest}");
        }
        let share = page.run(
            "return document.getElementById('picture').getBoundingClientRect().width / innerWidth",
        );
        let share = share.as_f64().expect("a share");
        assert!(share >= 0.6, "{width} px: the picture has {share}");
        // Beside it the bead, five times as large; on a phone as large as there is room.
        let times = page.run("return +document.getElementById('inset').dataset.times");
        let times = times.as_f64().expect("a scale");
        assert!(
            times >= if width < 600 { 2.0 } else { 5.0 },
            "{width} px: {times}"
        );
    }
    assert_eq!(page.console(), Vec::<String>::new());
}

/// A line that takes a stop and does not deliver it: one that is silent, and one that breaks.
#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn a_stop_that_is_lost_with_the_line_goes_another_way() {
    let (_folder, page, run) = start(PATIENT, "--duration 300s");
    page.run("window.send = WebSocket.prototype.send; WebSocket.prototype.send = function () {};");
    page.click("freeze");
    page.wait_for(
        "return document.body.dataset.state === 'frozen'",
        programs::PATIENCE,
    );
    page.run("WebSocket.prototype.send = window.send");
    page.click("resume");
    page.wait_for(RUNNING, programs::PATIENCE);
    page.run("WebSocket.prototype.send = function () { this.close(); };");
    page.click("park");
    run.ended();
    // Its last word comes by the line, if that is back in time.
    shows(&page, "state", "stopped|no line");
}
