//! Steps of 10 um as fast as the PZT can go.

use super::held::{Row, follow};
use cellpos_runtime::TickRecord;
use cellpos_vision::Decision;

const STEP_UM: f64 = 10.0;
/// Bands of a step that is over, um.
const BAND_UM: f64 = 0.05 * STEP_UM;

/// How a bead went through its steps.
pub(super) struct Steps {
    /// From the start of each step until the bead stays within 5 %, ms.
    pub settled_ms: Vec<f64>,
    /// Good fixes that tracker or estimator refused.
    pub refused: usize,
    /// Furthest true position from the middle of the picture in each step, um.
    pub furthest_um: Vec<f64>,
}

fn script(steps: usize) -> String {
    let half = STEP_UM / 2.0;
    let way = |to: f64| {
        format!(
            "[[step.step]]\ndo = \"move\"\nto = \"{to}um\"\nduration = \"5ms\"\nshape = \"constant-velocity\"\n\
             [[step.step]]\ndo = \"hold\"\nduration = \"95ms\"\n"
        )
    };
    format!(
        "name = \"steps\"\nstart = \"-{half}um\"\n[[step]]\ndo = \"hold\"\nduration = \"1s\"\n\
         [[step]]\ndo = \"repeat\"\ntimes = {}\n{}{}\
         [[step]]\ndo = \"hold\"\nduration = \"2s\"\n",
        steps / 2,
        way(half),
        way(-half)
    )
}

/// So many steps under a law on a rig with the imperfections of a real one, whose gain is so many times the model's.
pub(super) fn go(law: &'static str, seed: u64, steps: usize, gain: f64) -> Steps {
    let row = Row {
        gain,
        ideal: false,
        seconds: 2.0 + 0.1 * steps as f64 + 0.5,
        ..Row::step(law, 0.0)
    };
    judged(&follow(&row, seed, script(steps)))
}

fn judged(ticks: &[TickRecord]) -> Steps {
    let running: Vec<&TickRecord> = ticks.iter().filter(|t| t.is_running()).collect();
    let mut settled_ms = Vec::new();
    let mut furthest_um = Vec::new();
    // Where each step begins, ns, and how long after it the bead was outside last.
    let mut step: Option<(i64, f64)> = None;
    for pair in running.windows(2) {
        let [before, now] = pair else { continue };
        let ends_um = STEP_UM / 2.0;
        let leaves =
            before.target_um.abs() > ends_um - 1e-6 && now.target_um.abs() < ends_um - 1e-6;
        if leaves {
            settled_ms.extend(step.map(|(_, ms)| ms));
            step = Some((before.time_ns, 0.0));
            furthest_um.push(0.0_f64);
        }
        let Some((since_ns, outside_ms)) = &mut step else {
            continue;
        };
        if let Some(um) = furthest_um.last_mut() {
            *um = um.max(now.true_um.abs());
        }
        let since_ms = (now.time_ns - *since_ns) as f64 * 1e-6;
        if since_ms > 95.0 {
            continue;
        }
        // To the end that the target goes to: away from the one that it left.
        if (now.true_um - now.target_um).abs() > BAND_UM || now.target_um.abs() < ends_um - 1e-6 {
            *outside_ms = since_ms;
        }
    }
    settled_ms.extend(step.map(|(_, ms)| ms));
    let refused = running
        .iter()
        .filter(|t| t.error_um.is_finite())
        .filter(|t| {
            let accepted = Decision::from_number(t.decision).is_none_or(Decision::is_accepted);
            !accepted || t.flags.has(cellpos_runtime::TickFlags::GATED)
        })
        .count();
    Steps {
        settled_ms,
        refused,
        furthest_um,
    }
}
