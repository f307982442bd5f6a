//! Hysteresis of relays, for the simulator that hides effects.

/// Classical Preisach model: relays over the half plane up > down, weights falling off from the diagonal and, slowly, from
/// the middle of the stroke. Evaluated exactly through its Everett function and the stack of remembered extremes (Mayergoyz,
/// Mathematical Models of Hysteresis, 1991, ch. 1). A grid of relays would move in steps that no piezo shows.
pub(super) struct Relays {
    width_um: f64,
    span: f64,
    /// Remembered extremes, alternating minimum and maximum, the outermost first.
    extremes: Vec<f64>,
    at: f64,
    scale: f64,
    /// Displacement at `at`, once known.
    value: Option<f64>,
}

impl Relays {
    pub(super) fn new(width_um: f64) -> Self {
        let span = 6.0 * width_um;
        let mut relays = Self {
            width_um,
            span,
            extremes: vec![-span],
            at: 0.0,
            scale: 1.0,
            value: None,
        };
        // Far from the last reversal the displacement follows the input: the nominal gain is that of the large stroke.
        relays.scale = 0.5 / width_um;
        // Demagnetised by an oscillation that dies out.
        for k in 0..400 {
            let a = span * (1.0 - f64::from(k) / 400.0);
            relays.extremes.push(if k % 2 == 0 { a } else { -a });
        }
        relays
    }

    /// Weight of all relays that switch between two extremes: `exp(-half width/width)` integrated over the triangle,
    /// falling off from the middle over ten widths.
    fn everett(&self, up: f64, down: f64) -> f64 {
        let (w, d) = (self.width_um, (up - down).max(0.0));
        let middle = 0.5 * (up + down) / (10.0 * w);
        (2.0 * d * w - 4.0 * w * w * (1.0 - (-0.5 * d / w).exp())) * (-middle * middle).exp()
    }

    /// Displacement after the input has gone straight to `u`.
    pub(super) fn follow(&mut self, u: f64) -> f64 {
        if u == self.at
            && let Some(value) = self.value
        {
            return value;
        }
        if u != self.at {
            let rising = u > self.at;
            let last_is_minimum = self.extremes.len() % 2 == 1;
            // A reversal is remembered.
            if rising != last_is_minimum {
                self.extremes.push(self.at);
            }
            // The input wipes out the extremes that it passes, in pairs.
            while self.extremes.len() >= 2 {
                let before = self.extremes[self.extremes.len() - 2];
                if (rising && u >= before) || (!rising && u <= before) {
                    self.extremes.pop();
                    self.extremes.pop();
                } else {
                    break;
                }
            }
            if self.extremes.is_empty() {
                self.extremes.push(-self.span);
            }
            self.at = u;
        }
        let mut sum = -0.5 * self.everett(self.span, -self.span);
        let mut low = self.extremes[0];
        let mut k = 1;
        loop {
            let high = self.extremes.get(k).copied();
            match high {
                None => {
                    sum += self.everett(self.at.max(low), low);
                    break;
                }
                Some(high) => {
                    let next = self.extremes.get(k + 1).copied().unwrap_or(self.at);
                    sum += self.everett(high, low) - self.everett(high, next.min(high));
                    low = next;
                    if k + 1 >= self.extremes.len() {
                        break;
                    }
                    k += 2;
                }
            }
        }
        self.value = Some(sum * self.scale);
        sum * self.scale
    }
}
