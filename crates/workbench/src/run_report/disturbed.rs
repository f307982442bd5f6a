//! Disturbed cycles in the means of a result: frames or the object were missing, so their lengths and errors may be wrong.

use cellpos_script::{CycleRow, Mean, trend};

/// How many of these cycles were disturbed, to stand behind their number.
pub(super) fn counted<'a>(rows: impl Iterator<Item = &'a CycleRow>) -> String {
    match rows.filter(|row| row.flags.is_disturbed()).count() {
        0 => String::new(),
        n => format!(", {n} of them disturbed"),
    }
}

/// A sentence, if a mean over cycles is in doubt for those that were disturbed: they change it by more than the 95 % interval that it has
/// without them, or leave too few others to tell. What changes steadily over the cycles is no doubt. `of` gives a cycle's value.
pub(super) fn doubt<'a>(
    name: &str,
    rows: impl Iterator<Item = &'a CycleRow>,
    of: impl Fn(&CycleRow) -> f64,
) -> Option<String> {
    let (mut whole, mut disturbed) = (vec![], vec![]);
    for row in rows {
        let value = of(row);
        let point = (row.cycle as f64, value);
        match row.flags.is_disturbed() {
            _ if !value.is_finite() => {}
            true => disturbed.push(point),
            false => whole.push(point),
        }
    }
    if disturbed.is_empty() {
        return None;
    }
    if whole.len() < 2 {
        return Some(format!(
            "Whether the disturbed cycles are right nobody can tell: {} of {} were not disturbed.",
            whole.len(),
            whole.len() + disturbed.len()
        ));
    }
    let without = Mean::of(&whole);
    let line = trend(whole.iter().map(|(cycle, value)| (*cycle as u64, *value)));
    let per_cycle = line.map_or(0.0, |line| line.per_cycle);
    let middle = whole.iter().map(|p| p.0).sum::<f64>() / whole.len() as f64;
    let off = disturbed
        .iter()
        .map(|(cycle, value)| value - without.mean - per_cycle * (cycle - middle));
    let change = off.sum::<f64>() / (whole.len() + disturbed.len()) as f64;
    (change.abs() > without.ci95).then(|| {
        format!(
            "The disturbed cycles change the result: {name} is {:.3} without them, {:.3} with them (means over all cycles).",
            without.mean,
            without.mean + change
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_script::{ArmKind, CycleFlags};

    /// The doubt about cycles with these errors, um, each disturbed or not.
    fn of(errors: impl Iterator<Item = (f64, bool)>) -> Option<String> {
        let row = |(cycle, (rms_um, disturbed))| {
            let mut row = CycleRow::empty(cycle, 1, ArmKind::Cyclic);
            row.rms_um = rms_um;
            row.flags = CycleFlags(if disturbed { CycleFlags::DISTURBED } else { 0 });
            row
        };
        let rows: Vec<CycleRow> = (0..).zip(errors).map(row).collect();
        doubt("stretch", rows.iter(), |row| row.rms_um)
    }

    #[test]
    fn a_mean_is_in_doubt_if_its_disturbed_cycles_move_it_out_of_its_interval() {
        let cycles = |per_cycle: f64, of_disturbed: f64| {
            (0..24).map(move |k| {
                let value = 3.8 + 0.02 * f64::from(k % 5) + per_cycle * f64::from(k);
                if k < 20 {
                    (value, false)
                } else {
                    (of_disturbed + per_cycle * f64::from(k), true)
                }
            })
        };
        for per_cycle in [0.0, -0.05] {
            assert_eq!(of(cycles(per_cycle, 3.85)), None, "{per_cycle}");
            assert!(of(cycles(per_cycle, 3.2)).is_some(), "{per_cycle}");
        }
        let said = of(cycles(0.0, 3.2)).unwrap();
        assert!(said.contains("3.840 without them, 3.731 with"), "{said}");
        assert_eq!(of(std::iter::repeat_n((3.2, false), 3)), None);
        // One that was not disturbed tells no interval.
        assert!(of([(3.8, false), (3.8, true)].into_iter()).is_some());
        assert!(of(std::iter::repeat_n((3.2, true), 3)).is_some());
    }
}
