//! A control law: proportional, and at rest while the bead is within a dead band, so that it does not chase diffusion.

use cellpos_control::{ControlLaw, LawInput, LawOutput};

/// The law.
#[derive(Debug, Clone, Copy)]
pub struct DeadBand {
    /// Gain, um of PZT per um of bead.
    pub kp_um_per_um: f64,
    /// Half width within which it rests, um.
    pub rest_um: f64,
}

impl ControlLaw for DeadBand {
    /// Whether it pushes.
    type State = bool;

    fn start(&self, _: f64) -> bool {
        false
    }

    fn step(&self, pushes: &mut bool, input: &LawInput) -> LawOutput {
        let error_um = input.reference_um - input.estimate.position_um;
        // Once it pushes, it continues to the middle of the band.
        let edge_um = if *pushes {
            0.3 * self.rest_um
        } else {
            self.rest_um
        };
        *pushes = error_um.abs() > edge_um;
        let push_um = if *pushes {
            self.kp_um_per_um * error_um
        } else {
            0.0
        };
        LawOutput::wish(input.estimate.neutral_um + push_um)
    }

    fn columns(&self) -> &'static [&'static str] {
        &["dead_band_pushes"]
    }

    fn record(&self, pushes: &bool, out: &mut [f32]) {
        out[0] = f32::from(u8::from(*pushes));
    }
}
