//! What is said of settings that were found in a recording.

use cellpos_vision::{LocaliserConfig, ProfileSpec, Suggestion};
use serde::Serialize;

/// Settings found in the recording.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Advice {
    /// The table `[vision]` for rig.toml.
    pub vision: LocaliserConfig,
    /// Objects that stood out in the frames looked at.
    pub objects: usize,
    /// Taken as beads.
    pub taken: usize,
    /// Cut by the border.
    pub at_border: usize,
    /// Of another size or contrast than most.
    pub other: usize,
    /// Not fitted by the mean profile.
    pub bad_fit: usize,
    /// Radius of the beads, px.
    pub radius_px: f64,
    /// Radius that was given, px.
    pub given_px: Option<f64>,
    /// What the settings hold for.
    pub range: Option<HoldsFor>,
}

/// What settings hold for: nine in ten beads are found, each of these alone changed so far.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct HoldsFor {
    /// Contrast over the noise of the beads looked at.
    pub snr: f64,
    /// Contrast over the noise down to which beads are found.
    pub least_snr: f64,
    /// Smallest and largest image of the bead in another focus, relative to this one.
    pub size: [f64; 2],
    /// Blur, px (standard deviation).
    pub blur_px: f64,
}

impl HoldsFor {
    fn of(found: &Suggestion) -> Option<Self> {
        let range = found.range?;
        Some(Self {
            snr: found.snr,
            least_snr: range.snr,
            size: [range.size.0, range.size.1],
            blur_px: range.blur_px,
        })
    }

    fn sentence(&self) -> String {
        let [smaller, larger] = self.size.map(|size| 100.0 * (size - 1.0));
        format!(
            "holds for: contrast over noise from {:.1} up (these beads: {:.1}); out of focus until the image is {:.0} % smaller or {larger:.0} % \
             larger; blur up to {:.1} px",
            self.least_snr, self.snr, -smaller, self.blur_px
        )
    }
}

impl Advice {
    pub(super) fn of(found: &Suggestion, given_px: Option<f64>) -> Self {
        let radius_px = match found.config.profile {
            ProfileSpec::Table { radius_px, .. } => radius_px,
            ProfileSpec::Ring { edge_px } => edge_px,
            ProfileSpec::Gaussian { sigma_px } => 2.0 * sigma_px,
        };
        Advice {
            vision: found.config.clone(),
            objects: found.objects,
            taken: found.taken,
            at_border: found.refused.at_border,
            other: found.refused.other,
            bad_fit: found.refused.bad_fit,
            radius_px,
            given_px,
            range: HoldsFor::of(found),
        }
    }

    /// What the profile rests on.
    fn profile(&self) -> &'static str {
        match self.vision.profile {
            ProfileSpec::Table { .. } => {
                "profile: learnt; it predicts unseen beads better than a Gaussian or the measured ring"
            }
            ProfileSpec::Gaussian { .. } => {
                "profile: a Gaussian; a learnt one predicts unseen beads no better"
            }
            ProfileSpec::Ring { .. } => {
                "profile: the measured ring, scaled; a learnt one predicts unseen beads no better"
            }
        }
    }

    /// The settings as a table to paste, with their basis.
    pub(crate) fn text(&self) -> String {
        let given = self
            .given_px
            .map_or(String::new(), |px| format!(" (given: {px:.2} px)"));
        let mut text = format!(
            "settings found: {} of {} objects are beads of radius {:.2} px{given}; {} of another size or contrast, {} at the border, \
             {} not round like these\n{}\n{}\npaste into rig.toml:\n\n",
            self.taken,
            self.objects,
            self.radius_px,
            self.other,
            self.at_border,
            self.bad_fit,
            self.profile(),
            self.range.as_ref().map_or_else(
                || "holds for: not known; beads drawn from these settings are not found with them"
                    .to_string(),
                HoldsFor::sentence
            )
        );
        text.push_str(&vision_table(&self.vision));
        text
    }
}

/// Settings that come out of a file, as the table that goes back into one.
pub(in crate::commands) fn vision_table(vision: &LocaliserConfig) -> String {
    let value = toml::Value::try_from(vision).unwrap_or(toml::Value::Boolean(false));
    toml::to_string(&toml::Table::from_iter([("vision".to_string(), value)]))
        .unwrap_or_else(|error| format!("# {error}\n"))
}
