//! What the fixes of all beads have in common: a running mean, and scales that differ from fix to fix.

/// Share of a new fix.
const FORGETTING: f64 = 1.0 / 64.0;

/// A running mean, of all fixes at first.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Pool {
    pub mean: f64,
    fixes: f64,
}

impl Pool {
    /// A mean that is known as from so many fixes.
    pub(crate) fn known(mean: f64, fixes: f64) -> Self {
        Pool { mean, fixes }
    }

    pub(crate) fn take_in(&mut self, value: f64) {
        self.fixes += 1.0;
        self.mean += (value - self.mean) * (1.0 / self.fixes).max(FORGETTING);
    }

    /// The mean; `None` before the first value.
    pub(crate) fn usual(&self) -> Option<f64> {
        (self.fixes > 0.0).then_some(self.mean)
    }

    /// Takes in a value that is known from some fixes and gives it drawn towards the mean of all, as if that were known from
    /// `weight` of them.
    pub(crate) fn shrink(&mut self, own: f64, fixes: f64, weight: f64) -> f64 {
        self.take_in(own);
        (fixes * own + weight * self.mean) / (fixes + weight)
    }
}

/// Variances that differ from fix to fix about a common one, by an inverse chi-square law of some degrees of freedom: the prior of the next
/// one. Its two parameters are the mean and the variance of the logarithms (Smyth 2004), so that few fixes with a large one
/// do not carry it.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Scales {
    mean: f64,
    variance: f64,
    /// Variance of the logarithms that the estimates' own errors make.
    own: f64,
    fixes: f64,
}

impl Scales {
    /// Takes in a variance above 0 that was estimated with so many degrees of freedom, 5 or more.
    pub(crate) fn take_in(&mut self, value: f64, freedom: f64) {
        self.fixes += 1.0;
        let share = (1.0 / self.fixes).max(FORGETTING);
        let off = value.ln() + bias(freedom) - self.mean;
        self.mean += share * off;
        self.variance = (1.0 - share) * (self.variance + share * off * off);
        self.own += share * (spread(freedom) - self.own);
    }

    /// The mean of the posterior of a variance, given an estimate of it with so many degrees of freedom.
    pub(crate) fn moderate(&self, value: f64, freedom: f64) -> f64 {
        let Some(common) = self.common() else {
            return value;
        };
        match self.prior() {
            Some(prior) => (prior * common + freedom * value) / (prior + freedom),
            None => common,
        }
    }

    /// The common variance; `None` before the first fix.
    pub(crate) fn common(&self) -> Option<f64> {
        let common = (self.mean - self.prior().map_or(0.0, bias)).exp();
        (self.fixes > 0.0).then_some(common)
    }

    /// Degrees of freedom of the law; `None` where the estimates' own errors are all the difference.
    fn prior(&self) -> Option<f64> {
        let excess = self.variance - self.own;
        // spread(prior) = excess
        (excess > 0.0).then(|| 1.0 + 2.0 / excess)
    }
}

/// By how much the logarithm of an estimate with so many degrees of freedom is too small on average, and its variance: ln(x) - psi(x) and
/// psi'(x) at half of them, by their series, to a tenth from 2 degrees of freedom on.
fn bias(freedom: f64) -> f64 {
    1.0 / freedom + 1.0 / (3.0 * freedom * freedom)
}

fn spread(freedom: f64) -> f64 {
    2.0 / (freedom - 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Estimates of a variance with so many degrees of freedom.
    fn estimates(freedom: u32) -> impl FnMut(f64) -> f64 {
        let mut random = cellpos_numeric::Random::new(5);
        // Two squares of normal numbers are an exponential one.
        move |variance| {
            let sum: f64 = (0..freedom / 2)
                .map(|_| -2.0 * (1.0 - random.uniform()).ln())
                .sum();
            variance * sum / f64::from(freedom)
        }
    }

    #[test]
    fn variances_that_are_all_alike_are_known_from_all_and_a_few_large_ones_from_themselves() {
        let mut estimate = estimates(40);
        let mut scales = Scales::default();
        (0..400).for_each(|_| scales.take_in(estimate(9.0), 40.0));
        let alike = scales.moderate(18.0, 40.0);
        assert!((alike / 9.0 - 1.0).abs() < 0.15, "{alike}");
        // One fix in four is beside a speck.
        for k in 0..400 {
            let variance = if k % 4 == 0 { 900.0 } else { 9.0 };
            scales.take_in(estimate(variance), 40.0);
        }
        let (clean, beside) = (scales.moderate(9.0, 40.0), scales.moderate(900.0, 40.0));
        assert!((clean / 9.0 - 1.0).abs() < 0.15, "{clean}");
        assert!((beside / 900.0 - 1.0).abs() < 0.15, "{beside}");
    }
}
