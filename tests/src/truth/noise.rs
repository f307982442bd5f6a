//! Components of the records' noise.

use super::random::Random;

/// Noise of a session.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nuisance {
    /// Diffusion coefficient \[um^2/s\]; 0 for a noise-free run.
    pub diffusion_um2_per_s: f64,
    /// Localisation noise \[um\].
    pub localisation_um: f64,
    /// Kind of the localisation noise.
    pub kind: Kind,
    /// Rounding step of a position \[um\].
    pub step_um: f64,
}

/// Kinds of localisation noise, all of the same RMS.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kind {
    /// White and normal.
    White,
    /// Half of the variance first-order coloured, with a time in rows.
    Coloured(f64),
    /// Student's t with four degrees of freedom: a row in a thousand is beyond five standard deviations.
    HeavyTails,
}

impl Nuisance {
    /// No noise at all.
    pub const QUIET: Self = Self {
        diffusion_um2_per_s: 0.0,
        localisation_um: 0.0,
        kind: Kind::White,
        step_um: 1e-4,
    };

    /// A position as written in the record.
    pub(super) fn rounded(&self, y: f64) -> f64 {
        (y / self.step_um).round() * self.step_um
    }
}

/// Localisation noise, row by row.
#[derive(Debug)]
pub(super) struct Localisation {
    nuisance: Nuisance,
    slow: f64,
}

impl Localisation {
    pub(super) fn new(nuisance: Nuisance) -> Self {
        Self {
            nuisance,
            slow: 0.0,
        }
    }

    pub(super) fn next(&mut self, random: &mut Random) -> f64 {
        let scale = self.nuisance.localisation_um;
        match self.nuisance.kind {
            Kind::White => scale * random.normal(),
            Kind::Coloured(rows) => {
                let keep = (-1.0 / rows).exp();
                self.slow = keep * self.slow + (1.0 - keep * keep).sqrt() * random.normal();
                scale * 0.5f64.sqrt() * (self.slow + random.normal())
            }
            Kind::HeavyTails => {
                let z = random.normal();
                let chi2: f64 = (0..4).map(|_| random.normal().powi(2)).sum();
                // Variance of Student's t with four degrees of freedom: 2.
                scale * z / (0.25 * chi2).sqrt() * 0.5f64.sqrt()
            }
        }
    }
}
