//! Self-contained HTML reports with SVG plots.
#![forbid(unsafe_code)]
