//! Keys of a rig file that its kind of rig does not use.

use super::{CameraConfig, RigFile};
use crate::quantities::line_of;

impl RigFile {
    /// A sentence with its line for each key of the file's text that this kind of rig does not use.
    pub(super) fn unused(&self, text: &str) -> Vec<String> {
        let emulated_camera = self.camera == CameraConfig::Emulated {};
        let emulated_cell = self.is_emulated() && self.emulator.cell.is_some();
        let looks = "[emulator.cell] puts a cell in the place of the bead";
        let kinds = [
            (
                emulated_camera,
                "cell",
                "background",
                "the emulated camera has its own empty channel",
            ),
            (
                self.follows_a_cell(),
                "",
                "vision",
                "a cell is followed, and [vision] describes beads",
            ),
            (emulated_cell, "emulator", "bead_radius_um", looks),
            (emulated_cell, "emulator", "bead_look", looks),
        ];
        let said = kinds.into_iter().filter(|(holds, ..)| *holds);
        said.filter_map(|(_, table, key, why)| {
            let line = line_of(text, Some(table), key)?;
            let name = match table {
                "" => format!("[{key}]"),
                table => format!("[{table}] {key}"),
            };
            Some(format!("{line}: {name} is not used: {why}"))
        })
        .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn unused(text: &str) -> Vec<String> {
        let file: RigFile = toml::from_str(text).expect("a rig file");
        file.unused(text)
    }

    #[test]
    fn what_a_kind_of_rig_does_not_use_is_said_with_its_line() {
        let cell = "[emulator]\nbead_look = \"disc\"\n[emulator.cell]\n[cell]\nbackground = \"empty.tif\"\n[vision]\n\
                    window_px = 21\nprofile = { kind = \"ring\", edge_px = 4.0 }\n";
        let lines: Vec<String> = (unused(cell).iter())
            .filter_map(|said| Some(said.split_once(" is not")?.0.to_owned()))
            .collect();
        assert_eq!(
            lines,
            [
                "5: [cell] background",
                "6: [vision]",
                "2: [emulator] bead_look"
            ]
        );
        // The same keys where they are used.
        let camera = "[actuator]\nkind = \"serial\"\nport = \"p\"\n[camera]\nkind = \"socket\"\nsocket = \"s\"\n";
        let real = format!("{camera}[cell]\nbackground = \"empty.tif\"\n");
        assert_eq!(unused(&real), Vec::<String>::new());
        let bead = "[emulator]\nbead_look = \"disc\"\n[vision]\nwindow_px = 21\n\
                    profile = { kind = \"ring\", edge_px = 4.0 }\n";
        assert_eq!(unused(bead), Vec::<String>::new());
    }

    #[test]
    fn no_example_has_a_key_that_it_does_not_use() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples");
        let files = std::fs::read_dir(folder).expect("examples").flatten();
        for path in files.map(|entry| entry.path()) {
            let text = std::fs::read_to_string(&path).unwrap_or_default();
            if let Ok(file) = RigFile::load(Some(&path)) {
                assert_eq!(file.unused(&text), Vec::<String>::new(), "{path:?}");
            }
        }
    }
}
