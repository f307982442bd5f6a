//! A rig of positions: the discretised plant of cellpos-plant, Brownian motion, drift, localisation noise, and a PI loop.

use cellpos_ident::candidate_model::CandidateModel;
use cellpos_ident::excitation::ExcitationLimits;
use cellpos_ident::experiment::{Bench, Measured, Plan, Row};
use cellpos_ident::frequency_response::Settings;
use cellpos_ident::sampled::Sampling;
use cellpos_numeric::Random;
use cellpos_plant::{Complex, DiscretePlant, DiscreteState, Seconds, TransferFunction};

/// Positions only, 1 kHz, held by PI.
pub(crate) struct PositionRig {
    plant: DiscretePlant,
    state: DiscreteState,
    pub neutral_um: f64,
    pub drift_um_per_s: f64,
    pub diffusion_um2_per_s: f64,
    pub localisation_um: f64,
    pub kp: f64,
    pub ki_per_s: f64,
    pub lose_every: usize,
    pub lost_from: usize,
    integral_um: f64,
    wander_um: f64,
    pending: Vec<f64>,
    ticks: usize,
    random: Random,
}

pub(crate) const PERIOD_S: f64 = 1e-3;

impl PositionRig {
    pub(crate) fn new(plant: &TransferFunction, delay_s: f64, seed: u64) -> Self {
        let plant = DiscretePlant::new(plant, Seconds(PERIOD_S), Seconds(delay_s)).unwrap();
        let state = plant.state(0.0);
        Self {
            plant,
            state,
            neutral_um: 4.0,
            drift_um_per_s: 3.0,
            diffusion_um2_per_s: 0.33,
            localisation_um: 0.02,
            kp: 0.33,
            ki_per_s: 9.6,
            lose_every: 0,
            lost_from: usize::MAX,
            integral_um: 0.0,
            wander_um: 0.0,
            pending: vec![0.0; (delay_s / PERIOD_S).ceil() as usize + 1],
            ticks: 0,
            random: Random::new(seed),
        }
    }
}

impl Bench for PositionRig {
    type Error = std::convert::Infallible;

    fn tick(&mut self, excitation_um: f64) -> Result<Row, Self::Error> {
        // Noise of the bead itself is seen after the camera's delay.
        let step = (2.0 * self.diffusion_um2_per_s * PERIOD_S).sqrt() * self.random.normal();
        self.wander_um += step + self.drift_um_per_s * PERIOD_S;
        self.pending.rotate_right(1);
        self.pending[0] = self.wander_um;
        let seen = self.pending[self.pending.len() - 1];
        let bead =
            self.plant.output_um(&self.state) + seen + self.localisation_um * self.random.normal();
        self.integral_um -= self.ki_per_s * bead * PERIOD_S;
        let command =
            (self.neutral_um - self.kp * bead + self.integral_um + excitation_um).clamp(0.0, 40.0);
        self.plant.step(&mut self.state, command - self.neutral_um);
        self.ticks += 1;
        let lost = self.ticks > self.lost_from
            || (self.lose_every > 0 && self.ticks.is_multiple_of(self.lose_every));
        Ok(Row {
            command_um: command,
            bead_um: (!lost).then_some(bead),
        })
    }
}

/// Expected plant and loop gain of the nominal rig with the PI gains above.
pub(crate) fn expected(delay_s: f64) -> impl Fn(f64) -> (Complex<f64>, Complex<f64>) {
    let model = CandidateModel::eq6(delay_s);
    move |f| {
        let sampling = cellpos_ident::sampled::Sampling::held(1.0 / PERIOD_S);
        let h = model.sampled_response(f, sampling);
        let s = Complex::new(0.0, 2.0 * std::f64::consts::PI * f);
        (h, h * (0.33 + 9.6 / s))
    }
}

/// Stepped sines on Eq. (6) with a delay of 2 ms, held, and the noise of what lies between them.
pub(crate) fn measured(lines_hz: &[f64], limits: ExcitationLimits, seed: u64) -> Measured {
    let plan = Plan::stepped_sines(lines_hz, &expected(0.002), limits, PERIOD_S, 20.0);
    let mut rig = PositionRig::new(&TransferFunction::eq6(), 0.002, seed);
    let records = plan.run(&mut rig, 0, |_| {}).unwrap();
    let sampling = Sampling::held(1.0 / PERIOD_S);
    plan.analyse_with_noise(&records, &Settings::default(), sampling, false)
        .unwrap()
}
