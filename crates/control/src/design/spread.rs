//! How a design stands up to a plant that is not the nominal one: gain by 0.5..2, one more sample of delay.

use crate::design::margins::{Margins, margins};
use crate::design::plant::DesignPlant;
use crate::linear::LinearLaw;
use cellpos_plant::PlantError;

/// One point of the spread.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpreadRow {
    /// Factor on the plant's gain.
    pub gain_factor: f64,
    /// Samples added to the delay.
    pub extra_samples: u32,
    /// Margins there.
    pub margins: Margins,
}

/// Gain factors of the spread table.
pub(super) const GAIN_FACTORS: [f64; 5] = [0.5, 0.71, 1.0, 1.41, 2.0];

/// Margins of one law over the spread of plants.
///
/// # Errors
/// A sample time or delay that cannot be discretised.
pub fn spread(plant: &DesignPlant, law: &LinearLaw) -> Result<Vec<SpreadRow>, PlantError> {
    let mut rows = Vec::with_capacity(2 * GAIN_FACTORS.len());
    for extra_samples in 0..2 {
        for gain_factor in GAIN_FACTORS {
            let margins = margins(&plant.changed(gain_factor, extra_samples)?, law)?;
            rows.push(SpreadRow {
                gain_factor,
                extra_samples,
                margins,
            });
        }
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pi::Pi;

    #[test]
    fn published_pi_gains_are_stable_over_the_spread() {
        for (delay_s, pi) in [(2.5e-3, Pi::new(0.46, 19.5)), (3.5e-3, Pi::new(0.33, 9.6))] {
            let law = LinearLaw::Pi {
                pi,
                sample_time_s: 1e-3,
            };
            let rows = spread(&DesignPlant::eq6(delay_s), &law).unwrap();
            assert_eq!(rows.len(), 10);
            assert!(rows.iter().all(|row| row.margins.stable), "{rows:?}");
        }
    }
}
