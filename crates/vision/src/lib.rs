//! Bead position, covariance and verdict from a camera frame.
//!
//! Pixel coordinates are 0-based with pixel centres at whole numbers, x along the row. Work per frame uses
//! buffers that exist already and allocates nothing. Not for devices or files: frames come in as slices.
#![forbid(unsafe_code)]

mod beyond;
pub mod blobs;
pub mod cells;
pub mod config;
mod crop;
mod detector;
mod fit;
mod fix;
mod frame;
mod learn;
mod level;
mod lines;
mod localiser;
pub mod many;
mod objects;
mod offsets;
mod outline;
mod pool;
pub mod profile;
mod residue;
mod seed;
mod smooth;
mod speckle;
mod streak;
pub mod suggest;
pub mod symmetry;
pub mod template;
pub mod track;

pub use blobs::{Blob, Blobs};
pub use cells::{Cell, CellConfig, CellError, CellFinder};
pub use config::{ConfigError, Learning, LocaliserConfig, PixelNoise, Polarity};
pub use detector::Detector;
pub use fix::{Fix, FixQuality};
pub use frame::{Frame, Pixels};
pub use learn::LearningReport;
pub use localiser::Localiser;
pub use many::{LinkConfig, ManyTracker, Sight};
pub use objects::Refused;
pub use profile::{GaussianProfile, RadialProfile, RingProfile};
pub use suggest::{NothingToSuggest, Suggestion};
pub use symmetry::RadialSymmetry;
pub use template::{PixelResponse, ProfileSpec, TABLE_KNOTS, Template};
pub use track::{
    CellStep, CellTracker, Commanded, Decision, TrackState, TrackStep, Tracker, TrackerConfig,
};
