//! Which rows count in a fit.

use crate::dot::dot;
use std::ops::Range;

/// Which rows of which record count in a fit: ranges per record.
pub(crate) type Mask = Vec<Vec<Range<usize>>>;

/// The first 60 % of the `rows` of every record, to fit on, and the rest, to judge by.
pub(crate) fn split_in_time(rows: impl Iterator<Item = usize>) -> (Mask, Mask) {
    let cuts: Vec<(usize, usize)> = rows.map(|n| (n * 6 / 10, n)).collect();
    (before(&cuts), after(&cuts))
}

/// Twice rows to fit on and rows to judge by: the first 60 % of what a change of the innovations does in every record, and the last
/// 60 %. Rows that it does not change say nothing of it: in a share of the time there may be none that do.
pub(crate) fn splits_of(change: &[Vec<f64>]) -> [(Mask, Mask); 2] {
    let cuts = |share: f64| -> Vec<(usize, usize)> {
        let of = |c: &Vec<f64>| (row_at(c, share), c.len());
        change.iter().map(of).collect()
    };
    let (late, early) = (cuts(0.6), cuts(0.4));
    [
        (before(&late), after(&late)),
        (after(&early), before(&early)),
    ]
}

/// The row by which a change has done a share of the whole; without one, that share of the rows.
fn row_at(change: &[f64], share: f64) -> usize {
    let whole = dot(change, change);
    if whole <= 0.0 {
        return (share * change.len() as f64) as usize;
    }
    let mut done = 0.0;
    let by = |x: &f64| {
        done += x * x;
        done >= share * whole
    };
    change.iter().position(by).map_or(change.len(), |k| k + 1)
}

fn before(cuts: &[(usize, usize)]) -> Mask {
    let of = |(cut, _): &(usize, usize)| std::iter::once(0..*cut).collect();
    cuts.iter().map(of).collect()
}

fn after(cuts: &[(usize, usize)]) -> Mask {
    let of = |(cut, rows): &(usize, usize)| std::iter::once(*cut..*rows).collect();
    cuts.iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_few_rows_show_is_split_within_these() {
        let few: Vec<f64> = (0..1000)
            .map(|k| f64::from(u8::from((600..700).contains(&k))))
            .collect();
        let [late, early] = splits_of(&[few, vec![0.0; 10]]);
        let one_each = |of: [Range<usize>; 2]| of.map(|rows| Vec::from_iter([rows]));
        assert_eq!(late.0, one_each([0..660, 0..6]));
        assert_eq!(late.1, one_each([660..1000, 6..10]));
        assert_eq!(early.0, one_each([640..1000, 4..10]));
        assert_eq!(early.1, one_each([0..640, 0..4]));
    }
}
