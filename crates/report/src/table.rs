//! Tables, and the meaning of a row or note.

use crate::svg::set;
use std::fmt::Write;

/// The meaning of a note or a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Emphasis {
    /// Neither good nor bad.
    #[default]
    Plain,
    /// Holds, passed.
    Good,
    /// To be looked at.
    Warning,
    /// Failed, broken.
    Bad,
}

impl Emphasis {
    pub(crate) fn class(self) -> &'static str {
        match self {
            Emphasis::Plain => "plain",
            Emphasis::Good => "good",
            Emphasis::Warning => "warning",
            Emphasis::Bad => "bad",
        }
    }

    /// A sign besides the colour, for colour-blind readers and for prints.
    pub(crate) fn sign(self) -> &'static str {
        match self {
            Emphasis::Plain => "",
            Emphasis::Good => "\u{2713} ",
            Emphasis::Warning => "\u{25b2} ",
            Emphasis::Bad => "\u{2717} ",
        }
    }
}

/// Header of a column and alignment of its cells.
#[derive(Debug, Clone, PartialEq)]
pub struct Column {
    head: String,
    right: bool,
}

impl Column {
    /// Text, on the left.
    pub fn left(head: &str) -> Self {
        Self {
            head: head.to_owned(),
            right: false,
        }
    }

    /// Numbers, on the right, in figures of equal width. Write the unit in the head.
    pub fn right(head: &str) -> Self {
        Self {
            head: head.to_owned(),
            right: true,
        }
    }
}

/// A table.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    columns: Vec<Column>,
    rows: Vec<(Emphasis, Vec<String>)>,
    caption: String,
}

impl Table {
    /// A table without rows.
    pub fn new<const N: usize>(columns: [Column; N]) -> Self {
        Self::with_columns(columns.to_vec())
    }

    /// A table without rows, for a number of columns known only at run time.
    pub fn with_columns(columns: Vec<Column>) -> Self {
        Self {
            columns,
            rows: Vec::new(),
            caption: String::new(),
        }
    }

    /// A table of names and values.
    pub fn key_values<K: AsRef<str>, V: AsRef<str>>(pairs: &[(K, V)]) -> Self {
        let mut table = Self::new([Column::left(""), Column::left("")]);
        for (key, value) in pairs {
            table.row([key.as_ref(), value.as_ref()]);
        }
        table
    }

    /// A line of text below the table.
    pub fn caption(&mut self, caption: &str) -> &mut Self {
        caption.clone_into(&mut self.caption);
        self
    }

    /// Adds a row. Surplus cells are dropped, missing ones left empty.
    pub fn row<I>(&mut self, cells: I) -> &mut Self
    where
        I: IntoIterator,
        I::Item: AsRef<str>,
    {
        self.row_with(Emphasis::Plain, cells)
    }

    /// Adds a row with a mark: good, to be checked, or bad.
    pub fn row_with<I>(&mut self, status: Emphasis, cells: I) -> &mut Self
    where
        I: IntoIterator,
        I::Item: AsRef<str>,
    {
        let cells = cells
            .into_iter()
            .take(self.columns.len())
            .map(|cell| cell.as_ref().to_owned())
            .collect();
        self.rows.push((status, cells));
        self
    }

    pub(crate) fn html(&self, out: &mut String) {
        out.push_str("<div class=\"scroll\"><table>");
        let side = |column: &Column| if column.right { " class=\"num\"" } else { "" };
        if self.columns.iter().any(|column| !column.head.is_empty()) {
            out.push_str("<thead><tr>");
            for column in &self.columns {
                let _ = write!(out, "<th{}>{}</th>", side(column), set(&column.head));
            }
            out.push_str("</tr></thead>");
        }
        out.push_str("<tbody>\n");
        for (status, cells) in &self.rows {
            let _ = write!(out, "<tr class=\"{}\">", status.class());
            for (index, column) in self.columns.iter().enumerate() {
                let cell = cells.get(index).map_or("", String::as_str);
                let sign = if index == 0 { status.sign() } else { "" };
                let class = match (column.right, cell.split_whitespace().any(is_long)) {
                    (true, _) => " class=\"num\"",
                    (false, true) => " class=\"long\"",
                    (false, false) => "",
                };
                let _ = write!(out, "<td{class}>{sign}{}</td>", set(cell));
            }
            out.push_str("</tr>\n");
        }
        out.push_str("</tbody></table></div>\n");
        // Outside of the scrolled part, so that a narrow screen shows all of it.
        if !self.caption.is_empty() {
            let _ = writeln!(out, "<p class=\"caption\">{}</p>", set(&self.caption));
        }
    }
}

/// Whether a word, such as a path or a fingerprint, may be broken anywhere. The longest words of English stay whole.
fn is_long(word: &str) -> bool {
    const LONGEST_WHOLE: usize = 24;
    word.chars().count() > LONGEST_WHOLE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_word_longer_than_any_of_english_is_broken() {
        let mut table = Table::key_values(&[("bead", "rad/s"), ("input", &"0f".repeat(32))]);
        table.caption("Units and fingerprints.");
        let mut out = String::new();
        table.html(&mut out);
        assert!(out.contains("<td>bead</td><td>rad/s</td>"), "{out}");
        assert!(out.contains("<td class=\"long\">0f0f"), "{out}");
    }
}
