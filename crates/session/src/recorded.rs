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
/// `run.toml` is damaged, or describes a loop that this version cannot build.
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
/// The loop cannot be built by this version.
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

/// The emulated world, if the camera was emulated.
fn emulated(meta: &RunMeta) -> Option<&toml::Value> {
    let rig = meta.config.get("rig")?;
    let camera = rig.get("camera")?.get("kind")?.as_str()?;
    rig.get("emulator").filter(|_| camera == "emulated")
}

/// Whether a cell was followed rather than a bead.
pub fn followed_a_cell(meta: &RunMeta) -> bool {
    let place = emulated(meta).or_else(|| meta.config.get("rig"));
    place.is_some_and(|place| place.get("cell").is_some())
}

/// Diffusion coefficient of the bead, um^2/s: from the emulator, or for a real rig from the model.
pub fn diffusion_of_run_um2_per_s(meta: &RunMeta) -> Option<f64> {
    let place = match emulated(meta) {
        Some(world) => world,
        None => meta.model.get("noise")?,
    };
    place.get("diffusion_um2_per_s")?.as_float()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_tells_whether_it_followed_a_cell() {
        let of = |rig: &str| {
            let mut meta = RunMeta::new("a", "real");
            meta.config = rig.parse().expect("TOML");
            followed_a_cell(&meta)
        };
        let emulated = "[rig.camera]\nkind = \"emulated\"\n[rig.emulator]\nseed = 1\n";
        assert!(!of(emulated));
        assert!(of(&format!("{emulated}[rig.emulator.cell]\ngain = 1.5\n")));
        let real = "[rig.camera]\nkind = \"socket\"\n[rig.emulator.cell]\ngain = 1.5\n";
        assert!(!of(real), "the emulated world is not in use");
        assert!(of(&format!(
            "{real}[rig.cell]\nbackground = \"empty.tif\"\n"
        )));
        assert!(!of(""));
    }
}
