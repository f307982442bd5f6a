//! Pages, links, figures and size of the book.

use super::{pages, read, root};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Targets of the links and pictures of a page, without code.
fn links(text: &str) -> Vec<(bool, String)> {
    let mut found = Vec::new();
    let mut code = false;
    for line in text.lines() {
        if line.starts_with("```") {
            code = !code;
        }
        if code {
            continue;
        }
        // Inline code shows brackets that are no links.
        let plain: String = line.split('`').step_by(2).collect::<Vec<_>>().join("x");
        let mut rest = plain.as_str();
        while let Some((before, behind)) = rest.split_once("](") {
            let Some((target, more)) = behind.split_once(')') else {
                break;
            };
            let opened = before.rfind('[').unwrap_or(0);
            found.push((before[..opened].ends_with('!'), target.to_owned()));
            rest = more;
        }
    }
    found
}

/// The anchors of a page's headings, as Git hosts and mdBook make them.
fn anchors(text: &str) -> BTreeSet<String> {
    let mut code = false;
    let mut found = BTreeSet::new();
    for line in text.lines() {
        if line.starts_with("```") {
            code = !code;
        }
        if !code && line.starts_with('#') {
            let title = line.trim_start_matches('#').trim().to_lowercase();
            let kept = title
                .chars()
                .filter(|c| c.is_alphanumeric() || " -_".contains(*c));
            found.insert(kept.map(|c| if c == ' ' { '-' } else { c }).collect());
        }
    }
    found
}

fn images() -> BTreeMap<String, u64> {
    let folder = std::fs::read_dir(root().join("docs/images")).expect("docs/images");
    folder
        .flatten()
        .map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            (name, entry.metadata().expect("a file").len())
        })
        .collect()
}

#[test]
fn every_page_is_in_the_summary_and_begins_with_its_title() {
    let listed: BTreeSet<PathBuf> = pages().iter().map(|page| root().join(page)).collect();
    let docs = std::fs::read_dir(root().join("docs")).expect("docs");
    for path in docs.flatten().map(|entry| entry.path()) {
        let is_page = path.extension().is_some_and(|end| end == "md");
        if is_page && path.file_name().is_some_and(|name| name != "SUMMARY.md") {
            assert!(
                listed.contains(&path),
                "{} is not in docs/SUMMARY.md",
                path.display()
            );
        }
    }
    for page in pages() {
        assert!(
            read(&page).starts_with("# "),
            "{page} begins without a title"
        );
    }
}

#[test]
fn every_link_leads_to_a_page_and_a_heading_that_exist() {
    let mut followed = 0;
    for page in pages() {
        let text = read(&page);
        let folder = root().join(Path::new(&page).parent().expect("a folder"));
        for (_, target) in links(&text) {
            if target.contains("://") || target.starts_with("mailto:") {
                continue;
            }
            let (file, anchor) = target.split_once('#').unwrap_or((&target, ""));
            let path = if file.is_empty() {
                root().join(&page)
            } else {
                folder.join(file)
            };
            assert!(path.exists(), "{page}: ({target}) leads nowhere");
            // The built book holds docs/ alone.
            assert!(
                page == "README.md" || !file.contains(".."),
                "{page}: ({target}) leaves the book"
            );
            if !anchor.is_empty() {
                let there = anchors(&std::fs::read_to_string(&path).expect("a page"));
                assert!(
                    there.contains(anchor),
                    "{page}: ({target}) has no such heading: {there:?}"
                );
            }
            followed += 1;
        }
    }
    assert!(followed > 100, "only {followed} links were found");
}

#[test]
fn every_figure_is_shown_and_made_by_a_command() {
    let maker = read("scripts/book/figures.py") + &read("scripts/book/drawings.py");
    let shown: BTreeSet<String> = pages()
        .iter()
        .flat_map(|page| links(&read(page)))
        .filter(|(is_picture, _)| *is_picture)
        .map(|(_, target)| target.rsplit('/').next().expect("a name").to_owned())
        .collect();
    assert!(shown.len() >= 25, "only {} figures", shown.len());
    for (name, bytes) in images() {
        assert!(shown.contains(&name), "docs/images/{name} is on no page");
        let stem = name.split('.').next().expect("a name");
        // Those of the outlines are drawn by a test of cellpos-vision.
        let made = maker.contains(stem) || stem.starts_with("outlines-");
        assert!(made, "no command makes docs/images/{name}");
        let most = if name.ends_with(".webp") {
            2_000_000
        } else {
            300_000
        };
        assert!(
            (1000..=most).contains(&bytes),
            "docs/images/{name} has {bytes} bytes"
        );
    }
}

/// Words of a page with its code: they have a letter or a digit, unlike bars of tables and operators.
fn words(text: &str) -> usize {
    let is_word = |word: &&str| word.chars().any(char::is_alphanumeric);
    text.split_whitespace().filter(is_word).count()
}

#[test]
fn the_book_has_at_most_20000_words_and_the_readme_120_lines() {
    let docs = pages().into_iter().filter(|page| page.starts_with("docs/"));
    let all: usize = docs.map(|page| words(&read(&page))).sum();
    assert!(all <= 20_000, "{all} words");
    assert!(read("README.md").lines().count() <= 120);
    assert_eq!(words("one `two` - 3\n| four | |\n```text\nfive\n```\n"), 6);
}

/// What `scripts/book-measure` wrote, between its marks.
fn marked<'a>(text: &'a str, name: &str) -> &'a str {
    let open = format!("<!-- {name} -->\n");
    let (_, behind) = text
        .split_once(&open)
        .unwrap_or_else(|| panic!("no {open}"));
    behind
        .split_once("<!-- end -->")
        .expect("the end of the mark")
        .0
}

#[test]
fn figures_in_the_readme_are_those_that_were_measured() {
    let measured: serde_json::Value =
        serde_json::from_str(&read("docs/measurements.json")).expect("JSON");
    let shown = |id: &str| {
        let figures = measured["figures"].as_array().expect("a list");
        let figure = figures.iter().find(|figure| figure["id"] == id);
        figure.unwrap_or_else(|| panic!("no {id}"))["shown"]
            .as_str()
            .expect("a text")
            .to_owned()
    };
    let readme = read("README.md");
    let table = marked(&readme, "measured");
    let mut rows = 0;
    for line in table.lines().filter(|line| line.starts_with("| `")) {
        let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
        assert_eq!(
            cells[2],
            shown(cells[0].trim_matches('`')),
            "{line}: run scripts/book-measure"
        );
        rows += 1;
    }
    assert!(rows >= 5, "{rows} figures in the README");
    // The drawing has the same texts: it is written together with the table.
    let drawn = read("docs/images/proof.svg");
    for id in [
        "hold.pi",
        "hold.lead",
        "hold.lqg",
        "hold.mpc",
        "hold.bound",
        "vision.cellpos",
        "vision.trackpy",
    ] {
        let text = shown(id);
        assert!(
            drawn.contains(&text),
            "proof.svg lacks {id}, {text}: run scripts/book-measure --write"
        );
    }
    // Outside the table no figure is claimed: a unit of precision behind a number is one.
    let elsewhere = readme.replace(table, "");
    for unit in [" nm", " ns", " us ", " px"] {
        for (at, _) in elsewhere.match_indices(unit) {
            let before = elsewhere[..at].chars().next_back();
            assert!(
                !before.is_some_and(|c| c.is_ascii_digit()),
                "a figure by hand before `{unit}`"
            );
        }
    }
    let page = read("docs/measurements.md");
    let (figures, _) = page.split_once("## Long tables").expect("the long tables");
    for line in figures.lines().filter(|line| line.starts_with("| `")) {
        let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
        assert_eq!(
            cells[2],
            shown(cells[0].trim_matches('`')),
            "docs/measurements.md: {line}"
        );
    }
}

#[test]
fn links_pictures_and_headings_are_told_apart() {
    let text = "# A `b`, C\n[x](y.md#z) ![p](q.png) `[no](no)`\n```\n[no](no)\n```\n";
    assert_eq!(
        links(text),
        [(false, "y.md#z".to_owned()), (true, "q.png".to_owned())]
    );
    assert_eq!(anchors(text).into_iter().collect::<Vec<_>>(), ["a-b-c"]);
}
