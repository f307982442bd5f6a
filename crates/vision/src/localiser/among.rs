//! All beads of a frame: each is fitted in a window from which the images of its neighbours are taken off.
//!
//! Taking off what was fitted and fitting again converges to the fit of all beads together, at the price of single fits.

use super::Localiser;
use super::view::{Others, View};
use crate::fit::Image;
use crate::fix::{Fix, FixQuality, squared};
use crate::frame::Frame;
use crate::reach::extent_px;
use crate::streak::Comb;

/// Share of a bead's contrast below which a bad fit next to it is no bead.
const LEAST_SHARE: f64 = 0.3;
/// Rounds in which fits and images taken off improve each other; the last one counts. The error falls by the overlap each time.
const ROUNDS: usize = 3;

impl Localiser {
    /// Position of a bead at a place (px) where none was. Unless the narrow window shows one now, nothing else is tried:
    /// [`Localiser::locate`] tries up to four times.
    pub(crate) fn locate_where_none_was(&mut self, frame: &Frame, place_px: (f64, f64)) -> Fix {
        self.residues.begin_frame();
        let view = View::of(frame);
        let side_px = self.narrow_px().min(self.config.window_px);
        let fix = self.attempt(&view, place_px, side_px);
        if fix.verdict == FixQuality::Good {
            return self.locate_in(&view, place_px);
        }
        fix
    }

    /// Positions of all beads near the places given (px), into `fixes`: one a bead, of any verdict. Beads whose images overlap are
    /// fitted together.
    pub fn locate_all(
        &mut self,
        frame: &Frame,
        places: impl Iterator<Item = (f64, f64)> + Clone,
        fixes: &mut Vec<Fix>,
    ) {
        self.residues.begin_frame();
        fixes.clear();
        let mut drafted = Vec::new();
        let radius_px = self.template.radius_px();
        let template = &self.template;
        let profile = |r_px: f64| f64::from(template.value_at_squared((r_px * r_px) as f32));
        let snr = self.snr.usual().unwrap_or(f64::INFINITY);
        let reach_px = 2.0 * extent_px(profile, template.support_px(), snr);
        for (n, (x, y)) in places.clone().enumerate() {
            let alone = places
                .clone()
                .enumerate()
                .all(|(m, (u, v))| m == n || squared(u - x, v - y) > reach_px * reach_px);
            let view = View {
                is_draft: !alone,
                ..View::of(frame)
            };
            // What stands beside one bead says nothing of another.
            self.narrow_fixes = 0;
            let fix = self.locate_in(&view, (x, y));
            let apart =
                |f: &Fix| squared(f.x_px - fix.x_px, f.y_px - fix.y_px) >= radius_px * radius_px;
            if fixes.iter().all(apart) {
                fixes.push(fix);
                drafted.push(!alone);
            }
        }
        for round in 1..=ROUNDS {
            for k in 0..fixes.len() {
                let own = fixes[k];
                let near = |f: &Fix| {
                    let off_px2 = squared(f.x_px - own.x_px, f.y_px - own.y_px);
                    off_px2 > 0.0 && off_px2 <= reach_px * reach_px
                };
                // Two beads may each be a bad fit because of the other; a much weaker one is no bead.
                let is_bead = |f: &&Fix| {
                    f.verdict == FixQuality::Good
                        || f.verdict == FixQuality::BadFit
                            && f.amplitude / own.amplitude > LEAST_SHARE
                };
                if !drafted[k] {
                    continue;
                }
                let mut others = Others::default();
                fixes
                    .iter()
                    .filter(is_bead)
                    .filter(|f| near(f))
                    .for_each(|f| others.add(f));
                let view = View {
                    others,
                    is_draft: round < ROUNDS,
                    ..View::of(frame)
                };
                self.narrow_fixes = 0;
                let fix = self.locate_in(&view, (own.x_px, own.y_px));
                let off_px = f64::hypot(fix.x_px - own.x_px, fix.y_px - own.y_px);
                if off_px < radius_px || round == ROUNDS {
                    fixes[k] = fix;
                }
            }
        }
        let mut kept = 0;
        for k in 0..fixes.len() {
            let fix = fixes[k];
            let same =
                |f: &Fix| squared(f.x_px - fix.x_px, f.y_px - fix.y_px) < radius_px * radius_px;
            if !fixes[..kept].iter().any(same) {
                fixes[kept] = fix;
                kept += 1;
            }
        }
        fixes.truncate(kept);
    }

    /// Copies a window, without the neighbours' images.
    pub(super) fn take_crop(&mut self, view: &View, x_px: f64, y_px: f64, side_px: usize) -> bool {
        if !self.crop.take(view.frame, x_px, y_px, side_px) {
            return false;
        }
        for (x_px, y_px, contrast) in view.others.beads() {
            let lanes_end = self.crop.lanes_end();
            let mut image = Image::new(lanes_end);
            let x = (x_px - self.crop.x0 as f64) as f32;
            let y = (y_px - self.crop.y0 as f64) as f32;
            let height = self.crop.height;
            for (j, row) in self.crop.rows.iter_mut().enumerate().take(height) {
                image.draw_row(&self.template, &Comb::STILL, x, j as f32 - y);
                for (v, f) in row.iter_mut().zip(&image.value).take(lanes_end) {
                    *v -= *contrast as f32 * f;
                }
            }
        }
        true
    }
}
