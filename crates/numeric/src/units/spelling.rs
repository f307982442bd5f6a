//! Suggests a known name for a misspelt one. Every file format of cellpos refuses unknown keys; without a suggestion the user
//! must look into the manual.

/// Letters that are compared; longer names are cut.
const MOST: usize = 40;

/// The known name nearest to a misspelt one, if it is near enough: one slip, and one more for every three letters of the shorter
/// name. Case does not count, and `-` equals `_`.
pub fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    known
        .into_iter()
        .map(|known| (distance(name, known), known))
        .min()
        .filter(|(distance, known)| {
            *distance <= 1 + name.chars().count().min(known.chars().count()) / 3
        })
        .map(|(_, known)| known)
}

/// The known name nearest to the unknown one in a message of serde: "unknown field `a`, expected one of `b`, `c`". `None` for any
/// other message, and if no name is near.
pub fn nearest_in(message: &str) -> Option<&str> {
    if !message.starts_with("unknown") {
        return None;
    }
    let mut quoted = message.split('`').skip(1).step_by(2);
    let wrong = quoted.next()?;
    // The most frequent slip is to leave out the unit.
    let with_unit = quoted.clone().find(|known| {
        let rest = known.strip_prefix(wrong);
        rest.is_some_and(|rest| rest.starts_with('_'))
    });
    with_unit.or_else(|| nearest(wrong, quoted))
}

fn letter(c: char) -> char {
    if c == '-' {
        '_'
    } else {
        c.to_ascii_lowercase()
    }
}

/// Levenshtein's edit distance.
fn distance(a: &str, b: &str) -> usize {
    let mut row = [0; MOST + 1];
    for (j, cell) in row.iter_mut().enumerate() {
        *cell = j;
    }
    let mut last = b.chars().take(MOST).count();
    for (i, from_a) in a.chars().map(letter).take(MOST).enumerate() {
        let mut diagonal = i;
        row[0] = i + 1;
        last = 0;
        for (j, from_b) in b.chars().map(letter).take(MOST).enumerate() {
            let substituted = diagonal + usize::from(from_a != from_b);
            diagonal = row[j + 1];
            row[j + 1] = substituted.min(row[j] + 1).min(diagonal + 1);
            last = j + 1;
        }
    }
    row[last]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slip_of_the_keyboard_finds_its_word() {
        let words = ["amplitude", "frequency_hz", "cycles", "Kp"];
        for (typed, meant) in [
            ("amplitud", "amplitude"),
            ("freqency_hz", "frequency_hz"),
            ("Frequency-Hz", "frequency_hz"),
            ("cycels", "cycles"),
            ("kp", "Kp"),
        ] {
            assert_eq!(nearest(typed, words), Some(meant), "{typed}");
        }
        for far in ["colour", "zzzzzzzz", "speed_um_per_s"] {
            assert_eq!(nearest(far, words), None, "{far}");
        }
        assert_eq!(nearest("anything", []), None);
    }

    #[test]
    fn the_key_that_was_meant_is_found_in_a_message_of_serde() {
        for (message, meant) in [
            (
                "unknown field `latency`, expected one of `latency_ms`, `rate_hz`",
                Some("latency_ms"),
            ),
            (
                "unknown variant `lgq`, expected one of `pi`, `lqg`",
                Some("lqg"),
            ),
            ("unknown field `zzzzzzzzz`, expected `rate_hz`", None),
            ("missing field `rate_hz`", None),
            ("invalid type", None),
        ] {
            assert_eq!(nearest_in(message), meant, "{message}");
        }
    }

    #[test]
    fn the_distance_is_that_of_levenshtein() {
        assert_eq!(distance("kitten", "sitting"), 3);
        assert_eq!(distance("", "abc"), 3);
        assert_eq!(distance("abc", ""), 3);
        assert_eq!(distance("latency", "latency_ms"), 3);
        assert_eq!(distance(&"a".repeat(100), &"a".repeat(90)), 0);
    }
}
