//! Frechet distance between Gaussians fitted to two sets, and the principal components in which it is computed.
//!
//! Source: Heusel et al., arXiv:1706.08500, eq. 6: `|m1 - m2|^2 + Tr(C1 + C2 - 2 (C1 C2)^(1/2))`. Covariances divide by
//! `n - 1`. Departs: the trace of the root is computed from the eigenvalues of the symmetric `C1^(1/2) C2 C1^(1/2)`.
//! They equal those of `C1 C2` and need no complex arithmetic; rounding below zero counts as zero.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

/// Mean and covariance of a set of vectors.
#[derive(Debug, Clone)]
pub struct Gaussian {
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
}

impl Gaussian {
    /// Fits `values`, rows of `dim` values each; the covariance divides by n - 1.
    ///
    /// # Panics
    /// If there are fewer than two rows.
    pub fn fit(values: &[f64], dim: usize) -> Self {
        let (mean, centred) = centre(values, dim);
        assert!(centred.ncols() > 1, "a covariance needs two vectors, got {}", centred.ncols());
        let covariance = (&centred * centred.transpose()) / (centred.ncols() - 1) as f64;
        Self { mean, covariance }
    }

    /// Sum of the variances of all coordinates.
    pub fn total_variance(&self) -> f64 {
        self.covariance.trace()
    }

    /// Frechet distance to another Gaussian; 0 for equal ones.
    pub fn distance(&self, other: &Self) -> f64 {
        let root = square_root(&self.covariance);
        let product = &root * &other.covariance * &root;
        // Rounding makes it slightly asymmetric, and the solver reads only one triangle.
        let product = (&product + product.transpose()) * 0.5;
        let trace_root: f64 = product.symmetric_eigenvalues().iter().map(|v| v.max(0.0).sqrt()).sum();
        let shift = (&self.mean - &other.mean).norm_squared();
        shift + self.covariance.trace() + other.covariance.trace() - 2.0 * trace_root
    }
}

/// The directions of largest variance of a set.
#[derive(Debug, Clone)]
pub struct PrincipalComponents {
    mean: DVector<f64>,
    /// Matrix of shape `[components, dim]`.
    basis: DMatrix<f64>,
    explained: f64,
}

impl PrincipalComponents {
    /// Finds the first `components` directions of `values`, rows of `dim` values each; fewer if the set spans fewer.
    ///
    /// # Panics
    /// If there are fewer than two rows.
    pub fn fit(values: &[f64], dim: usize, components: usize) -> Self {
        let Gaussian { mean, covariance } = Gaussian::fit(values, dim);
        let total = covariance.trace();
        let rows = values.len() / dim;
        let SymmetricEigen { eigenvectors, eigenvalues } = covariance.symmetric_eigen();
        let mut order: Vec<usize> = (0..dim).collect();
        order.sort_by(|&a, &b| eigenvalues[b].total_cmp(&eigenvalues[a]).then(a.cmp(&b)));
        order.truncate(components.min(dim).min(rows - 1));
        let explained = order.iter().map(|&i| eigenvalues[i].max(0.0)).sum::<f64>() / total;
        let basis = DMatrix::from_fn(order.len(), dim, |r, c| eigenvectors[(c, order[r])]);
        Self { mean, basis, explained }
    }

    /// Number of components.
    pub fn len(&self) -> usize {
        self.basis.nrows()
    }

    /// Returns true if there are no components.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The components' share of the variance of the set they were fitted to.
    pub fn explained(&self) -> f64 {
        self.explained
    }

    /// Coordinates of `values` along the components, row by row.
    pub fn project(&self, values: &[f64]) -> Vec<f64> {
        let dim = self.mean.len();
        let mut columns = DMatrix::from_column_slice(dim, values.len() / dim, values);
        for mut column in columns.column_iter_mut() {
            column -= &self.mean;
        }
        (&self.basis * columns).as_slice().to_vec()
    }
}

/// The mean, and the centred rows as the columns of a matrix.
fn centre(values: &[f64], dim: usize) -> (DVector<f64>, DMatrix<f64>) {
    assert!(dim > 0 && values.len().is_multiple_of(dim), "{} values are no rows of {dim}", values.len());
    let mut columns = DMatrix::from_column_slice(dim, values.len() / dim, values);
    let mean = columns.column_mean();
    for mut column in columns.column_iter_mut() {
        column -= &mean;
    }
    (mean, columns)
}

/// The symmetric root of a positive semi-definite matrix.
fn square_root(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let SymmetricEigen { eigenvectors, eigenvalues } = matrix.clone().symmetric_eigen();
    let scaled =
        DMatrix::from_fn(matrix.nrows(), matrix.ncols(), |r, c| eigenvectors[(r, c)] * eigenvalues[c].max(0.0).sqrt());
    scaled * eigenvectors.transpose()
}

/// Converts values to f64 without loss.
pub fn to_f64(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on the corners of a box with half sides `half`, moved by `shift`.
    fn corners(half: [f64; 3], shift: [f64; 3]) -> Vec<f64> {
        (0..8).flat_map(|i| (0..3).map(move |k| shift[k] + if i >> k & 1 == 1 { half[k] } else { -half[k] })).collect()
    }

    #[test]
    fn axis_aligned_boxes_have_the_distance_of_their_formula() {
        let (a, b) = (
            Gaussian::fit(&corners([1.0, 2.0, 3.0], [0.0; 3]), 3),
            Gaussian::fit(&corners([2.0, 2.0, 1.0], [1.0, 0.0, -2.0]), 3),
        );
        // The variance is h^2 * 8/7 along each axis. The distance is the shift squared plus the differences of the
        // deviations squared.
        let expected = 5.0 + 8.0 / 7.0 * (1.0 + 0.0 + 4.0);
        assert!((a.distance(&b) - expected).abs() < 1e-12);
        assert!((b.distance(&a) - expected).abs() < 1e-12);
        assert!(a.distance(&a).abs() < 1e-12);
    }

    #[test]
    fn components_are_sorted_by_variance_and_keep_distances() {
        let values = corners([1.0, 3.0, 2.0], [5.0, 5.0, 5.0]);
        let two = PrincipalComponents::fit(&values, 3, 2);
        assert_eq!(two.len(), 2);
        assert!((two.explained() - 13.0 / 14.0).abs() < 1e-12);
        let first = two.project(&[5.0, 8.0, 5.0]);
        assert!((first[0].abs() - 3.0).abs() < 1e-12 && first[1].abs() < 1e-12, "{first:?}");
        let projected = two.project(&values);
        let distance = Gaussian::fit(&projected, 2).distance(&Gaussian::fit(&projected, 2));
        assert!(distance.abs() < 1e-9);
    }
}
