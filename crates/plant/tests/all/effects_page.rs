//! docs/effects.md has every effect, as the table of the code has it. With CELLPOS_WRITE_SCHEMAS=1 the test writes the table.

use cellpos_plant::effects;
use std::path::Path;

const BEGIN: &str = "<!-- effects of the catalogue -->\n";
const END: &str = "<!-- end -->";

fn table() -> String {
    let mut text = "| id | place | equation | parameters |\n|---|---|---|---|\n".to_owned();
    for kind in effects::built_in() {
        let spec = kind.spec();
        let form = &spec.forms[0];
        let parameters = form.scalars.iter().chain(form.lists).map(|parameter| {
            let unit = match parameter.unit {
                "" | "1" => String::new(),
                unit => format!(" ({})", as_people_write(unit)),
            };
            format!("`{}`{unit}", parameter.name)
        });
        let parameters: Vec<String> = parameters.collect();
        text += &format!(
            "| `{}` | {} | {} | {} |\n",
            spec.id,
            spec.place.word(),
            spec.equation.replace('|', "\\|"),
            parameters.join(", ")
        );
    }
    text
}

/// The page is for people; the files of the catalogue have `um` and `deg`.
fn as_people_write(unit: &str) -> String {
    unit.replace("um", "µm")
        .replace("deg", "°")
        .replace("^2", "²")
}

#[test]
fn the_page_of_effects_is_what_the_code_says() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/effects.md");
    let page = std::fs::read_to_string(&path).expect("docs/effects.md");
    let (before, behind) = page.split_once(BEGIN).expect("the mark");
    let (there, after) = behind.split_once(END).expect("the end of the mark");
    let table = table();
    if std::env::var_os("CELLPOS_WRITE_SCHEMAS").is_some() {
        std::fs::write(&path, format!("{before}{BEGIN}{table}{END}{after}")).expect("written");
        return;
    }
    assert_eq!(
        there, table,
        "docs/effects.md is not what the code says: CELLPOS_WRITE_SCHEMAS=1 writes it"
    );
}
