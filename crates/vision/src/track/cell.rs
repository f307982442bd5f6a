//! Following one cell from frame to frame, by the same states and decisions as a bead.
//!
//! A cell has no template. Its expected place, the contrast of its body and its size distinguish it from others. It may stretch to
//! several times its length, but then its surface stays (a cell flat between two walls) or its volume does (a body of revolution);
//! one of the two must agree. Two cells that touch are one outline of another size, which is not taken. An object that keeps its
//! place while cells pass is not taken either.

use super::config::{Commanded, Decision, TrackState, TrackStep, TrackerConfig};
use super::motion::{Motion, Randomness};
use super::standing::{Chosen as Sighted, Standing};
use super::stays::Stays;
use crate::cells::{Cell, CellError, CellFinder};
use crate::config::ConfigError;
use crate::fix::{Fix, FixQuality};
use crate::frame::Frame;

/// Largest change of the size, however long the cell was not seen, as a fraction.
const MOST_SIZE_CHANGE: f64 = 0.4;
/// Largest change of the surface from frame to frame, as a fraction, though the volume agrees: no cell stretches faster.
const MOST_JUMP: f64 = 0.2;
/// Share of a new fix in the running contrast of the body.
const FORGETTING: f64 = 0.01;
/// A region whose middle is within this share of the cell's width of the prediction cannot be another cell.
const OWN_WIDTHS: f64 = 0.25;

/// The cell chosen, or on the way to it.
#[derive(Debug, Clone, Copy)]
struct Chosen {
    motion: Motion,
    /// As it was seen last.
    cell: Cell,
    body_grey: f64,
    confirmed: u32,
    last_fix_s: f64,
    /// Frames since then.
    missed: u32,
}

/// What the tracker made of a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellStep {
    /// State, decision and place, as of a bead; in the fix amplitude is the contrast of the body.
    pub track: TrackStep,
    /// The cell, where its fix was taken.
    pub cell: Option<Cell>,
}

/// Tracks one cell. Allocates only when made.
#[derive(Debug, Clone)]
pub struct CellTracker {
    config: TrackerConfig,
    randomness: Randomness,
    finder: CellFinder,
    standing: Standing,
    stays: Stays,
    chosen: Option<Chosen>,
    aim: Option<(f64, f64)>,
}

impl CellTracker {
    /// A tracker that searches, with a finder that knows its background. Of the settings, those of a bead's template
    /// (residual, neighbours) are of no effect.
    ///
    /// # Errors
    /// Names the first setting that cannot be used.
    pub fn new(finder: CellFinder, config: TrackerConfig) -> Result<Self, ConfigError> {
        config.check()?;
        Ok(CellTracker {
            config,
            randomness: Randomness::of(&config),
            finder,
            standing: Standing::default(),
            stays: Stays::default(),
            chosen: None,
            aim: None,
        })
    }

    /// Outline (px) of a cell of the last frame; empty if it is not kept.
    pub fn outline(&self, cell: &Cell) -> &[(f64, f64)] {
        let same = |found: &Cell| (found.x_px, found.y_px) == (cell.x_px, cell.y_px);
        let number = self.finder.found().iter().position(same);
        number.map_or(&[], |k| self.finder.outline(k))
    }

    /// Where the tracker stands.
    pub fn state(&self) -> TrackState {
        self.standing.state
    }

    /// Forgets the cell and searches for the one nearest to `aim` (px), or for the most prominent without an aim.
    pub fn choose(&mut self, aim: Option<(f64, f64)>) {
        self.aim = aim;
        self.search_anew();
    }

    /// Forgets the cell and searches as at the start.
    pub fn search_anew(&mut self) {
        self.chosen = None;
        self.standing.state = TrackState::Searching;
    }

    /// Says that what is followed is no cell in the flow: it did not move with the PZT. It is not chosen again where it stands.
    pub fn reject(&mut self) {
        if let Some(chosen) = self.chosen {
            self.stays.add(&chosen.cell);
            self.search_anew();
        }
    }

    /// Takes in the frame exposed about `time_s`, with what was commanded since the frame before. Without a frame, or with a
    /// time that has not moved on, the prediction is carried on.
    ///
    /// # Errors
    /// The frame cannot be compared with the background: another size, or no background yet.
    pub fn step(
        &mut self,
        frame: Option<&Frame>,
        time_s: f64,
        commanded: impl Into<Commanded>,
    ) -> Result<CellStep, CellError> {
        let Commanded {
            flow_px_per_s,
            streak_px,
            exposure_s,
            ..
        } = commanded.into();
        if let Some(frame) = frame {
            let way_px = self
                .chosen
                .map_or(streak_px, |c| c.motion.way_px(streak_px, exposure_s));
            self.finder.expect_smear(way_px);
            self.finder.find(frame)?;
            self.finder.refresh(frame);
        }
        let (dt_s, time_s) = self.standing.elapse(time_s);
        if let Some(chosen) = &mut self.chosen {
            chosen.motion.predict(dt_s, flow_px_per_s, &self.randomness);
            chosen.missed = chosen.missed.saturating_add(1);
        }
        let before = self.chosen;
        let (decision, seen) = match (frame, self.chosen) {
            (None, _) => (Decision::NoFrame, None),
            (Some(_), _) if self.finder.is_cluttered() => (Decision::Ambiguous, None),
            (Some(_), None) => self.search(time_s),
            (Some(_), Some(chosen)) => self.follow(chosen, time_s),
        };
        if frame.is_some() {
            let (flow_x, flow_y) = flow_px_per_s;
            let followed = seen.as_ref().filter(|_| decision.is_accepted());
            let carried_px = (flow_x * dt_s, flow_y * dt_s);
            self.stays.see(self.finder.found(), carried_px, followed);
        }
        let sighted = |chosen: Chosen| Sighted {
            motion: chosen.motion,
            confirmed: chosen.confirmed >= self.config.confirm_frames,
            last_fix_s: chosen.last_fix_s,
        };
        let (before, now) = (before.map(sighted), self.chosen.map(sighted));
        let fix = seen.map(|cell| fix(&cell, decision));
        let limit_s = self.config.coast_limit_s;
        Ok(CellStep {
            track: self.standing.settle(decision, fix, before, now, limit_s),
            cell: seen.filter(|_| decision.is_accepted()),
        })
    }

    fn search(&mut self, time_s: f64) -> (Decision, Option<Cell>) {
        let cells = self.finder.found();
        let distance = |c: &Cell| match self.aim {
            Some((x, y)) => f64::hypot(c.x_px - x, c.y_px - y),
            // The largest sum of contrast comes first.
            None => 0.0,
        };
        let best = cells
            .iter()
            .filter(|c| !c.at_border && !c.in_contact && !self.stays.holds(c))
            .min_by(|a, b| distance(a).total_cmp(&distance(b)));
        let Some(cell) = best.copied() else {
            let seen = cells.first().copied();
            let decision = match seen {
                None => Decision::NothingFound,
                Some(cell) if cell.at_border => Decision::AtBorder,
                Some(cell) if self.stays.holds(&cell) => Decision::Stays,
                Some(_) => Decision::InContact,
            };
            return (decision, seen);
        };
        self.chosen = Some(Chosen {
            motion: Motion::new(&fix(&cell, Decision::Confirming)),
            cell,
            body_grey: cell.body_grey,
            confirmed: 1,
            last_fix_s: time_s,
            missed: 0,
        });
        if self.config.confirm_frames <= 1 {
            return (Decision::Accepted, Some(cell));
        }
        (Decision::Confirming, Some(cell))
    }

    fn follow(&mut self, chosen: Chosen, time_s: f64) -> (Decision, Option<Cell>) {
        let confirming = chosen.confirmed < self.config.confirm_frames;
        let cells = self.finder.found();
        let surprise = |c: &Cell| chosen.motion.surprise(&fix(c, Decision::Accepted));
        let distance2 = |c: &Cell| chosen.motion.distance2(&fix(c, Decision::Accepted));
        let agreeing = || {
            cells
                .iter()
                .filter(|c| self.misfit(&chosen, c, &distance2).is_none())
        };
        let best = agreeing().min_by(|a, b| surprise(a).total_cmp(&surprise(b)));
        let Some(cell) = best.copied() else {
            let nearest = cells
                .iter()
                .min_by(|a, b| distance2(a).total_cmp(&distance2(b)))
                .copied();
            let decision = nearest
                .and_then(|c| self.misfit(&chosen, &c, &distance2))
                .unwrap_or(Decision::NothingFound);
            if confirming {
                // Not a cell that stays: search again with the next frame.
                self.chosen = None;
            }
            return (decision, nearest);
        };
        let rival = agreeing()
            .filter(|c| **c != cell)
            .map(surprise)
            .min_by(f64::total_cmp);
        if rival.is_some_and(|rival| rival - surprise(&cell) < self.config.certainty) {
            return (Decision::Ambiguous, Some(cell));
        }
        let mut taken = chosen;
        let decision = match self.standing.state {
            _ if confirming => {
                taken.confirmed += 1;
                if taken.confirmed < self.config.confirm_frames {
                    Decision::Confirming
                } else {
                    Decision::Accepted
                }
            }
            TrackState::Tracking | TrackState::Searching => Decision::Accepted,
            TrackState::Coasting => Decision::Regained,
            TrackState::Lost => Decision::Reacquired,
        };
        if decision == Decision::Reacquired {
            taken.motion = Motion::new(&fix(&cell, decision));
        } else {
            taken.motion.update(&fix(&cell, decision));
        }
        taken.body_grey += FORGETTING * (cell.body_grey - taken.body_grey);
        (taken.cell, taken.last_fix_s, taken.missed) = (cell, time_s, 0);
        self.chosen = Some(taken);
        (decision, Some(cell))
    }

    /// Why a region is not the cell; `None` when it may be.
    fn misfit(
        &self,
        chosen: &Chosen,
        cell: &Cell,
        distance2: &impl Fn(&Cell) -> f64,
    ) -> Option<Decision> {
        if cell.at_border {
            return Some(Decision::AtBorder);
        }
        if self.stays.holds(cell) {
            return Some(Decision::Stays);
        }
        let (x, y) = chosen.motion.position();
        let own_px = OWN_WIDTHS * chosen.cell.axes_px().1;
        let near = f64::hypot(cell.x_px - x, cell.y_px - y)
            <= own_px.max(self.config.least_gate_px)
            || distance2(cell) <= self.config.gate_sigma * self.config.gate_sigma;
        if !near && self.standing.state != TrackState::Lost {
            // A larger region over the prediction holds the cell and something else.
            let over = f64::abs(cell.x_px - x) < 0.5 * cell.extent_px((1.0, 0.0))
                && f64::abs(cell.y_px - y) < 0.5 * cell.extent_px((0.0, 1.0));
            return Some(if !over || sizes(cell, &chosen.cell).0 <= 0.0 {
                Decision::OutsideGate
            } else if cell.in_contact {
                Decision::InContact
            } else {
                Decision::Merged
            });
        }
        // As large as before and of another shape it is still the cell: one that is pressed into a constriction.
        let touched = |other: Decision| {
            if cell.in_contact {
                Decision::InContact
            } else {
                other
            }
        };
        let body = cell.body_grey / chosen.body_grey - 1.0;
        if body.abs() > self.config.max_amplitude_change {
            return Some(touched(Decision::OtherBead));
        }
        let allowed = (f64::from(chosen.missed.max(1)) * (1.0 + self.config.max_size_change).ln())
            .min((1.0 + MOST_SIZE_CHANGE).ln());
        let (surface, volume) = sizes(cell, &chosen.cell);
        let jump = f64::from(chosen.missed.max(1)) * (1.0 + MOST_JUMP).ln();
        if surface.abs().min(volume.abs()) <= allowed && surface.abs() <= jump {
            None
        } else if surface > 0.0 {
            Some(touched(Decision::Merged))
        } else {
            Some(touched(Decision::OtherBead))
        }
    }
}

/// Logarithms of surface and volume (of a body of revolution) over those of another.
fn sizes(cell: &Cell, other: &Cell) -> (f64, f64) {
    let surface = (cell.area_px / other.area_px).ln();
    (
        surface,
        surface + (cell.axes_px().1 / other.axes_px().1).ln(),
    )
}

/// The cell's place as a fix.
fn fix(cell: &Cell, decision: Decision) -> Fix {
    Fix {
        x_px: cell.x_px,
        y_px: cell.y_px,
        var_x_px2: cell.var_x_px2,
        var_y_px2: cell.var_y_px2,
        cov_xy_px2: cell.cov_xy_px2,
        amplitude: cell.body_grey,
        background: 0.0,
        residual_ratio: f64::NAN,
        snr: cell.snr,
        range_used: 0.0,
        verdict: match decision {
            Decision::Merged | Decision::InContact => FixQuality::BadFit,
            _ if cell.at_border => FixQuality::AtBorder,
            _ => FixQuality::Good,
        },
    }
}
