use cellpos_control::design::*;
use cellpos_control::*;
#[test]
fn sweep() {
    let plant = DesignPlant::eq6(2.5e-3);
    let model = LoopModel::eq6(2e-3);
    for fix in [0.02, 0.03, 0.04, 0.06, 0.08] {
        for effort in [1.0, 1.4, 2.0, 2.5, 3.0, 4.0, 6.0] {
            let est = EstimatorConfig { fix_noise_um: fix, ..EstimatorConfig::default() };
            let Ok(law) = ControllerConfig::Lqg(Lqg { effort }).linear(&est, &model) else { continue };
            let m = margins(&plant, &law).unwrap();
            let n = noise_figures(&plant, &law).unwrap().unwrap();
            let far = plant.changed(2.0, 1).unwrap();
            let f = margins(&far, &law).unwrap();
            let g = margins(&plant.changed(2.0, 0).unwrap(), &law).unwrap();
            let h = margins(&plant.changed(1.0, 1).unwrap(), &law).unwrap();
            println!("fix {fix} effort {effort}: rms {:.2} Ms {:.2} pm {:.1} gm {:.1} | 2x: {:.2} +1: {:.2} 2x+1 {} {:.2}", 1e3*n.rms_um, m.ms, m.pm_deg, m.gm_db, g.ms, h.ms, f.stable, f.ms);
        }
    }
}
