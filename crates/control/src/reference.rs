//! References: wanted positions of the bead, evaluated at a time without allocation.
//!
//! A [`Reference`] is a pure function of time since its start; scripts compose their own by implementing the trait.
//! Preview is the same function evaluated at the coming ticks ([`fill_preview`]).

use crate::error::{BuildError, check};
use std::f64::consts::{PI, TAU};

/// A bead position wanted as a function of time.
pub trait Reference {
    /// Position at a time since the start, um. Before 0 and after the end it holds its first and last value.
    fn at_um(&self, time_s: f64) -> f64;

    /// When it ends, s; `None`: never.
    fn duration_s(&self) -> Option<f64>;

    /// Phase of a periodic reference at a time, in cycles; `None` while it is not periodic. Learned corrections
    /// belong to this phase.
    fn phase(&self, time_s: f64) -> Option<f64> {
        let _ = time_s;
        None
    }
}

/// Fills `preview_um` with the reference at the ticks that follow `tick`, the next one first.
pub fn fill_preview(
    reference: &(impl Reference + ?Sized),
    tick: u64,
    sample_time_s: f64,
    preview_um: &mut [f64],
) {
    for (ahead, slot) in (1u64..).zip(preview_um) {
        *slot = reference.at_um(tick.saturating_add(ahead) as f64 * sample_time_s);
    }
}

/// The periodic shapes of [`Profile::Wave`], all between -1 and 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// Sine, starting at 0 and rising.
    Sine,
    /// Triangle, starting at 0 and rising.
    Triangle,
    /// Square, starting at 1.
    Square,
    /// Trapezoid with equal rise, high, fall and low, starting at 0 and rising.
    Trapezoid,
}

impl Shape {
    fn at(self, phase: f64) -> f64 {
        let phase = phase - phase.floor();
        let triangle = 1.0 - 4.0 * ((phase + 0.25).fract() - 0.5).abs();
        match self {
            Self::Sine => (TAU * phase).sin(),
            Self::Triangle => triangle,
            Self::Square => {
                if phase < 0.5 {
                    1.0
                } else {
                    -1.0
                }
            }
            Self::Trapezoid => (2.0 * triangle).clamp(-1.0, 1.0),
        }
    }
}

/// The built-in references.
#[derive(Debug, Clone, PartialEq)]
pub enum Profile {
    /// Stay at a position.
    Hold {
        /// Position, um.
        position_um: f64,
    },
    /// Constant speed, then hold.
    Ramp {
        /// Start, um.
        from_um: f64,
        /// End, um.
        to_um: f64,
        /// Duration, s.
        duration_s: f64,
    },
    /// Minimum-jerk move, then hold: `10 x^3 - 15 x^4 + 6 x^5`.
    MinimumJerk {
        /// Start, um.
        from_um: f64,
        /// End, um.
        to_um: f64,
        /// Duration, s.
        duration_s: f64,
    },
    /// A periodic wave that comes in over a raised-cosine fade.
    Wave {
        /// Shape.
        shape: Shape,
        /// Centre, um.
        centre_um: f64,
        /// Amplitude (half of peak to peak), um.
        amplitude_um: f64,
        /// Frequency, Hz.
        frequency_hz: f64,
        /// Fade-in, s; 0: at once.
        fade_s: f64,
    },
    /// Points joined by straight lines.
    Points(Points),
    /// One period of samples, repeated.
    Waveform {
        /// Positions over one period at equal spacing, um; joined by straight lines.
        samples_um: Vec<f64>,
        /// Period, s.
        period_s: f64,
    },
}

/// Points `(time_s, position_um)` joined by straight lines.
#[derive(Debug, Clone, PartialEq)]
pub struct Points {
    points: Vec<(f64, f64)>,
}

impl Points {
    /// Takes points in the order of their times.
    ///
    /// # Errors
    /// No point, a number that is not finite, times that do not grow.
    pub fn new(points: Vec<(f64, f64)>) -> Result<Self, BuildError> {
        check(
            "points",
            "points",
            points.len() as f64,
            !points.is_empty(),
            "at least one point",
        )?;
        let mut last = f64::NEG_INFINITY;
        for &(time_s, position_um) in &points {
            check(
                "points.time_s",
                "s",
                time_s,
                time_s > last,
                "later than the point before",
            )?;
            check("points.position_um", "um", position_um, true, "finite")?;
            last = time_s;
        }
        Ok(Self { points })
    }

    fn at_um(&self, time_s: f64) -> f64 {
        let next = self.points.partition_point(|&(t, _)| t <= time_s);
        let before = next.checked_sub(1).and_then(|i| self.points.get(i));
        match (before, self.points.get(next)) {
            (Some(&(t0, p0)), Some(&(t1, p1))) => p0 + (p1 - p0) * (time_s - t0) / (t1 - t0),
            (Some(&(_, p)), None) | (None, Some(&(_, p))) => p,
            (None, None) => 0.0,
        }
    }
}

fn move_um(
    from_um: f64,
    to_um: f64,
    duration_s: f64,
    time_s: f64,
    shape: impl Fn(f64) -> f64,
) -> f64 {
    if time_s <= 0.0 {
        from_um
    } else if time_s >= duration_s {
        to_um
    } else {
        from_um + (to_um - from_um) * shape(time_s / duration_s)
    }
}

impl Reference for Profile {
    fn at_um(&self, time_s: f64) -> f64 {
        match self {
            Self::Hold { position_um } => *position_um,
            Self::Ramp {
                from_um,
                to_um,
                duration_s,
            } => move_um(*from_um, *to_um, *duration_s, time_s, |x| x),
            Self::MinimumJerk {
                from_um,
                to_um,
                duration_s,
            } => move_um(*from_um, *to_um, *duration_s, time_s, |x| {
                x * x * x * (10.0 + x * (6.0 * x - 15.0))
            }),
            Self::Wave {
                shape,
                centre_um,
                amplitude_um,
                frequency_hz,
                fade_s,
            } => {
                if time_s <= 0.0 {
                    return *centre_um;
                }
                let fade = if time_s >= *fade_s {
                    1.0
                } else {
                    0.5 - 0.5 * (PI * time_s / fade_s).cos()
                };
                centre_um + fade * amplitude_um * shape.at(frequency_hz * time_s)
            }
            Self::Points(points) => points.at_um(time_s),
            Self::Waveform {
                samples_um,
                period_s,
            } => {
                let n = samples_um.len();
                let phase = (time_s.max(0.0) / period_s).fract() * n as f64;
                let index = phase.floor();
                let at = |i: usize| samples_um.get(i % n.max(1)).copied().unwrap_or(0.0);
                let (a, b) = (at(index as usize), at(index as usize + 1));
                a + (b - a) * (phase - index)
            }
        }
    }

    fn phase(&self, time_s: f64) -> Option<f64> {
        match self {
            Self::Wave {
                frequency_hz,
                fade_s,
                ..
            } if time_s >= *fade_s => Some(time_s * frequency_hz),
            Self::Waveform { period_s, .. } if time_s >= 0.0 => Some(time_s / period_s),
            _ => None,
        }
    }

    fn duration_s(&self) -> Option<f64> {
        match self {
            Self::Ramp { duration_s, .. } | Self::MinimumJerk { duration_s, .. } => {
                Some(*duration_s)
            }
            Self::Points(points) => points.points.last().map(|&(t, _)| t.max(0.0)),
            Self::Hold { .. } | Self::Wave { .. } | Self::Waveform { .. } => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waves_pass_through_their_corners() {
        let at = |shape: Shape, x: f64| shape.at(x);
        for (x, sine, triangle, trapezoid) in [
            (0.0, 0.0, 0.0, 0.0),
            (0.25, 1.0, 1.0, 1.0),
            (0.5, 0.0, 0.0, 0.0),
            (0.75, -1.0, -1.0, -1.0),
            (1.125, 0.5_f64.sqrt(), 0.5, 1.0),
        ] {
            assert!((at(Shape::Sine, x) - sine).abs() < 1e-12);
            assert!(
                (at(Shape::Triangle, x) - triangle).abs() < 1e-12,
                "triangle at {x}"
            );
            assert!(
                (at(Shape::Trapezoid, x) - trapezoid).abs() < 1e-12,
                "trapezoid at {x}"
            );
        }
        assert_eq!(
            (at(Shape::Square, 0.1), at(Shape::Square, 0.6)),
            (1.0, -1.0)
        );
    }

    #[test]
    fn a_minimum_jerk_move_starts_and_ends_at_rest_and_is_symmetric() {
        let p = Profile::MinimumJerk {
            from_um: -2.0,
            to_um: 8.0,
            duration_s: 0.1,
        };
        assert_eq!(
            (p.at_um(-1.0), p.at_um(0.1), p.at_um(5.0)),
            (-2.0, 8.0, 8.0)
        );
        assert!((p.at_um(0.05) - 3.0).abs() < 1e-12);
        assert!((p.at_um(1e-4) + 2.0).abs() < 1e-6, "jerk-limited start");
        assert!((p.at_um(0.03) + p.at_um(0.07) - 6.0).abs() < 1e-12);
    }

    #[test]
    fn points_are_joined_by_straight_lines_and_held_outside() {
        let p = Profile::Points(Points::new(vec![(0.0, 1.0), (1.0, 3.0), (1.5, 3.0)]).unwrap());
        assert_eq!(
            (p.at_um(-1.0), p.at_um(0.5), p.at_um(1.2), p.at_um(9.0)),
            (1.0, 2.0, 3.0, 3.0)
        );
        assert_eq!(p.duration_s(), Some(1.5));
        let error = Points::new(vec![(0.0, 1.0), (0.0, 2.0)]).unwrap_err();
        assert!(
            error.to_string().contains("later than the point before"),
            "{error}"
        );
    }

    #[test]
    fn preview_is_the_reference_of_the_coming_ticks() {
        let p = Profile::Ramp {
            from_um: 0.0,
            to_um: 10.0,
            duration_s: 0.01,
        };
        let mut preview = [0.0; 3];
        fill_preview(&p, 4, 1e-3, &mut preview);
        assert_eq!(preview.map(|x| (x * 1e9).round() / 1e9), [5.0, 6.0, 7.0]);
    }

    #[test]
    fn a_waveform_repeats_and_joins_its_last_sample_to_its_first() {
        let p = Profile::Waveform {
            samples_um: vec![0.0, 1.0, 0.0, -1.0],
            period_s: 0.4,
        };
        assert!((p.at_um(0.15) - 0.5).abs() < 1e-12);
        assert!((p.at_um(0.35) + 0.5).abs() < 1e-12);
        assert!((p.at_um(0.55) - p.at_um(0.15)).abs() < 1e-12);
    }
}
