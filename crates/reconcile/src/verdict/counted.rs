//! Effects that come by chance, and are counted or belong to the noise: missing, repeated and late frames, and jumps.

use crate::data::frames::{FrameCounts, wilson};
use crate::fit::context::Context;
use crate::verdict::jumps::{Jumps, rows_of_all};
use crate::verdict::late_frames::LateFrames;
use crate::verdict::result::{Effect as NamedEffect, Interval};
use crate::verdict::searching::ByChance;
use crate::verdict::significance;
use crate::verdict::wandering::Wandering;
use cellpos_plant::Effect;
use cellpos_plant::effects;

/// The effects of a model, and as results, and where they are.
#[derive(Debug, Default)]
pub(crate) struct Counted {
    pub of_model: Vec<Effect>,
    pub named: Vec<NamedEffect>,
    pub places: Vec<String>,
}

impl Counted {
    /// `gap` is what the others leave beyond the noise without any effect, in twice the log-likelihood.
    pub(crate) fn new(
        ctx: &Context<'_>,
        frames: &FrameCounts,
        by_chance: &ByChance,
        gap: f64,
    ) -> Self {
        let mut out = Self::default();
        out.add_frames(frames);
        if let Some(jumps) = &by_chance.jumps {
            out.add_jumps(ctx, jumps, gap);
        }
        if let Some(late) = by_chance.late.filter(LateFrames::matters) {
            out.add_late_frames(late, gap);
        }
        if let Some(wandering) = by_chance.wandering {
            out.add_wandering(wandering, gap);
        }
        out
    }

    fn add(&mut self, effect: Effect, intervals: &[[f64; 2]], (p_value, explained): (f64, f64)) {
        let parameters = effect.parameters();
        let parameters = parameters.iter().zip(intervals).map(|(p, ci95)| {
            let of = Interval {
                value: p.value,
                ci95: *ci95,
                unit: p.unit.to_owned(),
            };
            (p.name.clone(), of)
        });
        let spec = effect.kind().spec();
        self.named.push(NamedEffect {
            id: effect.id().to_owned(),
            place: spec.shown_place(),
            parameters: parameters.collect(),
            p_value,
            explained,
            alternatives: Vec::new(),
            separate_by: None,
        });
        self.of_model.push(effect);
    }

    /// Missing and repeated frames.
    fn add_frames(&mut self, frames: &FrameCounts) {
        let rows = [
            (
                effects::frame_drops(frames.drop_rate()),
                frames.drops_named(),
                frames.missing,
                frames.rows,
                0.0,
            ),
            (
                effects::frame_repeats(frames.repeat_rate()),
                frames.repeats_named(),
                frames.repeats,
                frames.pairs,
                frames.by_chance,
            ),
        ];
        for (effect, is_named, count, total, chance) in rows {
            if !is_named {
                continue;
            }
            let all = total.max(1) as f64;
            let rate = wilson(count as f64, all).map(|end| (end - chance / all).max(0.0));
            let p_value = significance::p_value(2.0 * (count as f64 - chance), 1);
            self.places
                .push(format!("{}: {count} of {total} frames", effect.id()));
            self.add(effect, &[rate], (p_value, 0.0));
        }
        let missing = frames.missing;
        if !frames.of_camera && missing > 0 {
            self.places
                .push(format!("{missing} of {} rows have no output", frames.rows));
        }
    }

    fn add_late_frames(&mut self, late: LateFrames, gap: f64) {
        let half_s = 1.96 * late.error_s;
        let interval = [(late.up_to_s - half_s).max(0.0), late.up_to_s + half_s];
        let p_value = significance::p_value(late.gain, 1);
        let explained = part_of(gap, late.gain);
        let effect = effects::frame_jitter(late.up_to_s);
        self.places.push(format!(
            "{}: the error of the frames grows with the speed of the bead and differs from frame to frame",
            effect.id(),
        ));
        self.add(effect, &[interval], (p_value, explained));
    }

    fn add_wandering(&mut self, w: Wandering, gap: f64) {
        let interval = |(value, error): (f64, f64)| {
            let factor = (1.96 * error).exp();
            [value / factor, value * factor]
        };
        let p_value = significance::p_value(w.gain, 2);
        let explained = part_of(gap, w.gain);
        let effect = effects::flow_wander(w.um_per_s.0, w.time_s.0);
        self.places.push(format!(
            "{}: the bead drifts to and fro by itself, at rest too",
            effect.id(),
        ));
        let intervals = [interval(w.um_per_s), interval(w.time_s)];
        self.add(effect, &intervals, (p_value, explained));
    }

    fn add_jumps(&mut self, ctx: &Context<'_>, jumps: &Jumps, gap: f64) {
        let count = jumps.count() as f64;
        let rows = rows_of_all(ctx) as f64;
        let over_s = 1.0 / ctx.problem.base.sample_s;
        let [per_s, um] = [count / rows * over_s, jumps.rms_um()];
        let rate = wilson(count, rows).map(|end| end * over_s);
        let half_um = jumps.rms_error_um();
        let effect = effects::jumps(per_s, um);
        let largest = jumps.largest();
        self.places.push(format!(
            "{}: {count} single rows; the largest is {} in {} at {:.3} s",
            effect.id(),
            ctx.scales.told(largest.um.abs()),
            ctx.problem.records[largest.record].name,
            largest.row as f64 * ctx.problem.base.sample_s,
        ));
        let p_value = significance::p_value(jumps.gain, jumps.count());
        let explained = part_of(gap, jumps.gain);
        let size = [(um - half_um).max(0.0), um + half_um];
        self.add(effect, &[rate, size], (p_value, explained));
    }
}

/// Part of the excess that such a gain explains, if the others leave `gap` without any effect.
fn part_of(gap: f64, gain: f64) -> f64 {
    gain / (gain + gap.max(0.0))
}
