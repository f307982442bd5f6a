//! Predicted hold error: the discrete closed loop driven by Brownian motion and localisation noise.
//!
//! The squares of the true position's response to one step of the walk, and to one wrong fix, are summed. That is exact, without
//! simulation of noise, and valid for any stable law. (An integrating walk has no stationary state, so a Lyapunov equation of the
//! whole loop has no solution.)

use crate::design::plant::DesignPlant;
use crate::linear::LinearLaw;
use cellpos_plant::PlantError;
use nalgebra::DVector;

/// Predicted RMS of the true position's error while holding, um.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseFigures {
    /// In all.
    pub rms_um: f64,
    /// From Brownian motion.
    pub brownian_um: f64,
    /// From localisation noise that the controller follows.
    pub fix_um: f64,
    /// RMS of the change of the command from tick to tick, um.
    pub move_rms_um: f64,
}

/// What disturbs the loop once, at tick 0.
#[derive(Clone, Copy, PartialEq)]
enum Impulse {
    /// The position jumps by 1 and is seen this number of ticks later.
    Walk(usize),
    /// One fix is wrong by 1.
    Fix,
}

/// Sums of squares of the true position and of the command after an impulse; `None` if they do not die out.
fn squares(
    plant: &DesignPlant,
    law: &LinearLaw,
    impulse: Impulse,
) -> Result<Option<(f64, f64)>, PlantError> {
    const LONGEST: usize = 200_000;
    let (truth, measured) = (plant.truth()?, plant.measured()?);
    let (mut x, mut y) = (truth.state(0.0), measured.state(0.0));
    let (a, b, c, d) = law.matrices();
    let mut state = DVector::zeros(a.nrows());
    let (mut position2, mut command2, mut recent, mut last) = (0.0, 0.0, 0.0, 0.0);
    for k in 0..LONGEST {
        let jump = if matches!(impulse, Impulse::Walk(_)) {
            1.0
        } else {
            0.0
        };
        let position = truth.output_um(&x) + jump;
        let seen = match impulse {
            Impulse::Walk(after) if k >= after => 1.0,
            Impulse::Fix if k == 0 => 1.0,
            _ => 0.0,
        };
        let fix = measured.output_um(&y) + seen;
        let command = -((&c * &state)[0] + d * fix);
        state = &a * &state + &b * fix;
        truth.step(&mut x, command);
        measured.step(&mut y, command);
        position2 += position * position;
        command2 += (command - last) * (command - last);
        recent += position * position;
        last = command;
        if k % 256 == 255 {
            if !recent.is_finite() || recent > 1e12 {
                return Ok(None);
            }
            if recent <= 1e-10 * position2 {
                return Ok(Some((position2, command2)));
            }
            recent = 0.0;
        }
    }
    Ok(None)
}

/// Predicted hold error of a law on a plant; `None` if the loop is not stable.
///
/// # Errors
/// A sample time or delay that cannot be discretised.
pub fn noise_figures(
    plant: &DesignPlant,
    law: &LinearLaw,
) -> Result<Option<NoiseFigures>, PlantError> {
    let samples = plant.delay_s / plant.sample_time_s;
    let whole = (samples + 1e-9).floor();
    let late = (samples - whole).max(0.0);
    let step_um2 = 2.0 * plant.diffusion_um2_per_s * plant.sample_time_s;
    let (mut brownian, mut moves) = (0.0, 0.0);
    for (after, weight) in [(whole as usize, 1.0 - late), (whole as usize + 1, late)] {
        if weight < 1e-9 {
            continue;
        }
        let Some((position2, command2)) = squares(plant, law, Impulse::Walk(after))? else {
            return Ok(None);
        };
        brownian += weight * step_um2 * position2;
        moves += weight * step_um2 * command2;
    }
    let Some((position2, command2)) = squares(plant, law, Impulse::Fix)? else {
        return Ok(None);
    };
    let fix_um2 = plant.fix_noise_um.powi(2);
    Ok(Some(NoiseFigures {
        rms_um: (brownian + fix_um2 * position2).sqrt(),
        brownian_um: brownian.sqrt(),
        fix_um: (fix_um2 * position2).sqrt(),
        move_rms_um: (moves + fix_um2 * command2).sqrt(),
    }))
}
