//! A cell that tires: the per-cycle table finds what is hidden in it, and nothing in the static arm.

use crate::common;
use cellpos_emulator::{CellConfig, WorldConfig};
use cellpos_runtime::Timing;
use cellpos_script::{ArmKind, CycleRow, trend};

#[test]
#[ignore = "360 cycles of a cell; through the program and through frames: fatigue.toml with 30 cycles, cell.rs with 4"]
fn the_trends_of_stretch_area_and_recovery_are_found_and_the_static_arm_has_none() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../examples/scripts/fatigue.toml"
    );
    let text = std::fs::read_to_string(path).unwrap();
    let cell = CellConfig::default();
    let world = WorldConfig {
        seed: 5,
        pixel_um: 0.2,
        height_px: 64,
        cell: Some(cell),
        ..WorldConfig::default()
    };
    let (summary, table) = common::run(&text, &world, Timing::default(), 0..0);
    assert_eq!(summary.safe_reason, None);
    assert_eq!(table.rows.len(), 360);
    let rest_um = table.rows[0].length_start_um;
    assert!((rest_um / cell.rest_um - 1.0).abs() < 0.05);
    let of = |arm: ArmKind, value: &dyn Fn(&CycleRow) -> f64| {
        let rows = table.rows.iter().filter(|row| row.arm == arm);
        trend(rows.map(|row| (row.cycle, value(row))))
    };
    let stretch = |row: &CycleRow| row.length_peak_um / rest_um;
    let recovery = |row: &CycleRow| row.recovery_s;
    let rest_um2 = table.rows[0].area_start_um2;
    let disc_um2 = std::f64::consts::FRAC_PI_4 * cell.rest_um.powi(2);
    assert!((rest_um2 / disc_um2 - 1.0).abs() < 0.05);
    let area = |row: &CycleRow| row.area_peak_um2 / rest_um2;
    for (name, found, first, last) in [
        ("stretch", of(ArmKind::Cyclic, &stretch), 3.80, 2.86),
        ("recovery", of(ArmKind::Cyclic, &recovery), 0.16, 0.37),
        // The volume is kept: the projected area varies with the root of the length.
        (
            "area",
            of(ArmKind::Cyclic, &area),
            3.80f64.sqrt(),
            2.86f64.sqrt(),
        ),
    ] {
        let found = found.unwrap();
        eprintln!("{name}: {found:?}");
        assert_eq!(found.cycles, 180, "{name}");
        assert!(
            (found.first.mean / first - 1.0).abs() < 0.05,
            "{name}: {found:?}"
        );
        assert!(
            (found.last.mean / last - 1.0).abs() < 0.05,
            "{name}: {found:?}"
        );
        assert!(found.is_significant(), "{name}: {found:?}");
    }
    for (name, still) in [
        ("stretch", of(ArmKind::Static, &stretch)),
        ("area", of(ArmKind::Static, &area)),
    ] {
        let still = still.unwrap();
        eprintln!("{name}, static: {still:?}");
        assert!(
            still.cycles == 180 && !still.is_significant(),
            "{name}: {still:?}"
        );
    }
    let recovering = of(ArmKind::Static, &recovery);
    assert!(
        recovering.is_none_or(|trend| !trend.is_significant()),
        "{recovering:?}"
    );
}
