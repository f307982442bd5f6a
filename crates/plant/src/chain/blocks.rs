//! The blocks that are not linear or not constant in time, each advanced over a piece of a straight-line input.

use super::linear::Segment;
use crate::phi::phi;
use nalgebra::Complex;

/// Bouc-Wen over a change of input from `from` to `to`, exactly: on each side of h = 0 the equation
/// `dh/du = 1 - (beta s + gamma sgn h) ...` is linear, so h moves along exponentials.
pub(crate) fn bouc_wen(h: f64, from: f64, to: f64, beta: f64, gamma: f64) -> f64 {
    let direction = if to > from { 1.0 } else { -1.0 };
    // Mirrored so that the input rises: with g = direction * h, dg/dv = 1 - beta g - gamma |g|, v the way travelled.
    let mut g = direction * h;
    let mut way = (to - from).abs();
    if g < 0.0 {
        // dg/dv = 1 - (beta - gamma) g up to the crossing of zero.
        let rate = beta - gamma;
        let crossing = if rate.abs() * g.abs() < 1e-9 {
            -g
        } else {
            (1.0 - rate * g).ln() / rate
        };
        if way <= crossing {
            return direction * relax(g, rate, way);
        }
        way -= crossing;
        g = 0.0;
    }
    direction * relax(g, beta + gamma, way)
}

/// `g` after `dg/dv = 1 - rate g` over `way`.
fn relax(g: f64, rate: f64, way: f64) -> f64 {
    let z = -rate * way;
    let exp = z.exp();
    let phi1 = if z.abs() < 1e-5 {
        1.0 + 0.5 * z
    } else {
        z.exp_m1() / z
    };
    g * exp + way * phi1
}

/// State of one hysteresis block.
#[derive(Debug, Clone)]
pub(crate) enum HysteresisBlock {
    BoucWen {
        fraction: f64,
        beta: f64,
        gamma: f64,
        explicit: bool,
        h: f64,
        input: f64,
    },
    Play {
        thresholds: Vec<f64>,
        weights: Vec<f64>,
        quadratic: f64,
        p: Vec<f64>,
    },
}

/// Beyond this \[um\] the explicit recursion has run away; it is stopped there so that no infinity enters the loop.
const RUNAWAY_UM: f64 = 1e6;

impl HysteresisBlock {
    /// The output after a monotone change of the input.
    pub(crate) fn follow(&mut self, u: f64) -> f64 {
        match self {
            Self::BoucWen {
                fraction,
                beta,
                gamma,
                explicit,
                h,
                input,
            } => {
                let du = u - *input;
                if du != 0.0 {
                    *h = if *explicit {
                        let next = *h + du - *beta * du.abs() * *h - *gamma * du * h.abs();
                        next.clamp(-RUNAWAY_UM, RUNAWAY_UM)
                    } else {
                        bouc_wen(*h, *input, u, *beta, *gamma)
                    };
                    *input = u;
                }
                u - *fraction * *h
            }
            Self::Play {
                thresholds,
                weights,
                quadratic,
                p,
            } => {
                let mut v = 0.0;
                for ((r, w), p) in thresholds.iter().zip(weights.iter()).zip(p.iter_mut()) {
                    *p = (u - r).max((u + r).min(*p));
                    v += w * *p;
                }
                v + *quadratic * v * v
            }
        }
    }

    pub(crate) fn reset(&mut self) {
        match self {
            Self::BoucWen { h, input, .. } => {
                *h = 0.0;
                *input = 0.0;
            }
            Self::Play { p, .. } => p.fill(0.0),
        }
    }
}

/// A block between linear groups.
#[derive(Debug, Clone)]
pub(crate) enum Block {
    Hysteresis(HysteresisBlock),
    /// Play of half width `half`, output `x`.
    Backlash {
        half: f64,
        x: f64,
    },
    /// First-order lag `lag exp(-dissolution t)`.
    Dissolving {
        lag: f64,
        dissolution: f64,
        y: f64,
        /// Slope at the end of the last piece, um/s.
        speed: f64,
    },
    /// `(1 + per_s t) y - per_s integral(y)`: velocity times a growing gain.
    GainDrift {
        per_s: f64,
        area: f64,
    },
    /// A constant flow.
    FlowDrift {
        speed: f64,
    },
    /// Dead zone of the speed: the bead lags the flow by the threshold and rests below it.
    Adhesion {
        threshold: f64,
        input: f64,
        output: f64,
    },
}

/// Integral over a piece of the dead zone of a speed that runs straight from `a` to `b`.
pub(crate) fn dead_zone_travel(a: f64, b: f64, threshold: f64, h: f64) -> f64 {
    let zone = |v: f64| (v.abs() - threshold).max(0.0) * v.signum();
    let (small, large) = (a.abs().min(b.abs()), a.abs().max(b.abs()));
    // Wholly inside or outside: no division by a small difference.
    if large <= threshold {
        return 0.0;
    }
    if (small >= threshold && a * b > 0.0) || (b - a).abs() < 1e-9 * large {
        return 0.5 * (zone(a) + zone(b)) * h;
    }
    // The dead zone is odd, so its primitive is even.
    let even = |v: f64| 0.5 * zone(v) * zone(v);
    h * (even(b) - even(a)) / (b - a)
}

impl Block {
    pub(crate) fn advance(&mut self, time_s: f64, h: f64, input: Segment) -> Segment {
        match self {
            Self::Hysteresis(block) => {
                let start = block.follow(input.start);
                let end = if input.end == input.start {
                    start
                } else {
                    block.follow(input.end)
                };
                Segment::line(start, end, h)
            }
            Self::Backlash { half, x } => {
                *x = (input.start - *half).max((input.start + *half).min(*x));
                let start = *x;
                *x = (input.end - *half).max((input.end + *half).min(*x));
                Segment::line(start, *x, h)
            }
            Self::Dissolving {
                lag,
                dissolution,
                y,
                speed,
            } => {
                let start = *y;
                if h <= 0.0 {
                    return Segment::line(start, start, 0.0);
                }
                // The lag changes over seconds, a piece lasts less than a millisecond: its mean is enough.
                let now = (*lag * (-*dissolution * (time_s + 0.5 * h)).exp()).max(1e-9);
                let f = phi(Complex::new(-h / now, 0.0));
                let rise = input.end - input.start;
                let gain = h / now;
                *y = f.exp.re * start + gain * (f.one.re * input.start + f.two.re * rise);
                *speed = (input.end - *y) / now;
                Segment {
                    start,
                    end: *y,
                    integral: input.integral - now * (*y - start),
                    speed_start: (input.start - start) / now,
                    speed_end: *speed,
                }
            }
            Self::GainDrift { per_s, area } => {
                let (before, after) = (1.0 + *per_s * time_s, 1.0 + *per_s * (time_s + h));
                let earlier = *area;
                *area += input.integral;
                Segment {
                    start: before * input.start - *per_s * earlier,
                    end: after * input.end - *per_s * *area,
                    integral: 0.5 * (before + after) * input.integral
                        - *per_s * h * (earlier + 0.5 * input.integral),
                    speed_start: before * input.speed_start,
                    speed_end: after * input.speed_end,
                }
            }
            Self::FlowDrift { speed } => Segment {
                start: input.start + *speed * time_s,
                end: input.end + *speed * (time_s + h),
                integral: input.integral + *speed * h * (time_s + 0.5 * h),
                speed_start: input.speed_start + *speed,
                speed_end: input.speed_end + *speed,
            },
            Self::Adhesion {
                threshold,
                input: last,
                output,
            } => {
                // A jump is infinitely fast and is followed in full.
                let start = *output + (input.start - *last);
                let travel = if h > 0.0 {
                    let mean = (input.end - input.start) / h;
                    let half = 0.5 * (input.speed_end - input.speed_start);
                    dead_zone_travel(mean - half, mean + half, *threshold, h)
                } else {
                    0.0
                };
                let zone = |v: f64| (v.abs() - *threshold).max(0.0) * v.signum();
                *last = input.end;
                *output = start + travel;
                Segment {
                    start,
                    end: *output,
                    integral: h * (start + 0.5 * travel),
                    speed_start: zone(input.speed_start),
                    speed_end: zone(input.speed_end),
                }
            }
        }
    }

    pub(crate) fn reset(&mut self) {
        match self {
            Self::Hysteresis(block) => block.reset(),
            Self::Backlash { x, .. } => *x = 0.0,
            Self::Dissolving { y, speed, .. } => {
                *y = 0.0;
                *speed = 0.0;
            }
            Self::FlowDrift { .. } => {}
            Self::GainDrift { area, .. } => *area = 0.0,
            Self::Adhesion { input, output, .. } => {
                *input = 0.0;
                *output = 0.0;
            }
        }
    }
}
