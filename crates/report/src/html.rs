//! The page: title, sections, paragraphs, notes, tables and figures.

use crate::draw;
use crate::figure::{Figure, slug};
use crate::picture::{Picture, base64};
use crate::style::PAGE_STYLE;
use crate::svg::{STYLE, escape, set, set_together};
use crate::table::{Emphasis, Table};
use crate::typeset::typeset;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// A report that could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A file or folder could not be written.
    #[error("cannot write {path}: {source}")]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
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
    Certainty(String),
    Lead(String),
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

    /// Adds a line on the uncertainty below the result: the kind of its intervals, and the errors that they do not cover.
    pub fn certainty(&mut self, text: &str) -> &mut Self {
        self.push(Block::Certainty(text.to_owned()))
    }

    /// Adds a line below the title on the work done: means, method, time. Cuts a text at 400 characters.
    pub fn lead(&mut self, text: &str) -> &mut Self {
        const MOST: usize = 400;
        let mut shown: String = text.chars().take(MOST).collect();
        if shown.len() < text.len() {
            shown.push('\u{2026}');
        }
        self.blocks.insert(0, Block::Lead(shown));
        self
    }

    /// Folds everything added until [`Report::unfold`] behind this title.
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

    /// Adds the command that made the page, as its last section, so that a reader can repeat it.
    pub fn command(&mut self, line: &str) -> &mut Self {
        self.section("Command").verbatim(line)
    }

    /// Adds preformatted text in letters of equal width: a command line, a file.
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

    /// Adds a picture of pixels, a PNG file, which the page carries within itself. `shows` describes it in a few words, from which
    /// the name of its file comes.
    pub fn picture(&mut self, shows: &str, caption: &str, png: Vec<u8>) -> &mut Self {
        self.push(Block::Picture(Picture {
            name: slug(shows),
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
        let (mut section, mut number) = (0, 0);
        for block in &self.blocks {
            match block {
                Block::Section(title) => {
                    // After the result, which comes first.
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
                    let _ = writeln!(
                        out,
                        "<p class=\"result {class}\">{sign}{}</p>",
                        set_together(text)
                    );
                }
                Block::Certainty(text) => {
                    let text = set_together(text);
                    let _ = writeln!(out, "<p class=\"sure\"><b>How sure:</b> {text}</p>");
                }
                Block::Lead(text) => {
                    let _ = writeln!(out, "<p class=\"lead\">{}</p>", set_together(text));
                }
                Block::Fold(title) => {
                    let _ = writeln!(out, "<details><summary>{}</summary>", set(title));
                }
                Block::Unfold => out.push_str("</details>\n"),
                Block::Picture(picture) => {
                    number += 1;
                    picture.html(&mut out, number);
                }
                Block::Figure(figure) => {
                    let _ = write!(out, "<figure>\n{}", draw::in_page(figure));
                    number += 1;
                    let caption = set(&figure.caption);
                    let _ = write!(
                        out,
                        "<figcaption>Figure {number}. {caption} <span class=\"take\">"
                    );
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
        write_file(path, self.to_html().as_bytes())
    }

    /// As [`Report::write`], with every figure as a file: `report.html` gets a folder `report-figures` with `NAME.svg`, `NAME.pdf`
    /// and `NAME.csv`, and `captions.txt` with the captions of all.
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
        write_file(path, self.page(Some(&beside)).as_bytes())?;
        let folder = path.with_file_name(&beside);
        for figure in self.figures() {
            for form in [Form::Svg, Form::Pdf, Form::Csv] {
                let name = format!("{}.{}", figure.name, form.ending());
                write_file(&folder.join(name), &form.of(figure))?;
            }
        }
        let captions = self.captions();
        if captions.contains("Figure 1 ") {
            write_file(&folder.join("captions.txt"), captions.as_bytes())?;
        }
        Ok(())
    }

    /// The captions and the description of the work, to be pasted.
    fn captions(&self) -> String {
        let mut out = typeset(&self.title);
        let leads = self.blocks.iter().filter_map(|block| match block {
            Block::Lead(text) | Block::Result(_, text) => Some(text),
            _ => None,
        });
        for text in leads {
            let _ = write!(out, "\n{}", typeset(text));
        }
        let shown = self.blocks.iter().filter_map(|block| match block {
            Block::Figure(figure) => Some((figure.name.as_str(), &figure.caption)),
            Block::Picture(picture) => Some((picture.name.as_str(), &picture.caption)),
            _ => None,
        });
        for (number, (name, caption)) in (1..).zip(shown) {
            let caption = typeset(caption);
            let _ = write!(out, "\n\nFigure {number} ({name}). {caption}");
        }
        out.push('\n');
        out
    }
}

/// The formats in which a figure can be downloaded.
#[derive(Debug, Clone, Copy)]
enum Form {
    Svg,
    Pdf,
    Csv,
}

impl Form {
    fn ending(self) -> &'static str {
        match self {
            Form::Svg => "svg",
            Form::Pdf => "pdf",
            Form::Csv => "csv",
        }
    }

    fn kind(self) -> &'static str {
        match self {
            Form::Svg => "image/svg+xml",
            Form::Pdf => "application/pdf",
            Form::Csv => "text/csv",
        }
    }

    fn of(self, figure: &Figure) -> Vec<u8> {
        match self {
            Form::Svg => figure.to_svg().into_bytes(),
            Form::Pdf => figure.to_pdf(),
            Form::Csv => figure.to_csv().into_bytes(),
        }
    }
}

/// Links to the sections.
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
    for form in [Form::Svg, Form::Pdf, Form::Csv] {
        let ending = form.ending();
        let target = match beside {
            Some(folder) => format!("{}/{name}.{ending}", encoded(folder)),
            None => format!("data:{};base64,{}", form.kind(), base64(&form.of(figure))),
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

/// Whether the name belongs to a device or a pipe, which no file may replace.
fn is_device(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir())
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), ReportError> {
    let attempt = || {
        if is_device(path) {
            return std::fs::write(path, bytes);
        }
        if let Some(folder) = path.parent()
            && !folder.as_os_str().is_empty()
        {
            std::fs::create_dir_all(folder)?;
        }
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(".part");
        let part = path.with_file_name(name);
        std::fs::write(&part, bytes)
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
