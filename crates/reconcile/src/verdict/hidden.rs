//! How large an effect may be and not show: the limits of the verdict `nothing-missing`.

use crate::fit::catalogue::{Part, Variant};
use crate::fit::context::{Context, Fit};
use crate::fit::linear::Tangents;
use crate::mask::Mask;
use crate::search::cost::threshold_of;
use crate::units::figure;
use cellpos_numeric::parallel;
use cellpos_plant::effects::Role;

/// Standard deviations beyond the least gain of a name: an effect of the stated size shows in 98 of 100 records.
const SURELY: f64 = 2.0;

/// A fit, with all that does not depend on what is added to it.
struct Seen<'a> {
    ctx: &'a Context<'a>,
    fit: &'a Fit,
    tangents: Tangents,
    sim: Vec<Vec<f64>>,
    all: Mask,
}

/// A size that need not show.
struct Size {
    size: f64,
    /// The size whose response told it.
    from: f64,
    /// With the effect's other numbers.
    words: String,
}

/// The effects that the records of a fit may hide although they matter, each with its largest such size, as one sentence. Which
/// sizes matter is known for this rig only.
pub(crate) fn sentence(ctx: &Context<'_>, fit: &Fit, threads: usize) -> Option<String> {
    if ctx.problem.base.free_start {
        return None;
    }
    let all = ctx.problem.all();
    let seen = Seen {
        ctx,
        fit,
        tangents: ctx.tangents(fit, &all),
        sim: ctx.simulated(&fit.parts, fit.offset_um, &all),
        all,
    };
    let sought = |v: &&Variant| {
        let candidate = v.candidate();
        candidate.role == Role::Chain && !candidate.late && !v.is_own() && !ctx.excludes(v.id())
    };
    let sought: Vec<Variant> = ctx.variants.iter().filter(sought).copied().collect();
    let said: Vec<String> = (sought.chunk_by(|a, b| a.id() == b.id()))
        .filter_map(|forms| seen.of_effect(forms, threads))
        .collect();
    (!said.is_empty()).then(|| {
        format!(
            "an effect up to this size need not show in these records, at worst: {}",
            said.join("; ")
        )
    })
}

impl Seen<'_> {
    /// The largest size of one effect over its forms and the usual range of its other numbers.
    fn of_effect(&self, forms: &[Variant], threads: usize) -> Option<String> {
        let mut sizes: Vec<Size> = Vec::new();
        for v in forms {
            sizes.extend(self.of_form(*v, threads));
        }
        let worst = sizes.iter().max_by(|a, b| a.size.total_cmp(&b.size))?;
        Some(format!("{} {}", forms.first()?.id(), worst.words))
    }

    fn of_form(&self, v: Variant, threads: usize) -> Vec<Size> {
        let candidate = v.candidate();
        let Some((at, least)) = candidate.smallest else {
            return Vec::new();
        };
        let (low, high) = candidate.typical;
        let mut starts = v.starts(&self.ctx.scope);
        starts.retain(|part| {
            let values = part.natural();
            let usual = values.first().is_some_and(|v| (low..=high).contains(v));
            usual && values.get(at).is_some_and(|v| *v != candidate.neutral)
        });
        let mut sizes = parallel::map(&starts, threads, |part| self.least_shown(part, at));
        if candidate.params.len() == 1 {
            // A curve is no line: the start that is nearest to the size it gives knows best.
            let off = |size: &Size| (size.size / size.from).ln().abs();
            sizes.sort_by(|a, b| off(a).total_cmp(&off(b)));
            sizes.truncate(1);
        }
        sizes.retain(|size| size.size > least);
        sizes
    }

    /// The size from which on a part surely shows next to the noise of the records; its response is proportional to its size.
    fn least_shown(&self, part: &Part, at: usize) -> Size {
        let candidate = part.variant();
        let values = part.natural();
        let added = (self.ctx).change(self.fit, &self.sim, part, &self.all);
        let gain = self.tangents.gain(&added, &self.fit.innovations, &self.all);
        let needed = threshold_of(candidate, self.ctx.problem.records.len()).sqrt() + SURELY;
        let from = (values[at] - candidate.neutral).abs();
        let size = from * needed / gain.own.sqrt();
        let number = &candidate.params[at];
        let said = match (size <= number.upper.abs(), candidate.neutral != 0.0) {
            (false, _) => format!("any {}", number.name),
            (true, false) => format!("{} {}", number.name, figure(size)),
            (true, true) => format!("{} off by {}", number.name, figure(size)),
        };
        let others = (candidate.params.iter().zip(&values).enumerate())
            .filter(|(i, _)| *i != at)
            .map(|(_, (p, value))| format!(" at {} {}", p.name, figure(*value)));
        Size {
            size,
            from,
            words: said + &others.collect::<String>(),
        }
    }
}
