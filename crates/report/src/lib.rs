//! Self-contained HTML reports with inline SVG plots.
//!
//! A [`Report`] is a title and a sequence of sections, paragraphs, notes, tables and [`Figure`]s. It becomes one HTML file, which
//! loads nothing from the network and suits light and dark screens. Every figure can also be written as SVG, PDF and CSV. The
//! same calls always give the same bytes: nothing here reads a clock, a locale or a random number.
//!
//! Long traces are thinned to the minimum and maximum of each pixel column, so an hour at 1 kHz stays a small picture with
//! every spike in it. [`Figure::to_csv`] writes the data as given. Axes carry their unit.
//!
//! Not for interactive plots. Not for numbers that a program should read: write JSON for that.
//!
//! ```
//! use cellpos_report::{Axis, Figure, Panel, Report, Series};
//! let frequency_hz = [2.0, 20.0, 200.0];
//! let mut report = Report::new("Frequency response");
//! report.paragraph("Gain of the nominal plant.");
//! report.figure(
//!     Figure::new("gain", "Gain against frequency").panel(
//!         Panel::new(Axis::log("frequency", "Hz"), Axis::linear("gain", "dB"))
//!             .series(Series::line("Eq. (6)", &frequency_hz, &[30.62, 9.88, -10.42])),
//!     ),
//! );
//! assert!(report.to_html().contains("<svg"));
//! ```
#![forbid(unsafe_code)]

mod axis;
mod csv;
mod draw;
mod drawing;
mod figure;
mod heat;
mod html;
mod marks;
mod mosaic;
mod numbers;
mod panel;
mod pdf;
mod picture;
mod series;
mod style;
mod svg;
mod table;
mod thin;
mod tile;
mod typeset;

pub use axis::{Axis, Scale, log_grid};
pub use figure::{Figure, HeatMap, Panel};
pub use html::{Report, ReportError};
pub use mosaic::Mosaic;
pub use numbers::{digits_of, number, with_interval};
pub use series::{Kind, Series};
pub use table::{Column, Emphasis, Table};
pub use tile::Tile;
pub use typeset::typeset;
