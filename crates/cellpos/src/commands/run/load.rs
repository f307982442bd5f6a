//! A script from its file.

use crate::outcome::Failure;
use cellpos_record::InputFile;
use cellpos_script::Script;
use cellpos_session::setup::ReferenceSpec;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::Path;

/// A script with everything that it names, in a form that is kept with the run.
pub(super) fn script(path: &Path) -> Result<(ReferenceSpec, Script, Vec<InputFile>), Failure> {
    let file = path.display().to_string();
    let text = cellpos_table::read_text(path, cellpos_script::MOST_BYTES).map_err(|error| {
        Failure::bad_input(
            format!("{file}: {error}"),
            "give the path of a script file; see examples/scripts/",
        )
    })?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let waveforms = RefCell::new(BTreeMap::new());
    let script = Script::parse_with(&text, &file, &|name| {
        let text = cellpos_table::read_text(&folder.join(name), cellpos_script::MOST_BYTES)
            .map_err(|error| error.to_string())?;
        waveforms
            .borrow_mut()
            .insert(name.to_string(), text.clone());
        Ok(text)
    })
    .map_err(Failure::input)?;
    let waveforms = waveforms.into_inner();
    let mut inputs = vec![InputFile::of_bytes(&file, text.as_bytes())];
    inputs.extend(waveforms.iter().map(|(name, text)| {
        InputFile::of_bytes(&folder.join(name).display().to_string(), text.as_bytes())
    }));
    let reference = ReferenceSpec::Script {
        file,
        text,
        from_s: 0.0,
        ran_s: None,
        first_length_um: None,
        waveforms,
    };
    Ok((reference, script, inputs))
}
