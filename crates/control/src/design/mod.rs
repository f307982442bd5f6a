//! Loop design: margins, predicted figures and bounds of a controller on a plant with a loop delay.
//!
//! All on the discrete loop: the plant under a zero-order hold with the camera path's delay, fractional if need be,
//! in the strictly proper form of the sampling convention. The loop delay `T` of the command line includes the half
//! sample of hold, so the discrete delay is `T / Ts - 1/2` samples.

mod bound;
mod curves;
mod density;
mod effort;
mod learning;
mod margins;
mod noise;
mod plant;
mod report;
mod search;
mod spread;
mod step;

pub use crate::uncertainty::{MarginSource, Uncertainty};
pub use bound::{bound_rms_of_path_um, bound_rms_um, kalman_posterior_um2};
pub use curves::{loop_response, step_response};
pub use density::predicted_density_um;
pub use learning::harmonic_responses;
pub use margins::{Margins, margins};
pub use noise::{NoiseFigures, noise_figures};
pub use plant::{DesignPlant, DesignWarning};
pub use report::{
    BrokenLimit, DesignError, DesignLimits, DesignReport, DesignRequest, Requested, default_lead,
    design,
};
pub use search::{PiSearch, search_pi};
pub use spread::{SpreadRow, spread};
pub use step::{
    CycleFigures, DisturbanceFigures, SetUpError, StepFigures, cycle_figures, disturbance_figures,
    step_figures,
};
