//! The items that a source file defines, and the items of its crate that it names.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A source file without comments, text and characters, and without its `#[cfg(test)]` items.
fn code(text: &str) -> String {
    without_tests(&without_literals(text))
}

fn without_literals(text: &str) -> String {
    let bytes: Vec<char> = text.chars().collect();
    let mut out = String::with_capacity(text.len());
    let at = |i: usize| bytes.get(i).copied().unwrap_or('\0');
    let mut i = 0;
    while i < bytes.len() {
        match (at(i), at(i + 1)) {
            ('/', '/') => {
                while i < bytes.len() && at(i) != '\n' {
                    i += 1;
                }
            }
            ('/', '*') => {
                while i < bytes.len() && !(at(i) == '*' && at(i + 1) == '/') {
                    i += 1;
                }
                i += 2;
            }
            ('r', '"' | '#') if !out.ends_with(|c: char| c.is_alphanumeric() || c == '_') => {
                let hashes = (i + 1..).take_while(|&k| at(k) == '#').count();
                if at(i + 1 + hashes) == '"' {
                    i += 2 + hashes;
                    let closes = |i: usize| at(i) == '"' && (1..=hashes).all(|k| at(i + k) == '#');
                    while i < bytes.len() && !closes(i) {
                        i += 1;
                    }
                    i += 1 + hashes;
                } else {
                    out.push('r');
                    i += 1;
                }
            }
            ('"', _) => {
                i += 1;
                while i < bytes.len() && at(i) != '"' {
                    i += if at(i) == '\\' { 2 } else { 1 };
                }
                i += 1;
            }
            ('\'', '\\') => {
                i += 2;
                while i < bytes.len() && at(i) != '\'' {
                    i += 1;
                }
                i += 1;
            }
            ('\'', _) if at(i + 2) == '\'' => i += 3,
            (c, _) => {
                out.push(c);
                i += 1;
            }
        }
    }
    out
}

fn without_tests(text: &str) -> String {
    const MARK: &str = "#[cfg(test)]";
    let mut out = String::new();
    let mut rest = text;
    while let Some(at) = rest.find(MARK) {
        out.push_str(&rest[..at]);
        rest = &rest[at + MARK.len()..];
        // The item ends with its first `;` outside braces, or with the brace that closes its first one.
        let mut depth = 0;
        let mut end = rest.len();
        for (i, c) in rest.char_indices() {
            match c {
                '{' => depth += 1,
                '}' => {
                    depth -= 1;
                    if depth == 0 {
                        end = i + 1;
                        break;
                    }
                }
                ';' if depth == 0 => {
                    end = i + 1;
                    break;
                }
                _ => {}
            }
        }
        rest = &rest[end..];
    }
    out.push_str(rest);
    out
}

/// One module: a file, its path in the crate, the items that it defines, and those of its crate that it names.
pub(super) struct Module {
    pub file: PathBuf,
    pub defines: BTreeSet<String>,
    /// `pub use`: the name given, the path it stands for.
    pub passed_on: Vec<(String, Vec<String>)>,
    pub names: Vec<Vec<String>>,
}

/// Path of a file as a module of its crate.
pub(super) fn module_path(source: &Path, file: &Path) -> Vec<String> {
    let inner = file.strip_prefix(source).unwrap().with_extension("");
    let mut parts: Vec<String> = inner
        .iter()
        .map(|part| part.to_string_lossy().into_owned())
        .collect();
    if matches!(
        parts.last().map(String::as_str),
        Some("mod" | "lib" | "main")
    ) {
        parts.pop();
    }
    parts
}

fn words(text: &str) -> Vec<String> {
    let mut found = vec![];
    let mut word = String::new();
    let mut characters = text.chars().peekable();
    while let Some(c) = characters.next() {
        if c.is_alphanumeric() || c == '_' {
            word.push(c);
            continue;
        }
        if !word.is_empty() {
            found.push(std::mem::take(&mut word));
        }
        if c == ':' && characters.peek() == Some(&':') {
            characters.next();
            found.push("::".to_string());
        } else if !c.is_whitespace() {
            found.push(c.to_string());
        }
    }
    if !word.is_empty() {
        found.push(word);
    }
    found
}

/// The paths of a use tree, each with the name it is given.
fn use_tree(words: &[String], prefix: &[String], found: &mut Vec<(String, Vec<String>)>) {
    let mut path = prefix.to_vec();
    let mut i = 0;
    while i < words.len() {
        match words[i].as_str() {
            "::" => i += 1,
            "{" => {
                let mut depth = 0;
                let mut start = i + 1;
                for (k, word) in words.iter().enumerate().skip(i) {
                    match word.as_str() {
                        "{" => depth += 1,
                        "}" => depth -= 1,
                        _ => {}
                    }
                    if (word == "," && depth == 1) || depth == 0 {
                        if start < k {
                            use_tree(&words[start..k], &path, found);
                        }
                        start = k + 1;
                    }
                    if depth == 0 {
                        return;
                    }
                }
                return;
            }
            "as" => {
                let name = words.get(i + 1).cloned().unwrap_or_default();
                found.push((name, path));
                return;
            }
            "self" if !path.is_empty() && i + 1 == words.len() => i += 1,
            word => {
                path.push(word.to_string());
                i += 1;
            }
        }
    }
    let name = path.last().cloned().unwrap_or_default();
    found.push((name, path));
}

/// Reads a file.
pub(super) fn read_module(file: &Path) -> Module {
    const ITEMS: [&str; 9] = [
        "fn",
        "struct",
        "enum",
        "trait",
        "const",
        "static",
        "type",
        "union",
        "macro_rules",
    ];
    let words = words(&code(&std::fs::read_to_string(file).unwrap()));
    let mut module = Module {
        file: file.to_path_buf(),
        defines: BTreeSet::new(),
        passed_on: vec![],
        names: vec![],
    };
    let mut i = 0;
    let mut public = false;
    while i < words.len() {
        let word = words[i].as_str();
        if word == "use" && words.get(i + 1).is_some_and(|next| next != "<") {
            let end = (i..words.len())
                .find(|&k| words[k] == ";")
                .unwrap_or(words.len());
            let mut tree = vec![];
            use_tree(&words[i + 1..end], &[], &mut tree);
            module
                .names
                .extend(tree.iter().map(|(_, path)| path.clone()));
            if public {
                module.passed_on.extend(tree);
            }
            i = end;
        } else if ITEMS.contains(&word) {
            let name = words[i + 1..]
                .iter()
                .find(|w| !matches!(w.as_str(), "!" | "mut" | "fn"));
            module.defines.extend(name.cloned());
        } else if matches!(word, "crate" | "super") && words.get(i + 1).is_some_and(|w| w == "::") {
            let mut path = vec![word.to_string()];
            while words.get(i + 1).is_some_and(|w| w == "::")
                && words
                    .get(i + 2)
                    .is_some_and(|w| w.starts_with(|c: char| c.is_alphabetic() || c == '_'))
            {
                path.push(words[i + 2].clone());
                i += 2;
            }
            module.names.push(path);
        }
        // Skips `pub`, `pub(crate)`, `pub(super)` before an item.
        public = word == "pub" || (public && matches!(word, "(" | "crate" | "super" | ")"));
        i += 1;
    }
    module
}
