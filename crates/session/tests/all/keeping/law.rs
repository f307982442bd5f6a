//! A control law of a user's own: proportional to the estimate, about the estimated zero flow.

use cellpos_control::{ControlLaw, LawInput, LawOutput};

#[derive(Debug, Clone)]
pub(super) struct Proportional {
    pub kp_um_per_um: f64,
}

impl ControlLaw for Proportional {
    type State = ();

    fn start(&self, _command_um: f64) {}

    fn step(&self, (): &mut (), input: &LawInput) -> LawOutput {
        let error_um = input.reference_um - input.estimate.position_um;
        LawOutput::wish(input.estimate.neutral_um + self.kp_um_per_um * error_um)
    }
}
