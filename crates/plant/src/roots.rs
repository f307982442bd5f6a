//! Roots of real polynomials; the roots may be many decades apart. Not for degrees beyond about 30.

use nalgebra::Complex;

/// Evaluates a polynomial given from the highest power down.
pub(crate) fn evaluate(coefficients: &[f64], s: Complex<f64>) -> Complex<f64> {
    coefficients
        .iter()
        .fold(Complex::new(0.0, 0.0), |sum, &c| sum * s + c)
}

/// The product of two polynomials given from the highest power down.
pub(crate) fn multiply(a: &[f64], b: &[f64]) -> Vec<f64> {
    if a.is_empty() || b.is_empty() {
        return Vec::new();
    }
    let mut product = vec![0.0; a.len() + b.len() - 1];
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            product[i + j] += x * y;
        }
    }
    product
}

/// The roots of a real polynomial given from the highest power down, sorted by magnitude. Real roots have an imaginary
/// part of exactly zero; complex ones come in exactly conjugate pairs.
///
/// Degree one and two in closed form without cancellation; above, Aberth's simultaneous iteration started from the
/// polynomial's Newton polygon (Bini 1996), which finds roots many decades apart.
pub(crate) fn roots(coefficients: &[f64]) -> Vec<Complex<f64>> {
    let first = coefficients.iter().position(|&c| c != 0.0);
    let Some(first) = first else {
        return Vec::new();
    };
    let mut p = &coefficients[first..];
    let mut found = Vec::with_capacity(p.len());
    while p.len() > 1 && p[p.len() - 1] == 0.0 {
        found.push(Complex::new(0.0, 0.0));
        p = &p[..p.len() - 1];
    }
    match *p {
        [] | [_] => {}
        [a, b] => found.push(Complex::new(-b / a, 0.0)),
        [a, b, c] => found.extend(quadratic(a, b, c)),
        _ => found.extend(paired(aberth(p))),
    }
    found.sort_by(|x, y| {
        x.norm()
            .total_cmp(&y.norm())
            .then(x.re.total_cmp(&y.re))
            .then(x.im.total_cmp(&y.im))
    });
    found
}

fn quadratic(a: f64, b: f64, c: f64) -> [Complex<f64>; 2] {
    let half = 0.5 * b;
    let discriminant = half * half - a * c;
    if discriminant < 0.0 {
        let im = (-discriminant).sqrt() / a.abs();
        return [Complex::new(-half / a, im), Complex::new(-half / a, -im)];
    }
    let q = -(half + discriminant.sqrt().copysign(half));
    if q == 0.0 {
        return [Complex::new(0.0, 0.0); 2];
    }
    [Complex::new(q / a, 0.0), Complex::new(c / q, 0.0)]
}

/// Radii of the roots from the upper convex hull of (power, log |coefficient|).
fn start_values(p: &[f64]) -> Vec<Complex<f64>> {
    let n = p.len() - 1;
    // Ascending powers for the hull.
    let points: Vec<(f64, f64)> = (0..=n)
        .filter(|&k| p[n - k] != 0.0)
        .map(|k| (k as f64, p[n - k].abs().ln()))
        .collect();
    let mut hull: Vec<(f64, f64)> = Vec::new();
    for &point in &points {
        while hull.len() >= 2 {
            let (a, b) = (hull[hull.len() - 2], hull[hull.len() - 1]);
            if (b.1 - a.1) * (point.0 - a.0) <= (point.1 - a.1) * (b.0 - a.0) {
                hull.pop();
            } else {
                break;
            }
        }
        hull.push(point);
    }
    let mut start = Vec::with_capacity(n);
    for pair in hull.windows(2) {
        let count = (pair[1].0 - pair[0].0) as usize;
        let radius = ((pair[0].1 - pair[1].1) / count as f64).exp();
        for i in 0..count {
            // An angle that no symmetry of a real polynomial shares.
            let angle =
                std::f64::consts::TAU * (i as f64 / count as f64) + 0.7 + 0.1 * start.len() as f64;
            start.push(Complex::from_polar(radius, angle));
        }
    }
    start
}

fn aberth(p: &[f64]) -> Vec<Complex<f64>> {
    let n = p.len() - 1;
    let derivative: Vec<f64> = p[..n]
        .iter()
        .enumerate()
        .map(|(i, c)| c * (n - i) as f64)
        .collect();
    let mut z = start_values(p);
    for _ in 0..400 {
        let mut moved = 0.0_f64;
        for i in 0..n {
            let value = evaluate(p, z[i]);
            if value.norm() == 0.0 {
                continue;
            }
            let newton = value / evaluate(&derivative, z[i]);
            let repulsion: Complex<f64> = (0..n)
                .filter(|&j| j != i)
                .map(|j| Complex::new(1.0, 0.0) / (z[i] - z[j]))
                .filter(|t| t.is_finite())
                .sum();
            let step = newton / (Complex::new(1.0, 0.0) - newton * repulsion);
            if step.is_finite() {
                z[i] -= step;
                moved = moved.max(step.norm() / z[i].norm().max(f64::MIN_POSITIVE));
            }
        }
        if moved < 1e-15 {
            break;
        }
    }
    z
}

/// Makes a set of computed roots symmetric about the real axis.
fn paired(mut z: Vec<Complex<f64>>) -> Vec<Complex<f64>> {
    let mut out = Vec::with_capacity(z.len());
    while let Some(a) = z.pop() {
        if a.im.abs() <= 1e-9 * a.norm() {
            out.push(Complex::new(a.re, 0.0));
            continue;
        }
        let partner = (0..z.len()).min_by(|&i, &j| {
            (z[i] - a.conj())
                .norm()
                .total_cmp(&(z[j] - a.conj()).norm())
        });
        match partner {
            Some(i) if (z[i] - a.conj()).norm() <= 1e-3 * a.norm() => {
                let b = z.swap_remove(i);
                let mean = (a + b.conj()) * 0.5;
                out.push(Complex::new(mean.re, mean.im.abs()));
                out.push(Complex::new(mean.re, -mean.im.abs()));
            }
            // A nearly double real root, computed with a small imaginary part.
            _ => out.push(Complex::new(a.re, 0.0)),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roots_many_decades_apart_are_found_to_near_machine_precision() {
        let wanted = [-0.001_704, -1.5, -76.3, -900.0, -20_175.0];
        let p = wanted
            .iter()
            .fold(vec![1.0], |p, r| multiply(&p, &[1.0, -r]));
        let found = roots(&p);
        for (z, w) in found.iter().zip(wanted) {
            assert!((z.re - w).abs() < 1e-11 * w.abs() && z.im == 0.0, "{z} {w}");
        }
    }

    #[test]
    fn complex_roots_come_as_exact_conjugates() {
        let p = multiply(
            &multiply(&[1.0, 40.0, 1e6], &[1.0, 3.0, 900.0]),
            &[1.0, 5.0],
        );
        let found = roots(&p);
        assert_eq!(found.len(), 5);
        assert!((found[0].re + 5.0).abs() < 1e-11);
        assert_eq!(found[1].conj(), found[2]);
        assert_eq!(found[3].conj(), found[4]);
        assert!((found[3].norm() - 1000.0).abs() < 1e-8);
    }

    #[test]
    fn zero_roots_and_double_roots_are_kept() {
        assert_eq!(roots(&[1.0, 3.0, 0.0, 0.0]).len(), 3);
        let double = roots(&[1.0, 2.0, 1.0]);
        assert_eq!(double, vec![Complex::new(-1.0, 0.0); 2]);
        assert!(roots(&[4.0]).is_empty() && roots(&[]).is_empty());
    }
}
