//! A rig that hides effects, written apart from the catalogue of `cellpos-plant`.
//!
//! Another integrator (fixed-step Runge-Kutta on Eq. (6) in controllable form, 64 steps a millisecond, the jumps of its
//! direct path apart from the flow, where the catalogue is exact), other equations where the literature offers them (Preisach relays for hysteresis, one
//! Kelvin-Voigt element per decade for creep, an internal variable for the standard linear solid), a second equation for
//! every effect ([`Second`]), and effects that the catalogue does not have ([`Stranger`]). Nuisances (diffusion,
//! localisation noise, phases), and where a case asks for it excitation and sizes, are drawn at random.

mod camera;
pub mod cases;
pub mod draw;
mod fresh;
mod hidden;
mod motion;
mod noise;
mod random;
mod relays;
mod scripts;
mod second;
mod signal;
mod strangers;
pub mod table;
pub mod threshold;

pub use hidden::Hidden;
pub use motion::Rig;
pub use noise::{Kind, Nuisance};
pub use random::Random;
pub use scripts::{Excitation, Script, scripts};
pub use second::Second;
pub use strangers::Stranger;

use cellpos_reconcile::Record;
use motion::positions;
use noise::Localisation;

/// Runs one record. Rows whose frame is dropped are left out of the record, as cameras do.
pub fn run(
    script: &Script,
    rig: Rig,
    hidden: &[Hidden],
    nuisance: Nuisance,
    random: &mut Random,
) -> Record {
    let u: Vec<f64> = script.pzt_um.iter().map(|p| p - 4.0).collect();
    let seen = positions(&u, rig, hidden, nuisance, random);
    let mut localisation = Localisation::new(nuisance);
    let (mut time, mut pzt, mut bead) = (Vec::new(), Vec::new(), Vec::new());
    let mut last = f64::NAN;
    // Rows that a burst still lasts.
    let mut burst = 0;
    for (k, y) in seen.iter().enumerate() {
        let mut y = *y + localisation.next(random);
        let mut dropped = false;
        for h in hidden {
            match *h {
                Hidden::Repeats(p) if random.uniform() < p && last.is_finite() => y = last,
                Hidden::Second(Second::RepeatBursts(p)) => {
                    if burst == 0 && random.uniform() < 0.5 * p && last.is_finite() {
                        burst = 2;
                    }
                    if burst > 0 {
                        (burst, y) = (burst - 1, last);
                    }
                }
                Hidden::Second(Second::DropBursts(p)) => {
                    if burst == 0 && random.uniform() < 0.25 * p {
                        burst = 4;
                    }
                    dropped = burst > 0;
                    burst -= i32::from(dropped);
                }
                Hidden::Drops(p) => dropped = random.uniform() < p,
                _ => {}
            }
        }
        last = y;
        time.push(k as f64 * 1e-3);
        pzt.push(script.pzt_um[k]);
        bead.push(if dropped {
            f64::NAN
        } else {
            nuisance.rounded(y)
        });
    }
    match Record::from_rows(script.name, &time, &pzt, &bead) {
        Ok(r) => r,
        Err(e) => panic!("the simulator made a record that cannot be read: {e}"),
    }
}
