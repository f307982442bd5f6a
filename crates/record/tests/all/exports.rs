//! Every form of an export has all rows of all sessions, with the same values.

use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int8Type, UInt64Type};
use cellpos_record::export::columns::{COLUMNS, Value};
use cellpos_record::{
    Event, Format, RunEnd, RunMeta, RunWriter, Selection, Sessions, Source, export,
};
use cellpos_runtime::TickRecord;
use std::path::{Path, PathBuf};

/// A tick in which every column has something to say now and then, and nothing now and then.
fn tick(seq: u64) -> TickRecord {
    let x = seq as f64;
    let now_and_then = |every: u64, value: f64| {
        if seq.is_multiple_of(every) {
            f64::NAN
        } else {
            value
        }
    };
    TickRecord {
        seq,
        time_ns: seq as i64 * 1_000_000 + (seq % 7) as i64,
        frame_id: seq * 3,
        mid_exposure_ns: seq as i64 * 1_000_000 - 2_000_003,
        measured_um: now_and_then(11, (x * 0.1).sin()),
        variance_um2: now_and_then(11, 4e-4),
        verdict: (seq % 6) as u8,
        target_um: x / 3.0,
        error_um: now_and_then(11, (x * 0.1).sin() - x / 3.0),
        command_um: 20.0 + x / 7.0,
        applied_um: now_and_then(5, 1.0 / (x + 1.0)),
        life: 2,
        board: if seq.is_multiple_of(13) { 255 } else { 2 },
        plan_ns: if seq.is_multiple_of(17) {
            -1
        } else {
            seq as i64 * 999_999
        },
        stage: 2,
        length_um: now_and_then(2, 9.5 + x * 1e-6),
        wake_ns: 1234,
        ..TickRecord::unknown()
    }
}

/// A run with two sessions of the given number of rows.
fn run(root: &Path, rows: u64) -> PathBuf {
    let session = |root: &Path, number: i64| {
        let mut meta = RunMeta::new("t", "virtual");
        let mut table = toml::Table::new();
        table.insert("number".into(), toml::Value::Integer(number));
        table.insert("gap_s".into(), toml::Value::Float(2.5));
        meta.config
            .insert("session".into(), toml::Value::Table(table));
        let mut writer = RunWriter::create(root, meta).unwrap();
        (0..rows).for_each(|seq| writer.tick(&tick(seq)));
        writer.event(&Event::new(0.5, "session").with("number", number));
        let done = writer.finish(RunEnd::new("done"));
        assert_eq!((done.rows, done.faults.rows_lost), (rows, 0));
        done.folder
    };
    let first = session(root, 1);
    session(&first.join("sessions"), 2);
    std::fs::write(
        first.join("cycles.csv"),
        "cycle,session,arm,start_s\n0,1,cyclic,0.1\n1,1,static,\n",
    )
    .unwrap();
    first
}

fn source(run: &Path) -> Source {
    let sessions = Sessions::of(run).unwrap();
    assert!(sessions.unreadable.is_empty());
    sessions.into_source().unwrap()
}

/// Content of every form: for each column the values, NaN if missing; words as their numbers.
fn expected(run: &Path) -> Vec<Vec<f64>> {
    let mut all: Vec<Vec<f64>> = COLUMNS.iter().map(|_| Vec::new()).collect();
    source(run)
        .rows(&Selection::default(), |rows| {
            for (column, values) in COLUMNS.iter().zip(&mut all) {
                values.extend(rows.iter().map(|row| column.number(row)));
            }
            Ok(())
        })
        .unwrap();
    all
}

fn same(name: &str, form: &str, found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len(), "{form}: rows of {name}");
    for (row, (a, b)) in found.iter().zip(expected).enumerate() {
        let equal = a == b || (a.is_nan() && b.is_nan());
        assert!(equal, "{form}: {name}, row {row}: {a} for {b}");
    }
}

/// The number of a word.
fn number(column: &cellpos_record::export::columns::Column, field: &str) -> f64 {
    match column.value {
        Value::Code(codes, _) => codes
            .iter()
            .find(|(_, word)| *word == field)
            .map_or(f64::NAN, |(number, _)| f64::from(*number)),
        _ if field.is_empty() => f64::NAN,
        _ => field.parse().unwrap(),
    }
}

fn csv(path: &Path, expected: &[Vec<f64>]) {
    let text = std::fs::read_to_string(path).unwrap();
    let table = cellpos_table::Table::parse(path, &text).unwrap();
    for (place, (column, expected)) in COLUMNS.iter().zip(expected).enumerate() {
        assert_eq!(table.names[place], column.name);
        let found: Vec<f64> = table
            .fields(place)
            .map(|field| number(column, field))
            .collect();
        same(column.name, "CSV", &found, expected);
    }
}

fn parquet(path: &Path, expected: &[Vec<f64>]) {
    let file = std::fs::File::open(path).unwrap();
    let builder =
        parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(file).unwrap();
    let schema = builder.schema().clone();
    let mut found: Vec<Vec<f64>> = COLUMNS.iter().map(|_| Vec::new()).collect();
    for batch in builder.build().unwrap() {
        let batch = batch.unwrap();
        for ((column, values), array) in COLUMNS.iter().zip(&mut found).zip(batch.columns()) {
            match column.value {
                Value::Number(_) => {
                    let array = array.as_primitive::<Float64Type>();
                    values.extend(array.iter().map(|value| value.unwrap_or(f64::NAN)));
                }
                Value::Whole(_) => {
                    let array = array.as_primitive::<UInt64Type>();
                    values.extend(array.values().iter().map(|value| *value as f64));
                }
                Value::Code(..) => {
                    let array = array.as_dictionary::<Int8Type>();
                    let words = array.downcast_dict::<arrow_array::StringArray>().unwrap();
                    values.extend(
                        words
                            .into_iter()
                            .map(|word| number(column, word.unwrap_or(""))),
                    );
                }
            }
        }
    }
    for ((column, found), expected) in COLUMNS.iter().zip(&found).zip(expected) {
        same(column.name, "Parquet", found, expected);
        let field = schema.field_with_name(column.name).unwrap();
        assert_eq!(field.metadata()["description"], column.about);
    }
}

/// Variables of doubles of a MAT-file of version 5.
fn mat(path: &Path, expected: &[Vec<f64>]) {
    let bytes = std::fs::read(path).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    assert_eq!(&bytes[124..128], &[0, 1, b'I', b'M']);
    let mut at = 128;
    let mut columns = COLUMNS.iter().zip(expected);
    while at < bytes.len() {
        assert_eq!(word(at), 14, "a matrix");
        let end = at + 8 + word(at + 4) as usize;
        let class = word(at + 16) & 0xff;
        let length = word(at + 44) as usize;
        let name = std::str::from_utf8(&bytes[at + 48..at + 48 + length]).unwrap();
        let data = at + 48 + length.next_multiple_of(8);
        if class == 6 {
            let (column, expected) = columns.next().unwrap();
            assert_eq!(name, column.name);
            assert_eq!(word(at + 32) as usize, expected.len());
            let values = &bytes[data + 8..data + 8 + word(data + 4) as usize];
            let found: Vec<f64> = values
                .chunks_exact(8)
                .map(|bytes| f64::from_le_bytes(bytes.try_into().unwrap()))
                .collect();
            same(name, "MAT", &found, expected);
        } else {
            assert!(name.starts_with("codes_"), "{name}");
        }
        at = end;
    }
    assert!(columns.next().is_none(), "a column is missing");
}

#[cfg(feature = "hdf5")]
fn hdf5(path: &Path, expected: &[Vec<f64>]) {
    let file = hdf5_pure::File::open_streaming(path).unwrap();
    for (column, expected) in COLUMNS.iter().zip(expected) {
        let dataset = file.dataset(&format!("ticks/{}", column.name)).unwrap();
        let mut found = dataset.read_f64().unwrap();
        if let Value::Code(codes, _) = column.value {
            for value in &mut found {
                if cellpos_record::export::columns::word(codes, *value as u8).is_none() {
                    *value = f64::NAN;
                }
            }
        }
        same(column.name, "HDF5", &found, expected);
    }
    let arms = file.dataset("cycles/arm").unwrap().read_string().unwrap();
    assert_eq!(arms, ["cyclic", "static"]);
    let events = file.dataset("events/session").unwrap().read_f64().unwrap();
    assert_eq!(events, [1.0, 2.0]);
}

/// The control law's own columns are exported under the names that the run gives them, session by session.
#[test]
fn the_laws_own_columns_are_in_the_export_whatever_their_place_in_a_session() {
    let root = tempfile::tempdir().unwrap();
    let session = |root: &Path, number: i64, law: &[&str]| {
        let mut meta = RunMeta::new("t", "virtual");
        meta.law_columns = law.iter().map(|name| (*name).to_owned()).collect();
        let mut table = toml::Table::new();
        table.insert("number".into(), toml::Value::Integer(number));
        table.insert("gap_s".into(), toml::Value::Float(2.5));
        meta.config
            .insert("session".into(), toml::Value::Table(table));
        let mut writer = RunWriter::create(root, meta).unwrap();
        for seq in 0..3 {
            let mut tick = tick(seq);
            for (place, value) in tick.law.iter_mut().enumerate() {
                *value = (10 * number) as f32 + place as f32;
            }
            writer.tick(&tick);
        }
        writer.finish(RunEnd::new("done")).folder
    };
    let run = session(root.path(), 1, &["own_um", "adapt_gain"]);
    session(
        &run.join("sessions"),
        2,
        &["adapt_gain", "late_s", "own_um"],
    );
    let source = source(&run);
    let selection = |names: &[&str]| Selection {
        columns: Some(names.iter().map(|name| (*name).to_owned()).collect()),
        ..Selection::default()
    };
    let path = root.path().join("law.csv");
    let wanted = selection(&["session", "own_um", "adapt_gain", "late_s"]);
    export(&source, &wanted, Format::Csv, &path).unwrap();
    let (first, second) = ("1,10,11,\n", "2,22,20,21\n");
    let text = format!(
        "session,own_um,adapt_gain,late_s\n{}{}",
        first.repeat(3),
        second.repeat(3)
    );
    assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
    let all = Selection::default();
    let columns = all.columns(&source).unwrap();
    let units: Vec<(&str, &str)> = columns[COLUMNS.len()..]
        .iter()
        .map(|column| (column.name, column.unit))
        .collect();
    assert_eq!(
        units,
        [("own_um", "um"), ("adapt_gain", ""), ("late_s", "s")]
    );
    // What is asked for twice, or is of no time of the run, is refused, and no file is left.
    let twice = export(&source, &selection(&["seq", "seq"]), Format::Mat, &path).unwrap_err();
    assert!(twice.to_string().contains("`seq`"), "{twice}");
    let later = Selection {
        from_s: 60.0,
        ..Selection::default()
    };
    let none = root.path().join("none.parquet");
    let said = export(&source, &later, Format::Parquet, &none).unwrap_err();
    assert!(said.to_string().contains("last at"), "{said}");
    assert!(!none.exists());
}

/// A device is written to, and never replaced by a file.
#[cfg(unix)]
#[test]
fn a_pipe_takes_what_is_exported_and_stays_a_pipe() {
    use std::os::unix::fs::FileTypeExt;
    let root = tempfile::tempdir().unwrap();
    let run = run(root.path(), 50);
    let pipe = root.path().join("pipe");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status();
    assert!(made.unwrap().success());
    let reader = std::thread::spawn({
        let pipe = pipe.clone();
        move || std::fs::read_to_string(pipe).unwrap()
    });
    export(&source(&run), &Selection::default(), Format::Csv, &pipe).unwrap();
    assert_eq!(reader.join().unwrap().lines().count(), 1 + 100);
    let kind = std::fs::metadata(&pipe).unwrap().file_type();
    assert!(kind.is_fifo());
}

fn every_form_agrees(rows: u64) {
    let root = tempfile::tempdir().unwrap();
    let run = run(root.path(), rows);
    let expected = expected(&run);
    assert_eq!(expected[0].len() as u64, 2 * rows);
    let second = expected[0][rows as usize];
    assert!(
        (second - expected[0][rows as usize - 1] - 2.5).abs() < 1e-9,
        "the pause is kept"
    );
    type Check = fn(&Path, &[Vec<f64>]);
    let mut forms: Vec<(Format, &str, Check)> = vec![
        (Format::Csv, "t.csv", csv),
        (Format::Parquet, "t.parquet", parquet),
        (Format::Mat, "t.mat", mat),
    ];
    #[cfg(feature = "hdf5")]
    forms.push((Format::Hdf5, "t.h5", hdf5));
    for (format, name, check) in forms.drain(..) {
        let path = root.path().join(name);
        let done = export(&source(&run), &Selection::default(), format, &path).unwrap();
        assert_eq!(done.rows, 2 * rows, "{name}");
        check(&path, &expected);
        std::fs::remove_file(path).unwrap();
    }
}

#[test]
fn every_form_has_all_rows_of_two_short_sessions_with_equal_values() {
    // More than a batch and a chunk, and no multiple of either. A row group takes more.
    every_form_agrees(17_001);
}

#[test]
#[ignore = "nightly: 7 s of a debug build; the fast one has fewer rows"]
fn every_form_has_all_rows_of_both_sessions_with_equal_values() {
    // More than a batch, a chunk and a row group, and no multiple of any.
    every_form_agrees(70_001);
}

#[test]
#[ignore = "a million rows take some minutes: cargo test -p cellpos-record --features hdf5 --test all exports -- --ignored"]
fn a_million_ticks_of_two_sessions_are_equal_in_every_form() {
    every_form_agrees(500_000);
}

/// Peak of the memory of this process since the last call, MB; None where the system does not say.
#[cfg(target_os = "linux")]
fn peak_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kb: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    std::fs::write("/proc/self/clear_refs", "5").ok()?;
    Some(kb / 1024.0)
}

/// The rows of a night: each form of an export streams them. Needs some 15 GB of disk for a while, and nothing else in this process.
#[cfg(target_os = "linux")]
#[test]
#[ignore = "long: 30 million rows, by itself: cargo test --release -p cellpos-record --features hdf5 --test all a_night -- --ignored --nocapture"]
fn a_night_of_thirty_million_ticks_is_exported_within_300_mb() {
    const MOST_MB: f64 = 300.0;
    let root = tempfile::tempdir().unwrap();
    let rows = 15_000_000;
    let run = run(root.path(), rows);
    println!("written: peak {:.0} MB", peak_mb().unwrap());
    let forms = [
        (Format::Csv, "t.csv"),
        (Format::Parquet, "t.parquet"),
        #[cfg(feature = "hdf5")]
        (Format::Hdf5, "t.h5"),
        (Format::Mat, "t.mat"),
    ];
    let mut peaks = Vec::new();
    for (format, name) in forms {
        let path = root.path().join(name);
        let began = std::time::Instant::now();
        let done = export(&source(&run), &Selection::default(), format, &path).unwrap();
        assert_eq!(done.rows, 2 * rows, "{name}");
        let peak = peak_mb().unwrap();
        let size = std::fs::metadata(&path).unwrap().len() >> 20;
        println!(
            "{name}: peak {peak:.0} MB, file {size} MB, {:.0} s",
            began.elapsed().as_secs_f64()
        );
        std::fs::remove_file(path).unwrap();
        peaks.push((name, peak));
    }
    assert!(peaks.iter().all(|(_, peak)| *peak < MOST_MB), "{peaks:?}");
}
