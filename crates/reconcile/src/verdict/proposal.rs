//! A hypothesis as effects of the user's own, to be edited and run again with `--effects`.

use crate::fit::context::Context;
use crate::units::Side;
use crate::verdict::battery::{Hypothesis, Term};
use cellpos_plant::effects::{Definition, Site, UserParameter, UserState};

/// How a term of the library is written in an effects file; `before` is a state that follows the input within a row.
const WRITTEN: &[(&str, &str)] = &[
    ("d^2", "input^2"),
    ("d^3", "input^3"),
    ("|d|", "abs(input)"),
    ("d |d|", "input*abs(input)"),
    ("sign(dd/dt)", "sign(input - before)"),
    ("|dd/dt|", "abs(input - before)/STEP"),
    ("t d", "time*input"),
    ("y", "position"),
    ("y^2", "position^2"),
    ("y^3", "position^3"),
    ("|y|", "abs(position)"),
    ("y d", "position*input"),
    ("y^2 d", "position^2*input"),
    ("v", "velocity"),
    ("v |v|", "velocity*abs(velocity)"),
    ("v^3", "velocity^3"),
    ("|v|", "abs(velocity)"),
    ("sign(v)", "sign(velocity)"),
    ("y v", "position*velocity"),
    ("y^2 v", "position^2*velocity"),
    ("t", "time"),
];

/// The effects that a hypothesis proposes: terms at the plant's input and at its output. Lines are left out: they have no equation
/// in the command, and `mains-hum` is in the catalogue.
pub(crate) fn of(ctx: &Context<'_>, hypothesis: &Hypothesis) -> Vec<Definition> {
    [("input", Site::Chip), ("output", Site::Plant)]
        .into_iter()
        .filter_map(|(place, site)| {
            let terms: Vec<&Term> = hypothesis
                .terms
                .iter()
                .filter(|t| t.place == place && written(ctx, t).is_some())
                .collect();
            (!terms.is_empty()).then(|| definition(ctx, site, &terms))
        })
        .collect()
}

fn written(ctx: &Context<'_>, term: &Term) -> Option<String> {
    let (_, text) = WRITTEN.iter().find(|(name, _)| *name == term.term)?;
    Some(text.replace("STEP", &format!("{:?}", ctx.scope.sample_s)))
}

/// One decimal more than anybody needs: a file that is read and edited.
fn rounded(x: f64) -> f64 {
    format!("{x:.3e}").parse().unwrap_or(x)
}

fn parameter(name: &str, unit: &str, bound: f64, start: f64) -> UserParameter {
    let bound = rounded(bound.abs().max(1e-300));
    UserParameter {
        name: name.to_owned(),
        unit: unit.to_owned(),
        lower: -bound,
        upper: bound,
        start: vec![rounded(start)],
    }
}

fn definition(ctx: &Context<'_>, site: Site, terms: &[&Term]) -> Definition {
    /// Multiple of the regression's value: it is a first step from a model without the effect.
    const ROOM: f64 = 20.0;
    let mut parameters = Vec::new();
    let mut output = if site == Site::Chip {
        "input"
    } else {
        "position"
    }
    .to_owned();
    let mut add = |name: &str, unit: &str, text: &str, bound: f64, start: f64| {
        output.push_str(&format!(" + {name}*{text}"));
        parameters.push(parameter(name, unit, bound, start));
    };
    for (i, t) in terms.iter().enumerate() {
        let text = written(ctx, t).unwrap_or_default();
        let name = format!("c{}", i + 1);
        add(&name, &t.unit, &text, ROOM * t.coefficient, t.coefficient);
    }
    // A linear base that was fitted to such records has taken up a part of the effect: let it go back.
    if site == Site::Chip {
        let has = |name: &str| terms.iter().any(|t| t.term == name);
        let per = ctx.scope.stroke_um / ctx.scope.travel_um.max(1e-12);
        let (stiffness, of_stiffness) = ctx.scales.coefficient(per, Side::Input, [0, 1, 0]);
        add("gain", "", "input", 0.5, 0.0);
        // A plant of one lag has two numbers. With a gain in addition, none of the three would be certain.
        let poles = &ctx.problem.base.zpk.poles;
        if !has("y") && !poles.is_empty() {
            add("stiffness", &of_stiffness, "position", stiffness, 0.0);
        }
        if !has("v") && poles.len() > 1 {
            let fastest = poles.iter().map(|p| p.norm()).fold(1e-3, f64::max);
            let (damping, of_damping) =
                ctx.scales
                    .coefficient(per / fastest, Side::Input, [0, 1, -1]);
            add("damping", &of_damping, "velocity", damping, 0.0);
        }
    }
    let states = if output.contains("before") {
        let rate = format!("(input - before)/{:?}", ctx.scope.sample_s);
        vec![UserState {
            name: "before".to_owned(),
            rate,
            start: "0".to_owned(),
        }]
    } else {
        Vec::new()
    };
    Definition {
        id: format!(
            "hypothesis-{}",
            if site == Site::Chip { "in" } else { "out" }
        ),
        site,
        says: terms
            .iter()
            .map(|t| format!("{} at the {}", t.term, t.place))
            .collect::<Vec<_>>()
            .join(", "),
        output,
        states,
        parameters,
        step_s: None,
    }
}
