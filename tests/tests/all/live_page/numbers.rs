//! Every number on the page is the record's at the same tick.

use super::watched::{RUNNING, Watched, only_run, says_the_summary, shows};
use cellpos_tests::browser::Browser;
use cellpos_tests::programs;
use serde_json::Value;
use std::path::Path;
use std::time::Duration;

/// What the page shows in one moment; the traces are read at a cursor.
const LOOK: &str = "const text = id => document.getElementById(id).textContent, gauge = document.getElementById('gauge-text');
    const box = document.getElementById('traces').getBoundingClientRect(), numbers = text => (text.match(/-?[0-9]+(\\.[0-9]+)?/g) ?? []).map(Number);
    document.getElementById('traces').dispatchEvent(new PointerEvent('pointermove', { clientX: box.left + 0.6 * box.width, clientY: box.top + 50 }));
    return { ticks: +document.body.dataset.ticks, late: +text('f-late'), skipped: +text('f-skipped'), lost: +text('f-lost'),
      stale: +text('f-stale'), coasted: +text('f-coasted'), records: +text('f-records'), rms: parseFloat(text('f-rms')),
      seq: +gauge.dataset.seq, gauge: numbers(gauge.textContent), cursor: /position -/.test(text('cursor')) ? [] : numbers(text('cursor')) };";

/// A row of the record.
struct Row {
    seq: u64,
    time_s: f64,
    /// Position, target, error in nm, PZT, zero flow, wake-up, computing: as the cursor shows them.
    shown: [f64; 7],
    running: bool,
    flags: u64,
}

/// Looks with a row at the cursor that are compared.
const LOOKS: usize = 20;

const LATE: u64 = 1 << 1;
const COASTING: u64 = 1 << 6;

fn record(folder: &Path, name: &str) -> Vec<Row> {
    let line = format!(
        "export latest-{name} --out ticks.csv --columns \
         seq,time_s,life,flags,measured_um,target_um,error_um,pzt_um,neutral_um,wake_us,compute_us"
    );
    let export = programs::cellpos(folder, &line).output().unwrap();
    assert!(export.status.success(), "{export:?}");
    let text = std::fs::read_to_string(folder.join("ticks.csv")).unwrap();
    text.lines()
        .skip(1)
        .map(|line| {
            let cells: Vec<&str> = line.split(',').collect();
            let number = |n: usize| cells[n].parse().unwrap_or(f64::NAN);
            Row {
                seq: cells[0].parse().unwrap(),
                time_s: number(1),
                running: cells[2] == "running",
                flags: cells[3].parse().unwrap(),
                shown: [
                    number(4),
                    number(5),
                    1e3 * number(6),
                    number(7),
                    number(8),
                    number(9),
                    number(10),
                ],
            }
        })
        .collect()
}

/// What the events before a tick count; `None`: some were told together, and their numbers are not known.
fn counted(events: &[Value], name: &str, ticks: u64) -> Option<u64> {
    let before = |event: &&Value| {
        event["event"] == name && event["data"]["tick"].as_u64().is_some_and(|n| n < ticks)
    };
    events.iter().filter(before).try_fold(0, |sum, event| {
        let alone = event["data"]["times"].is_null();
        alone.then(|| sum + event["data"]["count"].as_u64().unwrap_or(1))
    })
}

/// RMS error from two seconds after the loop was closed, nm, of the rows before a tick that have a position.
fn rms_nm(rows: &[Row], ticks: u64) -> f64 {
    let closed_s = rows.iter().find(|row| row.running).expect("closed").time_s;
    let counts = |row: &&Row| row.seq < ticks && row.running && row.time_s >= closed_s + 2.0;
    let errors = rows.iter().filter(counts).map(|row| row.shown[2]);
    let (n, squares) = errors
        .filter(|nm| nm.is_finite())
        .fold((0.0, 0.0), |(n, sum), nm| (n + 1.0, sum + nm * nm));
    (squares / n).sqrt()
}

#[test]
#[ignore = "needs chromium and chromium-driver: .ci/run installs them and runs this"]
fn every_number_on_the_page_is_the_records_at_the_same_tick() {
    let folder = tempfile::tempdir().unwrap();
    let page = Browser::start(1400, 1500);
    let line = "track --target 0um --view --name numbers --duration 600s";
    let run = Watched::start(folder.path(), line);
    page.open(&run.operator);
    page.wait_for(RUNNING, programs::PATIENCE);
    // Errors count from two seconds on.
    page.wait_for(
        "return document.getElementById('f-rms').textContent !== '-'",
        programs::PATIENCE,
    );
    let mut looks = vec![];
    let at_a_cursor = |look: &Value| look["cursor"].as_array().is_some_and(|c| !c.is_empty());
    let mut cursors = 0;
    // A busy machine shows fewer rows.
    while cursors < LOOKS {
        assert_eq!(
            page.run(RUNNING),
            Value::Bool(true),
            "{} looks",
            looks.len()
        );
        let look = page.run(LOOK);
        cursors += usize::from(at_a_cursor(&look));
        looks.push(look);
        std::thread::sleep(Duration::from_millis(200));
    }
    page.click("park");
    // The PZT is parked and the page says so; the program then still writes the table of all ticks.
    shows(&page, "state", "stopped");
    run.ended();
    let rows = record(folder.path(), "numbers");
    let (found, summary) = only_run(folder.path());
    says_the_summary(&page, &summary);
    let events = std::fs::read_to_string(found.join("events.jsonl")).unwrap();
    let events: Vec<Value> = (events.lines())
        .map(|line| serde_json::from_str(line).expect("an event"))
        .collect();
    let mut cursors = 0;
    for look in &looks {
        let whole = |key: &str| {
            let value = look[key].as_f64();
            value.unwrap_or_else(|| panic!("{key}: {look}")) as u64
        };
        let ticks = whole("ticks");
        let flagged = |mask: u64| {
            let has = |row: &&Row| row.seq < ticks && row.flags & mask != 0;
            rows.iter().filter(has).count() as u64
        };
        assert_eq!(whole("late"), flagged(LATE), "{look}");
        assert_eq!(whole("coasted"), flagged(COASTING), "{look}");
        if let Some(skipped) = counted(&events, "ticks-skipped", ticks) {
            assert_eq!(whole("skipped"), skipped, "{look}");
        }
        if let Some(lost) = counted(&events, "frames-dropped", ticks)
            && counted(&events, "frame-repeated", ticks) == Some(0)
        {
            assert_eq!(whole("lost"), lost, "{look}");
        }
        // One event may be of several frames of a tick.
        if let Some(stale) = counted(&events, "frame-stale", ticks) {
            assert!(whole("stale") >= stale, "{look}: {stale}");
            assert!(stale > 0 || whole("stale") == 0, "{look}");
        }
        assert_eq!(whole("records"), 0, "{look}");
        // The run's own figure takes account of ticks without a position, which are few here.
        let (rms, expected) = (look["rms"].as_f64().expect("an RMS"), rms_nm(&rows, ticks));
        assert!((rms / expected - 1.0).abs() < 0.02, "{look}: {expected}");
        let list = |key: &str| -> Vec<f64> {
            let numbers = look[key].as_array().expect("numbers");
            numbers.iter().filter_map(Value::as_f64).collect()
        };
        let row = (rows.iter()).find(|row| row.seq == whole("seq"));
        let [.., pzt, zero_flow, _, _] = row.expect("a row").shown;
        let gauge = list("gauge");
        assert!(
            gauge.len() == 2
                && (gauge[0] - pzt).abs() < 6e-4
                && (gauge[1] - zero_flow).abs() < 6e-4,
            "{look}: {pzt} {zero_flow}"
        );
        if let [time_s, shown @ ..] = list("cursor").as_slice() {
            cursors += 1;
            let step = [6e-4, 6e-4, 1.0, 6e-4, 6e-4];
            // Behind the zero flow there may be the gain; wake-up and computing come last.
            let tail = &shown[shown.len() - 2..];
            let agrees = |row: &Row| {
                (row.time_s - time_s).abs() < 6e-4
                    && shown
                        .iter()
                        .zip(row.shown)
                        .zip(step)
                        .all(|((a, b), most)| (a - b).abs() <= most)
                    && tail
                        .iter()
                        .zip(&row.shown[5..])
                        .all(|(a, b)| (a - b).abs() <= 0.6)
            };
            assert!(rows.iter().any(agrees), "{look}");
        }
    }
    println!("{} looks, {cursors} of them at a cursor", looks.len());
    assert!(cursors > 2, "{cursors}");
}
