//! Adaptation of the loop to the plant: its switch, and its outcome in words.

use cellpos_control::{AdaptMode, Adaptation, ControllerFile};
use cellpos_runtime::life::EventKind;

/// Whether the law follows the gain and delay of the plant while the loop runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Adapt {
    /// Follow them.
    On,
    /// It stays as it was designed.
    Off,
}

/// The command line overrides the controller. By default `lqg` and `mpc`, given by name, adapt; a controller.toml
/// follows its key `adapt` in `[estimator]`.
pub fn choose(asked: Option<Adapt>, controller: &mut ControllerFile) {
    if let Some(asked) = asked {
        controller.estimator.adapt = asked == Adapt::On;
    }
}

/// The state of adaptation, in a line.
pub fn text(now: &Adaptation) -> String {
    let mode = match now.mode {
        AdaptMode::Learning => "learning",
        AdaptMode::Known => "known",
        AdaptMode::Uncertain => "uncertain",
        AdaptMode::AtLimit => "at the end of its range",
    };
    let found = now.gain_estimate.map_or_else(String::new, |[gain, sd]| {
        format!(
            ", estimated {gain:.2} +- {:.2}",
            cellpos_numeric::statistics::Z95 * sd
        )
    });
    let mut text = format!(
        "tuned to {:.2} of the model's gain{found}, {:+.1} samples of delay; {mode}",
        now.gain, now.delay_samples
    );
    for flow in now.periodic_flows.iter().flatten() {
        let (hz, um) = (flow.frequency_hz, flow.amplitude_um);
        text += &format!("; a flow of {hz:.2} Hz is cancelled ({um:.2} um)");
    }
    if let Some(walk) = now.zero_flow_walk_um_per_sqrt_s {
        text += &format!("; zero flow wanders by {walk:.2} um in a second");
    }
    text
}

/// State of adaptation in a tick, from its columns in the record; `None` if they are empty.
pub(crate) fn recorded(columns: &[f32]) -> Option<Adaptation> {
    let [gain, delay_samples, found, sd, mode, ..] = *columns else {
        return None;
    };
    let modes = [
        AdaptMode::Learning,
        AdaptMode::Known,
        AdaptMode::Uncertain,
        AdaptMode::AtLimit,
    ];
    let mode = modes.into_iter().find(|m| f32::from(*m as u8) == mode)?;
    let known = found.is_finite() && sd.is_finite();
    Some(Adaptation {
        gain: f64::from(gain),
        delay_samples: f64::from(delay_samples),
        gain_estimate: known.then_some([f64::from(found), f64::from(sd)]),
        delay_estimate_samples: None,
        mode,
        periodic_flows: Default::default(),
        zero_flow_walk_um_per_sqrt_s: None,
        news: None,
    })
}

/// The sentence of [`EventKind::Adapted`]; `None` for another event.
pub(crate) fn sentence(kind: &EventKind) -> String {
    let EventKind::Adapted {
        gain_before,
        gain,
        delay_before_ms,
        delay_ms,
        over_s,
    } = *kind
    else {
        return String::new();
    };
    let (gain, delay_ms) = ([gain_before, gain], [delay_before_ms, delay_ms]);
    /// Smallest change of the gain that is mentioned with a change of the delay.
    const CHANGED: f64 = 1.1;
    let ratio = gain[1] / gain[0];
    let gain_changed = !(1.0 / CHANGED..=CHANGED).contains(&ratio);
    let mut parts = Vec::new();
    if gain_changed {
        let way = if ratio < 1.0 { "fell" } else { "rose" };
        parts.push(format!("gain {way} to {:.2}", gain[1]));
    }
    let more_ms = delay_ms[1] - delay_ms[0];
    if more_ms.abs() > 1e-6 {
        let way = if more_ms > 0.0 { "grew" } else { "shrank" };
        parts.push(format!("delay {way} by {:.2} ms", more_ms.abs()));
    }
    let hint = match (gain_changed, ratio < 1.0) {
        // Gas answers later as well, which may have been reported before.
        (true, true) if delay_ms[1] > 1e-6 => "; is there gas in the line?",
        (true, true) => "; is the channel clogging?",
        (true, false) => "; has a constriction opened, or the bead moved to the middle?",
        (false, _) => "; does the camera or the amplifier take longer than the rig file says?",
    };
    let what = parts.join(", ");
    let mut letters = what.chars();
    let first = letters.next().map(|c| c.to_uppercase().to_string());
    format!(
        "{}{} over {over_s:.1} s: adapted{hint}",
        first.unwrap_or_default(),
        letters.as_str()
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_control::PeriodicFlow;

    fn told(gain: [f64; 2], delay_ms: f64, over_s: f64) -> String {
        told_from(gain, [0.0, delay_ms], over_s)
    }

    fn told_from(gain: [f64; 2], delay_ms: [f64; 2], over_s: f64) -> String {
        sentence(&EventKind::Adapted {
            gain_before: gain[0],
            gain: gain[1],
            delay_before_ms: delay_ms[0],
            delay_ms: delay_ms[1],
            over_s,
        })
    }

    #[test]
    fn what_a_record_holds_of_adaptation_reads_as_a_line() {
        let now = recorded(&[0.5, 1.0, 0.75, 0.02, 2.0, f32::NAN]).expect("a tick that adapts");
        assert_eq!(
            text(&now),
            "tuned to 0.50 of the model's gain, estimated 0.75 +- 0.04, +1.0 samples of delay; uncertain"
        );
        let limit = recorded(&[2.5, 1.5, 3.1, 0.1, 3.0, 0.0]).expect("a tick that adapts");
        assert!(text(&limit).ends_with("; at the end of its range"));
        let unknown = recorded(&[1.0, 0.0, f32::NAN, f32::NAN, 0.0]).expect("too little motion");
        assert!(!text(&unknown).contains("estimated"));
        let mut shaken = unknown;
        shaken.periodic_flows[0] = Some(PeriodicFlow {
            frequency_hz: 50.0,
            amplitude_um: 0.3,
        });
        shaken.zero_flow_walk_um_per_sqrt_s = Some(0.2);
        assert!(text(&shaken).ends_with(
            "learning; a flow of 50.00 Hz is cancelled (0.30 um); zero flow wanders by 0.20 um in a second"
        ));
        assert_eq!(recorded(&[f32::NAN; 6]), None);
        assert_eq!(recorded(&[1.0]), None);
    }

    #[test]
    fn a_change_reads_as_a_sentence() {
        assert_eq!(
            told([1.0, 0.7], 0.0, 40.0),
            "Gain fell to 0.70 over 40.0 s: adapted; is the channel clogging?"
        );
        assert_eq!(
            told([1.0, 0.7], 0.5, 8.0),
            "Gain fell to 0.70, delay grew by 0.50 ms over 8.0 s: adapted; is there gas in the line?"
        );
        // The delay was reported before the gain.
        assert_eq!(
            told_from([1.0, 0.7], [0.5, 0.5], 9.0),
            "Gain fell to 0.70 over 9.0 s: adapted; is there gas in the line?"
        );
        assert_eq!(
            told([1.0, 1.04], 1.0, 0.5),
            "Delay grew by 1.00 ms over 0.5 s: adapted; does the camera or the amplifier take longer than the rig file says?"
        );
    }
}
