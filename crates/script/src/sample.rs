//! The table `[sample]` of rig.toml and of scripts: contents of the channel.

use serde::{Deserialize, Serialize};

/// Sample, medium and chip of a run, for reports and for the field's file formats. Every key may be left out.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Sample {
    /// Contents of the channel: cells and their source, beads and their diameter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sample: Option<String>,
    /// What it swims in.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub medium: Option<String>,
    /// Chip, with its batch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chip: Option<String>,
    /// Region of the chip that is in view: `channel` or `reservoir`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub region: Option<String>,
    /// Width of the channel, um.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub channel_width_um: Option<f64>,
    /// Temperature, degrees Celsius.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub temperature_degc: Option<f64>,
    /// Who ran it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub operator: Option<String>,
    /// Anything else.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub notes: Option<String>,
}

impl Sample {
    /// This one, with missing values from another.
    #[must_use]
    pub fn or(&self, other: &Self) -> Self {
        let text = |a: &Option<String>, b: &Option<String>| a.clone().or_else(|| b.clone());
        Self {
            sample: text(&self.sample, &other.sample),
            medium: text(&self.medium, &other.medium),
            chip: text(&self.chip, &other.chip),
            region: text(&self.region, &other.region),
            channel_width_um: self.channel_width_um.or(other.channel_width_um),
            temperature_degc: self.temperature_degc.or(other.temperature_degc),
            operator: text(&self.operator, &other.operator),
            notes: text(&self.notes, &other.notes),
        }
    }

    /// Names and values of the keys that are set.
    pub fn rows(&self) -> Vec<(&'static str, String)> {
        let number = |value: Option<f64>, unit: &str| value.map(|value| format!("{value} {unit}"));
        [
            ("sample", self.sample.clone()),
            ("medium", self.medium.clone()),
            ("chip", self.chip.clone()),
            ("region", self.region.clone()),
            ("channel width", number(self.channel_width_um, "um")),
            ("temperature", number(self.temperature_degc, "\u{b0}C")),
            ("operator", self.operator.clone()),
            ("notes", self.notes.clone()),
        ]
        .into_iter()
        .filter_map(|(name, value)| Some((name, value?)))
        .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_script_leaves_out_is_the_rigs() {
        let rig = Sample {
            chip: Some("PDMS-7".to_owned()),
            operator: Some("A".to_owned()),
            channel_width_um: Some(20.0),
            ..Sample::default()
        };
        let script = Sample {
            sample: Some("erythrocytes".to_owned()),
            operator: Some("B".to_owned()),
            ..Sample::default()
        };
        let rows = script.or(&rig).rows();
        assert_eq!(
            rows,
            vec![
                ("sample", "erythrocytes".to_owned()),
                ("chip", "PDMS-7".to_owned()),
                ("channel width", "20 um".to_owned()),
                ("operator", "B".to_owned()),
            ]
        );
    }
}
