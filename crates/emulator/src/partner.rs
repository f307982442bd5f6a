//! The emulated slow partner: a pressure controller with its own line, a regulator, a tube that stretches.

use crate::board_config::{BoardConfig, BoardConfigError};
use cellpos_board::Board;
use cellpos_link::um_from_picometres;

/// An emulated pressure controller in parallel with the PZT. Displacements are in um on its own scale.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PressureConfig {
    /// Its board: range, slew, watchdogs; it starts at `power_up_um`, where the flow is that of the PZT alone.
    pub board: BoardConfig,
    /// um of PZT displacement with the same effect as 1 um of this actuator.
    pub gain: f64,
    /// Lags of regulator and tube (63 % of a step), ms; 0: none.
    pub lags_ms: [f64; 2],
}

/// Board and pressure path of a partner.
#[derive(Debug, Clone)]
pub(crate) struct PressurePartner {
    pub board: Board,
    gain: f64,
    lags_s: [f64; 2],
    start_um: f64,
    applied_um: f64,
    /// Pressure behind the regulator, and behind the tube.
    stages_um: [f64; 2],
}

impl PressurePartner {
    pub(crate) fn new(config: &PressureConfig) -> Result<Self, BoardConfigError> {
        let board = config.board.board()?;
        let start_um = um_from_picometres(board.applied_pm());
        Ok(Self {
            board,
            gain: config.gain,
            lags_s: config.lags_ms.map(|ms| ms.max(0.0) * 1e-3),
            start_um,
            applied_um: start_um,
            stages_um: [start_um; 2],
        })
    }

    /// Advances the board's time.
    pub(crate) fn tick(&mut self, now_us: u64) {
        self.board.tick(now_us);
        self.applied_um = um_from_picometres(self.board.applied_pm());
    }

    /// Advances the pressure by `dt_s`; its mean effect over that time, um of PZT. Steps are of a fraction of a millisecond: the mean of
    /// a stage is taken as that of its ends.
    pub(crate) fn advance(&mut self, dt_s: f64) -> f64 {
        let mut into_um = self.applied_um;
        for (stage_um, lag_s) in self.stages_um.iter_mut().zip(self.lags_s) {
            let before_um = *stage_um;
            *stage_um = if lag_s > 0.0 {
                into_um + (before_um - into_um) * (-dt_s / lag_s).exp()
            } else {
                into_um
            };
            into_um = if lag_s > 0.0 {
                0.5 * (before_um + *stage_um)
            } else {
                into_um
            };
        }
        self.gain * (into_um - self.start_um)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_goes_through_both_lags() {
        let config = PressureConfig {
            board: BoardConfig::default(),
            gain: 0.8,
            lags_ms: [50.0, 20.0],
        };
        let mut partner = PressurePartner::new(&config).expect("sound");
        partner.applied_um += 1.0;
        let mut effect_um = 0.0;
        for _ in 0..1000 {
            effect_um = partner.advance(1e-4);
        }
        // 1 - (50 exp(-t/50) - 20 exp(-t/20)) / 30 at 99.95 ms.
        let (a, b) = ((-99.95_f64 / 50.0).exp(), (-99.95_f64 / 20.0).exp());
        let expected = 0.8 * (1.0 - (50.0 * a - 20.0 * b) / 30.0);
        assert!(
            (effect_um - expected).abs() < 1e-5,
            "{effect_um} {expected}"
        );
    }
}
