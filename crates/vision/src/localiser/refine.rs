//! The steps after the first fit: specks are left out, and rising light and another focus are fitted if the window asks for them.

use super::judge::WIDENED_RATIO;
use super::rise::Rise;
use super::view::View;
use super::{Fitted, Localiser, MAX_RECENTRES};
use crate::beyond;
use crate::dust::{self, Bill, Both, Speck};
use crate::fit::Pass;
use crate::fix::Fix;
use crate::left::{self, Left};
use crate::speckle;

/// How often specks are searched in the residual of a fit: each time those at least half as strong as the strongest are left out.
const MOST_LOOKS_FOR_SPECKS: usize = 5;

/// Standard deviations of the sum of squares from which specks beside the bead are looked for.
const LEAST_EXCESS: f64 = 3.0;
/// Least share of a fit's excess residual that offsets of the lines must explain to count.
const LEAST_OF_LINES: f64 = 0.5;

impl Localiser {
    /// The fit without specks, with the light's slope and the size where a test finds them.
    pub(super) fn refine(
        &mut self,
        view: &View,
        first: Option<Fitted>,
        guess: (f64, f64),
        side_px: usize,
    ) -> Option<Fitted> {
        let mut fitted = first;
        let mut left = fitted.as_ref().map(|f| self.left_by(f));
        let noise = self.noise_variance.unwrap_or(1.0).sqrt() as f32;
        if left.is_none_or(|l| l.strongest > speckle::LEAST_LEFT_SIGMA * noise) {
            // A speck may have drawn the fit to itself: those that show without the bead go first, in every window.
            self.cleans = true;
            if speckle::clean(&mut self.crop, noise) > 0
                && self.take_window(view, guess.0, guess.1, side_px)
            {
                fitted = self.fit(view, guess, side_px, MAX_RECENTRES);
                if !self.comb.is_still() {
                    fitted = self.fit_length(view, fitted, side_px);
                }
                left = fitted.as_ref().map(|f| self.left_by(f));
            }
        }
        for _ in 0..MOST_LOOKS_FOR_SPECKS {
            let (f, l) = (fitted.as_ref()?, left?);
            let brightest =
                f.pass.background + f.pass.amplitude.max(0.0) + f64::from(self.crop.pedestal);
            let noise = self.pixel_variance(brightest).sqrt() as f32;
            let (at, background) = ((f.x_px, f.y_px), f.pass.background);
            let found = speckle::leave_out(
                &mut self.crop,
                background,
                noise,
                self.residues.left.as_slice(),
                l.strongest,
            );
            if found == 0 {
                break;
            }
            // The window stays: a new one would have the specks again.
            fitted = self.fit(view, at, side_px, 0);
            left = fitted.as_ref().map(|f| self.left_by(f));
        }
        let mut f = Fitted {
            left: left?,
            ..fitted?
        };
        if !view.is_draft && self.comb.is_still() {
            f = self.without_specks(f, side_px);
        }
        let l = f.left;
        let level = f.pass.background + f64::from(self.crop.pedestal);
        // If the residual is wider or larger than noise, its score is, too.
        let asked = l.asks(self.pixel_variance(level) * self.widened.mean.max(1.0));
        if !asked.slopes && !asked.size {
            return Some(f);
        }
        // What is no bead without them must not become one by more parameters.
        if !self.is_certain(&f.pass, (f.x_px, f.y_px), 1.0) {
            return Some(f);
        }
        let weights = self.weights(Some(&f.pass));
        let pixels = (self.crop.width * self.crop.height) as f64;
        let misfit = f.pass.chi2 - self.weight_unit() * (pixels - 4.0);
        let start = ((f.x_px, f.y_px), f.pass.chi2, misfit);
        let found = beyond::fit(
            &mut self.crop,
            &mut self.template,
            &self.comb,
            start,
            weights,
            asked,
        );
        let Some((x_px, y_px, pass, slope)) = found else {
            return Some(f);
        };
        let rise = Rise {
            slope,
            way_px2: [0.0; 2],
        };
        let mut found = Fitted {
            x_px,
            y_px,
            pass,
            rise,
            ..f
        };
        if asked.slopes {
            let doubt = self.doubt(&found, f.pass.chi2 - found.pass.chi2);
            found.rise.way_px2 = [x_px - f.x_px, y_px - f.y_px].map(|way| doubt * way * way);
        }
        Some(Fitted {
            left: self.left_by(&found),
            ..found
        })
    }

    /// What a fit of rising light leaves, over what it has explained: the light's shape is known to that part. What is the same all round
    /// is the bead's, not the light's, and chance says nothing either.
    fn doubt(&mut self, f: &Fitted, explained: f64) -> f64 {
        let at = (f.x_px, f.y_px);
        let parts = (f.pass.amplitude, f.pass.background);
        let left = self
            .residues
            .lopsided(&self.crop, &self.template, &self.comb, at, parts);
        let noise = self.pixel_variance(f.pass.background + f64::from(self.crop.pedestal));
        let pixels = (self.crop.width * self.crop.height) as f64;
        let beyond = (left / noise - 1.0) * pixels - LEAST_EXCESS * (2.0 * pixels).sqrt();
        let explained = explained / self.weight_unit();
        if explained > 0.0 {
            beyond.max(0.0) / explained
        } else {
            0.0
        }
    }

    /// The fit without the light of specks beside the bead, if what is left then is noise. Else the window is as it was: a wall or a
    /// third speck is not explained by an ellipse, and bends it. One of two specks may not pay its price while the light of the other
    /// is left: then the two pay together.
    fn without_specks(&mut self, first: Fitted, side_px: usize) -> Fitted {
        let Some((one, speck, bill)) = self.with_speck(&first) else {
            return first;
        };
        let is_paid =
            |this: &Self, bill: &Bill| bill.is_paid(&this.crop, this.template.radius_px());
        let pays = is_paid(self, &bill);
        let second = self.with_speck(&one);
        // For a contrast of 1.
        let covariance = |pass: &Pass| pass.covariance * (pass.amplitude * pass.amplitude);
        let by_first = covariance(&one.pass) - covariance(&first.pass);
        let mut last = pays.then_some(one);
        let mut specks = [Some(speck), None];
        if let Some((mut two, other, own)) = second {
            // The first one's light is as uncertain as before: the last fit has taken it for known.
            if by_first.diagonal().min() > 0.0 {
                two.pass.covariance += by_first / (two.pass.amplitude * two.pass.amplitude);
            }
            if is_paid(self, &if pays { own } else { bill.and(&own) }) {
                (last, specks[1]) = (Some(two), Some(other));
            } else {
                other.put_back(&mut self.crop);
            }
        }
        if let Some(last) = last
            && self.leaves_noise(&last)
        {
            if side_px == self.config.window_px {
                self.read_noise_beside(&last);
            }
            return last;
        }
        for speck in specks.iter().flatten() {
            speck.put_back(&mut self.crop);
        }
        first
    }

    /// The fit of a bead together with a speck beside it, whose light is taken off the window, and what the speck explains.
    fn with_speck(&mut self, f: &Fitted) -> Option<(Fitted, Speck, Bill)> {
        let variance = self.least_variance(f);
        let own = self.pixel_variance(f.pass.background + f64::from(self.crop.pedestal));
        let unit = self.weight_unit() * variance / own;
        let pixels = (self.crop.width * self.crop.height) as f64;
        let before = f.pass.chi2 / unit;
        // What chance leaves moves the bead by less than its own noise.
        let chance = pixels + LEAST_EXCESS * (2.0 * pixels).sqrt();
        if before < chance {
            return None;
        }
        let place = (f.x_px - self.crop.x0 as f64, f.y_px - self.crop.y0 as f64);
        self.residues
            .take_off_mean(&self.crop, (place.0 as f32, place.1 as f32));
        let radius_px = self.template.radius_px();
        let left = self.residues.left.as_slice();
        let noise = variance.sqrt() as f32;
        let first = Speck::seen(&self.crop, left, place, radius_px, noise)?;
        let weights = self.weights(Some(&f.pass));
        let at = (f.x_px, f.y_px);
        let fit = |speck| dust::fit(&self.crop, &self.template, at, speck, weights);
        let mut both = fit(first);
        if both.as_ref().is_none_or(|b| b.pass.chi2 / unit > chance) {
            // A speck whose end is seen at the bead looks as wide as the bead's edge: a fit from there may end as a line along the edge.
            let other = fit(first.rounded());
            let is_better = |o: &Both| both.as_ref().is_none_or(|b| o.pass.chi2 < b.pass.chi2);
            both = other.filter(is_better).or(both);
        }
        let both = both?;
        both.speck.take_off(&mut self.crop);
        let parts = (both.pass.amplitude, both.pass.background);
        let left =
            self.residues
                .lopsided(&self.crop, &self.template, &self.comb, both.place_px, parts);
        let bill = Bill {
            specks: 1,
            gain: before - both.pass.chi2 / unit,
            lopsided: left / variance,
            other: f.left.explained_by_slope_and_size() / variance,
        };
        let (x_px, y_px) = both.place_px;
        let found = Fitted {
            x_px,
            y_px,
            pass: both.pass,
            converged: f.converged,
            rise: f.rise,
            left: f.left,
        };
        let left = self.left_by(&found);
        Some((Fitted { left, ..found }, both.speck, bill))
    }

    /// Whether what a fit leaves is noise, besides its mean all round.
    fn leaves_noise(&mut self, f: &Fitted) -> bool {
        let variance = self.least_variance(f);
        let at = (f.x_px, f.y_px);
        let parts = (f.pass.amplitude, f.pass.background);
        let left = self
            .residues
            .lopsided(&self.crop, &self.template, &self.comb, at, parts);
        left <= WIDENED_RATIO * variance
    }

    /// Noise variance of a pixel at a fit's level, grey^2. A speck at the border counts as noise there: the last windows tell it better.
    fn least_variance(&self, f: &Fitted) -> f64 {
        let own = self.pixel_variance(f.pass.background + f64::from(self.crop.pedestal));
        self.usual_noise().unwrap_or(own).min(own)
    }

    /// Widens a good fix's covariance by the offsets that rows and columns have had in the last fixes, and takes in this one's.
    pub(super) fn add_lines(&mut self, fix: &mut Fix, left: &Left) {
        let variance = self.pixel_variance(fix.background);
        let excess = left.lines.map(|lines| lines.excess(variance));
        // What a template leaves differs from line to line, too, but by little of all that it leaves.
        let beyond_noise = (fix.residual_ratio - 1.0) * variance;
        let explained = excess[0].max(0.0) + excess[1].max(0.0);
        if fix.residual_ratio > WIDENED_RATIO && explained < LEAST_OF_LINES * beyond_noise {
            return;
        }
        for (pool, excess) in self.lines.iter_mut().zip(excess) {
            pool.take_in(excess);
        }
        let [rows, columns] = self.lines.map(|pool| pool.mean.max(0.0));
        fix.var_y_px2 += rows * left.lines[0].moves;
        fix.var_x_px2 += columns * left.lines[1].moves;
    }

    /// What a fit leaves of the window.
    fn left_by(&mut self, f: &Fitted) -> Left {
        left::examine(
            &self.crop,
            &self.template,
            &self.comb,
            (f.x_px, f.y_px),
            (f.pass.amplitude, f.pass.background),
            self.residues.left.as_mut_slice(),
        )
    }
}
