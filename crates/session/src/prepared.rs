//! Model and controller, before the rig's displacement is known.

use cellpos_control::ControllerFile;
use cellpos_plant::Model;

/// Model and controller, before the board is armed.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepared {
    /// The plant that the controller assumes.
    pub model: Model,
    /// Controller, estimator and limits.
    pub controller: ControllerFile,
}
