//! Thinning of long traces to the resolution of a screen.

/// A run of points, in pixels, without a gap.
pub(crate) type Run = Vec<(f64, f64)>;

/// Keeps of each pixel column the first, lowest, highest and last point, in their order.
///
/// A line through the result covers the same pixels as a line through all points: no spike is lost.
pub(crate) fn line(run: Run) -> Run {
    // Below a few points per pixel column nothing is gained.
    if run.len() < 2000 {
        return run;
    }
    let mut kept = Run::new();
    let mut start = 0;
    while start < run.len() {
        let column = run[start].0.floor();
        let end = run[start..]
            .iter()
            .position(|(x, _)| x.floor() != column)
            .map_or(run.len(), |length| start + length);
        let (mut low, mut high) = (start, start);
        for index in start..end {
            if run[index].1 < run[low].1 {
                low = index;
            }
            if run[index].1 > run[high].1 {
                high = index;
            }
        }
        let mut picked = [start, low.min(high), low.max(high), end - 1];
        picked.sort_unstable();
        let mut before = None;
        for index in picked {
            if before != Some(index) {
                kept.push(run[index]);
            }
            before = Some(index);
        }
        start = end;
    }
    kept
}

/// Keeps one band edge pair per pixel column: the lowest low and the highest high.
pub(crate) fn band(run: Vec<(f64, f64, f64)>) -> Vec<(f64, f64, f64)> {
    if run.len() < 2000 {
        return run;
    }
    let mut kept: Vec<(f64, f64, f64)> = Vec::new();
    for (x, a, b) in run {
        let (low, high) = (a.min(b), a.max(b));
        match kept.last_mut() {
            Some((last, l, h)) if last.floor() == x.floor() => {
                *l = l.min(low);
                *h = h.max(high);
            }
            _ => kept.push((x, low, high)),
        }
    }
    kept
}

/// Keeps one point per cell of two pixels: points on top of each other do not show.
pub(crate) fn points(run: Run) -> Run {
    if run.len() < 2000 {
        return run;
    }
    let mut seen = std::collections::BTreeSet::new();
    run.into_iter()
        .filter(|(x, y)| seen.insert(((x / 2.0).floor() as i64, (y / 2.0).floor() as i64)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thinned_line_keeps_every_spike_and_both_ends() {
        let mut run: Run = (0..600_000)
            .map(|k| (f64::from(k) / 1000.0, f64::from(k % 7)))
            .collect();
        run[123_456].1 = 99.0;
        run[432_100].1 = -99.0;
        let thin = line(run.clone());
        assert!(thin.len() <= 4 * 601, "{}", thin.len());
        assert!(thin.contains(&run[123_456]));
        assert!(thin.contains(&run[432_100]));
        assert_eq!(thin.first(), run.first());
        assert_eq!(thin.last(), run.last());
        assert!(thin.windows(2).all(|pair| pair[0].0 <= pair[1].0));
    }

    #[test]
    fn a_thinned_band_holds_the_whole_band() {
        let run: Vec<_> = (0..50_000)
            .map(|k| (f64::from(k) / 100.0, -f64::from(k % 13), f64::from(k % 11)))
            .collect();
        let thin = band(run);
        assert_eq!(thin.len(), 500);
        assert!(
            thin.iter()
                .all(|(_, low, high)| *low == -12.0 && *high == 10.0)
        );
    }

    #[test]
    fn short_runs_are_left_alone() {
        let run: Run = (0..100).map(|k| (f64::from(k) / 100.0, 1.0)).collect();
        assert_eq!(line(run.clone()), run);
        assert_eq!(points(run.clone()), run);
    }
}
