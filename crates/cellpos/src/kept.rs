//! How a run kept its bead, in the words of its last lines.

use cellpos_runtime::Kept;

/// The error of the bead.
pub(crate) fn error(kept: &Kept) -> String {
    let nm = (kept.rms_nm).map_or_else(|| "-".to_owned(), |nm| format!("{nm:.1} nm"));
    let unseen = if kept.unseen_ms >= 0.5 {
        format!(" ({:.0} ms without a position)", kept.unseen_ms)
    } else {
        String::new()
    };
    format!("{nm} RMS from 2 s after the loop was closed{unseen}")
}

/// How long it was where it should be.
pub(crate) fn held(kept: &Kept) -> String {
    let Some((percent, nm)) = kept.held_percent.zip(kept.held_within_nm) else {
        return "-".to_owned();
    };
    // Counted while the reference stands still: a run on a wave has no such moment.
    let most = if kept.furthest_um > 0.0 {
        format!(", at most {:.2} um off", kept.furthest_um)
    } else {
        String::new()
    };
    format!(
        "{percent:.2} % of the time within {nm:.0} nm (five times the error of a PI hold){most}"
    )
}
