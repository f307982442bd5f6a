//! Position of one bead in a frame: seed, template fit, covariance, verdict.

mod alike;
mod among;
mod certainty;
mod judge;
mod noise;
mod refine;
mod rise;
mod together;
mod view;

pub use together::{Start, Together};

use crate::config::{ConfigError, LocaliserConfig};
use crate::crop::Crop;
use crate::fit::{self, Pass};
use crate::fix::{Fix, FixQuality};
use crate::frame::Frame;
use crate::learn::{Learner, LearningReport};
use crate::left::Left;
use crate::pool::{Pool, Scales};
use crate::residue::Residues;
use crate::seed;
use crate::speckle;
use crate::streak::{Comb, Way};
use crate::template::Template;
use alike::Alike;
use rise::Rise;
use view::View;

/// A step below this ends the fit, px: what is left after it is of second order in it.
const CONVERGED_PX: f64 = 0.01;
/// Windows centred further than this from the fit are taken anew, px.
const RECENTRE_PX: f64 = 1.0;
/// How often the window may be taken anew.
const MAX_RECENTRES: u32 = 4;
/// Half-width in bead radii of the window that leaves neighbours out.
const NARROW_RADII: f64 = 1.3;
/// Fixes that begin with the narrow window after one in which the whole was no good: something stands beside the bead, and one in so many
/// asks whether it still does.
const NARROW_FIXES: u32 = 32;
/// Steps in the length of a streak per fit.
const STRETCHES: usize = 2;
/// A streak's length is looked for within this factor of the expected one.
const MOST_STRETCH: f64 = 2.5;
/// Relative difference of the lengths of the secant.
const SECANT: f64 = 0.1;

/// Localises one bead per call. Buffers are made in [`Localiser::new`]; [`Localiser::locate`] allocates nothing.
///
/// The position is the weighted least-squares fit of the template over the whole window in four parameters (x, y,
/// amplitude, background), which reaches the Cramer-Rao bound; the covariance is that bound, widened by what the template
/// leaves of the window where that is more than noise.
#[derive(Debug, Clone)]
pub struct Localiser {
    config: LocaliserConfig,
    template: Template,
    crop: Crop,
    sign: f64,
    /// Noise variance of a pixel in force, grey^2; `None` before the first frame.
    noise_variance: Option<f64>,
    /// That of the window at hand with its degrees of freedom, and those of the last good fixes.
    noise_here: (f64, f64),
    noises: Scales,
    learner: Option<Learner>,
    /// Way of the bead during the exposure, expected and in use (px).
    streak: Way,
    comb: Comb,
    /// What the template leaves of the beads' windows.
    residues: Residues,
    /// So many fixes more begin with the narrow window.
    narrow_fixes: u32,
    /// Whether specks that show without knowing the bead are replaced in the windows of this fix.
    cleans: bool,
    /// How much of what may be lopsided was in the last fit that was asked.
    lopsided: f64,
    /// What light that falls unevenly on the bead moves it by: see [`judge::shading_px2`].
    shading_px2: f64,
    /// How much of a window the bead fills: the whole window, and the narrow one.
    filled: [f64; 2],
    /// Variance where the place is read off, over that of the noise; and of the offsets of rows and columns, grey^2.
    local: Scales,
    /// By how much errors of neighbours that are alike scatter the place more than white noise.
    alike: Alike,
    lines: [Pool; 2],
    /// What the last fixes were widened by, and their residual ratios.
    widened: Pool,
    ratio: Scales,
    /// Contrast of the last good fixes over the noise of a pixel.
    snr: Pool,
    /// Share of the beads' contrast in their windows that the last fixes left unexplained.
    unexplained: Pool,
    /// How much the pictures of beads that the template fits badly answer to a motion: see [`Residues::besides_the_mean`].
    answers: Pool,
    /// Pixels of beads drawn by fits.
    drawn_px: u64,
}

/// A fit at rest or given up.
struct Fitted {
    x_px: f64,
    y_px: f64,
    pass: Pass,
    converged: bool,
    /// Light that rises across the window, where it was fitted.
    rise: Rise,
    /// What it leaves, where that was looked at.
    left: Left,
}

impl Fitted {
    fn of((x_px, y_px): (f64, f64), pass: Pass, converged: bool) -> Self {
        Fitted {
            x_px,
            y_px,
            pass,
            converged,
            left: Left::default(),
            rise: Rise::default(),
        }
    }
}

impl Localiser {
    /// Makes the buffers and the template.
    ///
    /// # Errors
    /// Names the first setting that cannot be used.
    pub fn new(config: LocaliserConfig) -> Result<Self, ConfigError> {
        let template = config.template()?;
        let sign = config.polarity.sign();
        let learner = config
            .learning
            .map(|l| Learner::new(l, config.window_px, &template));
        let alike = Alike::new(&template, config.window_px);
        let filled = judge::filled(&template, config.window_px);
        let shading_px2 = judge::shading_px2(&template, config.window_px);
        Ok(Localiser {
            config,
            template,
            crop: Crop::new(),
            sign,
            noise_variance: None,
            noise_here: (1.0, 1.0),
            noises: Scales::default(),
            learner,
            streak: Way::default(),
            comb: Comb::STILL,
            residues: Residues::new(),
            narrow_fixes: 0,
            cleans: false,
            lopsided: 0.0,
            shading_px2,
            filled,
            local: Scales::default(),
            alike,
            lines: [Pool::default(); 2],
            widened: Pool::default(),
            ratio: Scales::default(),
            snr: Pool::default(),
            unexplained: Pool::default(),
            answers: Pool::default(),
            drawn_px: 0,
        })
    }

    /// Makes room to remember how so many beads look: what stays of a bead's look does not scatter its position.
    pub fn remember_beads(&mut self, beads: usize) {
        self.residues.reserve(beads);
    }

    /// The settings.
    pub fn config(&self) -> &LocaliserConfig {
        &self.config
    }

    /// The template in use.
    pub fn template(&self) -> &Template {
        &self.template
    }

    /// Pixels of beads that fits have drawn so far: nearly all the time of a fix is theirs, on any machine.
    pub fn drawn_px(&self) -> u64 {
        self.drawn_px
    }

    /// Counts a pass over the window with a number of beads in it.
    fn count_pass(&mut self, beads: usize) {
        let pixels = self.crop.width * self.crop.height;
        self.drawn_px += (pixels * beads * self.comb.teeth()) as u64;
    }

    /// 1 for bright cores, -1 for dark ones.
    pub fn sign(&self) -> f64 {
        self.sign
    }

    /// How far the learning of the template has come.
    pub fn learning(&self) -> LearningReport {
        self.learner
            .as_ref()
            .map(Learner::report)
            .unwrap_or_default()
    }

    /// Says how far beads go while the next frames are exposed, from the start to the end of an exposure (px); noughts for
    /// beads at rest. The length is a start value, refined by the fit; the direction is taken as it is.
    pub fn expect_streak(&mut self, way_px: (f64, f64)) {
        self.streak.whole_px = way_px;
        self.comb = Comb::new(self.streak, self.template.radius_px());
    }

    /// Says how much further they go in the second half of an exposure than in the first (px): a command takes effect meanwhile.
    pub fn expect_turn(&mut self, turn_px: (f64, f64)) {
        self.streak.turn_px = turn_px;
        self.comb = Comb::new(self.streak, self.template.radius_px());
    }

    /// Position of the bead nearest to `guess` (px), or of the strongest in the frame when there is no guess.
    ///
    /// A fix whose verdict is not [`FixQuality::Good`] carries what was found, for the record; it must not be used as a
    /// position.
    pub fn locate(&mut self, frame: &Frame, guess: Option<(f64, f64)>) -> Fix {
        self.residues.begin_frame();
        let radius_px = self.template.radius_px();
        let start =
            guess.or_else(|| seed::strongest(frame, self.sign, radius_px, self.config.min_snr));
        let Some((x_px, y_px)) = start else {
            return Fix::none(0.0, 0.0, FixQuality::NoSignal);
        };
        self.locate_in(&View::of(frame), (x_px, y_px))
    }

    /// Side of the window that just holds the bead, px.
    fn narrow_px(&self) -> usize {
        2 * (NARROW_RADII * self.template.radius_px()).ceil() as usize + 1
    }

    /// Position of the bead nearest to a place (px).
    fn locate_in(&mut self, view: &View, (x_px, y_px): (f64, f64)) -> Fix {
        let radius_px = self.template.radius_px();
        let window_px = self.config.window_px;
        let narrow_px = self.narrow_px();
        let narrow_first = self.narrow_fixes > 0 && narrow_px < window_px;
        if narrow_first {
            self.narrow_fixes -= 1;
            let fix = self.attempt(view, (x_px, y_px), narrow_px);
            if fix.verdict == FixQuality::Good {
                return fix;
            }
        }
        let fix = self.attempt(view, (x_px, y_px), window_px);
        if fix.verdict == FixQuality::Good && !view.is_draft {
            self.learn(&fix);
        }
        if matches!(fix.verdict, FixQuality::Good | FixQuality::AtBorder) {
            return fix;
        }
        // A neighbour may have come into the window's corner: once more with a window that just holds the bead.
        if narrow_px < window_px && !narrow_first {
            let again = self.attempt(view, (x_px, y_px), narrow_px);
            if again.verdict == FixQuality::Good {
                // Only whole windows are learnt from.
                if self.learner.is_none() && !view.is_draft {
                    self.narrow_fixes = NARROW_FIXES;
                }
                return again;
            }
        }
        // It may be out of focus, or blurred.
        if fix.verdict == FixQuality::BadFit {
            let pardoning = View {
                pardons: true,
                ..*view
            };
            let again = self.attempt(&pardoning, (x_px, y_px), window_px);
            if again.verdict == FixQuality::Good {
                return again;
            }
        }
        // The guess may have been out of the fit's reach: once more from the centroid.
        if !self.take_crop(view, x_px, y_px, window_px) {
            return fix;
        }
        let Some(centroid) = self.crop.centroid(self.sign as f32, radius_px) else {
            return fix;
        };
        let again = self.attempt(view, centroid, window_px);
        if matches!(again.verdict, FixQuality::Good | FixQuality::AtBorder) {
            again
        } else {
            fix
        }
    }

    /// Size of the bead of the last fix relative to the template, and its standard deviation: the template's scale fitted
    /// beside amplitude and background at the fix's position. Valid near 1, for telling beads apart; `None` when the
    /// fix was not from this window, or of a streak.
    pub fn relative_size(&self, fix: &Fix) -> Option<(f64, f64)> {
        if !self.comb.is_still() {
            return None;
        }
        let variance = self.noise_variance.unwrap_or(1.0);
        let (change, sd) = fit::scale(&self.crop, &self.template, fix.x_px, fix.y_px, variance)?;
        let size = self.template.size();
        Some((size * (1.0 + change), size * sd))
    }

    /// Copies a window.
    fn take_window(&mut self, view: &View, x_px: f64, y_px: f64, side_px: usize) -> bool {
        let taken = self.take_crop(view, x_px, y_px, side_px);
        if taken
            && self.cleans
            && let Some(variance) = self.noise_variance
        {
            speckle::clean(&mut self.crop, variance.sqrt() as f32);
        }
        taken
    }

    fn attempt(&mut self, view: &View, (x_px, y_px): (f64, f64), side_px: usize) -> Fix {
        self.comb = Comb::new(self.streak, self.template.radius_px());
        self.template.stretch_to(1.0);
        self.cleans = false;
        self.lopsided = 0.0;
        if !self.take_window(view, x_px, y_px, side_px) {
            return Fix::none(x_px, y_px, FixQuality::AtBorder);
        }
        let mut fitted = self.fit(view, (x_px, y_px), side_px, MAX_RECENTRES);
        // The noise is read off the border of a whole window that holds one bead in its middle; anywhere else edges
        // would count as noise.
        let whole = side_px == self.config.window_px && self.comb.is_still();
        if whole || self.noise_variance.is_none() {
            self.read_noise();
        }
        if !self.comb.is_still() {
            fitted = self.fit_length(view, fitted, side_px);
        } else if !whole {
            self.explain_noise(fitted.as_ref(), false);
        }
        let fitted = self.refine(view, fitted, (x_px, y_px), side_px);
        if whole {
            self.explain_noise(fitted.as_ref(), true);
            if !view.is_draft {
                self.keep_noise();
            }
        }
        let found = fitted.as_ref().map(|f| f.pass);
        let left = fitted.as_ref().map_or(Left::default(), |f| f.left);
        let rise = fitted.as_ref().map_or(Rise::default(), |f| f.rise);
        let mut fix = self.judge(view.frame, fitted, (x_px, y_px));
        if fix.verdict == FixQuality::BadFit && view.pardons {
            self.pardon(view.frame, &mut fix);
        }
        if view.is_draft {
            return fix;
        }
        let widening = self.widen(&mut fix, &left);
        self.add_rise(&mut fix, &rise);
        if fix.verdict == FixQuality::Good
            && !found.is_some_and(|p| self.is_certain(&p, (fix.x_px, fix.y_px), widening))
        {
            fix.verdict = FixQuality::NoSignal;
        }
        if fix.verdict == FixQuality::Good && self.has_rival(&fix, &left, widening) {
            fix.verdict = FixQuality::BadFit;
        }
        if let Some(pass) = found.filter(|_| fix.verdict == FixQuality::Good) {
            let variance = self.weight_unit() * widening * pass.amplitude_variance;
            fix.range_used = self.range_used(&fix, variance.sqrt());
        }
        if fix.verdict == FixQuality::Good && self.comb.is_still() {
            self.widened.take_in(widening);
            self.snr.take_in(fix.snr);
        }
        fix
    }

    /// Refines the length of a streak beside the position. By symmetry the two do not depend on each other, so that they
    /// are fitted in turn.
    fn fit_length(&mut self, view: &View, first: Option<Fitted>, side_px: usize) -> Option<Fitted> {
        let (mut fitted, mut factor) = (first?, 1.0);
        for _ in 0..STRETCHES {
            let bead = [(fitted.x_px, fitted.y_px, 1.0)];
            let Some(better) = self.stretched(factor, bead.into_iter()) else {
                break;
            };
            factor = better;
            fitted = self.fit(view, (fitted.x_px, fitted.y_px), side_px, MAX_RECENTRES)?;
        }
        Some(fitted)
    }

    /// Takes a better length of the streak for the beads in the window (x, y, contrast) into use: the factor of the expected
    /// length, from the factor in use.
    fn stretched(
        &mut self,
        factor: f64,
        beads: impl Iterator<Item = (f64, f64, f64)> + Clone,
    ) -> Option<f64> {
        let radius_px = self.template.radius_px();
        let streak = self.streak;
        let of = |factor: f64| Comb::new(streak.times(factor), radius_px);
        let (shorter, longer) = (of(factor * (1.0 - SECANT)), of(factor * (1.0 + SECANT)));
        let change = fit::stretch(&self.crop, &self.template, &shorter, &longer, beads)?;
        let better =
            (factor * (1.0 + 2.0 * SECANT * change)).clamp(1.0 / MOST_STRETCH, MOST_STRETCH);
        self.comb = of(better);
        Some(better)
    }

    fn learn(&mut self, fix: &Fix) {
        // A streak would blur what is learnt.
        if !self.comb.is_still() {
            return;
        }
        let Some(learner) = &mut self.learner else {
            return;
        };
        let background = fix.background - f64::from(self.crop.pedestal);
        if learner.take_in(&self.crop, (fix.x_px, fix.y_px), fix.amplitude, background) {
            learner.refresh(&mut self.template);
            self.alike.learn(&self.template, self.config.window_px);
            self.filled = judge::filled(&self.template, self.config.window_px);
            self.shading_px2 = judge::shading_px2(&self.template, self.config.window_px);
        }
    }

    /// Until the first template is learnt, as much is tolerated as learning may change: it could not start otherwise.
    fn template_tolerance(&self) -> f64 {
        let configured = self.config.template_tolerance;
        match &self.learner {
            Some(l) if l.is_first() => configured.max(l.max_change()),
            _ => configured,
        }
    }

    fn fit(
        &mut self,
        view: &View,
        (x_px, y_px): (f64, f64),
        side_px: usize,
        max_recentres: u32,
    ) -> Option<Fitted> {
        let shot = self.has_shot_noise();
        let reach_px = 0.4 * self.template.radius_px();
        let (mut x_px, mut y_px) = (x_px, y_px);
        let mut before: Option<Pass> = None;
        let mut recentres = 0;
        for n in 1..=self.config.max_passes {
            self.count_pass(1);
            let pass = fit::pass(
                &self.crop,
                &self.template,
                &self.comb,
                (x_px, y_px),
                self.weights(before.as_ref()),
            )?;
            let length = f64::hypot(pass.step_x_px, pass.step_y_px);
            // Steps are kept within the template's range of attraction.
            let scale = if length > reach_px {
                reach_px / length
            } else {
                1.0
            };
            x_px += scale * pass.step_x_px;
            y_px += scale * pass.step_y_px;
            // Weights from the model need a model: the first pass has none.
            let at_rest = length < CONVERGED_PX && (n > 1 || !shot);
            before = Some(pass);
            let off_centre = f64::max(
                (x_px - self.crop.x0 as f64 - (self.crop.width as f64 - 1.0) / 2.0).abs(),
                (y_px - self.crop.y0 as f64 - (self.crop.height as f64 - 1.0) / 2.0).abs(),
            );
            if off_centre > RECENTRE_PX && recentres < max_recentres {
                let (x0, y0) = (self.crop.x0, self.crop.y0);
                if !self.take_window(view, x_px, y_px, side_px) {
                    return Some(Fitted::of((x_px, y_px), pass, false));
                }
                recentres += 1;
                if (x0, y0) != (self.crop.x0, self.crop.y0) {
                    continue;
                }
            }
            if at_rest {
                return Some(Fitted::of((x_px, y_px), pass, true));
            }
        }
        before.map(|pass| Fitted::of((x_px, y_px), pass, false))
    }
}
