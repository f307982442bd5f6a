//! Tables of a script besides its steps: `[stop]`, `[sample]` and `[clips]`.

use crate::error::ScriptError;
use crate::node::{Node, length, time};
use crate::sample::Sample;
use crate::script::{ClipWishes, Stop};
use cellpos_numeric::units::Micrometers;

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

/// The table `[clips]`.
pub(crate) fn clips(root: &Node) -> Result<Option<ClipWishes>, ScriptError> {
    let Some(node) = root.table("clips")? else {
        return Ok(None);
    };
    node.only(&["cycles", "phases", "before", "after", "most_mb", "events"])?;
    let whole = |n: f64| n >= 1.0 && n.fract() == 0.0 && n < 1e15;
    let cycles = node.numbers("cycles", "for example cycles = [1, 10, 100]", whole)?;
    let share = |n: f64| (0.0..1.0).contains(&n);
    let help = "shares of a cycle, for example [0.0, 0.5]";
    let phases = node.numbers("phases", help, share)?;
    let usual = ClipWishes::default();
    Ok(Some(ClipWishes {
        cycles: cycles.into_iter().map(|n| n as u64).collect(),
        phases: if phases.is_empty() {
            usual.phases
        } else {
            phases
        },
        before_s: time(&node, "before")?.unwrap_or(usual.before_s).min(10.0),
        after_s: time(&node, "after")?.unwrap_or(usual.after_s).min(10.0),
        most_mb: node
            .whole("most_mb", (1, 1_000_000))?
            .unwrap_or(usual.most_mb),
        events: node.flag("events")?.unwrap_or(usual.events),
    }))
}

#[cfg(test)]
mod tests {
    use crate::Script;

    const STEP: &str = "[[step]]\ndo = \"hold\"\nduration = \"1s\"\n";

    #[test]
    fn clips_are_wished_for_by_cycle_and_phase() {
        let text = format!(
            "[clips]\ncycles = [1, 100]\nphases = [0.25]\nbefore = \"100ms\"\nmost_mb = 50\n{STEP}"
        );
        let clips = Script::parse(&text, "t.toml").unwrap().clips.unwrap();
        assert_eq!((clips.cycles, clips.phases), (vec![1, 100], vec![0.25]));
        assert_eq!((clips.before_s, clips.after_s), (0.1, 0.25));
        assert_eq!((clips.most_mb, clips.events), (50, true));
        assert!(Script::parse(STEP, "t.toml").unwrap().clips.is_none());
        for (wrong, said) in [
            ("cycles = [0]", "cycles"),
            ("cycles = [1.5]", "cycles"),
            ("phases = [1]", "phases"),
            ("cycle = [1]", "did you mean `cycles`"),
        ] {
            let error = Script::parse(&format!("[clips]\n{wrong}\n{STEP}"), "t.toml").unwrap_err();
            let text = format!("{error} {error:?}");
            assert!(text.contains(said), "{wrong}: {text}");
        }
    }

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
