//! The rows of the table, and what must hold in them.

use super::held::{GAIN_PER_S, Held, OWN_KP, Row};
use super::interval::interval;
use cellpos_emulator::FaultKind;

/// The laws: those of this project, and one of a user's own.
pub(super) const LAWS: [&str; 4] = ["lqg", "pi", "mpc", "own"];

/// Events in a run of the nightly table.
const TIMES: usize = 5;

/// Every row of the nightly table.
pub(super) fn all() -> Vec<Row> {
    let mut rows = Vec::new();
    for law in LAWS {
        let step = |um_per_s| Row::step(law, um_per_s).again(TIMES);
        for um_per_s in [38.0, -114.0, 190.0, -379.0, 568.0, -985.0] {
            rows.push(step(um_per_s));
        }
        for um_per_s in [-38.0, 379.0, -985.0] {
            for rate_hz in [2000.0, 5000.0] {
                rows.push(Row {
                    rate_hz,
                    ..step(um_per_s)
                });
            }
            for pixel_um in [0.15, 0.2, 0.25] {
                rows.push(Row {
                    pixel_um,
                    ..step(-um_per_s)
                });
            }
            // Three radii of the bead.
            rows.push(Row {
                second_um: Some(1.5),
                ..step(um_per_s)
            });
        }
        let event = |kind, for_s| Row::event(law, kind, for_s);
        for for_s in [0.005, 0.02, 0.05, 0.1, 0.19] {
            rows.push(event("link-loss", for_s).again(TIMES));
        }
        for for_s in [0.02, 0.1, 0.4] {
            for kind in ["stall-camera", "frozen-picture", "drop-frames"] {
                rows.push(event(kind, for_s).again(TIMES));
            }
            rows.push(event("stale-frames", for_s));
        }
        for kind in ["double-frames", "reorder-frames", "link-garbage"] {
            rows.push(event(kind, 0.5).again(TIMES));
        }
        rows.push(event("lose-bead", 0.4));
        rows.push(Row::to_the_end(law, "lose-bead"));
        rows.push(Row::to_the_end(law, "stall-camera"));
        rows.push(Row::flipped(law));
    }
    rows
}

/// State of the run at its end, and whether it ended as asked, which is exit code 0.
fn expected(row: &Row) -> (&'static str, bool) {
    if row.has(FaultKind::GainFlip) || row.has(FaultKind::StaleFrames) {
        // The loop stops: five old frames in a row end a run, too.
        ("safe", false)
    } else if row.has(FaultKind::LoseBead) || row.ends_unseen() {
        // A bead that goes from a picture that goes on may be another when it is back.
        ("not-kept", false)
    } else {
        ("running", true)
    }
}

/// Longest time that the PZT may be more than 1 um off zero flow after the gain changed its sign, ms.
pub(super) const FLIPPED_MS: f64 = 50.0;

/// What is asked of a run.
pub(super) struct Limits {
    /// RMS of a quiet hold, um, and the largest error of the stated one.
    hold_um: f64,
    stated: f64,
}

impl Limits {
    pub(super) fn of_the_loop() -> Self {
        Self {
            hold_um: 0.057,
            stated: 0.1,
        }
    }

    /// The furthest that a bead may go when the flow steps, um.
    pub(super) fn furthest_um(&self, row: &Row) -> f64 {
        let (delay_s, tick_s) = row.delay_and_tick_s();
        1.3 * row.flow_um_per_s.abs() * (delay_s + 2.0 * tick_s) + 4.0 * self.hold_um
    }

    /// The same, or what a law without an integral can do if that is more: it lets a flow of `v` carry the bead towards `v / (gain kp)`, with
    /// the time constant `1 / (gain kp)`, until the zero flow is known. Nobody can tell a flow from the walk before it has gone `z` standard
    /// deviations of it, `v t = z sqrt(2 D t)`; flows that step 0.01 times in a second are likelier than the walk from z = 5.3 on.
    pub(super) fn possible_um(&self, row: &Row) -> f64 {
        const Z: f64 = 5.3;
        const WALK_UM2_PER_S: f64 = 2.0 * 0.33;
        let asked_um = self.furthest_um(row);
        let speed = row.flow_um_per_s.abs();
        if row.law != "own" || speed == 0.0 {
            return asked_um;
        }
        let answer_per_s = GAIN_PER_S * OWN_KP;
        let told_s = Z * Z * WALK_UM2_PER_S / (speed * speed) + row.delay_and_tick_s().0;
        let carried_um = speed / answer_per_s * (1.0 - (-answer_per_s * told_s).exp());
        asked_um.max(carried_um + 4.0 * self.hold_um)
    }

    /// What a run broke.
    pub(super) fn broken(&self, row: &Row, held: &Held) -> Vec<String> {
        let mut broken = Vec::new();
        let (state, as_asked) = expected(row);
        if (held.state.as_str(), held.as_asked) != (state, as_asked) {
            broken.push(format!(
                "{state} and {as_asked} expected: {held}: {}",
                held.ended
            ));
        }
        if row.has(FaultKind::GainFlip) && held.pzt_off_ms > FLIPPED_MS {
            broken.push(format!("the PZT off for {:.0} ms: {held}", held.pzt_off_ms));
        }
        if state == "running" && (held.changed || held.other_beads > 0) {
            broken.push(format!("another bead: {held}"));
        }
        let most_um = self.possible_um(row);
        let far = held.furthest_um.iter().filter(|um| **um > most_um);
        if row.flow_um_per_s != 0.0 && far.clone().count() > 0 {
            let far: Vec<f64> = far.copied().collect();
            broken.push(format!("at most {most_um:.2} um, {far:.2?}: {held}"));
        }
        broken
    }

    /// How the runs of a row went, in numbers.
    pub(super) fn counts(&self, row: &Row, held: &[&Held]) -> String {
        let count = |is: &dyn Fn(&Held) -> bool| held.iter().filter(|h| is(h)).count();
        let [truth, stated] = Self::rms(held);
        let mut text = format!("{} seeds", held.len());
        if row.flow_um_per_s != 0.0 {
            let most_um = self.furthest_um(row);
            let all = || held.iter().flat_map(|h| &h.furthest_um);
            let (far, events) = (all().filter(|um| **um > most_um).count(), all().count());
            let [low, high] = interval(far, events).map(|p| 100.0 * p);
            text += &format!(
                ", {far} of {events} steps beyond {most_um:.2} um ({low:.1} to {high:.1} %)"
            );
            let possible_um = self.possible_um(row);
            if possible_um > most_um {
                let far = all().filter(|um| **um > possible_um).count();
                text += &format!(", {far} beyond {possible_um:.2} um, which is possible");
            }
        }
        text += &format!(
            ", {} another bead, {} said to be as asked, PZT off for at most {:.0} ms; RMS {truth:.1} nm, stated {stated:.1} ({:+.1} %)",
            count(&|h| h.changed || h.other_beads > 0),
            count(&|h| h.as_asked),
            held.iter().map(|h| h.pzt_off_ms).fold(0.0, f64::max),
            100.0 * (stated / truth - 1.0),
        );
        text
    }

    /// Root of the mean square of the runs' RMS errors, true and stated, nm.
    fn rms(held: &[&Held]) -> [f64; 2] {
        let rms = |of: fn(&Held) -> f64| {
            let squares: f64 = held.iter().map(|held| of(held).powi(2)).sum();
            (squares / held.len() as f64).sqrt()
        };
        [rms(|h| h.true_rms_nm), rms(|h| h.stated_rms_nm)]
    }

    /// What is wrong with the stated errors of a row's runs: with their RMS, for the walk of a bead that nobody sees is chance.
    pub(super) fn stated(&self, row: &Row, held: &[&Held]) -> Option<String> {
        let [truth, stated] = Self::rms(held);
        let error = stated / truth - 1.0;
        // The walk of a bead that nobody sees is chance: what is stated is its expectation. Of so many runs their mean square may be off
        // by twice its standard error.
        let n = held.len() as f64;
        let off = |h: &Held| h.stated_rms_nm.powi(2) - h.true_rms_nm.powi(2);
        let mean = held.iter().map(|held| off(held)).sum::<f64>() / n;
        let scatter = held
            .iter()
            .map(|held| (off(held) - mean).powi(2))
            .sum::<f64>();
        let chance = if row.is_blind() {
            2.0 * (scatter / (n * (n - 1.0).max(1.0))).sqrt()
        } else {
            0.0
        };
        let least = if row.is_blind() { 8 } else { 1 };
        let beyond = error.abs() > self.stated && mean.abs() > chance;
        let wrong = held.len() >= least && beyond || error.is_nan();
        wrong.then(|| {
            format!(
                "the error is {truth:.1} nm, and {stated:.1} nm are stated ({:+.1} %)",
                100.0 * error
            )
        })
    }
}
