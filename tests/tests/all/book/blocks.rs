//! Every snippet of the pages is read by the program that it is for.

use super::{Block, blocks, pages, read, root};
use cellpos_tests::programs;
use std::path::Path;

/// How a snippet is tried: the file that it goes into, and the command that reads it.
fn reader(kind: &str) -> Option<(&'static str, &'static str)> {
    Some(match kind {
        // Of a rig the devices are not there: the file alone is looked at.
        "rig" => ("rig.toml", "rig check rig.toml"),
        // A script may wait for a cell's length.
        "script" => ("script.toml", "check script.toml --rig cell.toml"),
        "model" => ("model.toml", "design --model model.toml --delay 2.5ms"),
        "calibration" => ("calibration.toml", "rig check uses-it.toml"),
        "controller" => (
            "controller.toml",
            "track --target 0um --controller controller.toml --duration 1s --clock virtual --frames off --no-record",
        ),
        "effects" => (
            "mine.toml",
            "reconcile --model eq6 --data none.csv --effects mine.toml",
        ),
        _ => return None,
    })
}

fn try_snippet(kind: &str, text: &str) -> Result<(), String> {
    let folder = tempfile::tempdir().unwrap();
    let (file, command) = reader(kind).ok_or_else(|| format!("no such kind: {kind}"))?;
    std::fs::write(folder.path().join(file), text).unwrap();
    let uses_it =
        "calibration_file = \"calibration.toml\"\n[camera]\nkind = \"socket\"\nsocket = \"c\"\n";
    std::fs::write(folder.path().join("uses-it.toml"), uses_it).unwrap();
    std::fs::copy(
        root().join("examples/cell.toml"),
        folder.path().join("cell.toml"),
    )
    .unwrap();
    let out = programs::cellpos(folder.path(), command).output().unwrap();
    let said = format!(
        "{}{}",
        programs::stdout(&out),
        String::from_utf8_lossy(&out.stderr)
    );
    let read = match kind {
        // The rig may lack keys; it must be readable.
        "rig" | "calibration" => out.status.code() != Some(2),
        // The record is not there, which is said after the effects were read.
        "effects" => said.contains("none.csv"),
        _ => out.status.success(),
    };
    if read { Ok(()) } else { Err(said) }
}

#[test]
fn every_snippet_is_read_by_the_program() {
    let mut tried = 0;
    for page in pages() {
        for block in blocks(&read(&page)) {
            let Some(kind) = block.info.strip_prefix("toml ") else {
                continue;
            };
            if kind != "fragment" {
                try_snippet(kind, &block.text)
                    .unwrap_or_else(|said| panic!("{page}:{}\n{said}", block.line));
                tried += 1;
            }
        }
    }
    assert!(tried >= 9, "only {tried} snippets were tried");
}

#[test]
fn a_wrong_snippet_of_each_kind_is_found() {
    for (kind, text) in [
        ("rig", "[camera]\nkindd = \"socket\"\n"),
        ("script", "[[step]]\ndo = \"hodl\"\n"),
        ("model", "name = \"a\"\nworking_point = 4\n"),
        ("calibration", "pixel = 1\n"),
        ("controller", "controler = \"pi\"\n"),
        ("effects", "[[effects]]\nid = \"a\"\nplce = \"chip\"\n"),
    ] {
        assert!(try_snippet(kind, text).is_err(), "{kind}");
    }
}

#[test]
fn every_block_says_what_it_is() {
    let known = |block: &Block| {
        let info = block.info.as_str();
        let plain = [
            "sh",
            "sh slow",
            "text",
            "console",
            "json",
            "rust",
            "python",
            "python pandas",
        ];
        let others = ["matlab", "r", "julia", "toml fragment"];
        plain.contains(&info)
            || others.contains(&info)
            || info
                .strip_prefix("toml ")
                .is_some_and(|kind| reader(kind).is_some())
    };
    for page in pages() {
        for block in blocks(&read(&page)) {
            // Scripts are read by the tests of their crate; the chain and installed files of rig.md by rig_page.
            let elsewhere = page == "docs/scripts.md" && block.info == "toml"
                || page == "docs/rig.md" && block.info.is_empty();
            assert!(
                known(&block) || elsewhere,
                "{page}:{}: `{}`",
                block.line,
                block.info
            );
            if block.info == "json" {
                let read: Result<serde_json::Value, _> = serde_json::from_str(&block.text);
                assert!(read.is_ok(), "{page}:{}", block.line);
            }
        }
    }
}

#[test]
fn rust_is_on_pages_that_are_compiled() {
    let compiled = read("crates/session/src/lib.rs");
    for page in pages() {
        if blocks(&read(&page))
            .iter()
            .any(|block| block.info == "rust")
        {
            let name = Path::new(&page).file_name().unwrap().to_string_lossy();
            assert!(
                compiled.contains(&format!("docs/{name}\"")),
                "{page}: include it in cellpos-session"
            );
        }
    }
    assert!(root().join("docs/embed.md").is_file());
}
