//! LPIPS (Zhang et al. 2018, version 0.1): the distance between two pictures, measured between the features that a
//! network trained on photographs computes from them. Equal pictures score 0; held-out views of good models score
//! 0.1 to 0.4.
//!
//! The network is VGG16 or AlexNet. Linear weights (*heads*) turn the differences of the features into the
//! distance. Networks are not trained here; all weights come from files that the user names.
//!
//! What it knows nothing about: models, cameras, reports, and where the weights come from.
//!
//! Why no machine-learning framework: these networks need only a matrix product, threads and a file format.
//! ndarray's matrix product was faster than the frameworks that were tried, and needs far fewer packages.

mod convolution;
mod network;
#[cfg(test)]
mod tests;
mod weights;

use std::io;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use convolution::FeatureMap;
use network::Network;
use weights::Weights;

/// Subtracted from the colours (red, green, blue; -1..=1) before the first convolution, as published.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
/// Divisor of the colours (red, green, blue) after [`SHIFT`] is subtracted, as published.
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Added to the length of a feature vector before the division by it, as published.
const LENGTH_EPSILON: f32 = 1e-10;
/// Number of pixels that a thread compares at a time. It is fixed, so that sums do not depend on the number of
/// threads.
const PIXELS_A_TASK: usize = 4096;

/// Why weights cannot be loaded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LpipsError {
    /// The file cannot be read.
    #[error("{}: {cause}; --lpips must name a folder with vgg.safetensors and alex.safetensors", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        cause: io::Error,
    },
    /// The file does not hold this network's weights.
    #[error("{}: {reason}; fetch the LPIPS weights again", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong, one line.
        reason: String,
    },
}

/// A network with its weights.
#[derive(Debug)]
struct Lpips {
    network: Network,
    weights: Weights,
}

impl Lpips {
    /// Reads a safetensors file with `conv{i}.weight` (OIHW), `conv{i}.bias` and `lin{i}.weight` (the heads), as
    /// 16-bit or 32-bit floats. Shapes must be those of the network, and all numbers must be finite.
    fn read(path: &Path, network: Network) -> Result<Self, LpipsError> {
        let bytes = std::fs::read(path).map_err(|cause| LpipsError::Io { path: path.into(), cause })?;
        let malformed = |reason| LpipsError::Malformed { path: path.into(), reason };
        Self::parse(&bytes, network).map_err(malformed)
    }

    /// Parses the bytes of a weight file. An error says in one line what is wrong with them.
    fn parse(bytes: &[u8], network: Network) -> Result<Self, String> {
        Ok(Self { network, weights: weights::parse(bytes, network)? })
    }

    /// The LPIPS distance of two pictures `[height, width, rgb]` with values 0 to 1; `None` if a side is shorter
    /// than [`Network::size_min_px`]. Gives the same bits for any number of threads. Needs about a kilobyte of
    /// memory per pixel.
    ///
    /// Panics if the length of `a` or `b` is not `3 · width · height`.
    fn distance(&self, a: &[f32], b: &[f32], size_px: [u32; 2]) -> Option<f64> {
        if size_px.iter().any(|&side| side < self.network.size_min_px()) {
            return None;
        }
        let mut maps = [a, b].map(|rgb| input(rgb, size_px));
        let (mut sum, mut heads) = (0.0, self.weights.heads.iter());
        for (convolution, step) in self.weights.convolutions.iter().zip(self.network.steps()) {
            if step.pooled {
                maps = maps.map(|map| map.max_pooled(self.network.pool_side_px()));
            }
            maps = maps.map(|map| convolution.run(&map));
            if step.tapped {
                sum += mean_difference(&maps, heads.next().expect("a head for each tap"));
            }
        }
        Some(sum)
    }
}

/// A picture as normalised input of the networks.
fn input(rgb: &[f32], size_px: [u32; 2]) -> FeatureMap {
    let (pixels, rest) = rgb.as_chunks::<3>();
    let size_px = size_px.map(|side| side as usize);
    assert!(rest.is_empty() && pixels.len() == size_px[0] * size_px[1], "values of a {size_px:?} picture");
    let normalised = |pixel: &[f32; 3]| [0, 1, 2].map(|c| (2.0 * pixel[c] - 1.0 - SHIFT[c]) / SCALE[c]);
    FeatureMap { size_px, channels: 3, values: pixels.iter().flat_map(normalised).collect() }
}

/// Scales the feature vectors to unit length, and returns the weighted sum over channels of their squared
/// differences, as a mean over pixels. `head` has the weight of each channel.
fn mean_difference(maps: &[FeatureMap; 2], head: &[f32]) -> f64 {
    let channels = head.len();
    let task = PIXELS_A_TASK * channels;
    let sums: Vec<f64> = maps[0]
        .values
        .par_chunks(task)
        .zip(maps[1].values.par_chunks(task))
        .map(|(a, b)| {
            let pixels = a.chunks_exact(channels).zip(b.chunks_exact(channels));
            pixels.map(|(a, b)| f64::from(difference(a, b, head))).sum()
        })
        .collect();
    sums.iter().sum::<f64>() / (maps[0].values.len() / channels) as f64
}

fn difference(a: &[f32], b: &[f32], head: &[f32]) -> f32 {
    let inverse_length = |v: &[f32]| 1.0 / (v.iter().map(|x| x * x).sum::<f32>().sqrt() + LENGTH_EPSILON);
    let (scale_a, scale_b) = (inverse_length(a), inverse_length(b));
    let squares = a.iter().zip(b).map(|(a, b)| (a * scale_a - b * scale_b).powi(2));
    squares.zip(head).map(|(square, weight)| square * weight).sum()
}

/// The LPIPS distances by both networks.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct LpipsScore {
    /// Distance by VGG16, the network that papers usually quote.
    pub vgg: f64,
    /// Distance by AlexNet.
    pub alex: f64,
}

impl LpipsScore {
    /// The mean of the scores of several views; `None` without views.
    pub(super) fn mean(of: impl Iterator<Item = Self>) -> Option<Self> {
        let all: Vec<Self> = of.collect();
        let mean = |value: fn(&Self) -> f64| all.iter().map(value).sum::<f64>() / all.len() as f64;
        (!all.is_empty()).then(|| Self { vgg: mean(|score| score.vgg), alex: mean(|score| score.alex) })
    }
}

/// VGG16 and AlexNet with their weights.
#[derive(Debug)]
pub(crate) struct LpipsPair {
    vgg: Lpips,
    alex: Lpips,
}

impl LpipsPair {
    /// Reads `vgg.safetensors` and `alex.safetensors` in a folder.
    pub(super) fn read(folder: &Path) -> Result<Self, LpipsError> {
        Ok(Self {
            vgg: Lpips::read(&folder.join("vgg.safetensors"), Network::Vgg)?,
            alex: Lpips::read(&folder.join("alex.safetensors"), Network::Alex)?,
        })
    }

    /// [`Lpips::distance`] by both networks; `None` if the pictures are too small for one of them.
    pub(super) fn score(&self, a: &[f32], b: &[f32], size_px: [u32; 2]) -> Option<LpipsScore> {
        Some(LpipsScore { vgg: self.vgg.distance(a, b, size_px)?, alex: self.alex.distance(a, b, size_px)? })
    }
}
