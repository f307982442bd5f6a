use cellpos_emulator::{World, WorldConfig};
use cellpos_plant::Model;
use cellpos_vision::*;
use std::time::Instant;
fn main() {
    let hz: f64 = std::env::args().nth(1).and_then(|a| a.parse().ok()).unwrap_or(120.0);
    let amp: f64 = std::env::args().nth(2).and_then(|a| a.parse().ok()).unwrap_or(1.0);
    let window: usize = std::env::args().nth(3).and_then(|a| a.parse().ok()).unwrap_or(41);
    let told: f64 = std::env::args().nth(4).and_then(|a| a.parse().ok()).unwrap_or(1.0);
    let config = WorldConfig { seed: 4103, latency_ms: 2.0, exposure_ms: 0.3, drift_um_per_s: 0.0, ..WorldConfig::real() };
    let mut model = Model::eq6();
    model.working_point_um = 20.0;
    let mut world = World::new(&config, &model, 0).unwrap();
    let lc = LocaliserConfig { window_px: window, noise: PixelNoise::Estimated, ..LocaliserConfig::new(ProfileSpec::Ring { edge_px: 5.0 }) };
    let mut loc = Localiser::new(lc).unwrap();
    let mut px = Vec::new();
    let mut us = Vec::new();
    let mut err = Vec::new();
    let (mut u, mut cmds) = (20.0, vec![20.0; 10]);
    let mut bad = 0;
    let mut n = 0;
    for k in 0..800_i64 {
        // commands change 0.35 ms behind the middle of an exposure
        let t = (k + 1) * 1_000_000 + 350_000;
        world.advance_to(t, u);
        u = 20.0 + amp * (core::f64::consts::TAU * hz * k as f64 * 1e-3).sin();
        cmds.push(u);
        while let Some(info) = world.take_frame(&mut px) {
            let id = info.id as i64;
            // mid at (id+1) ms: command in force is that from t = id ms + 0.35: k = id-1 -> pushed index
            let held = cmds[(10 + id - 1).max(0) as usize];
            let way = told * 378.0 * (held - 20.0) * 0.3e-3 / 0.1;
            let frame = Frame { width: 256, height: 32, pixels: Pixels::Mono8(&px) };
            loc.expect_streak((way, 0.0));
            let guess = (127.5 + info.true_um / 0.1 + 0.2, 15.5 + info.true_lateral_um / 0.1);
            let start = Instant::now();
            let fix = loc.locate(&frame, Some(guess));
            us.push(start.elapsed().as_secs_f64() * 1e6);
            n += 1;
            if fix.verdict != FixQuality::Good { bad += 1; }
            err.push(((fix.x_px - 127.5) * 0.1 - info.true_um).abs());
        }
    }
    us.sort_by(f64::total_cmp);
    err.sort_by(f64::total_cmp);
    let at = |q: f64| us[((us.len() - 1) as f64 * q) as usize];
    println!("{n} frames, bad {bad}: median {:.0} p90 {:.0} p99 {:.0} max {:.0} us, err median {:.4} p99 {:.4}", at(0.5), at(0.9), at(0.99), at(1.0), err[err.len()/2], err[err.len()*99/100]);
}
