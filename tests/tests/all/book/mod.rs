//! The README and the book (docs/): every command runs, every snippet is read, every link leads somewhere, every figure has its command.
//!
//! | block | what the tests do |
//! |---|---|
//! | `sh` | the blocks of a page run in their order, in one folder with the examples |
//! | `sh slow` | the same, in the ignored test |
//! | `text`, `console` | shows what needs hardware, a network or root: commands and options exist |
//! | `toml KIND`, `json` | the program reads it; `toml fragment` is a part of a file |
//! | `rust` | compiled and run as documentation of `cellpos-session` |
//! | `python` | run by `scripts/check-python.sh` and `scripts/check-readers.sh` |
//!
//! `scripts/book-build` lets mdBook build it.

mod blocks;
mod commands;
mod pages;

use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// README.md and the pages that SUMMARY.md names, relative to the root.
fn pages() -> Vec<String> {
    let summary = read("docs/SUMMARY.md");
    let named = summary
        .lines()
        .filter_map(|line| Some(line.split_once("](")?.1.split_once(')')?.0));
    let docs = named.map(|page| format!("docs/{page}"));
    std::iter::once("README.md".to_owned())
        .chain(docs)
        .collect()
}

fn read(page: &str) -> String {
    std::fs::read_to_string(root().join(page)).unwrap_or_else(|e| panic!("{page}: {e}"))
}

/// A fenced block of a page.
struct Block {
    /// Language and more, as after the fence.
    info: String,
    text: String,
    /// Of the fence, from 1.
    line: usize,
}

fn blocks(page: &str) -> Vec<Block> {
    let mut found: Vec<Block> = Vec::new();
    let mut inside = false;
    for (n, line) in page.lines().enumerate() {
        match line.strip_prefix("```") {
            Some(_) if inside => inside = false,
            Some(info) => {
                inside = true;
                found.push(Block {
                    info: info.trim().to_owned(),
                    text: String::new(),
                    line: n + 1,
                });
            }
            None if inside => {
                let block = found.last_mut().expect("a block is open");
                block.text += line;
                block.text.push('\n');
            }
            None => {}
        }
    }
    assert!(!inside, "a block that does not end");
    found
}

#[test]
fn the_blocks_of_a_page_are_found_with_their_kind() {
    let page = "a\n```sh\none\ntwo\n```\nb\n```toml rig\nx = 1\n```\n";
    let found = blocks(page);
    assert_eq!(found.len(), 2);
    assert_eq!(
        (found[0].info.as_str(), found[0].text.as_str()),
        ("sh", "one\ntwo\n")
    );
    assert_eq!((found[1].info.as_str(), found[1].line), ("toml rig", 7));
}
