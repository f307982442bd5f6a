//! A table of fields, before anything is known of their meaning.

use crate::error::{TableError, TableProblem};
use crate::mapping::ColumnRef;
use std::path::{Path, PathBuf};

/// A text file of rows and columns: separated by semicolons, tabs, commas or white space, with or without a header. Blank lines,
/// lines that start with `#` or `%`, and a line of units below the header are skipped. A byte-order mark and Windows line ends
/// are accepted. If commas do not separate, a number may have a decimal comma.
#[derive(Debug, Clone)]
pub struct Table<'a> {
    path: PathBuf,
    /// Names of the columns; `1`, `2`, ... without a header.
    pub names: Vec<String>,
    /// Fields of all rows, one row after the other: places in the text, which take less room than the fields themselves.
    text: &'a str,
    fields: Vec<Span>,
    /// Line of each row in the file, counted from 1.
    lines: Vec<u32>,
}

/// A field's place in the text. A text is at most 4 GB long.
#[derive(Debug, Clone, Copy)]
struct Span {
    start: u32,
    length: u32,
}

/// How fields are separated.
#[derive(Debug, Clone, Copy)]
enum Separator {
    Char(char),
    White,
}

impl Separator {
    fn of(line: &str) -> Self {
        // A comma may be a decimal one; the others separate and nothing else.
        [';', '\t', ',']
            .into_iter()
            .find(|separator| {
                let mut bare = bare(&[';', '\t', ',']);
                line.chars().any(|c| bare(c) && c == *separator)
            })
            .map_or(Self::White, Self::Char)
    }

    fn split(self, line: &str, mut take: impl FnMut(&str)) {
        match self {
            Self::White => line.split_whitespace().for_each(&mut take),
            Self::Char(separator) if line.contains('"') => {
                line.split(bare(&[separator]))
                    .map(unquote)
                    .for_each(&mut take);
            }
            Self::Char(separator) => line.split(separator).map(unquote).for_each(&mut take),
        }
    }
}

/// For each character of a line in turn: whether it is a separator outside a quoted field (one that begins with a quote).
fn bare(separators: &[char]) -> impl FnMut(char) -> bool {
    let (mut blank, mut quotes, mut open) = (true, false, false);
    move |c| {
        if c == '"' && blank {
            (quotes, open) = (true, true);
        } else if c == '"' && quotes {
            open = !open;
        }
        let ends = separators.contains(&c) && !open;
        (blank, quotes) = match ends {
            true => (true, false),
            false => (blank && c.is_whitespace(), quotes),
        };
        ends
    }
}

fn unquote(field: &str) -> &str {
    let field = field.trim();
    field
        .strip_prefix('"')
        .and_then(|field| field.strip_suffix('"'))
        .map_or(field, str::trim)
}

/// A number in the notation of any program, "nan" and "inf" included, with a decimal point or one decimal comma; None if it is
/// something else.
fn number(field: &str) -> Option<f64> {
    let parsed = field.parse().ok();
    if parsed.is_some() || field.contains('.') || field.matches(',').count() != 1 {
        return parsed;
    }
    field.replace(',', ".").parse().ok()
}

/// Notations of programs for a missing value.
fn is_no_value(field: &str) -> bool {
    ["", "nan", "na", "n/a", "null", "none", "-"]
        .iter()
        .any(|word| field.eq_ignore_ascii_case(word))
}

/// A column's plain name: without the unit in brackets, in small letters.
fn said(name: &str) -> String {
    let plain = name.split(['[', '(']).next().unwrap_or(name);
    plain.trim().to_lowercase()
}

impl<'a> Table<'a> {
    /// Parses a text. `path` is only for messages.
    ///
    /// A first line without any number is the header.
    ///
    /// # Errors
    /// [`TableProblem::Empty`], [`TableProblem::Fields`], [`TableProblem::DuplicateColumn`], [`TableProblem::TooLarge`].
    pub fn parse(path: &Path, text: &'a str) -> Result<Self, TableError> {
        let fail = |line, problem| TableError {
            path: path.to_owned(),
            line,
            problem,
        };
        if u32::try_from(text.len()).is_err() {
            return Err(fail(None, TableProblem::TooLarge));
        }
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let mut lines = text
            .lines()
            .enumerate()
            .map(|(index, line)| (index + 1, line))
            .filter(|(_, line)| {
                let line = line.trim_start();
                !line.is_empty() && !line.starts_with(['#', '%'])
            });
        let Some((first_line, first)) = lines.next() else {
            return Err(fail(None, TableProblem::Empty));
        };
        let separator = Separator::of(first);
        let mut fields = Vec::new();
        separator.split(first, |field| fields.push(field.replace("\"\"", "\"")));
        let is_header = fields.iter().all(|field| number(field).is_none());
        let names: Vec<String> = if is_header {
            fields
        } else {
            (1..=fields.len()).map(|place| place.to_string()).collect()
        };
        for (place, name) in names.iter().enumerate() {
            if !name.is_empty() && names.iter().take(place).any(|other| other == name) {
                return Err(fail(
                    Some(first_line),
                    TableProblem::DuplicateColumn(name.clone()),
                ));
            }
        }
        let mut table = Self {
            path: path.to_owned(),
            names,
            text,
            fields: Vec::new(),
            lines: Vec::new(),
        };
        let header = (!is_header).then_some((first_line, first));
        let mut may_be_units = is_header;
        for (line, row) in header.into_iter().chain(lines) {
            if std::mem::take(&mut may_be_units) && is_units(separator, row, table.names.len()) {
                continue;
            }
            let before = table.fields.len();
            separator.split(row, |field| {
                // A field is a part of the text, whose length fits.
                let start = field.as_ptr() as usize - text.as_ptr() as usize;
                table.fields.push(Span {
                    start: start as u32,
                    length: field.len() as u32,
                });
            });
            let found = table.fields.len() - before;
            if found != table.names.len() {
                let problem = TableProblem::Fields {
                    expected: table.names.len(),
                    found,
                };
                return Err(fail(Some(line), problem));
            }
            table.lines.push(line as u32);
        }
        if table.lines.is_empty() {
            return Err(fail(None, TableProblem::Empty));
        }
        Ok(table)
    }

    /// Whether the file names its columns.
    pub fn has_header(&self) -> bool {
        self.names.first().is_none_or(|name| name != "1")
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.lines.len()
    }

    /// Whether there are no rows (never after [`Table::parse`]).
    pub fn is_empty(&self) -> bool {
        self.lines.is_empty()
    }

    /// Line in the file of a row, counted from 1.
    pub fn line(&self, row: usize) -> Option<usize> {
        self.lines.get(row).map(|line| *line as usize)
    }

    /// The fields of a column, by its place counted from 0.
    pub fn fields(&self, place: usize) -> impl Iterator<Item = &'a str> {
        let text = self.text;
        self.fields
            .iter()
            .skip(place)
            .step_by(self.names.len().max(1))
            .map(move |span| {
                let start = span.start as usize;
                text.get(start..start + span.length as usize).unwrap_or("")
            })
    }

    /// Place of a column, counted from 0, if it exists. If no name matches, it takes the only one that matches before a unit in
    /// brackets.
    pub fn find(&self, column: &ColumnRef) -> Option<usize> {
        match column {
            ColumnRef::Name(name) => {
                let exact = self.names.iter().position(|other| other == name);
                exact.or_else(|| {
                    let mut like = (0..self.names.len())
                        .filter(|i| self.names[*i].contains(['[', '(']))
                        .filter(|i| said(&self.names[*i]) == said(name));
                    like.next().filter(|_| like.next().is_none())
                })
            }
            ColumnRef::Number(number) => number
                .checked_sub(1)
                .filter(|place| *place < self.names.len()),
        }
    }

    /// A column as finite numbers; an empty field becomes NaN if `allow_empty`.
    ///
    /// # Errors
    /// [`TableProblem::MissingColumn`], [`TableProblem::WrongUnit`], [`TableProblem::Cell`].
    pub fn numbers(&self, column: &ColumnRef, allow_empty: bool) -> Result<Vec<f64>, TableError> {
        let help = if allow_empty {
            "leave the field empty where there is no bead"
        } else {
            "write a decimal number with a point"
        };
        self.column(column, help, |field| field.is_empty() && allow_empty)
    }

    /// A column of a foreign file: an empty field, `nan`, `NA`, `null` or `-` becomes NaN.
    ///
    /// # Errors
    /// As [`Table::numbers`].
    pub fn numbers_or_nan(&self, column: &ColumnRef) -> Result<Vec<f64>, TableError> {
        let help = "leave the field empty, or write nan, where there is no value";
        self.column(column, help, is_no_value)
    }

    fn column(
        &self,
        column: &ColumnRef,
        help: &'static str,
        is_none: impl Fn(&str) -> bool,
    ) -> Result<Vec<f64>, TableError> {
        let Some(place) = self.find(column) else {
            return Err(self.missing(column));
        };
        self.fields(place)
            .enumerate()
            .map(|(row, field)| match number(field) {
                Some(value) if value.is_finite() => Ok(value),
                _ if is_none(field) => Ok(f64::NAN),
                _ => Err(self.fail(
                    self.line(row),
                    TableProblem::Cell {
                        column: self.names.get(place).cloned().unwrap_or_default(),
                        text: field.chars().take(40).collect(),
                        help,
                    },
                )),
            })
            .collect()
    }

    pub(crate) fn fail(&self, line: Option<usize>, problem: TableProblem) -> TableError {
        TableError {
            path: self.path.clone(),
            line,
            problem,
        }
    }

    /// The reason why a column is missing: no header, another unit, another spelling, or no such column.
    fn missing(&self, column: &ColumnRef) -> TableError {
        let ColumnRef::Name(wanted) = column else {
            return self.fail(
                None,
                TableProblem::MissingColumn {
                    wanted: column.to_string(),
                    found: self.names.clone(),
                    hint: Some("columns are counted from 1".to_owned()),
                },
            );
        };
        if !self.has_header() {
            return self.fail(self.line(0), TableProblem::NoHeader);
        }
        for name in &self.names {
            if let Some((unit, factor)) = other_unit(name, wanted) {
                return self.fail(
                    None,
                    TableProblem::WrongUnit {
                        column: name.clone(),
                        unit,
                        wanted: wanted.clone(),
                        factor,
                    },
                );
            }
        }
        let like = |name: &&String| {
            let plain = |text: &str| {
                text.to_lowercase()
                    .replace(['\u{b5}', '\u{3bc}'], "u")
                    .replace(|c: char| !c.is_ascii_alphanumeric(), "")
            };
            plain(name) == plain(wanted) || plain(wanted).starts_with(&plain(name))
        };
        let hint = self
            .names
            .iter()
            .filter(|name| !name.is_empty())
            .find(like)
            .map(|name| format!("rename `{name}` if it is `{wanted}`"));
        self.fail(
            None,
            TableProblem::MissingColumn {
                wanted: wanted.clone(),
                found: self.names.clone(),
                hint,
            },
        )
    }
}

/// Whether the line below a header has the units: as many fields, all short words, none a value or a sign for a missing one.
fn is_units(separator: Separator, line: &str, columns: usize) -> bool {
    let (mut fields, mut words) = (0, 0);
    separator.split(line, |field| {
        fields += 1;
        let short = field.chars().count() <= 12;
        words += usize::from(short && number(field).is_none() && !is_no_value(field));
    });
    fields == columns && words == fields
}

/// If `name` is `wanted` with another unit: that unit, and the factor from it to the wanted one.
fn other_unit(name: &str, wanted: &str) -> Option<(&'static str, Option<f64>)> {
    const LENGTHS: [(&str, &str, Option<f64>); 7] = [
        ("nm", "nanometres", Some(1e-3)),
        ("mm", "millimetres", Some(1e3)),
        ("m", "metres", Some(1e6)),
        ("v", "volts", None),
        ("mv", "millivolts", None),
        ("px", "pixels", None),
        ("pm", "picometres", Some(1e-6)),
    ];
    const TIMES: [(&str, &str, Option<f64>); 4] = [
        ("ms", "milliseconds", Some(1e-3)),
        ("us", "microseconds", Some(1e-6)),
        ("ns", "nanoseconds", Some(1e-9)),
        ("min", "minutes", Some(60.0)),
    ];
    let (stem, unit) = wanted.rsplit_once('_')?;
    let (name_stem, name_unit) = name.trim().rsplit_once('_')?;
    if !name_stem.eq_ignore_ascii_case(stem) {
        return None;
    }
    let units: &[_] = match unit {
        "um" => &LENGTHS,
        "s" => &TIMES,
        _ => return None,
    };
    units
        .iter()
        .find(|(symbol, ..)| name_unit.eq_ignore_ascii_case(symbol))
        .map(|(_, noun, factor)| (*noun, *factor))
}
