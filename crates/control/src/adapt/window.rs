//! Forgetful sums of the regression of whitened positions on whitened model positions, one member for each delay tried.

/// Delays tried beside the design's, samples.
pub const DELAYS: [f64; MEMBERS] = [-1.0, -0.5, 0.0, 0.5, 1.0, 1.5];
/// How many.
pub const MEMBERS: usize = 6;
/// The design's own among them.
pub const NOMINAL: usize = 2;
/// Samples from one delay to the next.
const APART: f64 = 0.5;

/// Part of the gain that no measurement decides: a real plant is no linear one.
const MODEL_SD: f64 = 0.003;

/// Part of the excitation that comes by which a memory grows.
const GROWTH: f64 = 0.5;

/// Sums with a memory bounded by what they hold: old ticks are forgotten by the excitation of new ones, so that nothing is
/// forgotten at rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Window {
    /// Excitation (squares of the model's motion over those of the noise) that it holds at most, and to how much that grows
    /// with what comes: a memory that begins anew is short at first, so that what came before the change is soon gone.
    most: f64,
    limit: f64,
    /// Shortest memory, ticks: a few violent ticks are not all that is known.
    shortest: f64,
    n: f64,
    yy: f64,
    pp: [f64; MEMBERS],
    py: [f64; MEMBERS],
    /// Sums with the drift that the filter took off.
    pz: [f64; MEMBERS],
    zz: f64,
    zy: f64,
    /// The squares `pp` with their weights squared: what forgetting leaves of the averaging.
    pp2: [f64; MEMBERS],
}

/// What a window says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Finding {
    /// Gain over the model's, and its standard uncertainty.
    pub gain: f64,
    pub gain_sd: f64,
    /// Delay beyond the design's, samples, and its standard uncertainty.
    pub delay: f64,
    pub delay_sd: f64,
    /// The member that fits best.
    pub best: usize,
    /// By how many variances of the noise the others fit worse.
    pub worse: [f64; MEMBERS],
}

impl Finding {
    /// Logarithm of the gain; one that is no gain counts as a small one.
    pub fn log_gain(&self) -> f64 {
        self.gain.max(0.05).ln()
    }

    /// Standard uncertainty of the logarithm of the gain.
    pub fn log_sd(&self) -> f64 {
        self.gain_sd / self.gain.max(0.05)
    }
}

impl Window {
    pub fn new(most: f64, limit: f64, shortest: f64) -> Self {
        Self {
            most,
            limit,
            shortest,
            n: 0.0,
            yy: 0.0,
            pp: [0.0; MEMBERS],
            py: [0.0; MEMBERS],
            pz: [0.0; MEMBERS],
            zz: 0.0,
            zy: 0.0,
            pp2: [0.0; MEMBERS],
        }
    }

    /// The sums of another, kept as long as there at first, and in the end as long as here.
    pub fn taken_from(&self, other: &Self) -> Self {
        Self {
            limit: self.limit,
            shortest: self.shortest,
            ..*other
        }
    }

    /// One tick; `at` is the member in force, `noise_um2` the variance of `y` that the model does not explain. `z` is the drift
    /// that the filter had taken off the series: where the flow wanders less than the filter expects, or more, what is left
    /// goes with it, and so do the commands that answered it; without `z` that would pass for gain.
    pub fn add(&mut self, at: usize, p: &[f64; MEMBERS], z: f64, y: f64, noise_um2: f64) {
        let motion = p.get(at).copied().unwrap_or(0.0);
        let excitation = motion * motion / noise_um2;
        let keep = 1.0 - (excitation / self.most).min(1.0 / self.shortest);
        self.most = (self.most + GROWTH * excitation).min(self.limit);
        self.n = self.n * keep + 1.0;
        self.yy = self.yy * keep + y * y;
        self.zz = self.zz * keep + z * z;
        self.zy = self.zy * keep + z * y;
        for (j, p) in p.iter().enumerate() {
            self.pp[j] = self.pp[j] * keep + p * p;
            self.py[j] = self.py[j] * keep + p * y;
            self.pz[j] = self.pz[j] * keep + p * z;
            self.pp2[j] = self.pp2[j] * keep * keep + p * p;
        }
    }

    /// Variance that the best member leaves, um^2.
    pub fn residual_um2(&self, usable: &[bool; MEMBERS]) -> Option<f64> {
        let least = (0..MEMBERS)
            .filter(|&j| usable[j])
            .map(|j| self.squares(j))
            .fold(f64::INFINITY, f64::min);
        (self.n > 30.0 && least.is_finite()).then(|| least.max(0.0) / self.n)
    }

    /// Squares of a member's motion and its products with `y`, both without what goes with the drift.
    fn products(&self, j: usize) -> (f64, f64) {
        if self.zz <= 0.0 {
            return (self.pp[j], self.py[j]);
        }
        let part = self.pz[j] / self.zz;
        (self.pp[j] - part * self.pz[j], self.py[j] - part * self.zy)
    }

    /// Sum of squares that a member leaves; no gain below zero explains anything.
    fn squares(&self, j: usize) -> f64 {
        let (pp, py) = self.products(j);
        let yy = if self.zz > 0.0 {
            self.yy - self.zy * self.zy / self.zz
        } else {
            self.yy
        };
        let py = py.max(0.0);
        if pp > 0.0 { yy - py * py / pp } else { yy }
    }

    /// Gain and delay, where there is something to be said of them.
    pub fn finding(&self, usable: &[bool; MEMBERS], noise_um2: f64) -> Option<Finding> {
        let mut best = NOMINAL;
        let mut squares = [f64::INFINITY; MEMBERS];
        for j in (0..MEMBERS).filter(|&j| usable[j]) {
            squares[j] = self.squares(j);
            if squares[j] < squares[best] {
                best = j;
            }
        }
        let (pp, py) = self.products(best);
        if self.n < 8.0 || pp <= noise_um2 {
            return None;
        }
        let gain = py / pp;
        let (delay, delay_sd) = vertex(&squares, best, noise_um2);
        Some(Finding {
            gain,
            gain_sd: (noise_um2 * self.pp2[best] / (pp * pp))
                .sqrt()
                .hypot(MODEL_SD * gain),
            delay,
            delay_sd,
            best,
            worse: squares.map(|s| (s - squares[best]) / noise_um2),
        })
    }
}

/// Minimum of the parabola through the best member and its neighbours, and how sharp it is.
fn vertex(squares: &[f64; MEMBERS], best: usize, noise_um2: f64) -> (f64, f64) {
    let at = DELAYS[best];
    let neighbours = best
        .checked_sub(1)
        .and_then(|before| Some((*squares.get(before)?, *squares.get(best + 1)?)));
    let Some((before, after)) = neighbours.filter(|(b, a)| b.is_finite() && a.is_finite()) else {
        return (at, APART);
    };
    let bend = before - 2.0 * squares[best] + after;
    if bend.is_nan() || bend <= 0.0 {
        return (at, f64::INFINITY);
    }
    let off = (0.5 * (before - after) / bend).clamp(-0.5, 0.5);
    (at + APART * off, APART * (2.0 * noise_um2 / bend).sqrt())
}
