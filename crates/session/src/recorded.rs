//! The recorded set-up of a run's loop.

use crate::failure::Failure;
use crate::setup::{Setup, SetupConfig};
use crate::toml_file;
use cellpos_control::ControllerFile;
use cellpos_plant::Model;
use cellpos_record::{RunMeta, RunReader};

/// The loop as the run folder describes it.
///
/// # Errors
/// `run.toml` is damaged, or of a loop that this version cannot build.
pub fn setup(reader: &RunReader) -> Result<Setup, Failure> {
    let meta = reader.meta().map_err(|problem| {
        Failure::bad_input(
            format!(
                "{}: run.toml cannot be used: {problem}",
                reader.folder().display()
            ),
            "a replay needs the configuration in run.toml",
        )
    })?;
    let name = reader.folder().join("run.toml").display().to_string();
    setup_of(meta, &name)
}

/// The loop as the metadata of a run describe it; `name` is what errors call them.
///
/// # Errors
/// A loop that this version cannot build.
pub fn setup_of(meta: &RunMeta, name: &str) -> Result<Setup, Failure> {
    let mut config = meta.config.clone();
    config.remove("rig");
    config.remove("session");
    let text = |table: &toml::Table| toml::to_string(table).map_err(Failure::failed);
    Ok(Setup {
        model: Model::from_toml_str(&text(&meta.model)?, name).map_err(Failure::input)?,
        controller: ControllerFile::from_toml_str(&text(&meta.controller)?, name)
            .map_err(Failure::input)?,
        config: toml_file::parse::<SetupConfig>(&text(&config)?, name)?,
    })
}

/// Diffusion coefficient of the bead, um^2/s: the emulator's, or the model's where the rig was real.
pub fn diffusion_of_run_um2_per_s(meta: &RunMeta) -> Option<f64> {
    let rig = meta.config.get("rig");
    let camera = rig.and_then(|rig| rig.get("camera")?.get("kind")?.as_str());
    let place = if camera == Some("emulated") {
        rig?.get("emulator")?
    } else {
        meta.model.get("noise")?
    };
    place.get("diffusion_um2_per_s")?.as_float()
}
