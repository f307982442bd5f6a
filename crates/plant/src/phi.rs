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
}
