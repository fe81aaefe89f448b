//! The principal components of a model's view-dependent spherical harmonics, and quantisation along these
//! directions. A drone sees each part of a scene from only a few sides. View-dependent colour therefore has
//! few dimensions, and takes far fewer bits along principal directions than as separate coefficients.

use cosurf_scene::Splats;
use cosurf_wire::body::basis::{basis_bytes, read_basis, write_basis};
use cosurf_wire::body::{BodyError, ShLayout, sh_rest};

/// Maximum number of splats, selected at even intervals, from which the mean, the directions and the step are
/// computed.
const SAMPLES_MAX: usize = 1 << 15;
/// Smallest and largest quantisation step, in units of the coefficients. A finer step has no visible effect.
/// A coarser step would leave almost no view-dependent colour.
const STEPS: [f64; 2] = [0.01, 0.32];
/// Iterations of the bisection that finds the step for a given number of bits. The step is then accurate to
/// 1 %.
const BISECTIONS: usize = 9;
/// Directions with a standard deviation below this many steps are left out, because nearly all values would
/// round to zero.
const KEPT_STEPS: f64 = 0.2;
/// Directions with a standard deviation of at least this many steps get a byte per splat: half a byte holds
/// only -8 to 7 steps and would clamp too many of their values. The other directions get half a byte.
const WIDE_STEPS: f64 = 1.5;
/// Added to a magnitude before it is rounded down. It is below ½, so that more values become zero, which
/// saves bits and removes noise.
const ROUNDING_OFFSET: f32 = 0.4;
/// Number of sweeps of Jacobi's eigenvalue method, each over all pairs of dimensions. The method converges
/// quadratically: 45 dimensions (degree 3) need about eight sweeps.
const SWEEPS: usize = 16;
/// Direction cosines are stored in units of 1 / `UNIT`.
const UNIT: f32 = 32767.0;

/// The mean and the principal directions of a model's spherical harmonics. Each of them has m numbers: one
/// for each view-dependent coefficient of a splat ([`sh_rest`]).
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Basis {
    pub(super) layout: ShLayout,
    step: f32,
    mean: Vec<f32>,
    /// Unit vectors, `[components, m]`, in order of falling variance, in units of 1 / [`UNIT`].
    directions: Vec<i16>,
}

impl Basis {
    /// Computes the basis of the splats whose indices are in `order`, and the step at which a splat's
    /// spherical harmonics have an entropy of about `bits`. `order` must not be empty, and the degree must be
    /// above 0.
    pub(super) fn learn(splats: &Splats, order: &[u32], bits: f64) -> Self {
        let m = sh_rest(splats.sh_degree as u8);
        let samples: Vec<&[f32]> = order
            .iter()
            .step_by(order.len().div_ceil(SAMPLES_MAX))
            .map(|&i| &splats.sh_of(i as usize)[3..])
            .collect();
        let mean = mean(m, &samples);
        let mut matrix = covariance(&mean, &samples);
        let rotation = diagonalise(m, &mut matrix);
        let deviations: Vec<f64> = (0..m).map(|k| matrix[k * m + k].max(0.0).sqrt()).collect();
        let mut ranked: Vec<usize> = (0..m).collect();
        ranked.sort_by(|&a, &b| deviations[b].total_cmp(&deviations[a]));
        let cosines = ranked.iter().flat_map(|&k| (0..m).map(move |a| (a, k)));
        let mut basis = Self {
            layout: ShLayout { components: m as u8, wide: m as u8 },
            step: 1.0,
            mean: mean.iter().map(|v| *v as f32).collect(),
            directions: cosines
                .map(|(a, k)| (rotation[a * m + k] * f64::from(UNIT)).round() as i16)
                .collect(),
        };
        let step = basis.find_step(&samples, bits);
        let count_above = |steps: f64| ranked.iter().filter(|&&k| deviations[k] >= steps * step).count();
        let components = count_above(KEPT_STEPS);
        basis.layout = ShLayout { components: components as u8, wide: count_above(WIDE_STEPS) as u8 };
        basis.step = step as f32;
        basis.directions.truncate(components * m);
        basis
    }

    /// Returns the step at which the entropy of a splat's values along all directions is just below `bits`. If
    /// no step within [`STEPS`] has this entropy, returns about the nearer end of that range.
    fn find_step(&self, samples: &[&[f32]], bits: f64) -> f64 {
        let m = self.mean.len();
        let projections: Vec<f32> =
            samples.iter().flat_map(|sh| (0..m).map(|k| self.project(k, sh))).collect();
        let total_entropy = |step: f64| {
            (0..m).map(|k| entropy(projections.iter().skip(k).step_by(m), step as f32)).sum::<f64>()
        };
        let [mut finer, mut coarser] = STEPS;
        for _ in 0..BISECTIONS {
            let step = (finer * coarser).sqrt();
            *(if total_entropy(step) > bits { &mut finer } else { &mut coarser }) = step;
        }
        coarser
    }

    /// The mean. It is the best estimate for a splat whose spherical harmonics have not arrived.
    pub(super) fn mean(&self) -> &[f32] {
        &self.mean
    }

    /// Projects the difference between `sh` and the mean onto direction `k`.
    fn project(&self, k: usize, sh: &[f32]) -> f32 {
        let m = self.mean.len();
        let terms = sh.iter().zip(&self.mean).zip(&self.directions[k * m..(k + 1) * m]);
        terms.map(|((v, mean), cosine)| (v - mean) * f32::from(*cosine)).sum::<f32>() / UNIT
    }

    pub(super) fn encode(&self, sh_degree: u8) -> Vec<u8> {
        let mut bytes = vec![0; basis_bytes(sh_degree)];
        write_basis(self.layout, self.step, &self.mean, &self.directions, &mut bytes);
        bytes
    }

    pub(super) fn decode(sh_degree: u8, bytes: &[u8]) -> Result<Self, BodyError> {
        let m = sh_rest(sh_degree);
        let (mut mean, mut directions) = (vec![0.0; m], vec![0; m * m]);
        let (layout, step) = read_basis(sh_degree, bytes, &mut mean, &mut directions)?;
        directions.truncate(usize::from(layout.components) * m);
        Ok(Self { layout, step, mean, directions })
    }

    /// Quantises view-dependent spherical harmonics: appends the number of steps along each direction to
    /// `out`.
    pub(super) fn quantise(&self, sh: &[f32], out: &mut Vec<i8>) {
        for k in 0..usize::from(self.layout.components) {
            out.push(self.layout.clamp(k, round(self.project(k, sh) / self.step)));
        }
    }

    /// Dequantises view-dependent spherical harmonics into `sh`. `steps` gives the number of steps along each
    /// direction.
    pub(super) fn dequantise(&self, steps: impl Fn(usize) -> i8, sh: &mut [f32]) {
        sh.copy_from_slice(&self.mean);
        for (k, direction) in self.directions.chunks_exact(self.mean.len()).enumerate() {
            let scale = f32::from(steps(k)) * self.step / UNIT;
            if scale != 0.0 {
                sh.iter_mut().zip(direction).for_each(|(v, cosine)| *v += scale * f32::from(*cosine));
            }
        }
    }
}

fn round(steps: f32) -> i32 {
    (steps.abs() + ROUNDING_OFFSET).floor().copysign(steps) as i32
}

/// Entropy per value, in bits, of `values` quantised with `step`.
fn entropy<'a>(values: impl Iterator<Item = &'a f32>, step: f32) -> f64 {
    let mut counts = [0u32; 256];
    values.for_each(|value| counts[(round(value / step).clamp(-128, 127) + 128) as usize] += 1);
    let total = f64::from(counts.iter().sum::<u32>());
    counts
        .iter()
        .filter(|&&count| count > 0)
        .map(|&count| f64::from(count) / total)
        .map(|p| -p * libm::log2(p))
        .sum()
}

fn mean(m: usize, samples: &[&[f32]]) -> Vec<f64> {
    let mut mean = vec![0.0; m];
    for sample in samples {
        mean.iter_mut().zip(*sample).for_each(|(sum, v)| *sum += f64::from(*v));
    }
    mean.iter_mut().for_each(|sum| *sum /= samples.len() as f64);
    mean
}

/// The covariance matrix of `samples`, `[m, m]`.
fn covariance(mean: &[f64], samples: &[&[f32]]) -> Vec<f64> {
    let m = mean.len();
    let mut matrix = vec![0.0; m * m];
    let mut deviation = vec![0.0; m];
    for sample in samples {
        (0..m).for_each(|a| deviation[a] = f64::from(sample[a]) - mean[a]);
        for (a, row) in matrix.chunks_exact_mut(m).enumerate() {
            row.iter_mut().zip(&deviation).for_each(|(sum, b)| *sum += deviation[a] * b);
        }
    }
    matrix.iter_mut().for_each(|sum| *sum /= samples.len() as f64);
    matrix
}

/// Diagonalises the symmetric `matrix`, `[m, m]`, in place by Jacobi's method. Returns the rotation,
/// `[m, m]`, whose columns are the eigenvectors.
fn diagonalise(m: usize, matrix: &mut [f64]) -> Vec<f64> {
    let mut rotation: Vec<f64> = (0..m * m).map(|i| f64::from(u8::from(i % (m + 1) == 0))).collect();
    let trace: f64 = (0..m).map(|k| matrix[k * m + k]).sum();
    for _ in 0..SWEEPS {
        for p in 0..m {
            for q in p + 1..m {
                let off_diagonal = matrix[p * m + q];
                if off_diagonal.abs() <= 1e-12 * trace {
                    continue;
                }
                let theta = (matrix[q * m + q] - matrix[p * m + p]) / (2.0 * off_diagonal);
                let tangent = theta.signum() / (theta.abs() + libm::hypot(theta, 1.0));
                let cosine = libm::hypot(tangent, 1.0).recip();
                let sine = tangent * cosine;
                for k in 0..m {
                    rotate(matrix, k * m + p, k * m + q, cosine, sine);
                    rotate(&mut rotation, k * m + p, k * m + q, cosine, sine);
                }
                for k in 0..m {
                    rotate(matrix, p * m + k, q * m + k, cosine, sine);
                }
            }
        }
    }
    rotation
}

fn rotate(values: &mut [f64], i: usize, j: usize, cosine: f64, sine: f64) {
    let (a, b) = (values[i], values[j]);
    values[i] = cosine * a - sine * b;
    values[j] = sine * a + cosine * b;
}
