//! scratch
use crate::*;
use crate::catalogue::{Scope};
use crate::fit::Context;
use crate::predict::{Base, Zpk};
use crate::problem::Problem;
use cellpos_plant::Model;
/// scratch
pub fn debug_search(model: &Model, records: &[Record]) {
    let t0 = std::time::Instant::now();
    let zpk = Zpk { zeros: model.plant.zeros(), poles: model.plant.poles(), gain: model.plant.num()[0] / model.plant.den()[0] };
    let base = Base { zpk, working_point_um: model.working_point_um, sample_s: records[0].sample_s, interpolated_input: false };
    let (lo, hi) = records.iter().map(|r| r.pzt_range_um()).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (c, d)| (a.min(c), b.max(d)));
    let wp = model.working_point_um;
    let scope = Scope { working_point_um: wp, low_um: lo, high_um: hi, stroke_um: (hi - wp).max(wp - lo), sample_s: base.sample_s, velocity_gain_per_s: 379.0 };
    let repeated: Vec<Vec<bool>> = records.iter().map(|r| vec![false; r.rows()]).collect();
    let problem = Problem::new(base.clone(), records, &repeated, Noise::new(0.33, 1e-3, 0.03));
    let ctx = Context { problem: &problem, scope, fixed: vec![] };
    let null = ctx.fit(vec![], &problem.all(), 3);
    let (res, _) = ctx.residual(&null);
    let present: Vec<Vec<bool>> = problem.records.iter().map(|r| r.present.clone()).collect();
    let noise = floor::estimate(records, &present, &res);
    println!("noise {:?} sigma {:.5} D {:.4} loc {:.4} [{:?}]", noise, noise.innovation_um(), noise.diffusion_um2_per_s(1e-3), noise.localisation_um(), t0.elapsed());
    let problem = problem.clone().with_noise(noise);
    let ctx = Context { problem: &problem, scope, fixed: vec![] };
    let mask = problem.all();
    let found = search::search(&ctx, &mask, search::Effort { threads: 2, max_effects: 4 }, |s| eprintln!("   {s} [{:?}]", t0.elapsed()));
    println!("  null {:.0} (n {})", found.null.chi2 - found.null.count as f64, found.null.count);
    for (s, c) in &found.steps { println!("  step {:?} {:.1}", s, c - found.null.count as f64); }
    for (i, p) in found.fit.parts.iter().enumerate() {
        println!("  {} {:?} rivals {:?}", p.variant().id, p.natural(), found.rivals[i].iter().map(|r| (r.id, (r.chi2 - found.fit.chi2).round(), r.part.natural())).collect::<Vec<_>>());
    }
    println!("  soft {:.4} final {:.0}  [{:?}]", found.fit.soft, found.fit.chi2 - found.null.count as f64, t0.elapsed());
}
