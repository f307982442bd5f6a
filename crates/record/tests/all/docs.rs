//! The reference page of the data agrees with the data.

use cellpos_record::export::columns::{COLUMNS, OF_LAWS, Value, of_law};
use cellpos_runtime::TickFlags;

fn page() -> String {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/data.md");
    std::fs::read_to_string(path).unwrap()
}

/// The page is for people; the files have `um` and `us`.
fn as_people_write(unit: &str) -> String {
    match unit {
        "us" => "µs".to_owned(),
        unit => unit.replace("um", "µm").replace("m2", "m²"),
    }
}

#[test]
fn every_column_is_on_the_page_with_unit_words_and_meaning() {
    let page = page();
    for column in COLUMNS {
        let unit = as_people_write(column.unit);
        let line = format!("| `{}` | {unit} | {} |", column.name, column.about);
        assert!(page.contains(&line), "docs/data.md lacks the line\n{line}");
        if let Value::Code(codes, _) = column.value {
            let words: Vec<String> = codes
                .iter()
                .map(|(number, word)| format!("{number} `{word}`"))
                .collect();
            let line = format!("| `{}` | {} |", column.name, words.join(", "));
            assert!(page.contains(&line), "docs/data.md lacks the line\n{line}");
        }
    }
    for (name, about) in OF_LAWS {
        let name = [(*name).to_owned()];
        let columns = of_law(&name);
        let unit = as_people_write(columns[0].unit);
        let line = format!("| `{}` | {unit} | {about} |", columns[0].name);
        assert!(page.contains(&line), "docs/data.md lacks the line\n{line}");
    }
    let (_, behind) = page.split_once("### Ticks").expect("the heading");
    let (tables, _) = behind
        .split_once("Words and their numbers")
        .expect("the words");
    let columns = tables.lines().filter(|line| line.starts_with("| `"));
    assert_eq!(
        columns.count(),
        COLUMNS.len() + OF_LAWS.len(),
        "a column that is gone is on the page"
    );
}

#[test]
fn every_bit_of_the_flags_is_on_the_page() {
    let page = page();
    for (name, value) in [
        ("timer", TickFlags::TIMER),
        ("late", TickFlags::LATE),
        ("dropped-frame", TickFlags::DROPPED_FRAME),
        ("records-lost", TickFlags::RECORDS_LOST),
        ("stuck", TickFlags::STUCK),
        ("command-lost", TickFlags::COMMAND_LOST),
        ("clipped", TickFlags::CLIPPED),
        ("partner-heard", TickFlags::PARTNER_HEARD),
        ("partner-lost", TickFlags::PARTNER_LOST),
        ("partner-limited", TickFlags::PARTNER_LIMITED),
        ("vision-slow", TickFlags::VISION_SLOW),
    ] {
        assert!(page.contains(&format!("| {value} | {name} |")), "{name}");
    }
    assert!(page.contains(&format!(
        "format` in run.toml is {}",
        cellpos_record::FORMAT
    )));
}
