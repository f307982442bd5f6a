//! From a camera frame to position, covariance and verdict of a bead or a cell.
//!
//! - [`Frame`] borrows grey values. Pixel coordinates are 0-based with pixel centres at whole numbers, x along the row.
//! - [`Localiser`] fits a [`Template`] and returns a [`Fix`]; [`LocaliserConfig`] has its settings.
//! - [`Tracker`] keeps one bead from frame to frame, [`CellTracker`] one cell; [`ManyTracker`] follows all beads of a recording.
//! - [`Detector`] and [`Blobs`] find objects in a whole frame; [`CellFinder`] finds cells against the empty channel.
//! - [`suggest`] learns the profile and the settings from a recording.
//!
//! Work per frame uses existing buffers and allocates nothing. Devices and files are elsewhere: frames come in as slices.
//!
//! ```
//! use cellpos_vision::{FixQuality, Frame, Localiser, LocaliserConfig, Pixels, ProfileSpec};
//! let (width, height) = (64, 48);
//! let config = LocaliserConfig::new(ProfileSpec::Gaussian { sigma_px: 2.0 });
//! // A bead at (30.25, 20.5) px, 80 grey levels on a background of 100, with a pattern of one grey level as noise.
//! let mut image: Vec<f32> = (0..width * height).map(|k| 100.0 + (k * k % 7 % 3) as f32 - 1.0).collect();
//! config.template().unwrap().draw(&mut image, width, 30.25, 20.5, 80.0);
//! let pixels: Vec<u8> = image.iter().map(|grey| grey.round() as u8).collect();
//! let fix = Localiser::new(config).unwrap().locate(&Frame { width, height, pixels: Pixels::Mono8(&pixels) }, None);
//! assert_eq!(fix.verdict, FixQuality::Good);
//! assert!((fix.x_px - 30.25).abs() < 0.1 && (fix.y_px - 20.5).abs() < 0.1);
//! ```
#![forbid(unsafe_code)]

mod beyond;
pub mod blobs;
pub mod cells;
pub mod config;
mod crop;
mod detector;
mod dust;
mod fibre;
mod fit;
mod fix;
mod frame;
mod joint;
mod learn;
mod least_squares;
mod left;
mod level;
mod lines;
mod localiser;
pub mod many;
mod objects;
mod observed;
mod offsets;
mod outline;
mod overlap;
mod pool;
pub mod profile;
mod range;
mod reach;
mod residue;
mod rings;
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
pub use localiser::{Localiser, Start, Together};
pub use many::{LinkConfig, ManyTracker, Sight};
pub use objects::Refused;
pub use profile::{GaussianProfile, RadialProfile, RingProfile};
pub use range::Range;
pub use suggest::{NothingToSuggest, Suggestion};
pub use symmetry::RadialSymmetry;
pub use template::{PixelResponse, ProfileSpec, TABLE_KNOTS, Template};
pub use track::{
    CellStep, CellTracker, Commanded, Decision, TrackState, TrackStep, Tracker, TrackerConfig,
};
