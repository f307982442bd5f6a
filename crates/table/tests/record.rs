//! Behaviour of reading and writing records.

use cellpos_table::{ColumnRef, Gaps, Mapping, Record, Table, TableError, TableProblem};
use proptest::prelude::*;
use std::path::Path;

fn parse(text: &str) -> Result<Record, TableError> {
    Record::parse(Path::new("in.csv"), text, &Mapping::default())
}

#[test]
fn a_record_written_reads_back_to_the_bit() {
    let n = 5000;
    let pzt: Vec<f64> = (0..n).map(|k| 20.0 + (f64::from(k) * 0.1).sin()).collect();
    let mut bead: Vec<f64> = (0..n).map(|k| (f64::from(k) * 0.3).cos() / 3.0).collect();
    bead[7] = f64::NAN;
    let mut record = Record::new("x.csv", 0.001, pzt, bead);
    record.more.push(("true_um".into(), vec![0.1; n as usize]));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("new/x.csv");
    record.write(&path).unwrap();
    let back = Record::read(&path, &Mapping::default()).unwrap();
    assert_eq!(back.pzt_um, record.pzt_um);
    assert_eq!(back.more, record.more);
    assert_eq!(back.step_s, 0.001);
    for (row, (a, b)) in back.bead_um.iter().zip(&record.bead_um).enumerate() {
        assert!(
            a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan()),
            "row {row}"
        );
    }
    let names: Vec<_> = std::fs::read_dir(path.parent().unwrap()).unwrap().collect();
    assert_eq!(names.len(), 1, "no temporary file stays behind");
    assert!(std::fs::read_to_string(&path).unwrap().contains("\n0.007,"));
}

#[test]
fn wrong_units_are_refused_and_the_message_says_what_to_do() {
    let text = "time_s,pzt_um,bead_nm\n0,1,2\n0.001,1,2\n";
    let error = parse(text).unwrap_err();
    assert_eq!(
        error.to_string(),
        "in.csv: column `bead_nm` is in nanometres, but `bead_um` is needed: convert it (multiply by 0.001) and \
         rename it `bead_um`, or map the column with its factor"
    );
    let error = parse("time_s,pzt_v,bead_um\n0,1,2\n0.001,1,2\n").unwrap_err();
    assert!(error.to_string().contains("volts"), "{error}");
    let error = parse("time_ms,pzt_um,bead_um\n0,1,2\n1,1,2\n").unwrap_err();
    assert!(error.to_string().contains("milliseconds"), "{error}");
}

#[test]
fn a_missing_column_names_what_exists_and_what_was_probably_meant() {
    let error = parse("time_s,PZT_um,bead_um\n0,1,2\n0.001,1,2\n").unwrap_err();
    let text = error.to_string();
    assert!(
        text.contains("no column `pzt_um`") && text.contains("rename `PZT_um`"),
        "{text}"
    );
    let error = parse("time_s,pzt_um\n0,1\n0.001,1\n").unwrap_err();
    assert!(matches!(error.problem, TableProblem::MissingColumn { .. }));
    assert!(
        Record::parse(
            Path::new("a"),
            "time_s,pzt_um\n0,1\n0.001,1\n",
            &Mapping::commands_only()
        )
        .is_ok()
    );
}

#[test]
fn numbers_that_are_not_finite_are_refused_with_line_and_column() {
    for bad in ["NaN", "inf", "-Infinity", "1,5e", "abc", "1e999"] {
        let text = format!("time_s;pzt_um;bead_um\n0;1;2\n\n0.001;1;{bad}\n");
        let error = parse(&text).unwrap_err();
        assert_eq!(error.line, Some(4), "{bad}: {error}");
        assert!(error.to_string().contains("bead_um"), "{error}");
    }
    let error = parse("time_s,pzt_um,bead_um\n0,1,2\n0.001,,2\n").unwrap_err();
    assert!(
        matches!(error.problem, TableProblem::Cell { .. }),
        "the command is never unknown"
    );
}

#[test]
fn time_must_grow_and_be_even() {
    let error = parse("time_s,pzt_um,bead_um\n0,1,2\n0.001,1,2\n0.001,1,2\n").unwrap_err();
    assert_eq!(error.line, Some(4));
    assert!(matches!(error.problem, TableProblem::TimeOrder { .. }));
    let error = parse("time_s,pzt_um,bead_um\n0,1,\n0.001,1,\n0.002,1,\n0.0035,1,\n0.0045,1,\n")
        .unwrap_err();
    assert_eq!(error.line, Some(5));
    assert!(matches!(error.problem, TableProblem::Sampling { .. }));
    let error = parse("time_s,pzt_um,bead_um\n0,1,2\n").unwrap_err();
    assert!(matches!(error.problem, TableProblem::TooShort { rows: 1 }));
}

#[test]
fn times_rounded_to_milliseconds_at_a_rate_that_does_not_divide_are_even() {
    let mut text = String::from("time_s,pzt_um,bead_um\n");
    for k in 0..3000 {
        text.push_str(&format!("{:.3},1,2\n", f64::from(k) / 130.0));
    }
    let record = parse(&text).unwrap();
    assert!(
        (record.rate_hz() - 130.0).abs() < 3e-3,
        "{}",
        record.rate_hz()
    );
    assert!(record.jitter_s <= 0.0011);
}

#[test]
fn missing_rows_are_refused_or_held_as_asked() {
    let text =
        "time_s,pzt_um,bead_um,x\n0,1,2,5\n0.001,1.5,3,5\n0.004,7,8,5\n0.005,7,9,5\n0.006,7,9,5\n";
    assert!(matches!(
        parse(text).unwrap_err().problem,
        TableProblem::Sampling { .. }
    ));
    let mapping = Mapping {
        gaps: Gaps::Hold,
        ..Mapping::default()
    };
    let record = Record::parse(Path::new("a"), text, &mapping).unwrap();
    assert_eq!(record.filled_rows, 2);
    assert_eq!(record.pzt_um, [1.0, 1.5, 1.5, 1.5, 7.0, 7.0, 7.0]);
    assert!(record.bead_um[2].is_nan() && record.bead_um[3].is_nan());
    assert_eq!(record.bead_um[4], 8.0);
    assert!(record.column("x").unwrap()[2].is_nan());
    let far = "time_s,pzt_um,bead_um\n0,1,2\n0.001,1,2\n0.002,1,2\n1e9,1,2\n";
    let error = Record::parse(Path::new("a"), far, &mapping).unwrap_err();
    assert!(
        matches!(error.problem, TableProblem::TooManyGaps { .. }),
        "{error}"
    );
}

#[test]
fn foreign_data_are_read_by_place_rate_and_factor() {
    let text = "1.0 9 3.0\n2.0 9 4.0\n3.0 9 5.0\n";
    let mapping = Mapping {
        pzt_factor: 4.0,
        ..Mapping::foreign("1", "3", 200.0)
    };
    let record = Record::parse(Path::new("m.dat"), text, &mapping).unwrap();
    assert_eq!(record.pzt_um, [4.0, 8.0, 12.0]);
    assert_eq!(record.bead_um, [3.0, 4.0, 5.0]);
    assert_eq!(record.step_s, 0.005);
    let error = Record::parse(Path::new("m.dat"), text, &Mapping::default()).unwrap_err();
    assert!(matches!(error.problem, TableProblem::NoHeader), "{error}");
    let error =
        Record::parse(Path::new("m.dat"), text, &Mapping::foreign("1", "4", 200.0)).unwrap_err();
    assert!(error.to_string().contains("counted from 1"), "{error}");
}

#[test]
fn header_quirks_of_other_programs_do_no_harm() {
    let text =
        "\u{feff}# exported\r\n\"time_s\", \"pzt_um\", \"bead_um\"\r\n0, 1, 2\r\n0.001, 1,\r\n";
    let record = parse(text).unwrap();
    assert_eq!(record.len(), 2);
    assert!(record.bead_um[1].is_nan());
    let error = parse("time_s,pzt_um,pzt_um\n0,1,2\n").unwrap_err();
    assert!(matches!(error.problem, TableProblem::DuplicateColumn(_)));
    let error = parse("time_s,pzt_um,bead_um\n0,1\n").unwrap_err();
    assert!(matches!(
        error.problem,
        TableProblem::Fields {
            expected: 3,
            found: 2
        }
    ));
    assert!(matches!(
        parse("").unwrap_err().problem,
        TableProblem::Empty
    ));
    assert!(matches!(
        parse("time_s,pzt_um,bead_um\n").unwrap_err().problem,
        TableProblem::Empty
    ));
}

#[test]
fn a_file_that_is_no_text_or_not_there_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.csv");
    let error = Record::read(&path, &Mapping::default()).unwrap_err();
    assert!(matches!(error.problem, TableProblem::Read(_)) && error.to_string().contains("a.csv"));
    std::fs::write(&path, [0xff, 0xfe, 0x00]).unwrap();
    let error = Record::read(&path, &Mapping::default()).unwrap_err();
    assert!(matches!(error.problem, TableProblem::NotText));
}

#[test]
fn records_of_the_shared_data_are_read() {
    let root = Path::new(env!("MEASURED_DATA"));
    let path = root.join("hidden-effects/none-1/multisine-small.csv");
    let record = Record::read(&path, &Mapping::default()).unwrap();
    assert_eq!(record.len(), 16_000);
    assert!((record.rate_hz() - 1000.0).abs() < 1e-6);
    let picma = root.join("piezo-picma/Model_Vi_Do.dat");
    let record = Record::read(&picma, &Mapping::foreign("1", "5", 200.0)).unwrap();
    assert_eq!(record.len(), 8027);
    assert_eq!(record.more.len(), 5);
}

proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in "(?s).{0,200}") {
        let _ = parse(&text);
        let _ = Table::parse(Path::new("x"), &text);
    }

    #[test]
    fn no_damaged_record_makes_the_reader_panic(
        rows in proptest::collection::vec((0u32..40, proptest::num::f64::ANY, proptest::option::of(-9f64..9.0)), 0..40),
        cut in 0usize..2000,
        hold in any::<bool>(),
    ) {
        let mut text = String::from("time_s,pzt_um,bead_um\n");
        let mut time = 0;
        for (step, pzt, bead) in rows {
            time += step / 10;
            let bead = bead.map(|b| b.to_string()).unwrap_or_default();
            text.push_str(&format!("{},{pzt},{bead}\n", f64::from(time) / 1000.0));
        }
        text.truncate(cut);
        let gaps = if hold { Gaps::Hold } else { Gaps::Refuse };
        let mapping = Mapping { gaps, ..Mapping::default() };
        if let Ok(record) = Record::parse(Path::new("x"), &text, &mapping) {
            prop_assert_eq!(record.pzt_um.len(), record.bead_um.len());
            prop_assert!(record.pzt_um.iter().all(|v| v.is_finite()));
            prop_assert!(record.step_s > 0.0);
        }
    }
}

#[test]
fn a_foreign_column_may_say_nan_where_it_has_no_value_and_comments_of_other_programs_are_skipped() {
    let text = "% rig 3\nV1;V2\n1.0;NaN\n2.0;\n3.0;0.5\n";
    let table = Table::parse("in.csv".as_ref(), text).unwrap();
    let values = table.numbers_or_nan(&ColumnRef::from("V2")).unwrap();
    assert!(values[0].is_nan() && values[1].is_nan() && values[2] == 0.5);
    let error = table.numbers(&ColumnRef::from("2"), true).unwrap_err();
    assert_eq!(error.line, Some(3), "{error}");
    let word = Table::parse("in.csv".as_ref(), "a,b\n1,2\n3,oops\n").unwrap();
    let error = word.numbers_or_nan(&ColumnRef::from("b")).unwrap_err();
    assert!(
        error.to_string().contains("oops") && error.line == Some(3),
        "{error}"
    );
}

#[test]
fn tables_of_other_programs_are_read_with_decimal_commas_units_and_words_for_no_value() {
    let text = "Zeit;Heizleistung [W];Temperatur [\u{b0}C]\ns;W;\u{b0}C\n0;7,71;21,5\n2;8,00;NA\n4;-1,5e1;22\n";
    let table = cellpos_table::Table::parse("heater.csv".as_ref(), text).unwrap();
    assert_eq!(table.len(), 3, "the line of units is no row");
    let column = |name: &str| table.numbers_or_nan(&name.into()).unwrap();
    assert_eq!(column("heizleistung"), [7.71, 8.0, -15.0]);
    let warm = column("Temperatur");
    assert!(warm[0] == 21.5 && warm[1].is_nan() && warm[2] == 22.0);
    // Where commas separate, they are nothing else.
    let table = cellpos_table::Table::parse("a.csv".as_ref(), "a,b\n1,5\n2,5\n").unwrap();
    assert_eq!(table.numbers_or_nan(&"b".into()).unwrap(), [5.0, 5.0]);
    // A name that fits two columns is no name.
    let text = "p [bar],p [Pa]\n1,2\n";
    let table = cellpos_table::Table::parse("b.csv".as_ref(), text).unwrap();
    assert!(table.numbers_or_nan(&"p".into()).is_err());
    // Words in the first row that are no units stay an error with their place.
    let text = "time_s,pzt_um\n0.0,much\n";
    let table = cellpos_table::Table::parse("c.csv".as_ref(), text).unwrap();
    let error = table.numbers_or_nan(&"pzt_um".into()).unwrap_err();
    assert!(error.to_string().contains("much"), "{error}");
}
