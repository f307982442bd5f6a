//! Light that rises across a window, as a fix has found it.

/// Light that rises across the window.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Rise {
    /// Along the row and along the column, grey levels a px.
    pub slope: (f64, f64),
    /// Squares of the ways by which fitting it has moved the place, times what it leaves over what it explains: the light of a speck
    /// in a corner is drawn into a slope that does not go on under the bead. What it leaves all round is the bead's, and moves nothing.
    pub way_px2: [f64; 2],
}
