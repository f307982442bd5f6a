//! What `cellpos identify` prints.

use crate::experiment::identify::{Done, Job};
use cellpos_ident::identifiability::Identifiability;
use cellpos_plant::{Hertz, TransferFunction};
use cellpos_report::number;
use serde_json::{Map, Value, json};
use std::fmt::Write;
use std::path::Path;

/// A number for JSON; a number that is not finite becomes `null`.
fn finite(value: f64) -> Value {
    if value.is_finite() {
        json!(value)
    } else {
        Value::Null
    }
}

fn ends(interval: [f64; 2]) -> Value {
    json!([finite(interval[0]), finite(interval[1])])
}

/// The JSON object of an identification of the emulated rig.
pub fn identification(done: &Done, job: &Job, model: &Path, report: &Path) -> Value {
    let result = &done.result;
    let eq6 = TransferFunction::eq6();
    let mut parameters = Map::new();
    for p in &result.judged.parameters {
        let (verdict, reason) = match &p.verdict {
            Identifiability::Identified => ("identified", Value::Null),
            Identifiability::NotIdentifiable { reason } => {
                ("not identifiable from this band", json!(reason))
            }
        };
        parameters.insert(
            p.name.to_owned(),
            json!({
                "value": finite(p.value),
                "unit": p.unit,
                "ci95": ends(p.ci95),
                "bootstrap95": p.bootstrap95.map(ends),
                "verdict": verdict,
                "reason": reason,
            }),
        );
    }
    let frequencies: Vec<Value> = result
        .compensated
        .iter()
        .map(|p| {
            json!({
                "frequency_hz": p.frequency_hz,
                "gain_db": p.gain_db,
                "gain_sd_db": p.gain_sd_db,
                "phase_deg": p.phase_deg,
                "phase_sd_deg": p.phase_sd_deg,
                "phase_with_delay_deg": p.delayed_phase_deg,
                "raw_phase_deg": p.raw_phase_deg,
                "coherence": p.coherence,
                "eq6_gain_db": eq6.gain_db(Hertz(p.frequency_hz)).0,
                "eq6_phase_deg": eq6.phase_deg(Hertz(p.frequency_hz)).0,
            })
        })
        .collect();
    let phase = result.judged.phase_delay95_s;
    let orders: Vec<Value> = result
        .selection
        .candidates
        .iter()
        .map(|r| {
            json!({
                "model": r.order.formula(), "chi2": finite(r.chi2), "dof": r.dof, "aicc": finite(r.aicc),
                "held_out": finite(r.held_out), "step_p_value": r.step_p_value,
            })
        })
        .collect();
    json!({
        "seed": job.seed,
        "rows": done.records.iter().map(|r| r.input.len()).sum::<usize>(),
        "frames": job.setup.frames,
        "closed_loop": job.setup.closed_loop,
        "model_formula": result.selection.best().order.formula(),
        "parameters": parameters,
        "frequencies": frequencies,
        "delay": {
            "led_ms": result.led.map(|l| l.delay_s * 1e3),
            "led_ci95_ms": result.led.map(|l| ends([l.ci95_s[0] * 1e3, l.ci95_s[1] * 1e3])),
            "exposure_to_tick_ms": done.age_s * 1e3,
            "led_edges": result.led.map(|l| l.edges),
            "phase_slope_ms": result.judged.phase_delay_s * 1e3,
            "phase_slope_ci95_ms": ends([phase[0] * 1e3, phase[1] * 1e3]),
            "disagreement_ms": result.disagreement_s.map(|g| g * 1e3),
        },
        "noise": result.measured.noise.map(|n| json!({
            "diffusion_um2_per_s": n.diffusion_um2_per_s,
            "diffusion_ci95_um2_per_s": n.diffusion_ci95_um2_per_s,
            "localisation_nm": n.localisation_um * 1e3,
            "timing_ms": n.timing_s * 1e3,
            "p_value": n.p_value,
            "used_for_weights": n.used,
        })),
        "ladder": orders,
        "neutral_um": done.neutral_um,
        "warnings": result.warnings,
        "runs": done.runs,
        "model": model.display().to_string(),
        "report": report.display().to_string(),
    })
}

/// The same for reading.
pub fn text(done: &Done, model: &Path, report: &Path) -> String {
    let result = &done.result;
    let mut out = format!("model  {}\n", result.selection.best().order.formula());
    for p in &result.judged.parameters {
        let _ = writeln!(
            out,
            "  {:<22} {:>10} {:<6} 95 % {} .. {}  {}",
            p.name,
            number(p.value),
            p.unit,
            number(p.ci95[0]),
            number(p.ci95[1]),
            p.verdict.label()
        );
    }
    if let Some(led) = result.led {
        let least_ms = result.judged.phase_delay95_s[0] * 1e3;
        let phase = if least_ms > 0.0 {
            format!("phase slope {least_ms:.3} ms or more")
        } else {
            "the phase slope does not determine it".to_owned()
        };
        let _ = writeln!(out, "delay  LED test {:.3} ms; {phase}", led.delay_s * 1e3);
    }
    let _ = writeln!(out, "line Hz   gain dB   phase deg   coherence");
    for p in &result.compensated {
        let _ = writeln!(
            out,
            "{:>7}  {:>8.3}  {:>10.2}  {:>10.5}",
            p.frequency_hz, p.gain_db, p.phase_deg, p.coherence
        );
    }
    for warning in &result.warnings {
        let _ = writeln!(out, "warning: {warning}");
    }
    if !done.runs.is_empty() {
        let _ = writeln!(out, "runs  {}", done.runs.join(" "));
    }
    let _ = writeln!(out, "wrote {} and {}", model.display(), report.display());
    out
}
