//! Records of other rigs, from a file to a base model.
//!
//! 1. [`arrays`] reads a file (text, `.npy`, `.mat`) as a table.
//! 2. [`columns`] takes a record from the table: input, output, time.
//! 3. [`sources`] reads runs and records of cellpos too; [`summary`] says what a record tells of its plant.
//! 4. [`base`] fits a linear model to such records and writes it as a model file; [`form`] is its order, stated or chosen.
//!    [`response`] makes one of a frequency response.

pub mod arrays;
pub mod base;
pub mod columns;
pub mod form;
pub mod response;
pub mod sources;
pub mod summary;
