//! The live page of commands that hold no bead for its own sake.

use super::watched::{RUNNING, Watched, pictures, shows};
use cellpos_tests::browser::Browser;
use cellpos_tests::programs;
use std::time::Duration;

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn an_identification_is_seen_freezes_and_parks_and_keeps_what_is_finished() {
    let folder = tempfile::tempdir().unwrap();
    // The browser is there when the run begins.
    let page = Browser::start(1400, 1500);
    let run = Watched::start(
        folder.path(),
        "identify --clock real --frequency 10Hz,20Hz,30Hz,50Hz,70Hz,110Hz,130Hz,150Hz,170Hz,190Hz --led-edges 0 --bootstrap 0 \
         --out model.toml --report identify.html --view",
    );
    page.open(&run.operator);
    shows(&page, "script-text", "Segment ([2-9]|10) of 10.*left");
    page.screenshot(&pictures().join("identify.png"));
    page.click_until("freeze", &["frozen"]);
    page.click_until("resume", &["running"]);
    // Before the program is gone, and the page looks for it in vain.
    assert_eq!(page.console(), Vec::<String>::new());
    page.click_until("park", &["safe", "over"]);
    let status = run.ended();
    assert_eq!(status.code(), Some(1));
    let kept = std::fs::read_to_string(folder.path().join("model.partial.json")).unwrap();
    let kept: serde_json::Value = serde_json::from_str(&kept).unwrap();
    assert!(!kept["segments"].as_array().unwrap().is_empty());
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn a_pzt_moved_by_hand_is_seen_goes_where_the_page_says_freezes_and_parks() {
    let folder = tempfile::tempdir().unwrap();
    let page = Browser::start(1400, 1500);
    let mut run = Watched::open(folder.path(), "jog --view --speed 5um/s");
    page.open(&run.operator);
    page.wait_for(RUNNING, programs::PATIENCE);
    page.wait_for(
        "return document.getElementById('picture').width > 200",
        programs::PATIENCE,
    );
    page.run(
        "const t = document.getElementById('target'); t.value = '30'; t.form.requestSubmit();",
    );
    shows(&page, "gauge-text", "PZT 2[2-9]");
    page.click_until("freeze", &["frozen"]);
    std::thread::sleep(Duration::from_millis(300));
    let stands = page.text_of("gauge-text");
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(page.text_of("gauge-text"), stands);
    page.screenshot(&pictures().join("jog.png"));
    page.click_until("resume", &["running"]);
    shows(&page, "gauge-text", "PZT 30[.]000");
    shows(&page, "events", "PZT at 30");
    // Before the program is gone, and the page looks for it in vain.
    assert_eq!(page.console(), Vec::<String>::new());
    page.click_until("park", &["safe", "over"]);
    let stdin = run.child.stdin.take();
    let status = run.ended();
    drop(stdin);
    assert!(status.success(), "{status}");
}
