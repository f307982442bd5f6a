//! How far a model may be off by its own statement.
//!
//! A model that was identified has a covariance. A response by which it may be off is no evidence for an effect. So these responses enter the
//! covariance of the residuals, one for each principal direction of the parameters. Without them an error of the delay by two of its standard
//! deviations would be named, or hide a name.

use nalgebra::{DMatrix, SymmetricEigen};

use cellpos_plant::{Model, TransferFunction};

/// Part of a standard deviation by which a model is moved: there its response is linear in the parameters.
pub(crate) const STEP: f64 = 0.05;
/// Directions with less than this part of the largest correlation are rounding.
const LEAST: f64 = 1e-9;

/// Models that are [`STEP`] standard deviations off the given one, along each direction of its covariance; none if it states no covariance
/// of finite numbers.
pub(crate) fn off_by_a_step(model: &Model) -> Vec<Model> {
    let Some(stated) = &model.covariance else {
        return Vec::new();
    };
    let n = stated.parameters.len();
    let of = |i: usize, j: usize| stated.matrix.get(i).and_then(|row| row.get(j)).copied();
    let mut covariance = DMatrix::from_fn(n, n, |i, j| of(i, j).unwrap_or(0.0));
    // A parameter that the model does not hold, such as a delay that is to be found, is no error of it: the others are as uncertain as
    // with that one known.
    for (k, _) in (stated.parameters.iter().enumerate()).filter(|(_, name)| !has(model, name)) {
        let (row, variance) = (covariance.row(k).into_owned(), covariance[(k, k)]);
        if variance > 0.0 {
            covariance -= row.transpose() * &row / variance;
        }
        covariance.row_mut(k).fill(0.0);
        covariance.column_mut(k).fill(0.0);
    }
    let sd: Vec<f64> = (covariance.diagonal().iter().map(|v| v.max(0.0).sqrt())).collect();
    // The parameters have different units, their correlations have none.
    let correlation = DMatrix::from_fn(n, n, |i, j| match sd[i] * sd[j] {
        0.0 => 0.0,
        both => covariance[(i, j)] / both,
    });
    // The decomposition of NaN would never end.
    if n == 0 || correlation.iter().any(|c| !c.is_finite()) {
        return Vec::new();
    }
    let eigen = SymmetricEigen::new(correlation);
    let largest = eigen.eigenvalues.max();
    let directions = eigen
        .eigenvalues
        .iter()
        .zip(eigen.eigenvectors.column_iter());
    directions
        .filter(|(variance, _)| **variance > LEAST * largest)
        .filter_map(|(variance, way)| {
            let step = STEP * variance.sqrt();
            let moved = stated.parameters.iter().zip(&sd).zip(way.iter());
            (moved.into_iter()).try_fold(model.clone(), |model, ((name, sd), way)| {
                moved_by(model, name, step * sd * way)
            })
        })
        .collect()
}

/// Whether a model holds a parameter.
fn has(model: &Model, name: &str) -> bool {
    let of = name.split_once('.').map_or(name, |(of, _)| of);
    of == "plant" || model.effect(of).is_some()
}

/// The model with one parameter changed: `plant.num[0]` or `EFFECT.PARAMETER`. `None` if the result is no model, or has no such
/// parameter.
fn moved_by(mut model: Model, name: &str, by: f64) -> Option<Model> {
    if by == 0.0 {
        return Some(model);
    }
    let (of, parameter) = name.split_once('.')?;
    if of == "plant" {
        let (mut num, mut den) = (model.plant.num().to_vec(), model.plant.den().to_vec());
        let (list, index) = parameter.strip_suffix(']')?.split_once('[')?;
        let coefficients = match list {
            "num" => &mut num,
            "den" => &mut den,
            _ => return None,
        };
        *coefficients.get_mut(index.parse::<usize>().ok()?)? += by;
        model.plant = TransferFunction::new(num, den).ok()?;
        return Some(model);
    }
    let effect = model.effects.iter_mut().find(|e| e.id() == of)?;
    let stated = effect.parameters();
    let value = stated.iter().find(|p| p.name == parameter)?.value;
    *effect = effect.with_parameter(parameter, value + by).ok()?;
    Some(model)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cellpos_plant::{Covariance, effects};

    fn model(matrix: Vec<Vec<f64>>) -> Model {
        let mut model = Model::eq6().with_effect(effects::time_delay(2e-3));
        model.plant = TransferFunction::new(vec![400.0], vec![1.0, 0.0]).expect("a plant");
        model.covariance = Some(Covariance {
            parameters: ["plant.num[0]", "plant.den[1]", "time-delay.delay_s"]
                .map(str::to_owned)
                .to_vec(),
            matrix,
        });
        model
    }

    #[test]
    fn models_off_by_a_step_have_the_covariance_that_was_stated() {
        // Gain and delay by 4 /s and 0.1 ms, correlated by 0.8; the pole is exact.
        let matrix = vec![
            vec![16.0, 0.0, 0.8 * 4.0 * 1e-4],
            vec![0.0, 0.0, 0.0],
            vec![0.8 * 4.0 * 1e-4, 0.0, 1e-8],
        ];
        let off = off_by_a_step(&model(matrix.clone()));
        assert_eq!(off.len(), 2);
        let steps: Vec<[f64; 2]> = (off.iter())
            .map(|m| {
                let delay_s = m.effects[0].parameters()[0].value;
                [m.plant.num()[0] - 400.0, delay_s - 2e-3].map(|by| by / STEP)
            })
            .collect();
        for (i, j, stated) in [(0, 0, 16.0), (0, 1, 3.2e-4), (1, 1, 1e-8)] {
            let found: f64 = steps.iter().map(|s| s[i] * s[j]).sum();
            assert!((found / stated - 1.0).abs() < 1e-6, "{i} {j}: {found}");
        }
    }

    #[test]
    fn a_delay_that_is_not_in_the_model_is_known() {
        let matrix = vec![
            vec![16.0, 0.0, 0.8 * 4.0 * 1e-4],
            vec![0.0, 0.0, 0.0],
            vec![0.8 * 4.0 * 1e-4, 0.0, 1e-8],
        ];
        let mut model = model(matrix);
        model.effects.clear();
        let off = off_by_a_step(&model);
        assert_eq!(off.len(), 1);
        let by = (off[0].plant.num()[0] - 400.0) / STEP;
        assert!((by.abs() - 4.0 * 0.6).abs() < 1e-6, "{by}");
    }

    #[test]
    fn a_covariance_that_is_none_moves_nothing() {
        assert!(off_by_a_step(&Model::eq6()).is_empty());
        let nan = vec![vec![f64::NAN; 3]; 3];
        assert!(off_by_a_step(&model(nan)).is_empty());
        assert!(off_by_a_step(&model(vec![vec![0.0; 3]; 3])).is_empty());
        assert!(off_by_a_step(&model(Vec::new())).is_empty());
    }
}
