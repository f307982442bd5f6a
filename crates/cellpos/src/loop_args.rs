//! Options of the commands that close the loop: `track` and `run`.

use crate::outcome::Failure;
use cellpos_numeric::units::Micrometers;
use cellpos_session::adapt::{self, Adapt};
use cellpos_session::connect;
use cellpos_session::rig_file::RigFile;
use cellpos_session::setup::{self, Prepared};
use std::path::{Path, PathBuf};

/// Law, model, rig and folder of a run.
#[derive(Debug, clap::Args)]
pub(crate) struct LoopArgs {
    /// pi, lead, lqg, mpc, or the path of a controller.toml. lqg holds best; pi needs less of a model.
    #[arg(long, default_value = setup::DEFAULT_LAW)]
    pub(crate) controller: String,
    /// Follow gain and delay of the plant; default: on for lqg and mpc, off for pi and lead, else as controller.toml says.
    #[arg(long, value_enum)]
    adapt: Option<Adapt>,
    /// Rig file; default: the emulated rig.
    #[arg(long)]
    pub(crate) rig: Option<PathBuf>,
    /// Model that the controller is made for: a model.toml, or eq6.
    #[arg(long, default_value = "eq6")]
    pub(crate) model: String,
    /// Follow the bead or cell nearest to this position; default: `near_um` of `--rig`, else the most prominent.
    #[arg(long, allow_hyphen_values = true)]
    near: Option<Micrometers>,
    /// Run in spite of errors of the rig file.
    #[arg(long)]
    pub(crate) anyway: bool,
    /// false: the emulated rig has the imperfections of a real one [default: as rig.toml says].
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    ideal: Option<bool>,
    /// Seed of the emulated rig; default: that of rig.toml.
    #[arg(long)]
    seed: Option<u64>,
    /// Run without real-time priority.
    #[arg(long)]
    pub(crate) best_effort: bool,
    /// Folder of the runs.
    #[arg(long, default_value = "runs")]
    pub(crate) runs: PathBuf,
}

impl LoopArgs {
    /// The rig as file and options have it.
    ///
    /// # Errors
    /// A file that cannot be read; options of the emulated rig for a real one.
    pub(crate) fn file(&self) -> Result<RigFile, Failure> {
        let mut file = RigFile::load(self.rig.as_deref())?;
        file.emulate_as(self.seed, self.ideal)?;
        self.choose_near(&mut file);
        Ok(file)
    }

    /// `--near`, if it was given.
    pub(crate) fn choose_near(&self, file: &mut RigFile) {
        if let Some(near) = self.near {
            file.near_um = Some(near.value());
        }
    }

    /// The law for the model, adapting or not.
    ///
    /// # Errors
    /// A model or a law that cannot be read or designed.
    pub(crate) fn prepare(&self, file: &RigFile) -> Result<Prepared, Failure> {
        let mut prepared = connect::prepare(&self.model, &self.controller, file)?;
        adapt::choose(self.adapt, &mut prepared.controller);
        let estimator = &prepared.controller.estimator;
        if estimator.adapt && !estimator.adapts() {
            tracing::warn!(
                "the loop does not adapt: dither_percent = 0 in {}",
                self.controller
            );
        }
        Ok(prepared)
    }

    /// The files that a run depends on.
    pub(crate) fn inputs<'a>(&'a self, file: &'a RigFile) -> Vec<&'a Path> {
        connect::inputs(self.rig.as_deref(), file, &self.model, &self.controller)
    }
}
