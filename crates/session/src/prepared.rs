//! Model and controller, before anything is known of where the rig stands.

use cellpos_control::ControllerFile;
use cellpos_plant::Model;

/// Model and controller, before the board is armed.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepared {
    /// The plant that the controller believes in.
    pub model: Model,
    /// Controller, estimator and limits.
    pub controller: ControllerFile,
}
