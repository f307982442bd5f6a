//! The functions of exponential integrators, without cancellation near zero.

use nalgebra::Complex;

/// `exp(z)`, `phi1 = (e^z - 1)/z`, `phi2 = (e^z - 1 - z)/z^2`, `phi3 = (e^z - 1 - z - z^2/2)/z^3`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Phi {
    pub exp: Complex<f64>,
    pub one: Complex<f64>,
    pub two: Complex<f64>,
    pub three: Complex<f64>,
}

pub(crate) fn phi(z: Complex<f64>) -> Phi {
    let unit = Complex::new(1.0, 0.0);
    if z.norm() < 0.5 {
        // phi3 by its series sum z^k/(k+3)!; 14 terms are beyond double precision for |z| < 0.5.
        let mut three = Complex::new(0.0, 0.0);
        for k in (0..14).rev() {
            three = three * z / f64::from(k + 4) + unit;
        }
        three /= 6.0;
        let two = three * z + 0.5;
        let one = two * z + 1.0;
        return Phi {
            exp: one * z + 1.0,
            one,
            two,
            three,
        };
    }
    let exp = z.exp();
    let one = (exp - 1.0) / z;
    let two = (one - 1.0) / z;
    let three = (two - 0.5) / z;
    Phi {
        exp,
        one,
        two,
        three,
    }
}

/// `exp(x)`, `phi1` and `phi2` of a real number, fast: a block that changes from step to step calls it in every step.
pub(crate) fn phi_real(x: f64) -> [f64; 3] {
    if x.abs() < 0.5 {
        // phi2 by its series sum x^k/(k+2)!, to double precision.
        let last = if x.abs() < 0.03 { 6 } else { 14 };
        let mut two = 1.0;
        for inverse in INVERSE[1..=last].iter().rev() {
            two = two * (x * inverse) + 1.0;
        }
        two *= 0.5;
        let one = two * x + 1.0;
        return [one * x + 1.0, one, two];
    }
    let exp = x.exp();
    let one = (exp - 1.0) / x;
    [exp, one, (one - 1.0) / x]
}

/// `1/(k + 2)`.
const INVERSE: [f64; 15] = {
    let mut all = [0.0; 15];
    let mut k = 0;
    while k < 15 {
        all[k] = 1.0 / (k as f64 + 2.0);
        k += 1;
    }
    all
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn series_and_closed_form_agree_where_they_meet() {
        for angle in [0.0, 1.0, 2.5, 3.1] {
            let inside = phi(Complex::from_polar(0.499_999_999, angle));
            let outside = phi(Complex::from_polar(0.500_000_001, angle));
            for (a, b) in [
                (inside.exp, outside.exp),
                (inside.one, outside.one),
                (inside.two, outside.two),
                (inside.three, outside.three),
            ] {
                assert!((a - b).norm() < 5e-9, "{a} {b}");
            }
        }
        let zero = phi(Complex::new(0.0, 0.0));
        assert_eq!(zero.one.re, 1.0);
        assert_eq!(zero.two.re, 0.5);
        assert!((zero.three.re - 1.0 / 6.0).abs() < 1e-16);
    }

    #[test]
    fn real_and_complex_agree() {
        for x in [
            -40.0, -3.0, -0.6, -0.4, -0.031, -0.029, -1e-3, 0.0, 0.2, 0.499, 0.7, 5.0,
        ] {
            let f = phi(Complex::new(x, 0.0));
            for (a, b) in phi_real(x).into_iter().zip([f.exp.re, f.one.re, f.two.re]) {
                assert!((a - b).abs() <= 1e-14 * b.abs().max(1.0), "{x}: {a} {b}");
            }
        }
    }
}
