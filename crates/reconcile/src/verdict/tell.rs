//! A result of the search in the units of its records.

use crate::units::Scales;
use crate::verdict::result::Reconciliation;

impl Reconciliation {
    /// Brings the figures of the search into the units of the records; names, sentences and models have them already.
    pub(crate) fn tell(&mut self, scales: &Scales) {
        let [input, output] = scales.per_unit();
        let out = |value: &mut f64| *value /= output;
        let gap = &mut self.gap;
        gap.unit = scales.output_unit().to_owned();
        [
            &mut gap.before,
            &mut gap.after,
            &mut gap.floor,
            &mut gap.free_run_before,
            &mut gap.free_run_after,
            &mut gap.free_run_floor,
        ]
        .into_iter()
        .for_each(out);
        gap.steps.iter_mut().for_each(|step| out(&mut step.rms));
        for r in &mut gap.per_record {
            [
                &mut r.before,
                &mut r.after,
                &mut r.free_run_before,
                &mut r.free_run_after,
            ]
            .into_iter()
            .for_each(out);
        }
        for b in &mut gap.bands {
            [&mut b.before, &mut b.after, &mut b.floor]
                .into_iter()
                .for_each(out);
        }
        for map in [&mut self.before, &mut self.after] {
            for cell in map.rows.iter_mut().flat_map(|row| &mut row.cells) {
                out(&mut cell.rms_um);
                out(&mut cell.floor_um);
            }
        }
        for t in &mut self.traces.all {
            let columns = [
                &mut t.measured_um,
                &mut t.before_um,
                &mut t.after_um,
                &mut t.residual_before_um,
                &mut t.residual_after_um,
            ];
            columns.into_iter().flatten().for_each(out);
        }
        self.noise = self.noise.scaled(output.powi(-2));
        if let Some(edge) = self.base_shift.get_mut("frame_edge_share") {
            let per = input / output;
            (edge.value, edge.ci95) = (edge.value * per, edge.ci95.map(|v| v * per));
            // One name: a pure number that is reported as such.
            edge.unit = format!("{}/{}", scales.output_unit(), scales.input_unit());
        }
    }
}
