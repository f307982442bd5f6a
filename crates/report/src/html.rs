//! The page: title, sections, paragraphs, notes, tables and figures.

use crate::draw;
use crate::figure::Figure;
use crate::picture::{Picture, base64};
use crate::style::PAGE_STYLE;
use crate::svg::{STYLE, escape, set};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// A report that could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A file or folder could not be written.
    #[error("cannot write {path}: {source}")]
    Write {
        /// What was to be written.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
}

/// How a note or a row is meant.
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
    fn class(self) -> &'static str {
        match self {
            Emphasis::Plain => "plain",
            Emphasis::Good => "good",
            Emphasis::Warning => "warning",
            Emphasis::Bad => "bad",
        }
    }

    /// A sign besides the colour, for colour-blind readers and for prints.
    fn sign(self) -> &'static str {
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

    /// A table without rows, for a number of columns known only when running.
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

    /// Adds a row that is marked as good, to be looked at, or bad.
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

    fn html(&self, out: &mut String) {
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
                let _ = write!(out, "<td{}>{sign}{}</td>", side(column), set(cell));
            }
            out.push_str("</tr>\n");
        }
        out.push_str("</tbody></table></div>\n");
        // Outside of what scrolls: on a narrow screen it is read whole.
        if !self.caption.is_empty() {
            let _ = writeln!(out, "<p class=\"caption\">{}</p>", set(&self.caption));
        }
    }
}

#[derive(Debug, Clone)]
enum Block {
    Section(String),
    Subsection(String),
    Paragraph(String),
    Note(Emphasis, String),
    List(Vec<String>),
    Verbatim(String),
    Table(Table),
    Figure(Figure),
    Picture(Picture),
    Result(Emphasis, String),
    Fold(String),
    Unfold,
}

/// A report: see the crate's documentation.
#[derive(Debug, Clone)]
pub struct Report {
    title: String,
    blocks: Vec<Block>,
}

impl Report {
    /// A report without content.
    pub fn new(title: &str) -> Self {
        Self {
            title: title.to_owned(),
            blocks: Vec::new(),
        }
    }

    fn push(&mut self, block: Block) -> &mut Self {
        self.blocks.push(block);
        self
    }

    /// Starts a section; sections are listed at the top of a long report.
    pub fn section(&mut self, title: &str) -> &mut Self {
        self.push(Block::Section(title.to_owned()))
    }

    /// Starts a part of a section.
    pub fn subsection(&mut self, title: &str) -> &mut Self {
        self.push(Block::Subsection(title.to_owned()))
    }

    /// Adds a paragraph of plain text (markup is shown as written).
    pub fn paragraph(&mut self, text: &str) -> &mut Self {
        self.push(Block::Paragraph(text.to_owned()))
    }

    /// Adds a note that stands out: a verdict, a warning.
    pub fn note(&mut self, status: Emphasis, text: &str) -> &mut Self {
        self.push(Block::Note(status, text.to_owned()))
    }

    /// Adds the result: one sentence, at the top of the page.
    pub fn result(&mut self, status: Emphasis, sentence: &str) -> &mut Self {
        self.push(Block::Result(status, sentence.to_owned()))
    }

    /// What is added until [`Report::unfold`] is folded behind this title: it is there, and not in the way.
    pub fn fold(&mut self, title: &str) -> &mut Self {
        self.push(Block::Fold(title.to_owned()))
    }

    /// Ends what [`Report::fold`] began.
    pub fn unfold(&mut self) -> &mut Self {
        self.push(Block::Unfold)
    }

    /// Adds a list.
    pub fn list<S: AsRef<str>>(&mut self, items: &[S]) -> &mut Self {
        let items = items.iter().map(|item| item.as_ref().to_owned()).collect();
        self.push(Block::List(items))
    }

    /// Adds text as it stands, in letters of equal width: a command line, a file.
    pub fn verbatim(&mut self, text: &str) -> &mut Self {
        self.push(Block::Verbatim(text.to_owned()))
    }

    /// Adds a table.
    pub fn table(&mut self, table: Table) -> &mut Self {
        self.push(Block::Table(table))
    }

    /// Adds a figure. A name already taken gets a number, so that no file overwrites another.
    pub fn figure(&mut self, mut figure: Figure) -> &mut Self {
        let wanted = figure.name.clone();
        let mut number = 2;
        while self.figures().any(|other| other.name == figure.name) {
            figure.name = format!("{wanted}-{number}");
            number += 1;
        }
        self.push(Block::Figure(figure))
    }

    /// Adds a picture of pixels, a PNG file, which the page carries within itself. `shows` describes it in a few words.
    pub fn picture(&mut self, shows: &str, caption: &str, png: Vec<u8>) -> &mut Self {
        self.push(Block::Picture(Picture {
            shows: shows.to_owned(),
            caption: caption.to_owned(),
            png,
        }))
    }

    /// The figures, in order.
    pub fn figures(&self) -> impl Iterator<Item = &Figure> {
        self.blocks.iter().filter_map(|block| match block {
            Block::Figure(figure) => Some(figure),
            _ => None,
        })
    }

    /// The whole report as one HTML page; its figures' data are within it.
    pub fn to_html(&self) -> String {
        self.page(None)
    }

    /// The page; `beside` is the folder with its figures, if there is one.
    fn page(&self, beside: Option<&str>) -> String {
        let title = set(&self.title);
        let mut out = String::new();
        let _ = write!(
            out,
            "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <meta name=\"color-scheme\" content=\"light dark\">\n<title>{title}</title>\n\
             <style>{PAGE_STYLE}{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n"
        );
        let sections: Vec<&String> = self
            .blocks
            .iter()
            .filter_map(|block| match block {
                Block::Section(title) => Some(title),
                _ => None,
            })
            .collect();
        let mut section = 0;
        for block in &self.blocks {
            match block {
                Block::Section(title) => {
                    // Behind the result, which comes first.
                    if section == 0 && sections.len() > 3 {
                        contents(&mut out, &sections);
                    }
                    section += 1;
                    let _ = writeln!(out, "<h2 id=\"section-{section}\">{}</h2>", set(title));
                }
                Block::Subsection(title) => {
                    let _ = writeln!(out, "<h3>{}</h3>", set(title));
                }
                Block::Paragraph(text) => {
                    let _ = writeln!(out, "<p>{}</p>", set(text));
                }
                Block::Note(status, text) => {
                    let (class, sign) = (status.class(), status.sign());
                    let _ = writeln!(out, "<p class=\"note {class}\">{sign}{}</p>", set(text));
                }
                Block::List(items) => {
                    out.push_str("<ul>\n");
                    for item in items {
                        let _ = writeln!(out, "<li>{}</li>", set(item));
                    }
                    out.push_str("</ul>\n");
                }
                Block::Verbatim(text) => {
                    let _ = writeln!(out, "<pre>{}</pre>", escape(text));
                }
                Block::Table(table) => table.html(&mut out),
                Block::Result(status, text) => {
                    let (class, sign) = (status.class(), status.sign());
                    let _ = writeln!(out, "<p class=\"result {class}\">{sign}{}</p>", set(text));
                }
                Block::Fold(title) => {
                    let _ = writeln!(out, "<details><summary>{}</summary>", set(title));
                }
                Block::Unfold => out.push_str("</details>\n"),
                Block::Picture(picture) => picture.html(&mut out, set),
                Block::Figure(figure) => {
                    let _ = write!(out, "<figure>\n{}", draw::in_page(figure));
                    let caption = set(&figure.caption);
                    let _ = write!(out, "<figcaption>{caption} <span class=\"take\">");
                    take(&mut out, figure, beside);
                    out.push_str("</span></figcaption>\n</figure>\n");
                }
            }
        }
        out.push_str("</main>\n</body>\n</html>\n");
        out
    }

    /// Writes the page to `path`; folders are made as needed, and an existing file is replaced in one step, so that a
    /// reader never sees half a report.
    ///
    /// # Errors
    /// [`ReportError::Write`] names the file.
    pub fn write(&self, path: &Path) -> Result<(), ReportError> {
        write_file(path, &self.to_html())
    }

    /// As [`Report::write`], with every figure as a file: `report.html` gets a folder `report-figures` with
    /// `NAME.svg` and `NAME.csv`.
    ///
    /// # Errors
    /// [`ReportError::Write`] names the file.
    pub fn write_with_figures(&self, path: &Path) -> Result<(), ReportError> {
        if is_device(path) {
            return self.write(path);
        }
        let stem = path.file_stem().map_or_else(
            || "report".into(),
            |stem| stem.to_string_lossy().into_owned(),
        );
        let beside = format!("{stem}-figures");
        write_file(path, &self.page(Some(&beside)))?;
        let folder = path.with_file_name(&beside);
        for figure in self.figures() {
            write_file(
                &folder.join(format!("{}.svg", figure.name)),
                &figure.to_svg(),
            )?;
            write_file(
                &folder.join(format!("{}.csv", figure.name)),
                &figure.to_csv(),
            )?;
        }
        Ok(())
    }
}

/// The sections, to jump to.
fn contents(out: &mut String, sections: &[&String]) {
    out.push_str("<nav><ul>\n");
    for (index, title) in (1..).zip(sections) {
        let title = set(title);
        let _ = writeln!(out, "<li><a href=\"#section-{index}\">{title}</a></li>");
    }
    out.push_str("</ul></nav>\n");
}

/// Download links of a figure: to the files next to the page, or to data within it.
fn take(out: &mut String, figure: &Figure, beside: Option<&str>) {
    let name = figure.name();
    for (ending, kind) in [("svg", "image/svg+xml"), ("csv", "text/csv")] {
        let target = match beside {
            Some(folder) => format!("{}/{name}.{ending}", encoded(folder)),
            None => {
                let data = if ending == "svg" {
                    figure.to_svg()
                } else {
                    figure.to_csv()
                };
                format!("data:{kind};base64,{}", base64(data.as_bytes()))
            }
        };
        let shown = ending.to_uppercase();
        let _ = write!(
            out,
            "<a download=\"{name}.{ending}\" href=\"{target}\">{shown}</a> "
        );
    }
}

/// A file name as a part of an address.
fn encoded(name: &str) -> String {
    let mut out = String::new();
    for byte in name.bytes() {
        if byte.is_ascii_alphanumeric() || matches!(byte, b'-' | b'_' | b'.') {
            out.push(char::from(byte));
        } else {
            let _ = write!(out, "%{byte:02X}");
        }
    }
    out
}

/// Whether there is something of this name that is no file: a device or a pipe, which no file may take the place of.
fn is_device(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir())
}

fn write_file(path: &Path, text: &str) -> Result<(), ReportError> {
    let attempt = || {
        if is_device(path) {
            return std::fs::write(path, text);
        }
        if let Some(folder) = path.parent()
            && !folder.as_os_str().is_empty()
        {
            std::fs::create_dir_all(folder)?;
        }
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(".part");
        let part = path.with_file_name(name);
        std::fs::write(&part, text)
            .and_then(|()| std::fs::rename(&part, path))
            .inspect_err(|_| {
                let _ = std::fs::remove_file(&part);
            })
    };
    attempt().map_err(|source| ReportError::Write {
        path: path.to_owned(),
        source,
    })
}
