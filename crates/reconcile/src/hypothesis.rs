//! When nothing in the catalogue closes the gap: a formula for what is left, by sparse regression, with its worth on
//! data that it has not seen.

use crate::fit::{Context, Fit};
use crate::linear::dot;
use crate::problem::{Mask, split_in_time};
use nalgebra::{DMatrix, DVector};
use std::f64::consts::TAU;

/// A formula for the unexplained part.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Hypothesis {
    /// For example `bead_speed += 12.1 d^2 - 0.4 d^3`, d the displacement from the working point in um.
    pub formula: String,
    /// Part of the excess over the floor that it removes on the held-out last 40 % of every record, 0..1.
    pub held_out_worth: f64,
    /// Terms with coefficients and units.
    pub terms: Vec<Term>,
}

/// One term of a formula.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Term {
    /// The term.
    pub term: String,
    /// Its coefficient.
    pub coefficient: f64,
    /// Unit of the coefficient.
    pub unit: String,
}

/// Columns of one term in every record.
struct Candidate {
    name: String,
    unit: String,
    columns: Vec<Vec<f64>>,
}

/// Regresses what a fit leaves over on a library of terms of the speed and of the position.
pub(crate) fn hypothesis(ctx: &Context<'_>, fit: &Fit) -> Option<Hypothesis> {
    let dt = ctx.problem.base.sample_s;
    let records = &ctx.problem.records;
    let (train, test) = split_in_time(records);
    let (residual, sim) = ctx.residual(fit);
    let mut library: Vec<Candidate> = Vec::new();
    let mut add = |name: &str, unit: &str, speed: bool, f: &dyn Fn(usize, usize) -> f64| {
        let columns = records
            .iter()
            .enumerate()
            .map(|(i, r)| {
                let n = r.u.len();
                let mut sum = 0.0;
                let raw: Vec<f64> = (0..n)
                    .map(|k| {
                        if speed {
                            let now = sum;
                            sum += dt * f(i, k);
                            now
                        } else {
                            f(i, k)
                        }
                    })
                    .collect();
                let mut w = vec![0.0; n];
                r.whitener.apply(&raw, &mut w);
                w
            })
            .collect();
        library.push(Candidate {
            name: name.to_owned(),
            unit: unit.to_owned(),
            columns,
        });
    };
    let d = |i: usize, k: usize| records[i].u[k];
    let rate = |i: usize, k: usize| {
        if k == 0 {
            0.0
        } else {
            (records[i].u[k] - records[i].u[k - 1]) / dt
        }
    };
    let y = |i: usize, k: usize| sim[i][k] + residual[i][k] - residual[i][0];
    add("1", "um/s", true, &|_, _| 1.0);
    add("d", "1/s", true, &d);
    add("d^2", "1/(um s)", true, &|i, k| d(i, k).powi(2));
    add("d^3", "1/(um^2 s)", true, &|i, k| d(i, k).powi(3));
    add("|d|", "1/s", true, &|i, k| d(i, k).abs());
    add("d |d|", "1/(um s)", true, &|i, k| d(i, k) * d(i, k).abs());
    add("sign(dd/dt)", "um/s", true, &|i, k| {
        rate(i, k).signum() * f64::from(u8::from(rate(i, k) != 0.0))
    });
    add("|dd/dt|", "1", true, &|i, k| rate(i, k).abs());
    add("t d", "1/s^2", true, &|i, k| d(i, k) * k as f64 * dt);
    add("t", "um/s^2", true, &|_, k| k as f64 * dt);
    add("y d", "1/(um s)", true, &|i, k| d(i, k) * y(i, k));
    add("y^2 d", "1/(um^2 s)", true, &|i, k| {
        d(i, k) * y(i, k).powi(2)
    });
    add("y", "1/s", true, &|i, k| y(i, k));
    for lag in [1usize, 2, 5, 10, 20, 50, 100, 200] {
        add(
            &format!("d(t - {} ms)", lag as f64 * dt * 1e3),
            "1/s",
            true,
            &|i, k| if k >= lag { d(i, k - lag) } else { 0.0 },
        );
        add(
            &format!("d(t - {} ms)^2", lag as f64 * dt * 1e3),
            "1/(um s)",
            true,
            &|i, k| if k >= lag { d(i, k - lag).powi(2) } else { 0.0 },
        );
    }
    add("d (position)", "1", false, &d);
    add("d^2 (position)", "1/um", false, &|i, k| d(i, k).powi(2));
    add("y^2 (position)", "1/um", false, &|i, k| y(i, k).powi(2));
    add("y^3 (position)", "1/um^2", false, &|i, k| y(i, k).powi(3));
    // Forward selection on the first part of every record.
    let inner = |a: &[Vec<f64>], b: &[Vec<f64>], mask: &Mask| -> f64 {
        a.iter()
            .zip(b)
            .zip(mask)
            .map(|((a, b), m)| {
                m.iter()
                    .map(|r| dot(&a[r.clone()], &b[r.clone()]))
                    .sum::<f64>()
            })
            .sum()
    };
    // A line first, with an amplitude and a phase of its own in every record.
    let line = strongest_line(ctx, fit).and_then(|hz| without_line(ctx, fit, hz, &train));
    let line = line.filter(|l| {
        inner(&l.left, &l.left, &test) < inner(&fit.innovations, &fit.innovations, &test) - 10.0
    });
    let all = &fit.innovations;
    let e = line.as_ref().map_or(all, |l| &l.left);
    let mut chosen: Vec<usize> = Vec::new();
    let mut coefficients = DVector::zeros(0);
    let mut left = e.clone();
    for _ in 0..4 {
        let best = (0..library.len())
            .filter(|i| !chosen.contains(i))
            .map(|i| {
                let c = &library[i].columns;
                let cc = inner(c, c, &train);
                let ce = inner(c, &left, &train);
                (i, if cc > 1e-9 { ce * ce / cc } else { 0.0 })
            })
            .max_by(|a, b| a.1.total_cmp(&b.1))?;
        if best.1 < 40.0 {
            break;
        }
        let mut trial = chosen.clone();
        trial.push(best.0);
        let n = trial.len();
        let a = DMatrix::from_fn(n, n, |i, j| {
            inner(
                &library[trial[i]].columns,
                &library[trial[j]].columns,
                &train,
            )
        });
        let b = DVector::from_fn(n, |i, _| inner(&library[trial[i]].columns, e, &train));
        let Some(x) = a.cholesky().map(|c| c.solve(&b)) else {
            break;
        };
        let mut next = e.clone();
        for (i, x) in trial.iter().zip(x.iter()) {
            for (next, c) in next.iter_mut().zip(&library[*i].columns) {
                for (n, c) in next.iter_mut().zip(c) {
                    *n -= x * c;
                }
            }
        }
        // Each term must also help where it was not fitted.
        if inner(&next, &next, &test) > inner(&left, &left, &test) - 10.0 {
            break;
        }
        chosen = trial;
        coefficients = x;
        left = next;
    }
    if chosen.is_empty() && line.is_none() {
        return None;
    }
    let count = ctx.problem.count(&test) as f64;
    let before = inner(all, all, &test) - count;
    let after = inner(&left, &left, &test) - count;
    let line = line.map(|l| Term {
        term: format!(
            "sin(2 pi {:.2} Hz t + phase of the record) (position)",
            l.hz
        ),
        coefficient: l.amplitude_um,
        unit: "um".to_owned(),
    });
    let terms: Vec<Term> = line
        .into_iter()
        .chain(chosen.iter().zip(coefficients.iter()).map(|(i, x)| Term {
            term: library[*i].name.clone(),
            coefficient: *x,
            unit: library[*i].unit.clone(),
        }))
        .collect();
    let formula = terms
        .iter()
        .map(|t| format!("{:+.4} [{}] {}", t.coefficient, t.unit, t.term))
        .collect::<Vec<_>>()
        .join(" ");
    Some(Hypothesis {
        formula: format!("d bead/dt or bead (where marked position) += {formula}"),
        held_out_worth: if before > 0.0 {
            (1.0 - after / before).clamp(-1.0, 1.0)
        } else {
            0.0
        },
        terms,
    })
}

/// What a line leaves over.
struct Line {
    hz: f64,
    /// Mean over the records \[um\].
    amplitude_um: f64,
    left: Vec<Vec<f64>>,
}

/// Takes a line off, amplitude and phase of every record from the rows of a mask.
fn without_line(ctx: &Context<'_>, fit: &Fit, hz: f64, train: &Mask) -> Option<Line> {
    let mut left = fit.innovations.clone();
    let mut sum = 0.0;
    for ((r, e), mask) in ctx.problem.records.iter().zip(&mut left).zip(train) {
        let n = e.len();
        let (s, c): (Vec<f64>, Vec<f64>) = (0..n)
            .map(|k| (TAU * hz * k as f64 * ctx.problem.base.sample_s).sin_cos())
            .unzip();
        let (mut ws, mut wc) = (vec![0.0; n], vec![0.0; n]);
        r.whitener.apply(&s, &mut ws);
        r.whitener.apply(&c, &mut wc);
        let rows = mask.first()?.clone();
        let (ws_in, wc_in, e_in) = (&ws[rows.clone()], &wc[rows.clone()], &e[rows]);
        let (ss, cc, sc) = (dot(ws_in, ws_in), dot(wc_in, wc_in), dot(ws_in, wc_in));
        let (se, ce) = (dot(ws_in, e_in), dot(wc_in, e_in));
        let det = ss * cc - sc * sc;
        if det <= 1e-9 * ss * cc {
            continue;
        }
        let (a, b) = ((cc * se - sc * ce) / det, (ss * ce - sc * se) / det);
        sum += a.hypot(b);
        for (e, (s, c)) in e.iter_mut().zip(ws.iter().zip(&wc)) {
            *e -= a * s + b * c;
        }
    }
    Some(Line {
        hz,
        amplitude_um: sum / ctx.problem.records.len() as f64,
        left,
    })
}

/// The frequency of the strongest line in the innovations that is on no line of the command, if any stands out.
fn strongest_line(ctx: &Context<'_>, fit: &Fit) -> Option<f64> {
    let mask = ctx.problem.all();
    let coarse: Vec<f64> = (0..480)
        .map(|i| 3.05 + f64::from(i))
        .filter(|f| f * ctx.problem.base.sample_s < 0.48)
        .collect();
    // The longest record decides; a line is everywhere.
    let longest = (0..ctx.problem.records.len()).max_by_key(|i| ctx.problem.records[*i].u.len())?;
    let e = &fit.innovations[longest];
    let n = e.len().min(4000);
    let mut best = (0.0, 0.0);
    for f in coarse {
        for part in 0..8 {
            let hz = f + f64::from(part) / 8.0;
            let (mut s, mut c) = (0.0, 0.0);
            for (k, e) in e[..n].iter().enumerate() {
                let (a, b) = (TAU * hz * k as f64 * ctx.problem.base.sample_s).sin_cos();
                s += a * e;
                c += b * e;
            }
            let p = 2.0 * (s * s + c * c) / n as f64;
            if p > best.1 {
                best = (hz, p);
            }
        }
    }
    if best.1 < 40.0 {
        return None;
    }
    let fine = (0..41).map(|i| best.0 - 0.1 + f64::from(i) * 0.005);
    fine.map(|hz| (hz, crate::screen::line_score(ctx, fit, hz, &mask)))
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map(|b| b.0)
}
