//! Tables of a script beside its steps: `[stop]` and `[sample]`.

use crate::error::ScriptError;
use crate::node::{Node, length, time};
use crate::sample::Sample;
use crate::script::Stop;
use cellpos_units::Micrometers;

/// The table `[stop]`.
pub(crate) fn stop(root: &Node) -> Result<Stop, ScriptError> {
    let Some(node) = root.table("stop")? else {
        return Ok(Stop::default());
    };
    node.only(&[
        "lost_longer_than",
        "error_above",
        "amplitude_error_above",
        "length_change_above",
        "stretch_down",
        "rest_length_change",
        "recovery_above",
        "after",
        "after_cycles",
    ])?;
    Ok(Stop {
        lost_longer_than_s: time(&node, "lost_longer_than")?,
        error_above_um: length(&node, "error_above", 1e-3)?,
        amplitude_error_above: node.percent("amplitude_error_above", (0.1, 1000.0))?,
        length_change_above_um: length(&node, "length_change_above", 1e-3)?,
        stretch_down: node.percent("stretch_down", (0.1, 100.0))?,
        rest_length_change: node.percent("rest_length_change", (0.1, 1000.0))?,
        recovery_above_s: time(&node, "recovery_above")?,
        after_s: time(&node, "after")?,
        after_cycles: node.whole("after_cycles", (1, u64::MAX))?,
    })
}

/// The table `[sample]`.
pub(crate) fn sample(root: &Node) -> Result<Sample, ScriptError> {
    let Some(node) = root.table("sample")? else {
        return Ok(Sample::default());
    };
    node.only(&[
        "sample",
        "medium",
        "chip",
        "region",
        "channel_width",
        "temperature",
        "operator",
        "notes",
    ])?;
    let text = |key: &str| -> Result<Option<String>, ScriptError> {
        Ok(node.text(key)?.map(|text| text.value.to_owned()))
    };
    let temperature_degc = match node.text("temperature")? {
        None => None,
        Some(text) => {
            let number = text.value.strip_suffix("degC").map(str::trim);
            let degc = number.and_then(|number| number.parse::<f64>().ok());
            let within = degc.filter(|degc| (-50.0..=150.0).contains(degc));
            Some(within.ok_or_else(|| {
                node.source.fail(
                    text.span.clone(),
                    format!("`temperature` = \"{}\" is none", text.value),
                    Some("write for example \"37degC\""),
                )
            })?)
        }
    };
    Ok(Sample {
        sample: text("sample")?,
        medium: text("medium")?,
        chip: text("chip")?,
        region: text("region")?,
        channel_width_um: node.quantity::<Micrometers>(
            "channel_width",
            Micrometers::value,
            (0.1, 1e4),
        )?,
        temperature_degc,
        operator: text("operator")?,
        notes: text("notes")?,
    })
}

#[cfg(test)]
mod tests {
    use crate::Script;

    const STEP: &str = "[[step]]\ndo = \"hold\"\nduration = \"1s\"\n";

    #[test]
    fn the_sample_and_the_stops_on_what_the_cell_does_are_read_with_their_units() {
        let text = format!(
            "[sample]\nsample = \"erythrocytes\"\nchannel_width = \"20um\"\ntemperature = \"37degC\"\n\
             [stop]\nstretch_down = \"20%\"\nrest_length_change = \"10%\"\nrecovery_above = \"300ms\"\n{STEP}"
        );
        let script = Script::parse(&text, "t.toml").unwrap();
        assert_eq!(script.sample.channel_width_um, Some(20.0));
        assert_eq!(script.sample.temperature_degc, Some(37.0));
        let stop = script.stop;
        assert_eq!(stop.stretch_down, Some(0.2));
        assert_eq!(stop.rest_length_change, Some(0.1));
        assert_eq!(stop.recovery_above_s, Some(0.3));
        for (wrong, said) in [
            ("[sample]\ntemperature = \"warm\"\n", "degC"),
            ("[sample]\nchannel_width = 20\n", "unit"),
            ("[sample]\ncolour = \"red\"\n", "colour"),
            ("[stop]\nstretch_down = 20\n", "%"),
        ] {
            let error = Script::parse(&format!("{wrong}{STEP}"), "t.toml").unwrap_err();
            let text = format!("{error} {:?}", error);
            assert!(text.contains(said), "{wrong}: {text}");
        }
    }
}
