//! Units as people write them: files and programs have `um`, pages have `µm`.

/// Units that are separate words.
const WORDS: [(&str, &str); 5] = [
    ("um", "\u{b5}m"),
    ("um2", "\u{b5}m\u{b2}"),
    ("um^2", "\u{b5}m\u{b2}"),
    ("rtHz", "\u{221a}Hz"),
    ("+-", "\u{b1}"),
];
/// Units that are also English words: they count only after a number, or alone in brackets.
const AFTER_NUMBERS: [(&str, &str); 2] = [("us", "\u{b5}s"), ("deg", "\u{b0}")];

/// A text with its units as people write them. Names of keys, columns and files stay as they are.
pub fn typeset(text: &str) -> String {
    let mut out = String::with_capacity(text.len() + 8);
    let mut rest = text;
    'text: while let Some(first) = rest.chars().next() {
        let before = out.chars().next_back();
        if starts_word(before) {
            let words = WORDS.iter().map(|pair| (pair, true));
            let others = AFTER_NUMBERS.iter().map(|pair| (pair, false));
            // Of two with the same beginning, try the longer first.
            for ((name, sign), alone) in words.rev().chain(others) {
                let Some(after) = rest.strip_prefix(name) else {
                    continue;
                };
                if ends_word(after) && (alone || follows_number(&out, after)) {
                    if *name == "deg" && out.ends_with(' ') {
                        out.pop();
                    }
                    out.push_str(sign);
                    rest = after;
                    continue 'text;
                }
            }
        }
        out.push(first);
        rest = &rest[first.len_utf8()..];
    }
    out
}

/// Whether a unit may begin after this character: it may directly after a digit.
fn starts_word(before: Option<char>) -> bool {
    before.is_none_or(|c| !(c.is_alphabetic() || matches!(c, '_' | '-' | '.')))
}

fn ends_word(after: &str) -> bool {
    let mut next = after.chars();
    match next.next() {
        None => true,
        Some('.') => !next.next().is_some_and(char::is_alphanumeric),
        Some(c) => !(c.is_alphanumeric() || matches!(c, '_' | '-')),
    }
}

fn follows_number(before: &str, after: &str) -> bool {
    let mut back = before.chars().rev();
    match back.next() {
        Some(' ' | '\u{a0}') => back.next().is_some_and(|c| c.is_ascii_digit()),
        Some('(') => after.starts_with(')'),
        Some(c) => c.is_ascii_digit(),
        None => after.is_empty(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_set_and_names_stay() {
        for (text, set) in [
            ("2.5 um at 3um/s", "2.5 µm at 3µm/s"),
            ("bead (um)", "bead (µm)"),
            ("um", "µm"),
            (
                "0.33 um2/s and 4 um^2, 3 um.",
                "0.33 µm²/s and 4 µm², 3 µm.",
            ),
            ("1.0 +- 0.1, nm/rtHz", "1.0 ± 0.1, nm/√Hz"),
            (
                "time (us), 45 deg, phase (deg)",
                "time (µs), 45°, phase (°)",
            ),
            ("12 us late; tell us more", "12 µs late; tell us more"),
            (
                "pixel_um, um_per_px, um.csv, maximum, um-scale",
                "pixel_um, um_per_px, um.csv, maximum, um-scale",
            ),
            ("deg", "°"),
        ] {
            assert_eq!(typeset(text), set);
        }
    }
}
