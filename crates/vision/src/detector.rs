//! A detector for the beads that a localiser fits.

use crate::localiser::Localiser;
use crate::seed::Detector;

impl Detector {
    /// A detector for beads like the localiser's, with room for `max_beads` of them in a frame.
    pub fn new(localiser: &Localiser, max_beads: usize) -> Self {
        Self::of(
            localiser.sign(),
            localiser.template().radius_px(),
            localiser.config().min_snr,
            max_beads,
        )
    }
}
