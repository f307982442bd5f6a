//! What of several runs is compared.

use crate::run_report::bound::Bound;
use crate::run_report::cycles::{on_the_way, was_elsewhere};
use crate::run_report::fatigue::length_between;
use crate::run_report::origin;
use crate::run_report::recorded::Recorded;
use crate::run_report::session::ending;
use cellpos_report::Emphasis;
use cellpos_script::{ArmKind, AtRest, CycleFlags, CycleRow, Trend, trend};
use cellpos_session::Failure;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// A quantity of the cycles.
pub(super) struct Quantity {
    pub(super) name: &'static str,
    pub(super) unit: &'static str,
    pub(super) of: fn(&CycleRow, &AtRest) -> f64,
}

/// What a cell has.
pub(super) const CELL: [Quantity; 3] = [
    Quantity {
        name: "stretch",
        unit: "",
        of: |row, rest| rest.stretch(row),
    },
    Quantity {
        name: "recovery time",
        unit: "s",
        of: |row, _| row.recovery_s,
    },
    Quantity {
        name: "length at start",
        unit: "um",
        of: |row, _| length_between(row),
    },
];

/// What a bead has.
pub(super) const BEAD: [Quantity; 2] = [
    Quantity {
        name: "reached / commanded",
        unit: "",
        of: |row, _| row.reached_um / row.commanded_um,
    },
    Quantity {
        name: "error RMS",
        unit: "um",
        of: |row, _| row.rms_um,
    },
];

/// Mean of the first and of the last ten cycles of a quantity, with half their 95 % intervals.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Ends {
    pub(super) arm: &'static str,
    pub(super) quantity: &'static str,
    pub(super) unit: &'static str,
    pub(super) cycles: u64,
    pub(super) first: f64,
    pub(super) first_ci95: f64,
    pub(super) last: f64,
    pub(super) last_ci95: f64,
}

/// A run as the page compares it.
#[derive(Debug, Serialize)]
pub(super) struct Compared {
    pub(super) run: PathBuf,
    pub(super) name: String,
    pub(super) outcome: String,
    pub(super) duration_s: f64,
    pub(super) cycles: usize,
    pub(super) cycles_elsewhere: usize,
    pub(super) rms_nm: Option<f64>,
    pub(super) rms_ci95_nm: Option<f64>,
    pub(super) bound_rms_nm: Option<f64>,
    pub(super) ends: Vec<Ends>,
    #[serde(skip)]
    pub(super) emphasis: Emphasis,
    #[serde(skip)]
    pub(super) task: String,
    #[serde(skip)]
    pub(super) started: String,
    #[serde(skip)]
    pub(super) rows: Vec<CycleRow>,
}

/// The cycles of an arm that count.
pub(super) fn counted(rows: &[CycleRow], arm: ArmKind) -> impl Iterator<Item = &CycleRow> {
    rows.iter().filter(move |row| {
        row.arm == arm
            && !row.flags.has(CycleFlags::SKIPPED)
            && !row.flags.has(CycleFlags::RAMP)
            && !on_the_way(row)
            && !was_elsewhere(row)
    })
}

/// Cycle and value of a quantity.
pub(super) fn values(rows: &[CycleRow], arm: ArmKind, quantity: &Quantity) -> Vec<(f64, f64)> {
    let rest = AtRest::of(rows);
    counted(rows, arm)
        .map(|row| (row.cycle as f64 + 1.0, (quantity.of)(row, &rest)))
        .filter(|(_, value)| value.is_finite())
        .collect()
}

pub(super) fn arm_name(arm: ArmKind) -> &'static str {
    match arm {
        ArmKind::Cyclic => "cyclic",
        ArmKind::Static => "static",
    }
}

pub(super) const ARMS: [ArmKind; 2] = [ArmKind::Cyclic, ArmKind::Static];

impl Compared {
    pub(super) fn open(run: &Path, name: String) -> Result<Self, Failure> {
        let recorded = Recorded::open(run)?;
        let rows = recorded.cycles.rows.clone();
        let last = recorded.sessions.last();
        let (emphasis, outcome) = last.map_or((Emphasis::Plain, String::new()), ending);
        let meta = recorded.first.meta().ok();
        let ticks = &recorded.ticks;
        let nm = |um: f64| um * 1e3;
        let mut ends = Vec::new();
        for quantity in CELL.iter().chain(&BEAD) {
            for arm in ARMS {
                let points = values(&rows, arm, quantity);
                let found: Option<Trend> =
                    trend(points.iter().map(|(cycle, value)| (*cycle as u64, *value)));
                ends.extend(found.map(|found| Ends {
                    arm: arm_name(arm),
                    quantity: quantity.name,
                    unit: quantity.unit,
                    cycles: found.cycles,
                    first: found.first.mean,
                    first_ci95: found.first.ci95,
                    last: found.last.mean,
                    last_ci95: found.last.ci95,
                }));
            }
        }
        Ok(Self {
            run: run.to_owned(),
            name,
            outcome,
            duration_s: ticks.duration_s(),
            cycles: rows.len(),
            cycles_elsewhere: rows.iter().filter(|row| was_elsewhere(row)).count(),
            rms_nm: ticks.rms_um().map(nm),
            rms_ci95_nm: ticks.rms_ci95_um().map(nm),
            bound_rms_nm: Bound::of(&recorded.first, ticks)
                .filter(|bound| !bound.is_beaten(ticks))
                .map(|bound| nm(bound.rms_um)),
            ends,
            emphasis,
            task: meta.map_or_else(String::new, |meta| {
                format!("{} {}.", origin::task(meta, &rows), origin::rig(meta))
            }),
            started: meta.map_or_else(String::new, |meta| meta.started_utc.clone()),
            rows,
        })
    }

    pub(super) fn end(&self, arm: ArmKind, quantity: &str) -> Option<&Ends> {
        let of = |ends: &&Ends| ends.arm == arm_name(arm) && ends.quantity == quantity;
        self.ends.iter().find(of)
    }
}
