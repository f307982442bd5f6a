//! Behaviour of run folders: whole, cut off, damaged, resumed.

use cellpos_record::{
    Event, FlushPolicy, Format, InputFile, RunEnd, RunMeta, RunReader, RunWriter, Selection,
    Source, csv_head, export, write_csv,
};
use cellpos_runtime::{TickFlags, TickRecord};
use proptest::prelude::*;
use std::path::{Path, PathBuf};

pub(crate) fn row(seq: u64) -> TickRecord {
    let x = seq as f64;
    let mut flags = TickFlags::default();
    flags.set(TickFlags::COASTING);
    TickRecord {
        seq,
        time_ns: seq as i64 * 1_000_000,
        frame_id: seq + 7,
        mid_exposure_ns: seq as i64 * 1_000_000 - 2_000_000,
        measured_um: (x * 0.1).sin(),
        variance_um2: 4e-4,
        verdict: 0,
        track: 1,
        decision: 10,
        target_um: 0.0,
        error_um: (x * 0.1).sin(),
        estimate_um: (x * 0.1).cos(),
        neutral_um: 20.0,
        requested_um: 20.0 + x / 3.0,
        command_um: 20.0 + x / 7.0,
        applied_um: f64::NAN,
        true_um: -0.0,
        life: 3,
        request: 2,
        board: 1,
        board_fault: 4,
        plan_ns: -1,
        stage: 2,
        length_um: 9.5,
        area_um2: 61.0 + x,
        length_sd_um: 0.02,
        area_sd_um2: 0.3,
        flags,
        drained: 1,
        wake_ns: 1234,
        compute_ns: 5678,
        solver_status: 1,
        solver_iterations: 9,
        solver_active: 3,
        solver_ns: 95_000,
        ..TickRecord::unknown()
    }
}

/// The bits of a row, so that NaN equals NaN and -0 does not equal 0.
pub(crate) fn bits(row: &TickRecord) -> Vec<u64> {
    let mut bits = vec![
        row.seq,
        row.time_ns as u64,
        row.frame_id,
        row.mid_exposure_ns as u64,
        row.verdict.into(),
        row.track.into(),
        row.decision.into(),
        row.life.into(),
        row.request.into(),
        row.board.into(),
        row.board_fault.into(),
        row.flags.0.into(),
        row.drained.into(),
        row.wake_ns.into(),
        row.compute_ns.into(),
        row.solver_ns.into(),
        row.solver_iterations.into(),
    ];
    let floats = [
        row.measured_um,
        row.variance_um2,
        row.target_um,
        row.error_um,
        row.estimate_um,
        row.neutral_um,
        row.requested_um,
        row.command_um,
        row.applied_um,
        row.true_um,
        row.length_um,
        row.area_um2,
        row.length_sd_um,
        row.area_sd_um2,
    ];
    bits.extend(floats.iter().map(|v| v.to_bits()));
    bits
}

pub(crate) fn policy(rows: usize) -> FlushPolicy {
    FlushPolicy {
        rows,
        interval: None,
        sync: false,
    }
}

/// A run of `rows` rows in batches of `batch`, not finished.
fn cut_off(root: &Path, rows: u64, batch: usize) -> PathBuf {
    let mut writer =
        RunWriter::create_with(root, RunMeta::new("test", "virtual"), policy(batch)).unwrap();
    (0..rows).for_each(|seq| writer.tick(&row(seq)));
    writer.event(&Event::new(0.5, "bead-lost").with("frames", 3));
    writer.folder().to_owned()
}

#[test]
fn a_finished_run_reads_back_to_the_bit_with_everything_around_it() {
    let root = tempfile::tempdir().unwrap();
    let mut meta = RunMeta::new("track", "real");
    meta.seed = Some(7);
    meta.command_line = vec!["cellpos".into(), "track".into()];
    meta.inputs.push(InputFile::of_bytes("model.toml", b"x"));
    let mut writer = RunWriter::create(root.path(), meta).unwrap();
    for seq in 0..2345 {
        writer.tick(&row(seq));
    }
    writer.event(&Event::new(1.0, "safe").with("why", "link lost"));
    let finished = writer.finish(RunEnd::new("done"));
    assert!(finished.parquet.is_ok());
    assert_eq!(finished.rows, 2345);
    assert_eq!(finished.faults, Default::default());

    let run = RunReader::open(&finished.folder).unwrap();
    let (ticks, lost) = run.ticks().unwrap();
    assert_eq!(ticks.len(), 2345);
    for (seq, tick) in ticks.iter().enumerate() {
        assert_eq!(bits(tick), bits(&row(seq as u64)));
    }
    assert!(lost.finished && lost.rows == 0 && lost.gaps.is_empty());
    let meta = run.meta().unwrap();
    assert_eq!(meta.seed, Some(7));
    let end = meta.end.as_ref().unwrap();
    assert_eq!((end.outcome.as_str(), end.rows), ("done", 2345));
    let events = run.events().unwrap();
    assert_eq!(events.unreadable_lines, 0);
    assert_eq!(events.events[0].event, "safe");
    assert_eq!(events.events[0].data["why"], "link lost");
}

#[test]
fn runs_never_overwrite_each_other() {
    let root = tempfile::tempdir().unwrap();
    let folders: Vec<PathBuf> = (0..5).map(|_| cut_off(root.path(), 3, 2)).collect();
    let mut unique = folders.clone();
    unique.sort();
    unique.dedup();
    assert_eq!(unique.len(), 5);
    for bad in ["", "../x", "a b", "a/b"] {
        assert!(
            RunWriter::create(root.path(), RunMeta::new(bad, "real")).is_err(),
            "{bad:?}"
        );
    }
}

#[test]
fn the_same_rows_give_the_same_bytes_on_the_virtual_clock() {
    let root = tempfile::tempdir().unwrap();
    let write = || {
        let mut writer = RunWriter::create(root.path(), RunMeta::new("t", "virtual")).unwrap();
        (0..10_000).for_each(|seq| writer.tick(&row(seq)));
        let folder = writer.finish(RunEnd::new("done")).folder;
        (
            std::fs::read(folder.join("ticks.arrow")).unwrap(),
            std::fs::read(folder.join("ticks.parquet")).unwrap(),
        )
    };
    assert!(write() == write());
}

#[test]
fn rows_behind_damage_are_found_again_and_the_gap_shows() {
    let root = tempfile::tempdir().unwrap();
    let folder = cut_off(root.path(), 100, 10);
    let path = folder.join("ticks.arrow");
    let mut bytes = std::fs::read(&path).unwrap();
    // Zeroes over the middle: the batch there, and the start of the next, make no sense any more.
    let middle = bytes.len() / 2;
    bytes[middle - 2000..middle + 2000].fill(0);
    std::fs::write(&path, &bytes).unwrap();
    let (ticks, lost) = RunReader::open(&folder).unwrap().ticks().unwrap();
    assert!((70..100).contains(&ticks.len()), "{}", ticks.len());
    assert_eq!(ticks.last().unwrap().seq, 99);
    assert!(lost.rows > 0 && lost.damaged_bytes > 0);
    assert_eq!(lost.rows as usize, 100 - ticks.len());
}

#[test]
fn the_last_row_of_a_kind_is_found_from_the_end_over_damage_and_a_torn_batch() {
    let root = tempfile::tempdir().unwrap();
    let folder = cut_off(root.path(), 100, 10);
    let last = |is: &dyn Fn(&TickRecord) -> bool| {
        let run = RunReader::open(&folder).unwrap();
        run.last_where(is).unwrap().map(|row| row.seq)
    };
    assert_eq!(last(&|_| true), Some(99));
    assert_eq!(last(&|row| row.seq.is_multiple_of(37)), Some(74));
    assert_eq!(last(&|row| row.stage == 7), None);
    // Damage in the middle, and the last batch torn.
    let path = folder.join("ticks.arrow");
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle..middle + 3000].fill(0x5a);
    bytes.truncate(bytes.len() - 100);
    std::fs::write(&path, &bytes).unwrap();
    assert_eq!(last(&|_| true), Some(89));
    assert_eq!(last(&|row| row.seq < 20), Some(19));
}

#[test]
fn rows_lost_before_the_recorder_show_as_a_gap() {
    let root = tempfile::tempdir().unwrap();
    let mut writer =
        RunWriter::create_with(root.path(), RunMeta::new("t", "real"), policy(10)).unwrap();
    for seq in (0..20).chain(25..40) {
        writer.tick(&row(seq));
    }
    let folder = writer.finish(RunEnd::new("done")).folder;
    let run = RunReader::open(&folder).unwrap();
    let (_, lost) = run.ticks().unwrap();
    assert_eq!(lost.rows, 5);
    assert_eq!((lost.gaps[0].after_seq, lost.gaps[0].before_seq), (19, 25));
    let record = run.to_record().unwrap();
    assert_eq!((record.len(), record.filled_rows), (40, 5));
    assert!(record.bead_um[22].is_nan() && record.pzt_um[22] == record.pzt_um[19]);
}

#[test]
fn a_torn_event_line_is_counted_and_the_others_read() {
    let root = tempfile::tempdir().unwrap();
    let folder = cut_off(root.path(), 5, 10);
    let path = folder.join("events.jsonl");
    let mut text = std::fs::read_to_string(&path).unwrap();
    text.push_str("{\"time_s\":1.0,\"eve");
    std::fs::write(&path, text).unwrap();
    let events = RunReader::open(&folder).unwrap().events().unwrap();
    assert_eq!((events.events.len(), events.unreadable_lines), (1, 1));
}

#[test]
fn exports_carry_units_in_their_names_and_follow_the_row_convention() {
    let root = tempfile::tempdir().unwrap();
    let folder = cut_off(root.path(), 100, 8);
    let run = RunReader::open(&folder).unwrap();
    let source = Source::single(RunReader::open(&folder).unwrap());
    let all = Selection::default();
    let csv = root.path().join("out/run.csv");
    let done = export(&source, &all, Format::Csv, &csv).unwrap();
    assert_eq!(done.rows, 100);
    let text = std::fs::read_to_string(&csv).unwrap();
    assert_eq!(text.lines().next(), Some(csv_head().as_str()));
    assert!(csv_head().starts_with("time_s,pzt_um,bead_um,"));
    assert_eq!(text.lines().count(), 1 + 100);
    let third: Vec<&str> = text.lines().nth(4).unwrap().split(',').collect();
    assert_eq!(third[0], "0.003");
    assert_eq!(third[1].parse::<f64>().unwrap(), 20.0 + 3.0 / 7.0);
    assert_eq!(third[2].parse::<f64>().unwrap(), (3.0f64 * 0.1).sin());
    let head = csv_head();
    let head: Vec<&str> = head.split(',').collect();
    let applied = head.iter().position(|name| *name == "applied_um").unwrap();
    assert_eq!(
        third[applied], "",
        "a number that does not exist is an empty field"
    );
    assert_eq!(head.len(), third.len());
    let area = head.iter().position(|name| *name == "area_um2").unwrap();
    assert_eq!(third[area].parse::<f64>().unwrap(), 64.0);
    let record = run.to_record().unwrap();
    assert!((record.rate_hz() - 1000.0).abs() < 1e-9);

    let parquet = root.path().join("out/run.parquet");
    export(&source, &all, Format::Parquet, &parquet).unwrap();
    let file = std::fs::File::open(&parquet).unwrap();
    let reader = parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(file)
        .unwrap()
        .build()
        .unwrap();
    let mut rows = 0;
    for batch in reader {
        let batch = batch.unwrap();
        let column = batch.column_by_name("pzt_um").unwrap();
        let column = column
            .as_any()
            .downcast_ref::<arrow_array::Float64Array>()
            .unwrap();
        for value in column.values() {
            assert_eq!(value.to_bits(), (20.0 + rows as f64 / 7.0).to_bits());
            rows += 1;
        }
        assert_eq!(batch.num_columns(), head.len());
        let applied = batch.column_by_name("applied_um").unwrap();
        assert_eq!(arrow_array::Array::null_count(applied), batch.num_rows());
    }
    assert_eq!(rows, 100);
    let names: Vec<_> = std::fs::read_dir(root.path().join("out"))
        .unwrap()
        .collect();
    assert_eq!(names.len(), 2, "no temporary file stays behind");
}

#[test]
fn a_block_of_zeros_is_no_row() {
    let root = tempfile::tempdir().unwrap();
    let folder = cut_off(root.path(), 100, 10);
    let path = folder.join("ticks.arrow");
    let mut bytes = std::fs::read(&path).unwrap();
    // A file after a crash of the system: the length is right, the last blocks were never written.
    let length = bytes.len();
    bytes[length - 1500..].fill(0);
    std::fs::write(&path, &bytes).unwrap();
    let (ticks, lost) = RunReader::open(&folder).unwrap().ticks().unwrap();
    for tick in &ticks {
        assert_eq!(bits(tick), bits(&row(tick.seq)), "row {}", tick.seq);
    }
    assert!(ticks.len() < 100);
    assert_eq!(ticks.len() as u64 + lost.damaged_rows, 100);
}

#[test]
fn a_run_of_a_later_format_is_refused_by_name() {
    let root = tempfile::tempdir().unwrap();
    let folder = cut_off(root.path(), 5, 10);
    let path = folder.join("run.toml");
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.contains("format = 2"));
    std::fs::write(&path, text.replace("format = 2", "format = 3")).unwrap();
    let error = RunReader::open(&folder).unwrap_err().to_string();
    assert!(
        error.contains("format 3") && error.contains("up to 2"),
        "{error}"
    );
}

#[test]
fn rows_that_do_not_read_back_are_counted_as_lost() {
    let root = tempfile::tempdir().unwrap();
    let mut writer =
        RunWriter::create_with(root.path(), RunMeta::new("t", "real"), policy(10)).unwrap();
    (0..50).for_each(|seq| writer.tick(&row(seq)));
    assert!(!writer.is_failing());
    std::fs::remove_dir_all(writer.folder()).unwrap();
    (50..100).for_each(|seq| writer.tick(&row(seq)));
    assert!(writer.is_failing());
    let mut end = RunEnd::new("done");
    end.rows_lost = 3;
    let done = writer.finish(end);
    assert_eq!((done.rows, done.faults.rows_lost), (0, 100));
    assert!(done.faults.first.unwrap().contains("removed"));
}

#[cfg(unix)]
#[test]
fn a_symbolic_link_in_a_run_folder_is_not_written_through() {
    let root = tempfile::tempdir().unwrap();
    let victim = root.path().join("victim");
    std::fs::write(&victim, "whole\n").unwrap();
    let link = root.path().join("cycles.csv");
    std::os::unix::fs::symlink(&victim, &link).unwrap();
    let error = cellpos_record::LineFile::open(&link, "a,b", false)
        .err()
        .unwrap();
    assert!(error.to_string().contains("symbolic link"), "{error}");
    assert_eq!(std::fs::read_to_string(&victim).unwrap(), "whole\n");
}

#[test]
fn a_part_of_a_run_is_exported_as_asked_over_its_sessions() {
    let root = tempfile::tempdir().unwrap();
    let parts = [1, 2].map(|number| cellpos_record::Part {
        reader: RunReader::open(&cut_off(root.path(), 100, 8)).unwrap(),
        number,
        offset_ns: (number as i64 - 1) * 1_000_000_000,
    });
    let source = Source::new(parts.into());
    let selection = Selection {
        from_s: 0.090,
        to_s: 1.009,
        every: 4.try_into().unwrap(),
        columns: Some(vec!["session".into(), "time_s".into(), "verdict".into()]),
    };
    let mut csv = Vec::new();
    let done = write_csv(&source, &selection, &mut csv).unwrap();
    assert_eq!(
        String::from_utf8(csv).unwrap(),
        "session,time_s,verdict\n1,0.09,good\n1,0.094,good\n1,0.098,good\n2,1.002,good\n2,1.006,good\n"
    );
    assert_eq!((done.rows, done.lost.len()), (5, 2));
    let wrong = Selection {
        columns: Some(vec!["pzt".into()]),
        ..Selection::default()
    };
    let error = write_csv(&source, &wrong, &mut Vec::new())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("`pzt`") && error.contains("pzt_um"),
        "{error}"
    );
}

#[test]
fn a_folder_that_is_no_run_is_named() {
    let root = tempfile::tempdir().unwrap();
    let error = RunReader::open(root.path()).unwrap_err();
    assert!(error.to_string().contains("not a run folder"), "{error}");
    let folder = cut_off(root.path(), 5, 10);
    std::fs::write(folder.join("run.toml"), "format = \"x").unwrap();
    let run = RunReader::open(&folder).unwrap();
    assert!(run.meta().is_err());
    assert_eq!(
        run.ticks().unwrap().0.len(),
        5,
        "rows read without metadata"
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn no_damage_makes_the_reader_panic_or_invent_rows(
        hits in proptest::collection::vec((0.0f64..1.0, any::<u8>()), 1..20),
        cut in 0.3f64..1.0,
        smear in 0usize..3000,
    ) {
        let root = tempfile::tempdir().unwrap();
        let folder = cut_off(root.path(), 60, 12);
        let path = folder.join("ticks.arrow");
        let mut bytes = std::fs::read(&path).unwrap();
        let length = bytes.len();
        for (place, value) in &hits {
            bytes[((length - 1) as f64 * place) as usize] = *value;
        }
        let start = ((length - 1) as f64 * hits[0].0) as usize;
        let end = (start + smear).min(length);
        bytes[start..end].fill(hits[0].1);
        bytes.truncate((length as f64 * cut) as usize);
        std::fs::write(&path, &bytes).unwrap();
        std::fs::write(folder.join("events.jsonl"), &bytes).unwrap();
        std::fs::write(folder.join("run.toml"), &bytes).unwrap();
        let run = RunReader::open(&folder).unwrap();
        let (ticks, _) = run.ticks().unwrap();
        prop_assert!(ticks.len() <= 60);
        let _ = run.events().unwrap();
        let _ = run.to_record();
    }
}
