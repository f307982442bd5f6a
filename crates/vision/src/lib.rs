//! Bead position, covariance and verdict from a camera frame.
//!
//! Pixel coordinates are 0-based with pixel centres at whole numbers, x along the row. Everything that runs per frame
//! uses buffers made beforehand and allocates nothing. Not for devices or files: frames come in as slices.
#![forbid(unsafe_code)]

pub mod config;
mod crop;
mod fit;
mod fix;
mod frame;
mod localiser;
pub mod profile;
mod seed;

pub use config::{ConfigError, LocaliserConfig, Noise, Polarity};
pub use fix::{Fix, Verdict};
pub use frame::{Frame, Pixels};
pub use localiser::Localiser;
pub use profile::{
    GaussianProfile, PixelResponse, ProfileSpec, RadialProfile, RingProfile, Template,
};
