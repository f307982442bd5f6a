//! Run folders and their exports.

mod docs;
mod exports;
mod own_columns;
mod run;
