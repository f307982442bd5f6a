//! A hypothesis on a bead as a Kalman filter of its position, the flow that carries it, that flow's change, and the gain.

use cellpos_control::flow_step_log_density;

/// Standard deviation of the gain over the model's: loops are made for a half to twice of it; and its limits.
const GAIN_SD: f64 = 0.35;
const GAIN_RANGE: [f64; 2] = [0.4, 2.5];
/// What the size of the gain may change by when its sign does.
const FLIP_SD: f64 = 0.1;
/// A flow starts to change as often as it steps, so often in a second.
const CHANGES_PER_S: f64 = 0.01;

/// Numbers that all paths share; um and ticks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Noise {
    /// Variance of the bead's walk and of the flow's in a tick.
    pub walk_um2: f64,
    pub flow_um2: f64,
    /// Speed of a flow that has begun to change, and its growth in a tick.
    pub change_um: f64,
    pub growth: f64,
    /// Change of a flow in a tick below which it is not seen: while it grows it moves the bead by less than its walk.
    pub least_um: f64,
    /// What a tick leaves of what is known of the gain.
    pub kept: f64,
    pub sample_s: f64,
}

/// Position, flow, its change, and gain over the model's, with covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Path {
    /// Sign of the gain; 0: the bead does not feel the commands.
    sign: f64,
    x: [f64; 4],
    p: [[f64; 4]; 4],
}

impl Path {
    pub(super) fn at(position_um: f64, variance_um2: f64, flow_um: f64) -> Self {
        let mut p = [[0.0; 4]; 4];
        p[0][0] = variance_um2;
        p[1][1] = flow_um * flow_um;
        p[3][3] = GAIN_SD * GAIN_SD;
        Self {
            sign: 1.0,
            x: [position_um, 0.0, 0.0, 1.0],
            p,
        }
    }

    /// The same bead, which no longer feels the commands: it goes on as it goes, now that they drive it by `driven_um`.
    fn adrift(mut self, driven_um: f64) -> Self {
        self.add(1, 3, driven_um);
        (self.sign, self.x[3]) = (0.0, 0.0);
        for k in 0..4 {
            (self.p[3][k], self.p[k][3]) = (0.0, 0.0);
        }
        self
    }

    /// The same bead with the opposite sign of its gain.
    fn against(mut self) -> Self {
        self.sign = -1.0;
        self.x[3] = -self.x[3];
        for k in 0..3 {
            self.p[3][k] = -self.p[3][k];
            self.p[k][3] = -self.p[k][3];
        }
        self.p[3][3] += FLIP_SD * FLIP_SD;
        self
    }

    /// Adds a multiple of one state to another: x' = F x, P' = F P F^T.
    fn add(&mut self, to: usize, from: usize, factor: f64) {
        self.x[to] += factor * self.x[from];
        for k in 0..4 {
            self.p[to][k] += factor * self.p[from][k];
        }
        for row in &mut self.p {
            row[to] += factor * row[from];
        }
    }

    /// One tick in which the model's bead goes `driven_um`, give or take `doubt_um`. The flow of a restless path changes.
    fn advance(&mut self, driven_um: f64, doubt_um: f64, restless: bool, noise: &Noise) {
        self.add(0, 1, 1.0);
        self.add(0, 2, 0.5);
        self.add(0, 3, driven_um);
        self.add(1, 2, 1.0);
        self.p[0][0] += noise.walk_um2 + doubt_um * doubt_um;
        self.p[1][1] += noise.flow_um2;
        if restless {
            let change_um = self.x[2].abs().max(noise.least_um) * noise.growth;
            self.p[2][2] += change_um * change_um;
        }
        let kept = noise.kept;
        self.x[3] = self.sign + kept * (self.x[3] - self.sign);
        for k in 0..4 {
            self.p[3][k] *= kept;
            self.p[k][3] *= kept;
        }
        self.p[3][3] += (1.0 - kept * kept) * (self.sign * GAIN_SD).powi(2);
    }

    /// Takes a fix in, `ticks` after the one before; gives the logarithm of its likelihood.
    fn correct(&mut self, position_um: f64, variance_um2: f64, ticks: f64, sample_s: f64) -> f64 {
        let off_um = position_um - self.x[0];
        let spread_um2 = self.p[0][0] + variance_um2;
        let quiet =
            -0.5 * (off_um * off_um / spread_um2 + (std::f64::consts::TAU * spread_um2).ln());
        let stepped = flow_step_log_density(off_um, ticks * sample_s);
        if stepped > quiet {
            // The flow is as uncertain as the step that the fix shows.
            let speed_um = off_um / ticks;
            self.p[0][0] += off_um * off_um;
            self.p[0][1] += off_um * speed_um;
            self.p[1][0] += off_um * speed_um;
            self.p[1][1] += speed_um * speed_um;
        }
        let spread_um2 = self.p[0][0] + variance_um2;
        let first = self.p[0];
        let gains = first.map(|p| p / spread_um2);
        for (x, gain) in self.x.iter_mut().zip(gains) {
            *x += gain * off_um;
        }
        for (row, gain) in self.p.iter_mut().zip(gains) {
            for (p, first) in row.iter_mut().zip(first) {
                *p -= gain * first;
            }
        }
        let [least, most] = GAIN_RANGE;
        self.x[3] = self.sign * (self.sign * self.x[3]).clamp(least, most);
        quiet.max(stepped)
    }
}

/// A hypothesis on the bead, with a flow that is quiet and with one that has begun to change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Belief {
    quiet: Path,
    restless: Path,
    /// Logarithms of their likelihoods less that of the likelier one.
    odds: [f64; 2],
}

impl Belief {
    pub(super) fn of(path: Path) -> Self {
        Self {
            quiet: path,
            restless: path,
            odds: [0.0, f64::NEG_INFINITY],
        }
    }

    pub(super) fn against(self) -> Self {
        Self {
            quiet: self.quiet.against(),
            restless: self.restless.against(),
            ..self
        }
    }

    pub(super) fn adrift(self, driven_um: f64) -> Self {
        Self {
            quiet: self.quiet.adrift(driven_um),
            restless: self.restless.adrift(driven_um),
            ..self
        }
    }

    /// Moves on by a tick; commands are counted from a displacement at which the model drives the bead `shift_um` further.
    pub(super) fn advance(&mut self, driven_um: f64, doubt_um: f64, shift_um: f64, noise: &Noise) {
        for (path, restless) in [(&mut self.quiet, false), (&mut self.restless, true)] {
            path.add(1, 3, shift_um);
            path.advance(driven_um, doubt_um, restless, noise);
        }
    }

    /// Takes a fix in; gives the logarithm of its likelihood.
    pub(super) fn correct(
        &mut self,
        position_um: f64,
        variance_um2: f64,
        ticks: f64,
        noise: &Noise,
    ) -> f64 {
        let likely =
            |path: &mut Path| path.correct(position_um, variance_um2, ticks, noise.sample_s);
        let [quiet, restless] = self.odds;
        let mut odds = [
            quiet + likely(&mut self.quiet),
            restless + likely(&mut self.restless),
        ];
        let cost = -(CHANGES_PER_S * ticks * noise.sample_s).min(1.0).ln();
        if odds[1] < odds[0] - cost {
            odds[1] = odds[0] - cost;
            self.restless = self.quiet;
            self.restless.p[1][1] += noise.change_um * noise.change_um;
            self.restless.p[2][2] += noise.least_um * noise.least_um;
        } else if odds[0] < odds[1] - cost {
            odds[0] = odds[1] - cost;
            self.quiet = self.restless;
        }
        let most = odds[0].max(odds[1]);
        self.odds = odds.map(|odds| odds - most);
        most
    }
}
