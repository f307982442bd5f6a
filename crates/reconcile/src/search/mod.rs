//! Which candidates to fit: screening, additions one after another, replacements.

pub(crate) mod cost;
pub(crate) mod effort;
pub(crate) mod found;
pub(crate) mod lines;
mod pairs;
mod pixel;
mod screen;
pub(crate) mod sequential;
pub(crate) mod suspect;
