//! The columns of a record: those that a control law adds, those that an older recording lacks, and Arrow's own reading.

use super::run::{bits, policy, row};
use cellpos_record::{RunEnd, RunMeta, RunReader, RunWriter, Selection, Source, write_csv};
use cellpos_runtime::TickRecord;
use std::path::{Path, PathBuf};

#[test]
fn arrow_itself_reads_the_stream() {
    let root = tempfile::tempdir().unwrap();
    let mut writer =
        RunWriter::create_with(root.path(), RunMeta::new("t", "virtual"), policy(16)).unwrap();
    (0..50).for_each(|seq| writer.tick(&row(seq)));
    let folder = writer.finish(RunEnd::new("done")).folder;
    let file = std::fs::File::open(folder.join("ticks.arrow")).unwrap();
    let rows: usize = arrow_ipc::reader::StreamReader::try_new(file, None)
        .unwrap()
        .map(|batch| batch.unwrap().num_rows())
        .sum();
    assert_eq!(rows, 50);
}

/// A run of 50 rows as it was written before a column existed, and before rows had a check.
fn recorded_without(root: &Path, missing: &str, row: impl Fn(u64) -> TickRecord) -> PathBuf {
    let mut writer =
        RunWriter::create_with(root, RunMeta::new("t", "virtual"), policy(16)).unwrap();
    (0..50).for_each(|seq| writer.tick(&row(seq)));
    let folder = writer.finish(RunEnd::new("done")).folder;
    let path = folder.join("ticks.arrow");
    let file = std::fs::File::open(&path).unwrap();
    let mut batches: Vec<arrow_array::RecordBatch> =
        arrow_ipc::reader::StreamReader::try_new(file, None)
            .unwrap()
            .map(Result::unwrap)
            .collect();
    for batch in &mut batches {
        for name in [missing, "check"] {
            let place = batch.schema().index_of(name).unwrap();
            batch.remove_column(place);
        }
    }
    let file = std::fs::File::create(&path).unwrap();
    let mut old = arrow_ipc::writer::StreamWriter::try_new(file, &batches[0].schema()).unwrap();
    for batch in &batches {
        old.write(batch).unwrap();
    }
    old.finish().unwrap();
    folder
}

#[test]
fn the_error_of_a_recording_from_before_it_was_kept_is_counted_from_the_reference_at_the_exposure()
{
    let root = tempfile::tempdir().unwrap();
    // A reference that moves by 0.5 um each tick; the exposure is two ticks old.
    let folder = recorded_without(root.path(), "error_um", |seq| TickRecord {
        target_um: seq as f64 * 0.5,
        verdict: u8::from(seq == 30),
        ..row(seq)
    });
    let (ticks, _) = RunReader::open(&folder).unwrap().ticks().unwrap();
    assert_eq!(ticks.len(), 50);
    for tick in &ticks {
        let then_um = (tick.seq as f64 - 2.0) * 0.5;
        if tick.seq < 2 || tick.seq == 30 {
            assert!(tick.error_um.is_nan(), "{}", tick.seq);
        } else {
            let off_um = tick.error_um - (tick.measured_um - then_um);
            assert!(off_um.abs() < 1e-12, "{}: {off_um}", tick.seq);
        }
    }
}

#[test]
fn a_recording_from_before_a_column_existed_reads_with_nothing_known_of_it() {
    let root = tempfile::tempdir().unwrap();
    let folder = recorded_without(root.path(), "area_um2", row);
    let (ticks, lost) = RunReader::open(&folder).unwrap().ticks().unwrap();
    assert_eq!(
        (ticks.len(), lost.damaged_bytes, lost.finished),
        (50, 0, true)
    );
    for (tick, seq) in ticks.iter().zip(0..) {
        assert!(tick.area_um2.is_nan());
        let expected = TickRecord {
            area_um2: tick.area_um2,
            ..row(seq)
        };
        assert_eq!(bits(tick), bits(&expected));
    }
    let mut csv = Vec::new();
    let source = Source::single(RunReader::open(&folder).unwrap());
    write_csv(&source, &Selection::default(), &mut csv).unwrap();
    let csv = String::from_utf8(csv).unwrap();
    assert!(
        csv.lines().skip(1).all(|line| line.contains(",9.5,,")),
        "{csv}"
    );
}

#[test]
fn a_control_law_has_its_own_columns_under_its_own_names() {
    let root = tempfile::tempdir().unwrap();
    let mut meta = RunMeta::new("law", "real");
    meta.law_columns = vec!["pi_integral_um".into(), "pi_lead_um".into()];
    let mut writer = RunWriter::create_with(root.path(), meta.clone(), policy(16)).unwrap();
    let own = |seq: u64| {
        let mut row = row(seq);
        row.law = std::array::from_fn(|i| {
            if i < 2 {
                (seq + i as u64) as f32 / 3.0
            } else {
                f32::NAN
            }
        });
        row
    };
    (0..40).for_each(|seq| writer.tick(&own(seq)));
    let folder = writer.folder().to_owned();
    drop(writer);
    let reader = RunReader::open(&folder).unwrap();
    assert_eq!(reader.law_columns(), ["pi_integral_um", "pi_lead_um"]);
    let (ticks, lost) = reader.ticks().unwrap();
    assert_eq!((ticks.len(), lost.damaged_rows), (40, 0));
    for (tick, seq) in ticks.iter().zip(0..) {
        assert_eq!(tick.law.map(f32::to_bits), own(seq).law.map(f32::to_bits));
    }
    let file = std::fs::File::open(folder.join("ticks.arrow")).unwrap();
    let stream = arrow_ipc::reader::StreamReader::try_new(file, None).unwrap();
    assert!(
        stream.schema().index_of("pi_lead_um").is_ok(),
        "any Arrow library sees them"
    );
    meta.law_columns.push("command_um".into());
    let error = RunWriter::create(root.path(), meta)
        .err()
        .unwrap()
        .to_string();
    assert!(error.contains("`command_um`"), "{error}");
}
