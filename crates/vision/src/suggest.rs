//! Settings found from a recording: strong objects that come again, their mean radial profile, and their distinguishing
//! properties.
//!
//! For a recording whose beads nobody has described. Objects of either polarity are found by their contrast against a smooth
//! background, and those of the commonest size and contrast are taken as beads. The mean profile about their centres becomes the
//! template: aligned, fitted, aligned again. Offline; allocates.

mod apart;
mod settings;

use self::settings::{FADE, rounded, settings};
use crate::config::{LocaliserConfig, MAX_WINDOW_PX};
use crate::fix::{Fix, FixQuality, squared};
use crate::frame::Frame;
use crate::localiser::Localiser;
use crate::objects::{self, Bead, Flat, Object, Refused};
use crate::overlap;
use crate::range::Range;
use crate::reach;
use crate::smooth::Rings;
use crate::template::Template;
use cellpos_numeric::statistics;

/// Passes of aligning and averaging.
const PASSES: usize = 4;
/// Objects are alike within these factors of size and of contrast.
const ALIKE: (f64, f64) = (1.3, 1.7);
/// Fewest objects that make a profile.
const FEWEST: usize = 5;
/// Least distance up to which a profile is learnt, in radii of the region that stands out, and that up to which its end is looked for.
const REACH: (f64, f64) = (1.6, 3.2);
/// Searches without the scene, at most: each has beads whose profile is nearer to their own.
const SCENES: usize = 3;
/// Kinds of objects tried, the commonest first.
const KINDS: usize = 3;
/// Margin on the residual that the beads themselves have: that of nine in ten, since dust and neighbours spoil some.
const TOLERANCE_MARGIN: f64 = 2.0;
const TOLERANCE_SHARE: f64 = 0.9;
/// Least contrast over the noise of a bead, as a share of the recording's: five times the noise, with a margin for beads that are
/// fainter than most.
const ROOM_FOR_NOISE: f64 = 0.13;
/// Largest tolerance. At 0.26 the template explains half of a bead's part of its window (mean square 0.135 of the contrast's:
/// [`crate::Localiser`]), and most beads must be explained by half of that.
const MOST_TOLERANCE: f64 = 0.26;

/// What was found in a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Suggestion {
    /// Settings of the localiser. Their profile is a table if a learnt one predicts unseen beads better than the best Gaussian or
    /// ring; otherwise it is that Gaussian or ring.
    pub config: LocaliserConfig,
    /// Farthest that a bead went from frame to frame, with a margin, px.
    pub max_step_px: f64,
    /// Objects that stood out.
    pub objects: usize,
    /// Of these, taken as beads.
    pub taken: usize,
    /// Refused: another size or contrast, at the border, or a bad fit to the mean profile.
    pub refused: Refused,
    /// Median of the beads' peak contrast over the noise.
    pub snr: f64,
    /// The range of the settings, tried with beads drawn from their template; `None` if they do not find these.
    pub range: Option<Range>,
}

/// Why there is no suggestion.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NothingToSuggest {
    /// Nothing stands out.
    #[error("nothing stands out of the noise in any of {frames} frames")]
    Nothing {
        /// Frames looked at.
        frames: usize,
    },
    /// Too few objects that are alike.
    #[error(
        "of {objects} objects that stand out in {frames} frames no {FEWEST} are alike in size and contrast"
    )]
    NoneAlike {
        /// Objects that stand out.
        objects: usize,
        /// Frames looked at.
        frames: usize,
    },
    /// The mean profile does not fit the objects that it was made of.
    #[error(
        "the mean profile of {objects} objects does not fit them: they have no common round shape (cells: --cells)"
    )]
    NoProfile {
        /// Objects that were alike.
        objects: usize,
    },
    /// The noise chooses the places of the objects, and so their profile.
    #[error(
        "{objects} objects are too faint for a profile: either half of their pixels puts them elsewhere, by more than their noise \
         explains (more light, or a profile given by hand)"
    )]
    Faint {
        /// Objects that were alike.
        objects: usize,
    },
}

/// Looks at frames of a recording, spread over it, and suggests settings for its beads.
///
/// # Errors
/// Nothing stands out, or what does is not alike, not round, or too faint.
pub fn suggest(frames: &[Frame]) -> Result<Suggestion, NothingToSuggest> {
    found_in_scene(frames, |flats| suggest_in(frames, flats))
}

/// Searches in the frames, and again without their scene: walls, dust, uneven light. A bead that keeps its distance from a wall would
/// have the wall in its profile, and dust outnumbers beads.
///
/// The scene is the median of the frames without the images of their beads. Each search finds beads whose images are nearer to the true
/// ones. A search counts unless it finds fewer beads than the one before.
fn found_in_scene(
    frames: &[Frame],
    search: impl Fn(&[Flat]) -> Result<Found, NothingToSuggest>,
) -> Result<Suggestion, NothingToSuggest> {
    let flats: Vec<Flat> = frames.iter().map(Flat::new).collect();
    let search_without_scene = |rest: &[Flat]| {
        let scene = objects::scene(rest)?;
        let mut flats = flats.clone();
        flats.iter_mut().for_each(|flat| flat.subtract(&scene));
        search(&flats).ok()
    };
    let mut found = search(&flats);
    let count = frames.len();
    // Dust that stands still and outnumbers the beads is part of the median of the frames themselves.
    let others = match &found {
        Ok(first) if first.stands(count) => search_without_scene(&flats)
            .filter(|others| 2 * others.fits.len() > count && others.are_elsewhere(first)),
        Ok(_) => None,
        Err(_) => search_without_scene(&flats),
    };
    found = others.map_or(found, Ok);
    for _ in 0..SCENES {
        // Where beads rest, nothing tells their images from the scene behind them.
        let Ok(known) = &found else { break };
        if known.stands(count) {
            break;
        }
        let rest = without_beads(&flats, &known.template, &known.fits);
        match search_without_scene(&rest) {
            Some(next) if !next.has_fewer_than(known) => found = Ok(next),
            _ => break,
        }
    }
    // Many beads are drawn for a range: once, for the settings that were found.
    found.map(|Found { suggestion, .. }| Suggestion {
        range: Range::of(&suggestion.config, suggestion.snr),
        ..suggestion
    })
}

/// A suggestion without its range, its template, and the fixes behind it with their frames, in the order of the frames.
struct Found {
    suggestion: Suggestion,
    template: Template,
    fits: Vec<(usize, Fix)>,
}

impl Found {
    /// Whether the median of the frames holds what was found: more than half of the fixes cover a place that a fix of every other frame
    /// covers. It is dust, or beads that rest.
    fn stands(&self, frames: usize) -> bool {
        let stands = |own: &&(usize, Fix)| 2 * self.near(&own.1) >= frames;
        2 * self.fits.iter().filter(stands).count() > self.fits.len()
    }

    /// Whether more than half of the fixes are near none of another search.
    fn are_elsewhere(&self, other: &Found) -> bool {
        let apart = |own: &&(usize, Fix)| other.near(&own.1) == 0;
        2 * self.fits.iter().filter(apart).count() > self.fits.len()
    }

    /// Number of fixes within a radius of a place.
    fn near(&self, place: &Fix) -> usize {
        let radius_px = self.template.radius_px();
        let near = |(_, fix): &&(usize, Fix)| {
            squared(fix.x_px - place.x_px, fix.y_px - place.y_px) < radius_px.powi(2)
        };
        self.fits.iter().filter(near).count()
    }

    /// Whether there are fewer fixes than in another search, by more than chance: their number's root.
    fn has_fewer_than(&self, other: &Found) -> bool {
        let count = other.fits.len() as f64;
        (self.fits.len() as f64) < count - count.sqrt()
    }
}

/// The frames without the images of their beads.
fn without_beads(flats: &[Flat], template: &Template, fits: &[(usize, Fix)]) -> Vec<Flat> {
    let mut rest = flats.to_vec();
    for (frame, fix) in fits {
        if let Some(flat) = rest.get_mut(*frame) {
            flat.take_out(template, fix);
        }
    }
    rest
}

fn suggest_in(frames: &[Frame], flats: &[Flat]) -> Result<Found, NothingToSuggest> {
    let mut refused = Refused::default();
    let mut objects = Vec::new();
    for (n, flat) in flats.iter().enumerate() {
        flat.objects(n, &mut objects, &mut refused);
    }
    let all = objects.clone();
    let seen = all.len();
    objects.retain(|o| !o.cut);
    let count = frames.len();
    if objects.is_empty() {
        return Err(NothingToSuggest::Nothing { frames: count });
    }
    let total = objects.len();
    let mut failed = None;
    for _ in 0..KINDS {
        let alike = commonest(&objects);
        if alike.len() < FEWEST.min(count.max(2)) {
            break;
        }
        // Those that have no common round shape, as pairs of beads in any direction, may hide others that have.
        objects.retain(|o| !alike.contains(o));
        refused.other = total - alike.len();
        match learn(frames, flats, (alike, &all), refused) {
            Ok(mut found) => {
                found.suggestion.objects = seen;
                return Ok(found);
            }
            Err(error) => failed = failed.or(Some(error)),
        }
    }
    Err(failed.unwrap_or(NothingToSuggest::NoneAlike {
        objects: seen,
        frames: count,
    }))
}

/// The template learnt from the beads that a detector with rough settings sees, whatever their fits say. That corrects a size that
/// is wrong by a fifth or so.
///
/// # Errors
/// As [`suggest`].
pub fn refine(frames: &[Frame], rough: &Localiser) -> Result<Suggestion, NothingToSuggest> {
    let mut detector = crate::Detector::thorough(rough, 1000);
    let radius_px = 1.85 * rough.template().radius_px();
    let mut all = Vec::new();
    for (n, frame) in frames.iter().enumerate() {
        for blob in detector.detect(frame) {
            all.push(Object {
                frame: n,
                x_px: blob.x_px,
                y_px: blob.y_px,
                radius_px,
                contrast: blob.peak,
                cut: blob.at_border,
            });
        }
    }
    let whole: Vec<Object> = all.iter().filter(|o| !o.cut).copied().collect();
    if whole.is_empty() {
        return Err(NothingToSuggest::Nothing {
            frames: frames.len(),
        });
    }
    let alike = commonest(&whole);
    let refused = Refused {
        other: whole.len() - alike.len(),
        ..Refused::default()
    };
    let found = found_in_scene(frames, |flats| {
        learn(frames, flats, (alike.clone(), &all), refused)
    })?;
    Ok(Suggestion {
        objects: whole.len(),
        ..found
    })
}

fn learn(
    frames: &[Frame],
    flats: &[Flat],
    (alike, all): (Vec<Object>, &[Object]),
    mut refused: Refused,
) -> Result<Found, NothingToSuggest> {
    let region_px = median(alike.iter().map(|o| o.radius_px));
    let least_px = REACH.0 * region_px;
    let mut reach_px = least_px;
    let end_px = (REACH.1 * region_px).min(0.5 * MAX_WINDOW_PX as f64);
    let beads = alike.iter().map(|o| Bead::among(o, all, end_px));
    let mut beads: Vec<Bead> = beads.collect();
    let mut snr = f64::INFINITY;
    let objects = beads.len();
    let failed = NothingToSuggest::NoProfile { objects };
    let mut config = None;
    let mut template: Option<Template> = None;
    let mut fits: Vec<(usize, Fix)> = Vec::new();
    let mut filled = 1.0_f64;
    let mut apart = None;
    for pass in 0..PASSES {
        let rings = collect(flats, &beads, template.as_ref(), least_px);
        let parametric = rings.parametric().ok_or(failed)?;
        if pass > 0 {
            let settings: &LocaliserConfig = config.as_ref().ok_or(failed)?;
            let known = template.as_ref().ok_or(failed)?;
            let rest = without_beads(flats, known, &fits);
            let extent_px = reach::round_extent_px(&rest, known, &fits, end_px);
            // A fit's window has the profile in it, and the level about it.
            let window_px = LocaliserConfig::new(settings.profile).window_px;
            let fitted_px = least_px.max(0.5 * window_px as f64).min(end_px);
            reach_px = (extent_px / (1.0 - FADE)).clamp(fitted_px, end_px);
        }
        let learnt = overlap::learn(flats, &beads, parametric, reach_px).ok_or(failed)?;
        let mut settings = settings(&learnt, parametric, reach_px, snr).ok_or(failed)?;
        settings.template_tolerance = MOST_TOLERANCE;
        let mut localiser = Localiser::new(settings.clone()).map_err(|_| failed)?;
        fits = fit(frames, &mut beads, &mut localiser);
        template = settings.template().ok();
        if let Some(template) = &template {
            let looks = (settings.polarity, reach_px);
            apart = apart::place(flats, &mut beads, template, looks);
        }
        snr = median(fits.iter().map(|(_, f)| f.snr));
        filled = localiser.filled();
        if fits.len() * 2 < objects && pass + 1 == PASSES {
            return Err(failed);
        }
        config = Some(settings);
    }
    if apart.is_some_and(|apart| apart > apart::MOST_APART) {
        return Err(NothingToSuggest::Faint { objects });
    }
    let mut config = config.ok_or(failed)?;
    refused.bad_fit = objects - fits.len();
    // What the beads' own residuals need, with a margin for those not looked at.
    let needed = fits.iter().map(|(_, f)| {
        let excess = (f.residual_ratio - config.max_residual_ratio).max(0.0);
        (excess / filled).sqrt() / f.snr.max(1.0)
    });
    let needed = quantile(needed, TOLERANCE_SHARE);
    let rough = LocaliserConfig::new(config.profile);
    config.template_tolerance =
        (TOLERANCE_MARGIN * needed).clamp(rough.template_tolerance, MOST_TOLERANCE);
    config.min_snr = (ROOM_FOR_NOISE * snr).clamp(1.0, 20.0);
    let max_step_px = step_px(&fits, reach_px);
    let suggestion = Suggestion {
        range: None,
        config,
        max_step_px,
        objects,
        taken: fits.len(),
        refused,
        snr,
    };
    Ok(Found {
        suggestion,
        template: template.ok_or(failed)?,
        fits,
    })
}

/// Fits the beads, each with the others of its frame; takes over their places and contrasts. The good fixes, with their frames. The
/// next profile is learnt from the beads that have one: two beads in one region, or half of one, are another image at any place.
fn fit(frames: &[Frame], beads: &mut [Bead], localiser: &mut Localiser) -> Vec<(usize, Fix)> {
    let mut fits = Vec::new();
    let mut found: Vec<Fix> = Vec::new();
    let near_px = localiser.template().radius_px();
    beads.iter_mut().for_each(|bead| bead.image = 0.0);
    for beads in beads.chunk_by_mut(|a, b| a.at.frame == b.at.frame) {
        let Some(frame) = beads.first().and_then(|bead| frames.get(bead.at.frame)) else {
            continue;
        };
        let places = beads.iter().map(|bead| (bead.at.x_px, bead.at.y_px));
        localiser.locate_all(frame, places, &mut found);
        for bead in beads {
            let at = &mut bead.at;
            let away = |fix: &Fix| f64::hypot(fix.x_px - at.x_px, fix.y_px - at.y_px);
            let nearest = found.iter().min_by(|a, b| away(a).total_cmp(&away(b)));
            let is_bead = |fix: &&Fix| fix.verdict == FixQuality::Good && away(fix) < near_px;
            let Some(fix) = nearest.filter(is_bead) else {
                continue;
            };
            (at.x_px, at.y_px) = (fix.x_px, fix.y_px);
            bead.image = fix.amplitude;
            fits.push((at.frame, *fix));
        }
    }
    // Of what has no good fix the contrast is that of most.
    let usual = if fits.is_empty() {
        1.0
    } else {
        median(fits.iter().map(|(_, fix)| fix.amplitude.abs()))
    };
    let enough = fits.len() >= FEWEST;
    for bead in beads.iter_mut() {
        let is_fitted = bead.image != 0.0;
        bead.counts = is_fitted || !enough;
        bead.contrast = if is_fitted { bead.image.abs() } else { usual };
    }
    fits
}

/// Objects alike to the one that has most, and strongest, like it.
fn commonest(objects: &[Object]) -> Vec<Object> {
    let within = |a: f64, b: f64, factor: f64| a < factor * b && b < factor * a;
    let alike = |a: &Object| {
        let same = |b: &&Object| {
            within(a.radius_px, b.radius_px, ALIKE.0) && within(a.contrast, b.contrast, ALIKE.1)
        };
        objects.iter().filter(same).copied().collect::<Vec<_>>()
    };
    let weight = |a: &Object| alike(a).len() as f64 * a.contrast * a.radius_px;
    let best = objects
        .iter()
        .max_by(|a, b| weight(a).total_cmp(&weight(b)));
    best.map(alike).unwrap_or_default()
}

/// Grey values over the distance from the objects' centres, up to `reach_px`: of each object with its contrast and level removed
/// by the template of the previous pass.
fn collect(
    flats: &[Flat],
    beads: &[Bead],
    template: Option<&Template>,
    reach_px: f64,
) -> Box<Rings> {
    let mut rings = Box::new(Rings::new(reach_px));
    for bead in beads.iter().filter(|bead| bead.counts) {
        let Some(pixels) = bead.pixels(flats, reach_px) else {
            continue;
        };
        let pixels: Vec<(f64, f64)> = pixels.map(|p| (p.r_px, p.grey)).collect();
        let (contrast, level) = template
            .and_then(|template| contrast_and_level(template, pixels.iter().copied()))
            .unwrap_or((1.0, 0.0));
        // The sign stays with the values: it is the polarity.
        let contrast = contrast.abs();
        rings.next_bead();
        for (r_px, v) in pixels {
            rings.add(r_px, (v - level) / contrast, contrast * contrast);
        }
    }
    rings
}

/// Contrast and level of a template that fit the pixels best.
fn contrast_and_level(
    template: &Template,
    pixels: impl Iterator<Item = (f64, f64)>,
) -> Option<(f64, f64)> {
    let (mut n, mut g1, mut g2, mut s1, mut sg) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (r_px, v) in pixels {
        let g = f64::from(template.value_at_squared((r_px * r_px) as f32));
        n += 1.0;
        g1 += g;
        g2 += g * g;
        s1 += v;
        sg += g * v;
    }
    let contrast = (n * sg - g1 * s1) / (n * g2 - g1 * g1);
    let level = (s1 - contrast * g1) / n;
    (contrast.is_finite() && contrast != 0.0 && level.is_finite()).then_some((contrast, level))
}

/// Farthest step of a bead between neighbouring frames, with a margin; without such steps, a bead's reach.
fn step_px(fits: &[(usize, crate::Fix)], reach_px: f64) -> f64 {
    let mut steps = Vec::new();
    for (n, fix) in fits {
        let next = fits.iter().filter(|(m, _)| *m == n + 1);
        let away = next.map(|(_, f)| f64::hypot(f.x_px - fix.x_px, f.y_px - fix.y_px));
        if let Some(step) = away.min_by(f64::total_cmp).filter(|step| *step < reach_px) {
            steps.push(step);
        }
    }
    if steps.is_empty() {
        return reach_px;
    }
    rounded((2.5 * quantile(steps.into_iter(), 0.99)).max(2.0), 10.0)
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    quantile(values, 0.5)
}

fn quantile(values: impl Iterator<Item = f64>, share: f64) -> f64 {
    let values: Vec<f64> = values.collect();
    if values.is_empty() {
        0.0
    } else {
        statistics::quantile(&values, share)
    }
}
