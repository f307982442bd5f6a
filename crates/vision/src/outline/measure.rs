//! Moments of the area inside the contour, and their uncertainty.

use super::{BORDER_PX, Contrast, Outline, Outliner, normals, smear};

/// Share of a disc's second moments that an outline's have at least.
const LEAST_MOMENT: f64 = 0.05;

impl Outliner {
    /// Radius of the disc with the contour's area, px.
    pub(super) fn radius_px(&self) -> f64 {
        let n = self.points.len();
        let cross = |(i, a): (usize, &(f64, f64))| {
            let b = self.points[(i + 1) % n];
            a.0 * b.1 - b.0 * a.1
        };
        let area = 0.5 * self.points.iter().enumerate().map(cross).sum::<f64>();
        (area.abs() / core::f64::consts::PI).sqrt().max(1.0)
    }

    /// Half axes of the ellipse with the second moments of the contour's points, px.
    pub(super) fn half_axes_px(&self) -> (f64, f64) {
        let n = self.points.len().max(1) as f64;
        let sum = self
            .points
            .iter()
            .fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
        let (mx, my) = (sum.0 / n, sum.1 / n);
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for (x, y) in self.points.iter().map(|p| (p.0 - mx, p.1 - my)) {
            xx += x * x / n;
            xy += x * y / n;
            yy += y * y / n;
        }
        // Points on a circle have half of its squared radius along each axis.
        let (mean, half) = (0.5 * (xx + yy), 0.5 * f64::hypot(xx - yy, 2.0 * xy));
        let axis = |moment: f64| (2.0 * moment.max(0.0)).sqrt();
        (axis(mean + half), axis(mean - half))
    }

    /// Sums over the polygon; `variance` is that of a pixel about the mean profile, grey^2.
    pub(super) fn measure(
        &mut self,
        contrast: &Contrast,
        variance: f64,
        (rim_grey, halo_grey): (f64, f64),
        edge_px: f64,
    ) -> Option<Outline> {
        let n = self.points.len();
        let &(x0, y0) = self.points.first()?;
        let (mut area, mut sx, mut sy, mut sxx, mut sxy, mut syy) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        // By Green's theorem.
        for i in 0..n {
            let (a, b) = (self.points[i], self.points[(i + 1) % n]);
            let (a, b) = ((a.0 - x0, a.1 - y0), (b.0 - x0, b.1 - y0));
            let cross = a.0 * b.1 - b.0 * a.1;
            area += cross / 2.0;
            sx += cross * (a.0 + b.0) / 6.0;
            sy += cross * (a.1 + b.1) / 6.0;
            sxx += cross * (a.0 * a.0 + a.0 * b.0 + b.0 * b.0) / 12.0;
            syy += cross * (a.1 * a.1 + a.1 * b.1 + b.1 * b.1) / 12.0;
            sxy += cross * (2.0 * a.0 * a.1 + 2.0 * b.0 * b.1 + a.0 * b.1 + b.0 * a.1) / 24.0;
        }
        if area <= 0.0 || !area.is_finite() {
            return None;
        }
        let (mx, my) = (sx / area, sy / area);
        // A polygon on a smooth curve leaves the bows outside: 2/3 pi^2 / n^2 of the area for a circle.
        let bows = 1.0 + 2.0 / 3.0 * (core::f64::consts::PI / n as f64).powi(2);
        let moments = [
            bows * (sxx / area - mx * mx),
            bows * (sxy / area - mx * my),
            bows * (syy / area - my * my),
        ];
        // The contour of something hardly larger than a pixel may cross itself.
        let least = LEAST_MOMENT * area / (4.0 * core::f64::consts::PI);
        if moments[0].min(moments[2]) < least
            || moments[0] * moments[2] - moments[1] * moments[1] < least * least
        {
            return None;
        }
        let area_px = bows * area;
        let (x_px, y_px) = (x0 + mx, y0 + my);
        let mut information = [0.0; smear::WAYS + 1];
        for (known, profile) in information.iter_mut().zip(&self.smear.profiles) {
            *known = profile.information();
        }
        let mut c = [0.0; 6];
        // Integrals along the contour: of 1, and of a point's contribution to the moments.
        let mut around = [0.0; 4];
        let (mut place, mut area_variance, mut point_variance) = ([0.0; 3], 0.0, 0.0);
        for i in 0..n {
            let (a, b) = (self.points[(i + n - 1) % n], self.points[(i + 1) % n]);
            let length = 0.5 * f64::hypot(b.0 - a.0, b.1 - a.1);
            let amplitude = self.amplitudes[i];
            let which = self.normals.get(i).map_or(0, |n| self.smear.which(n));
            let each = length * variance / (information[which] * amplitude * amplitude);
            let (x, y) = (self.points[i].0 - x_px, self.points[i].1 - y_px);
            area_variance += each;
            point_variance += each / (length * length).max(1e-9);
            place[0] += each * x * x;
            place[1] += each * y * y;
            place[2] += each * x * y;
            let m = [x * x - moments[0], x * y - moments[1], y * y - moments[2]];
            for (sum, m) in around.iter_mut().zip([1.0, m[0], m[1], m[2]]) {
                *sum += length * m;
            }
            let pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];
            for (sum, (i, j)) in c.iter_mut().zip(pairs) {
                *sum += each * m[i] * m[j];
            }
        }
        let hull_area = self.hull_area();
        let left_px = self.left_px((area_px / core::f64::consts::PI).sqrt(), edge_px);
        area_variance += (left_px * around[0]).powi(2);
        let pairs = [(1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3)];
        for (sum, (i, j)) in c.iter_mut().zip(pairs) {
            *sum += left_px * left_px * around[i] * around[j];
        }
        let over = 1.0 / (area_px * area_px);
        let (width, height) = (contrast.width as f64, contrast.height as f64);
        let at_border = self.points.iter().any(|&(x, y)| {
            x < BORDER_PX
                || y < BORDER_PX
                || x > width - 1.0 - BORDER_PX
                || y > height - 1.0 - BORDER_PX
        });
        Some(Outline {
            x_px,
            y_px,
            place_variances: place.map(|v| v * over),
            area_px,
            area_variance,
            moments_px2: moments,
            moment_variances: c.map(|v| v * over),
            rim_grey,
            halo_grey,
            solidity: (area / hull_area).min(1.0),
            dents_px: self.dents_px(),
            point_variance: point_variance / n as f64,
            open_px: self.open_px(),
            edge_px,
            at_border,
        })
    }

    /// Standard deviation of the error that all points of an outline have in common, px. Nobody knows how much of an edge's width is
    /// another focus. To first order in its square a blur moves a round edge by half of it over the radius. The rim and the halo of a blurred
    /// step are one standard deviation of the blur from its middle. The known blur of a frame also moves an edge that is not symmetric, by up
    /// to half of its square over the edge's width.
    fn left_px(&self, radius_px: f64, edge_px: f64) -> f64 {
        let by_focus = 0.5 * (0.5 * edge_px).powi(2) / radius_px.max(1.0);
        let by_blur = 0.5 * self.blur_px * self.blur_px / edge_px;
        let by_smear = self.smear.left_px(radius_px);
        f64::hypot(by_focus, f64::hypot(by_blur, by_smear))
    }

    /// Length of the longest stretch of the contour that has no edge, px.
    fn open_px(&self) -> f64 {
        let n = self.points.len();
        let (mut open, mut longest) = (0.0, 0.0_f64);
        // Twice round, for a stretch over the first point.
        for i in 0..2 * n {
            let (a, b) = (self.points[i % n], self.points[(i + 1) % n]);
            let has_edge = |k: usize| self.amplitudes[k % n] > normals::AMPLITUDES.0;
            if has_edge(i) || has_edge(i + 1) {
                open = 0.0;
            } else {
                open += f64::hypot(b.0 - a.0, b.1 - a.1);
                longest = longest.max(open);
            }
        }
        longest
    }

    /// Depths of the two deepest dents below the convex hull that was laid last, px.
    fn dents_px(&self) -> [f64; 2] {
        let (n, edges) = (self.points.len(), self.hull.len());
        let mut deepest = [0.0_f64; 2];
        let Some(first) = self.hull.first() else {
            return deepest;
        };
        let Some(start) = self.points.iter().position(|p| p == first) else {
            return deepest;
        };
        // Contour and hull go round in the same sense.
        let (mut edge, mut depth) = (0, 0.0_f64);
        for k in 1..=n {
            let at = |k: usize| self.points[(start + k) % n];
            let (a, b) = (self.hull[edge % edges], self.hull[(edge + 1) % edges]);
            if at(k) == b {
                let [most, second] = &mut deepest;
                if depth > *most {
                    (*most, *second) = (depth, *most);
                } else if depth > *second {
                    *second = depth;
                }
                (edge, depth) = (edge + 1, 0.0);
                continue;
            }
            let (before, own, next) = (at(k + n - 1), at(k), at(k + 1));
            let mean = |a: f64, b: f64, c: f64| 0.25 * (a + c) + 0.5 * b;
            let (x, y) = (
                mean(before.0, own.0, next.0) - a.0,
                mean(before.1, own.1, next.1) - a.1,
            );
            let (tx, ty) = (b.0 - a.0, b.1 - a.1);
            depth = depth.max((tx * y - ty * x) / f64::hypot(tx, ty).max(1e-9));
        }
        deepest
    }

    /// Area of the contour's convex hull (Andrew's monotone chain).
    fn hull_area(&mut self) -> f64 {
        self.sorted.clear();
        self.sorted.extend(&self.points);
        self.sorted
            .sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        self.hull.clear();
        let turn = |a: (f64, f64), b: (f64, f64), c: (f64, f64)| {
            (b.0 - a.0) * (c.1 - a.1) - (b.1 - a.1) * (c.0 - a.0)
        };
        for back in [false, true] {
            let base = self.hull.len();
            for k in 0..self.sorted.len() {
                let at = if back { self.sorted.len() - 1 - k } else { k };
                let p = self.sorted[at];
                while let [.., a, b] = self.hull.as_slice()
                    && self.hull.len() >= base + 2
                    && turn(*a, *b, p) <= 0.0
                {
                    self.hull.pop();
                }
                self.hull.push(p);
            }
            // The last point is the first of the way back.
            self.hull.pop();
        }
        let mut area = 0.0;
        for (k, a) in self.hull.iter().enumerate() {
            let b = self.hull[(k + 1) % self.hull.len()];
            area += 0.5 * (a.0 * b.1 - b.0 * a.1);
        }
        area.abs().max(1e-9)
    }
}
