//! Reason for a clip.

/// A moment to keep.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Moment {
    /// Number of the frame that the loop used then, and its time in the run, ns.
    pub(super) frame: (u64, i64),
    /// When, in the run, ns.
    pub(super) at_ns: i64,
    /// Name of its file, without an ending.
    pub(super) name: String,
}
