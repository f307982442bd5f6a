//! The residual of a fit, regressed on a library of terms of command, position, speed and time, each at both places at which it
//! may act. The result says where and how, and gives a formula with its worth on data that it has not seen.

use crate::dot::dot;
use crate::fit::context::{Context, Fit};
use crate::fit::linear::Tangents;
use crate::mask::{Mask, split_in_time};
use crate::search::lines::{Line, strongest_line, without_line};
use crate::thresholds::THRESHOLDS;
use crate::units::Side;
use nalgebra::{DMatrix, DVector};

/// A formula for the unexplained part.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Hypothesis {
    /// For example `plant input += -0.031 y^3`, y the position and d the command from the working point.
    pub formula: String,
    /// Part of the excess over the floor that it removes on the held-out last 40 % of every record, 0..1.
    pub held_out_worth: f64,
    /// Terms with coefficients and units.
    pub terms: Vec<Term>,
}

/// One term of a formula.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Term {
    /// The term: `d` command from the working point, `y` position, `v` its speed, `t` time.
    pub term: String,
    /// Where it acts: `input` (into the plant) or `output` (onto the position).
    pub place: &'static str,
    /// Its coefficient.
    pub coefficient: f64,
    /// Unit of the coefficient.
    pub unit: String,
}

/// One term in every record, as innovations.
pub(crate) struct Column {
    pub name: &'static str,
    pub place: &'static str,
    /// Powers of command, position and second in it.
    pub powers: [i32; 3],
    /// What it would mean, in words.
    pub says: &'static str,
    pub innovations: Vec<Vec<f64>>,
}

impl Column {
    /// Whether it bends: no linear plant makes it.
    pub(crate) fn is_curved(&self) -> bool {
        let linear = matches!(self.name, "y" | "v" | "t" | "t d");
        !linear
    }
}

/// The parts of a library term, row by row.
struct Row {
    d: f64,
    rate: f64,
    y: f64,
    v: f64,
    t: f64,
}

type Formula = fn(&Row) -> f64;

/// Name, powers of command, position and second, words, formula.
const TERMS: &[(&str, [i32; 3], &str, Formula)] = &[
    (
        "d^2",
        [2, 0, 0],
        "the response is not the same up and down: it goes with the square of the command",
        |r| r.d * r.d,
    ),
    (
        "d^3",
        [3, 0, 0],
        "the response changes with amplitude",
        |r| r.d.powi(3),
    ),
    (
        "|d|",
        [1, 0, 0],
        "the response is not the same on both sides of the working point",
        |r| r.d.abs(),
    ),
    (
        "d |d|",
        [2, 0, 0],
        "the response changes with amplitude",
        |r| r.d * r.d.abs(),
    ),
    (
        "sign(dd/dt)",
        [0, 0, 0],
        "the response depends on the direction of the command: friction or hysteresis",
        |r| sign(r.rate),
    ),
    (
        "|dd/dt|",
        [1, 0, -1],
        "the response depends on the speed of the command, not on its direction",
        |r| r.rate.abs(),
    ),
    ("t d", [1, 0, 1], "the gain changes with time", |r| {
        r.t * r.d
    }),
    (
        "y",
        [0, 1, 0],
        "a force that goes with the position: another stiffness or outflow",
        |r| r.y,
    ),
    (
        "y^2",
        [0, 2, 0],
        "a force or an image that bends with the position",
        |r| r.y * r.y,
    ),
    (
        "y^3",
        [0, 3, 0],
        "a stiffness that grows with the position",
        |r| r.y.powi(3),
    ),
    (
        "|y|",
        [0, 1, 0],
        "the two sides of the position differ",
        |r| r.y.abs(),
    ),
    ("y d", [1, 1, 0], "the gain depends on the position", |r| {
        r.y * r.d
    }),
    (
        "y^2 d",
        [1, 2, 0],
        "the gain depends on the position",
        |r| r.y * r.y * r.d,
    ),
    ("v", [0, 1, -1], "another damping", |r| r.v),
    (
        "v |v|",
        [0, 2, -2],
        "a damping that grows with speed",
        |r| r.v * r.v.abs(),
    ),
    ("v^3", [0, 3, -3], "a damping that grows with speed", |r| {
        r.v.powi(3)
    }),
    ("|v|", [0, 1, -1], "motion differs by its direction", |r| {
        r.v.abs()
    }),
    ("sign(v)", [0, 0, 0], "dry friction", |r| sign(r.v)),
    (
        "y v",
        [0, 2, -1],
        "damping or scale depends on the position",
        |r| r.y * r.v,
    ),
    (
        "y^2 v",
        [0, 3, -1],
        "damping or scale depends on the position",
        |r| r.y * r.y * r.v,
    ),
    ("t", [0, 0, 1], "a drift that grows with time", |r| r.t),
];

fn sign(x: f64) -> f64 {
    if x == 0.0 { 0.0 } else { x.signum() }
}

/// Rows of a record with everything that terms consist of. The position is the model's plus the walk as the earlier rows show it.
/// With the row itself or later ones, its own noise would look like an effect.
fn rows(ctx: &Context<'_>, i: usize, sim: &[f64], residual: &[f64]) -> Vec<Row> {
    let dt = ctx.problem.base.sample_s;
    let r = &ctx.problem.records[i];
    let walk = r.whitener.ahead(residual);
    let first = if ctx.problem.base.free_start {
        0.0
    } else {
        (0..r.y.len())
            .find(|&k| r.present[k])
            .map_or(0.0, |k| r.y[k])
    };
    let y: Vec<f64> = sim.iter().zip(&walk).map(|(s, w)| s + w - first).collect();
    (0..r.u.len())
        .map(|k| {
            let a = k.saturating_sub(1);
            Row {
                d: r.u[k],
                rate: (r.u[k] - r.u[a]) / dt,
                y: y[k],
                v: (y[k] - y[a]) / dt,
                t: k as f64 * dt,
            }
        })
        .collect()
}

/// The library about a fit.
pub(crate) fn library(ctx: &Context<'_>, fit: &Fit) -> Vec<Column> {
    let (residual, path) = ctx.residual(fit);
    let sim = ctx.simulated(&fit.parts, fit.offset_um, &ctx.problem.all());
    let records = &ctx.problem.records;
    let rows: Vec<Vec<Row>> = (0..records.len())
        .map(|i| rows(ctx, i, &path[i], &residual[i]))
        .collect();
    let mut all = Vec::new();
    for &(name, powers, says, formula) in TERMS {
        for place in ["input", "output"] {
            let innovations = records
                .iter()
                .zip(&sim)
                .zip(&rows)
                .map(|((r, sim), rows)| {
                    let raw: Vec<f64> = rows.iter().map(formula).collect();
                    let moved = if place == "input" {
                        ctx.response(fit, (r, sim), &raw)
                    } else {
                        // A loop has set a row's command by its position: what shows at the output is that of the row before.
                        let shown = rows.windows(2).map(|w| {
                            let [before, now] = w else { return 0.0 };
                            formula(&Row {
                                d: before.d,
                                rate: before.rate,
                                ..*now
                            })
                        });
                        raw.iter().take(1).copied().chain(shown).collect()
                    };
                    r.whitened(&moved)
                })
                .collect();
            all.push(Column {
                name,
                place,
                powers,
                says,
                innovations,
            });
        }
    }
    all.retain(|c| c.innovations.iter().flatten().all(|x| x.is_finite()));
    all
}

/// The library term with the largest gain in addition to a fit, everything else refitted: its index in the library, and the gain
/// in twice the log-likelihood.
pub(crate) fn strongest(
    library: &[Column],
    tangents: &Tangents,
    fit: &Fit,
    mask: &Mask,
) -> Option<(usize, f64)> {
    library
        .iter()
        .enumerate()
        .map(|(i, c)| {
            (
                i,
                tangents.gain(&c.innovations, &fit.innovations, mask).score,
            )
        })
        .filter(|(_, s)| s.is_finite())
        .max_by(|a, b| a.1.total_cmp(&b.1))
}

fn inner(a: &[Vec<f64>], b: &[Vec<f64>], mask: &Mask) -> f64 {
    a.iter()
        .zip(b)
        .zip(mask)
        .map(|((a, b), m)| {
            m.iter()
                .map(|r| dot(&a[r.clone()], &b[r.clone()]))
                .sum::<f64>()
        })
        .sum()
}

/// Most terms of a formula.
const MOST_TERMS: usize = 4;

/// A column with its coefficient, in the units of the records.
fn term_of(ctx: &Context<'_>, column: &Column, value: f64) -> Term {
    let side = match column.place {
        "input" => Side::Input,
        _ => Side::Output,
    };
    let (coefficient, unit) = ctx.scales.coefficient(value, side, column.powers);
    Term {
        term: column.name.to_owned(),
        place: column.place,
        coefficient,
        unit,
    }
}

/// Least share of a column that is independent of the numbers of a base.
const LEAST_OWN: f64 = 1e-4;

/// What a change of gain, stiffness and damping of another plant's base would make, orthonormal on the rows of a mask.
fn straight(ctx: &Context<'_>, fit: &Fit, library: &[Column], mask: &Mask) -> Vec<Vec<Vec<f64>>> {
    if !ctx.problem.base.free_start {
        return Vec::new();
    }
    let sim = ctx.simulated(&fit.parts, fit.offset_um, &ctx.problem.all());
    let records = ctx.problem.records.iter().zip(&sim);
    let gain = records.map(|(r, sim)| r.whitened(&ctx.response(fit, (r, sim), &r.u)));
    let of_base = library
        .iter()
        .filter(|c| c.place == "input" && matches!(c.name, "y" | "v"))
        .map(|c| c.innovations.clone());
    let mut basis: Vec<Vec<Vec<f64>>> = Vec::new();
    for column in std::iter::once(gain.collect()).chain(of_base) {
        let size = inner(&column, &column, mask);
        let mut left = without(&column, &basis, mask);
        let rest = inner(&left, &left, mask);
        if rest > 1e-9 * size && rest > 0.0 {
            let scale = 1.0 / rest.sqrt();
            left.iter_mut().flatten().for_each(|x| *x *= scale);
            basis.push(left);
        }
    }
    basis
}

/// What an orthonormal basis leaves of a column.
fn without(column: &[Vec<f64>], basis: &[Vec<Vec<f64>>], mask: &Mask) -> Vec<Vec<f64>> {
    let mut left = column.to_vec();
    for q in basis {
        let share = inner(q, &left, mask);
        for (l, q) in left.iter_mut().zip(q) {
            l.iter_mut().zip(q).for_each(|(l, q)| *l -= share * q);
        }
    }
    left
}

/// The columns of a library without the part that a basis explains.
fn beside(library: &[Column], basis: &[Vec<Vec<f64>>], mask: &Mask) -> Vec<Vec<Vec<f64>>> {
    (library.iter())
        .map(|c| without(&c.innovations, basis, mask))
        .collect()
}

/// Least gain of a formula over a simpler one on rows that it has not seen, in twice the log-likelihood.
const UNSEEN: f64 = 10.0;

/// A formula, and the innovations that are left.
struct Selected {
    line: Option<Line>,
    /// Places in the library, with their coefficients.
    terms: Vec<(usize, f64)>,
    left: Vec<Vec<f64>>,
}

/// The formula for the innovations of a fit. A line with a separate amplitude and phase in every record is part of it if that says more. A
/// wrong response also makes lines, of the command's sines, and its terms say as much.
pub(crate) fn hypothesis(ctx: &Context<'_>, fit: &Fit, library: &[Column]) -> Option<Hypothesis> {
    let (train, test) = split_in_time(ctx.problem.rows());
    let squares = |e: &[Vec<f64>]| inner(e, e, &test);
    let plain = selected(ctx, fit, library, None);
    let with_line = strongest_line(ctx, fit)
        .and_then(|hz| without_line(ctx, fit, hz, &train))
        .and_then(|line| selected(ctx, fit, library, Some(line)))
        .filter(|found| {
            let simpler = plain.as_ref().map_or(&fit.innovations, |p| &p.left);
            squares(&found.left) < squares(simpler) - UNSEEN
        });
    let found = with_line.or(plain)?;
    let count = ctx.problem.count(&test) as f64;
    let before = squares(&fit.innovations) - count;
    let after = squares(&found.left) - count;
    let line = found.line.map(|l| Term {
        term: format!("sin(2 pi {:.2} Hz t + phase of the record)", l.hz),
        place: "output",
        coefficient: ctx.scales.output(l.amplitude_um),
        unit: ctx.scales.output_unit().to_owned(),
    });
    let of_library = (found.terms.iter()).map(|(i, x)| term_of(ctx, &library[*i], *x));
    let terms: Vec<Term> = line.into_iter().chain(of_library).collect();
    let words = terms.iter().map(|t| {
        format!(
            "{} += {:.4e} [{}] {}",
            t.place, t.coefficient, t.unit, t.term
        )
    });
    Some(Hypothesis {
        formula: words.collect::<Vec<_>>().join(", "),
        held_out_worth: if before > 0.0 {
            (1.0 - after / before).clamp(-1.0, 1.0)
        } else {
            0.0
        },
        terms,
    })
}

/// Forward selection on the first part of every record, beside a line if any; each term must also help in the rest.
fn selected(
    ctx: &Context<'_>,
    fit: &Fit,
    library: &[Column],
    line: Option<Line>,
) -> Option<Selected> {
    let (train, test) = split_in_time(ctx.problem.rows());
    let e = line.as_ref().map_or(&fit.innovations, |l| &l.left);
    // A base that was fitted to records of a plant that bends has another gain and lag than the plant: what these change is no term.
    let straight = straight(ctx, fit, library, &train);
    let (columns, e) = (
        beside(library, &straight, &train),
        without(e, &straight, &train),
    );
    let e = &e;
    let mut chosen: Vec<usize> = Vec::new();
    let mut coefficients = DVector::zeros(0);
    let mut left = e.clone();
    while chosen.len() < MOST_TERMS {
        let (best, gain) = (0..library.len())
            .filter(|i| !chosen.contains(i))
            .map(|i| {
                let c = &columns[i];
                let (cc, ce) = (inner(c, c, &train), inner(c, &left, &train));
                let own = &library[i].innovations;
                // A term that the base's own numbers also produce does not count.
                let seen = cc > LEAST_OWN * inner(own, own, &train);
                (i, if seen { ce * ce / cc } else { 0.0 })
            })
            .max_by(|a, b| a.1.total_cmp(&b.1))?;
        if gain < THRESHOLDS.term_worth {
            break;
        }
        let mut trial = chosen.clone();
        trial.push(best);
        let n = trial.len();
        let column = |i: usize| &columns[trial[i]];
        // Terms of very different units: each scaled by its size.
        let size: Vec<f64> = (0..n)
            .map(|i| {
                inner(column(i), column(i), &train)
                    .sqrt()
                    .max(f64::MIN_POSITIVE)
            })
            .collect();
        let a = DMatrix::from_fn(n, n, |i, j| {
            inner(column(i), column(j), &train) / (size[i] * size[j])
        });
        let b = DVector::from_fn(n, |i, _| inner(column(i), e, &train) / size[i]);
        let Some(x) = a.cholesky().map(|c| c.solve(&b)) else {
            break;
        };
        let x = DVector::from_fn(n, |i, _| x[i] / size[i]);
        let mut next = e.clone();
        for (i, x) in trial.iter().zip(x.iter()) {
            for (next, c) in next.iter_mut().zip(&columns[*i]) {
                next.iter_mut().zip(c).for_each(|(n, c)| *n -= x * c);
            }
        }
        if inner(&next, &next, &test) > inner(&left, &left, &test) - UNSEEN {
            break;
        }
        (chosen, coefficients, left) = (trial, x, next);
    }
    (!chosen.is_empty() || line.is_some()).then(|| Selected {
        line,
        terms: chosen
            .into_iter()
            .zip(coefficients.iter().copied())
            .collect(),
        left,
    })
}
