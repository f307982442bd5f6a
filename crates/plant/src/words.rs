//! Messages of the TOML reader in plain words.

/// A message of serde in plain words: a reader of a TOML file need not know Rust types.
pub fn in_words(message: &str) -> String {
    const WORDS: [(&str, &str); 19] = [
        ("f64", "a number"),
        ("f32", "a number"),
        ("u64", "a whole number from 0"),
        ("u32", "a whole number from 0"),
        ("u16", "a whole number from 0 to 65535"),
        ("u8", "a whole number from 0 to 255"),
        ("usize", "a whole number from 0"),
        ("i64", "a whole number"),
        ("i32", "a whole number"),
        ("i16", "a whole number"),
        ("isize", "a whole number"),
        ("bool", "true or false"),
        ("a boolean", "true or false"),
        ("a string", "a text in quotes"),
        ("a borrowed string", "a text in quotes"),
        ("string or map", "a word in quotes"),
        ("a sequence", "a list"),
        ("unit", "nothing"),
        ("path string", "a path in quotes"),
    ];
    let (before, expected) = match message.rsplit_once("expected ") {
        Some((before, expected)) if message.starts_with("invalid") => (before, expected),
        _ => return message.to_owned(),
    };
    let plain = WORDS
        .iter()
        .find(|(word, _)| *word == expected)
        .map(|(_, plain)| (*plain).to_owned())
        .or_else(|| {
            expected
                .starts_with("struct ")
                .then(|| "a table".to_owned())
        })
        .or_else(|| {
            let kind = expected.split(' ').any(|word| word == "enum");
            kind.then(|| "one of its words in quotes".to_owned())
        })
        .unwrap_or_else(|| expected.to_owned());
    let before = before
        .replace("invalid type: ", "is ")
        .replace("invalid value: ", "is ")
        .replace("floating point", "the number")
        .replace("integer", "the whole number")
        .replace("string \"", "the text \"")
        .replace("map", "a table")
        .replace("sequence", "a list");
    format!("{before}must be {plain}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_serde_are_told_without_the_types_of_the_language() {
        for (message, told) in [
            (
                "invalid type: string \"fast\", expected f64",
                "is the text \"fast\", must be a number",
            ),
            (
                "invalid type: integer `5`, expected a string",
                "is the whole number `5`, must be a text in quotes",
            ),
            (
                "invalid value: integer `-3`, expected u64",
                "is the whole number `-3`, must be a whole number from 0",
            ),
            (
                "invalid type: floating point `1.5`, expected struct Timing",
                "is the number `1.5`, must be a table",
            ),
            ("missing field `rate_hz`", "missing field `rate_hz`"),
        ] {
            assert_eq!(in_words(message), told);
        }
    }
}
