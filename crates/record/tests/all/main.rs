//! Run folders and their exports.

mod docs;
mod exports;
mod run;
