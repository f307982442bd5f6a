//! The rows of the table, and what must hold in them.

use super::held::{Held, Row};
use cellpos_emulator::FaultKind;

/// The laws: those of this project, and one of a user's own.
pub(super) const LAWS: [&str; 4] = ["lqg", "pi", "mpc", "own"];

/// Every row of the nightly table.
pub(super) fn all() -> Vec<Row> {
    let mut rows = Vec::new();
    for law in LAWS {
        for um_per_s in [38.0, -114.0, 190.0, -379.0, 568.0, -985.0] {
            rows.push(Row::step(law, um_per_s));
        }
        for um_per_s in [-38.0, 379.0, -985.0] {
            for rate_hz in [2000.0, 5000.0] {
                rows.push(Row {
                    rate_hz,
                    ..Row::step(law, um_per_s)
                });
            }
            for pixel_um in [0.15, 0.2, 0.25] {
                rows.push(Row {
                    pixel_um,
                    ..Row::step(law, -um_per_s)
                });
            }
            // Three radii of the bead.
            rows.push(Row {
                second_um: Some(1.5),
                ..Row::step(law, um_per_s)
            });
        }
        for for_s in [0.005, 0.02, 0.05, 0.1, 0.19] {
            rows.push(Row::event(law, "link-loss", for_s));
        }
        for for_s in [0.02, 0.1, 0.4] {
            rows.push(Row::event(law, "stall-camera", for_s));
            rows.push(Row::event(law, "frozen-picture", for_s));
            rows.push(Row::event(law, "drop-frames", for_s));
            rows.push(Row::event(law, "stale-frames", for_s));
        }
        for kind in ["double-frames", "reorder-frames", "link-garbage"] {
            rows.push(Row::event(law, kind, 0.5));
        }
        rows.push(Row::event(law, "lose-bead", 0.4));
        rows.push(Row::to_the_end(law, "lose-bead"));
        rows.push(Row::to_the_end(law, "stall-camera"));
        rows.push(Row::flipped(law));
    }
    rows
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

    /// What a run broke.
    pub(super) fn broken(&self, row: &Row, held: &Held) -> Vec<String> {
        let mut broken = Vec::new();
        let frozen = row.has(FaultKind::GainFlip);
        if row.ends_unseen() || frozen {
            // What became of the bead nobody can say.
            if held.as_asked {
                broken.push(format!("a run that lost its bead is as asked: {held}"));
            }
            if frozen && held.pzt_off_ms > FLIPPED_MS {
                broken.push(format!("the PZT off for {:.0} ms: {held}", held.pzt_off_ms));
            }
            return broken;
        }
        if held.changed || held.other_beads > 0 {
            broken.push(format!("another bead: {held}"));
        }
        let lost = held.state != "running" && held.state != "not-kept";
        if row.flow_um_per_s != 0.0 {
            let most_um = self.furthest_um(row);
            if held.worst_um > most_um {
                broken.push(format!("at most {most_um:.2} um: {held}"));
            }
            if held.state != "running" {
                broken.push(format!("not kept: {}", held.ended));
            }
        } else if row.has(FaultKind::StaleFrames) {
            // Five old frames in a row end a run.
            if held.state != "safe" {
                broken.push(format!("not safe: {}", held.ended));
            }
        } else if lost {
            broken.push(format!("lost: {}", held.ended));
        }
        broken
    }

    /// How the runs of a row went, in numbers.
    pub(super) fn counts(&self, row: &Row, held: &[&Held]) -> String {
        let count = |is: &dyn Fn(&Held) -> bool| held.iter().filter(|h| is(h)).count();
        let most_um = self.furthest_um(row);
        let [truth, stated] = Self::rms(held);
        format!(
            "{} seeds: {} not kept to the end, {} another bead, {} beyond {most_um:.2} um, {} said to be as asked, PZT off for at most {:.0} ms; RMS {truth:.1} nm, stated {stated:.1} ({:+.1} %)",
            held.len(),
            count(&|h| h.state != "running"),
            count(&|h| h.changed || h.other_beads > 0),
            count(&|h| h.worst_um > most_um),
            count(&|h| h.as_asked),
            held.iter().map(|h| h.pzt_off_ms).fold(0.0, f64::max),
            100.0 * (stated / truth - 1.0),
        )
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
