//! The directions in which a model's spherical harmonics vary (their principal components), and their steps
//! along these. Views from drones cover a small part of all directions, and what colours do there fits into
//! few dimensions: trained models need half the bits that coefficients one by one would.

use cosurf_scene::Splats;
use cosurf_wire::body::basis::{basis_bytes, read_basis, write_basis};
use cosurf_wire::body::{BodyError, ShLayout, sh_rest};

/// Splats that the directions are learned from, at most; spread evenly.
const SAMPLES_MAX: usize = 1 << 15;
/// Smallest and largest step: what is finer than the first nobody sees, what is coarser than the other helps
/// nobody.
const STEPS: [f64; 2] = [0.01, 0.32];
/// Halvings of the ratio of these that find the step for a number of bits: to less than 1 %.
const HALVINGS: usize = 9;
/// Directions of less standard deviation than this, in steps, are left out: nearly all would round to zero.
const KEPT_STEPS: f64 = 0.2;
/// Those of more get a byte of their own: ±8 steps would cut off too many.
const WIDE_STEPS: f64 = 1.5;
/// Added before rounding down. Below ½, so that what is nearly zero becomes zero: less noise, fewer bits.
const ROUNDING: f32 = 0.4;
/// Turns of Jacobi's method over all pairs; it converges quadratically, 45 dimensions in about eight.
const SWEEPS: usize = 16;
/// Direction cosines are whole multiples of this part of 1.
const UNIT: f32 = 32767.0;

/// Mean and directions.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Basis {
    pub(super) layout: ShLayout,
    step: f32,
    mean: Vec<f32>,
    /// `[components, m]`.
    directions: Vec<i16>,
}

impl Basis {
    /// Learns the basis of the splats in `order`, of which there is at least one, of a degree above 0, and the
    /// step with which a splat takes `bits`.
    pub(super) fn learn(splats: &Splats, order: &[u32], bits: f64) -> Self {
        let m = sh_rest(splats.sh_degree as u8);
        let samples: Vec<&[f32]> = order
            .iter()
            .step_by(order.len().div_ceil(SAMPLES_MAX))
            .map(|&i| &splats.sh_of(i as usize)[3..])
            .collect();
        let mean = mean(m, &samples);
        let mut matrix = covariance(&mean, &samples);
        let turn = diagonalise(m, &mut matrix);
        let deviations: Vec<f64> = (0..m).map(|k| matrix[k * m + k].max(0.0).sqrt()).collect();
        let mut ranked: Vec<usize> = (0..m).collect();
        ranked.sort_by(|&a, &b| deviations[b].total_cmp(&deviations[a]));
        let cosines = ranked.iter().flat_map(|&k| (0..m).map(move |a| (a, k)));
        let mut basis = Self {
            layout: ShLayout { components: m as u8, wide: m as u8 },
            step: 1.0,
            mean: mean.iter().map(|v| *v as f32).collect(),
            directions: cosines.map(|(a, k)| (turn[a * m + k] * f64::from(UNIT)).round() as i16).collect(),
        };
        let step = basis.find_step(&samples, bits);
        let beyond = |steps: f64| ranked.iter().filter(|&&k| deviations[k] >= steps * step).count();
        let components = beyond(KEPT_STEPS);
        basis.layout = ShLayout { components: components as u8, wide: beyond(WIDE_STEPS) as u8 };
        basis.step = step as f32;
        basis.directions.truncate(components * m);
        basis
    }

    /// The step with which the entropy of all directions is `bits` a splat.
    fn find_step(&self, samples: &[&[f32]], bits: f64) -> f64 {
        let m = self.mean.len();
        let ways: Vec<f32> = samples.iter().flat_map(|sh| (0..m).map(|k| self.along(k, sh))).collect();
        let of_all =
            |step: f64| (0..m).map(|k| entropy(ways.iter().skip(k).step_by(m), step as f32)).sum::<f64>();
        let [mut finer, mut coarser] = STEPS;
        for _ in 0..HALVINGS {
            let step = (finer * coarser).sqrt();
            *(if of_all(step) > bits { &mut finer } else { &mut coarser }) = step;
        }
        coarser
    }

    /// What is nearest to all where nothing else is known.
    pub(super) fn mean(&self) -> &[f32] {
        &self.mean
    }

    /// How far `sh` lies along direction `k`.
    fn along(&self, k: usize, sh: &[f32]) -> f32 {
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

    /// The steps of `sh` (beside the colour) along each direction, appended to `out`.
    pub(super) fn round(&self, sh: &[f32], out: &mut Vec<i8>) {
        for k in 0..usize::from(self.layout.components) {
            out.push(self.layout.clamp(k, round(self.along(k, sh) / self.step)));
        }
    }

    /// Spherical harmonics (beside the colour) of the splat with these steps.
    pub(super) fn unround(&self, steps: impl Fn(usize) -> i8, sh: &mut [f32]) {
        sh.copy_from_slice(&self.mean);
        for (k, direction) in self.directions.chunks_exact(self.mean.len()).enumerate() {
            let way = f32::from(steps(k)) * self.step / UNIT;
            if way != 0.0 {
                sh.iter_mut().zip(direction).for_each(|(v, cosine)| *v += way * f32::from(*cosine));
            }
        }
    }
}

fn round(steps: f32) -> i32 {
    (steps.abs() + ROUNDING).floor().copysign(steps) as i32
}

/// Bits that each of `ways` takes, in whole steps, by their own statistics.
fn entropy<'a>(ways: impl Iterator<Item = &'a f32>, step: f32) -> f64 {
    let mut counts = [0u32; 256];
    ways.for_each(|way| counts[(round(way / step).clamp(-128, 127) + 128) as usize] += 1);
    let total = f64::from(counts.iter().sum::<u32>());
    counts
        .iter()
        .filter(|&&count| count > 0)
        .map(|&count| f64::from(count) / total)
        .map(|p| -p * p.log2())
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

/// `[m, m]`.
fn covariance(mean: &[f64], samples: &[&[f32]]) -> Vec<f64> {
    let m = mean.len();
    let mut matrix = vec![0.0; m * m];
    let mut off = vec![0.0; m];
    for sample in samples {
        (0..m).for_each(|a| off[a] = f64::from(sample[a]) - mean[a]);
        for (a, row) in matrix.chunks_exact_mut(m).enumerate() {
            row.iter_mut().zip(&off).for_each(|(sum, b)| *sum += off[a] * b);
        }
    }
    matrix.iter_mut().for_each(|sum| *sum /= samples.len() as f64);
    matrix
}

/// Jacobi's method: turns the symmetric `matrix`, `[m, m]`, until nothing is beside its diagonal, and returns
/// the turn, whose columns are the directions.
fn diagonalise(m: usize, matrix: &mut [f64]) -> Vec<f64> {
    let mut turn: Vec<f64> = (0..m * m).map(|i| f64::from(u8::from(i % (m + 1) == 0))).collect();
    let trace: f64 = (0..m).map(|k| matrix[k * m + k]).sum();
    for _ in 0..SWEEPS {
        for p in 0..m {
            for q in p + 1..m {
                let beside = matrix[p * m + q];
                if beside.abs() <= 1e-12 * trace {
                    continue;
                }
                let theta = (matrix[q * m + q] - matrix[p * m + p]) / (2.0 * beside);
                let tangent = theta.signum() / (theta.abs() + theta.hypot(1.0));
                let cosine = tangent.hypot(1.0).recip();
                let sine = tangent * cosine;
                for k in 0..m {
                    rotate(matrix, k * m + p, k * m + q, cosine, sine);
                    rotate(&mut turn, k * m + p, k * m + q, cosine, sine);
                }
                for k in 0..m {
                    rotate(matrix, p * m + k, q * m + k, cosine, sine);
                }
            }
        }
    }
    turn
}

fn rotate(values: &mut [f64], i: usize, j: usize, cosine: f64, sine: f64) {
    let (a, b) = (values[i], values[j]);
    values[i] = cosine * a - sine * b;
    values[j] = sine * a + cosine * b;
}
