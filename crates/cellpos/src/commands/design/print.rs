//! The design's figures as a JSON object and as a table.

use cellpos_control::ControllerConfig;
use cellpos_control::design::{DesignReport, DesignRequest, DesignWarning};
use serde_json::{Value, json};
use std::fmt::Write as _;

/// One object; a figure that does not exist (no crossover, no settling) is null.
pub(super) fn json(model: &str, request: &DesignRequest, report: &DesignReport) -> Value {
    let m = &report.margins;
    let ts = request.plant.sample_time_s;
    let nm = |um: f64| um * 1e3;
    json!({
        "model": model,
        "delay_ms": request.plant.loop_delay_s() * 1e3,
        "delay_samples": request.plant.delay_s / ts,
        "sample_time_ms": ts * 1e3,
        "controller": controller(report),
        "criterion": criterion(request),
        "stable": m.stable,
        "spectral_radius": m.spectral_radius,
        "pm_deg": m.pm_deg,
        "gm_db": m.gm_db,
        "delay_margin_ms": m.delay_margin_s * 1e3,
        "delay_margin_samples": m.delay_margin_s / ts,
        "ms": m.ms,
        "ms_hz": m.ms_hz,
        "mt": m.mt,
        "mt_hz": m.mt_hz,
        "crossover_hz": m.crossover_hz,
        "s_below_1_hz": m.s_below_1_hz,
        "bandwidth_3db_hz": m.bandwidth_3db_hz,
        "step": report.step.map(|s| json!({
            "size_um": s.size_um,
            "rise_ms": s.rise_s * 1e3,
            "overshoot_percent": s.overshoot_percent,
            "settling_5_percent_ms": s.settling_5_percent_s * 1e3,
            "settling_2_percent_ms": s.settling_2_percent_s * 1e3,
            "largest_move_um": s.largest_move_um,
        })),
        "disturbance": report.disturbance.map(|d| json!({
            "drift_um_per_s": d.drift_um_per_s,
            "peak_nm": nm(d.peak_um),
            "recovery_ms": d.recovery_s * 1e3,
            "steady_error_nm": nm(d.steady_error_um),
        })),
        "diffusion_um2_per_s": request.plant.diffusion_um2_per_s,
        "fix_noise_nm": nm(request.plant.fix_noise_um),
        "predicted_rms_nm": report.noise.map(|n| nm(n.rms_um)),
        "predicted_brownian_nm": report.noise.map(|n| nm(n.brownian_um)),
        "predicted_fix_noise_nm": report.noise.map(|n| nm(n.fix_um)),
        "bound_rms_nm": nm(report.bound_rms_um),
        "spread": report.spread.iter().map(|row| json!({
            "gain_factor": row.gain_factor,
            "extra_samples": row.extra_samples,
            "stable": row.margins.stable,
            "pm_deg": row.margins.pm_deg,
            "gm_db": row.margins.gm_db,
            "ms": row.margins.ms,
            "mt": row.margins.mt,
        })).collect::<Vec<_>>(),
        "limits_broken": report.limits_broken.iter().map(|b| json!({
            "key": b.key, "value": b.value, "limit": b.limit, "unit": b.unit,
        })).collect::<Vec<_>>(),
        "warnings": report.warnings.iter().map(ToString::to_string).collect::<Vec<_>>(),
    })
}

fn controller(report: &DesignReport) -> Value {
    match &report.controller {
        ControllerConfig::Pi(pi) => json!({
            "kind": if pi.lead.is_some() { "lead" } else { "pi" },
            "kp_um_per_um": pi.kp,
            "ki_per_s": pi.ki_per_s,
            "setpoint_weight": pi.setpoint_weight,
            "tracking_time_ms": pi.tracking_time_s * 1e3,
            "lead": pi.lead.map(|l| json!({ "zero_hz": l.zero_hz, "pole_hz": l.pole_hz })),
        }),
        ControllerConfig::Lqg(lqg) => json!({ "kind": "lqg", "effort": lqg.effort }),
        ControllerConfig::Mpc(mpc, _) => json!({
            "kind": "mpc", "effort": mpc.effort, "move_effort": mpc.move_effort, "solver": mpc.solver,
        }),
    }
}

fn criterion(request: &DesignRequest) -> Option<String> {
    use cellpos_control::design::Requested;
    match request.controller {
        Requested::Pi(_) | Requested::Given(_) => None,
        Requested::SearchPi(s) => Some(format!(
            "largest integral gain (fastest rejection of drift) with Ms <= {} and Mt <= {}",
            s.max_ms, s.max_mt
        )),
    }
}

fn line(out: &mut String, name: &str, value: f64, decimals: usize, unit: &str) {
    // Writing into a String cannot fail.
    let _ = if value.is_finite() {
        writeln!(out, "  {name:<35}{value:>10.decimals$} {unit}")
    } else {
        writeln!(out, "  {name:<35}{:>10} {unit}", "none")
    };
}

/// The figures for a reader.
pub(super) fn table(model: &str, request: &DesignRequest, report: &DesignReport) -> String {
    let (m, ts) = (&report.margins, request.plant.sample_time_s);
    let mut out = String::new();
    let loud: Vec<&DesignWarning> = report
        .warnings
        .iter()
        .filter(|w| matches!(w, DesignWarning::ProbablyPerHertz(_)))
        .collect();
    for warning in loud {
        let _ = writeln!(out, "!!! {warning}\n");
    }
    let _ = writeln!(
        out,
        "{model}, loop delay {:.3} ms ({:.2} samples and half a sample of hold)",
        request.plant.loop_delay_s() * 1e3,
        request.plant.delay_s / ts
    );
    controller_lines(&mut out, report);
    if let Some(criterion) = criterion(request) {
        let _ = writeln!(out, "found as: {criterion}");
    }
    let _ = writeln!(out, "{}", if m.stable { "stable" } else { "UNSTABLE" });
    line(&mut out, "phase margin", m.pm_deg, 1, "deg");
    line(&mut out, "gain margin", m.gm_db, 1, "dB");
    line(&mut out, "delay margin", m.delay_margin_s * 1e3, 2, "ms");
    line(&mut out, "", m.delay_margin_s / ts, 2, "samples");
    line(&mut out, "Ms (peak of the sensitivity)", m.ms, 3, "");
    line(&mut out, "Mt (peak of T)", m.mt, 3, "");
    line(
        &mut out,
        "disturbances reduced below (|S|<1)",
        m.s_below_1_hz,
        1,
        "Hz",
    );
    line(
        &mut out,
        "bandwidth (-3 dB of T)",
        m.bandwidth_3db_hz,
        1,
        "Hz",
    );
    response_lines(&mut out, report);
    line(
        &mut out,
        "predicted hold error (true, RMS)",
        report.noise.map_or(f64::NAN, |n| n.rms_um * 1e3),
        1,
        "nm",
    );
    line(
        &mut out,
        "lowest possible (minimum variance)",
        report.bound_rms_um * 1e3,
        1,
        "nm",
    );
    line(
        &mut out,
        "  both with localisation noise of",
        request.plant.fix_noise_um * 1e3,
        1,
        "nm",
    );
    spread_lines(&mut out, report);
    out
}

fn controller_lines(out: &mut String, report: &DesignReport) {
    match &report.controller {
        ControllerConfig::Pi(pi) => {
            let _ = writeln!(
                out,
                "{}: kp {:.4} um/um, ki {:.3} /s, set-point weight {}",
                if pi.lead.is_some() { "PI + lead" } else { "PI" },
                pi.kp,
                pi.ki_per_s,
                pi.setpoint_weight
            );
            if let Some(lead) = pi.lead {
                let _ = writeln!(
                    out,
                    "lead: zero {:.1} Hz, pole {:.1} Hz",
                    lead.zero_hz, lead.pole_hz
                );
            }
        }
        ControllerConfig::Lqg(lqg) => {
            let _ = writeln!(out, "LQG: effort {}", lqg.effort);
        }
        ControllerConfig::Mpc(mpc, _) => {
            let _ = writeln!(
                out,
                "MPC without active constraints: effort {}, move effort {}",
                mpc.effort, mpc.move_effort
            );
        }
    }
}

/// Set-point step and disturbance.
fn response_lines(out: &mut String, report: &DesignReport) {
    if let Some(s) = &report.step {
        line(out, "10 um step: overshoot", s.overshoot_percent, 1, "%");
        line(
            out,
            "10 um step: settling to 5 %",
            s.settling_5_percent_s * 1e3,
            0,
            "ms",
        );
        line(
            out,
            "10 um step: settling to 2 %",
            s.settling_2_percent_s * 1e3,
            0,
            "ms",
        );
    }
    if let Some(d) = &report.disturbance {
        line(out, "10 um/s drift: peak error", d.peak_um * 1e3, 1, "nm");
        line(
            out,
            "10 um/s drift: recovery to 10 %",
            d.recovery_s * 1e3,
            0,
            "ms",
        );
        line(
            out,
            "10 um/s drift: steady error",
            d.steady_error_um * 1e3,
            3,
            "nm",
        );
    }
}

/// Margins at other gains and delays.
fn spread_lines(out: &mut String, report: &DesignReport) {
    let _ = writeln!(
        out,
        "spread:   gain  delay      PM deg   GM dB      Ms      Mt"
    );
    for row in &report.spread {
        let r = &row.margins;
        let _ = if r.stable {
            writeln!(
                out,
                "        x {:<5} +{}      {:>8.1}{:>8.1}{:>8.2}{:>8.2}",
                row.gain_factor, row.extra_samples, r.pm_deg, r.gm_db, r.ms, r.mt
            )
        } else {
            writeln!(
                out,
                "        x {:<5} +{}      UNSTABLE",
                row.gain_factor, row.extra_samples
            )
        };
    }
}
