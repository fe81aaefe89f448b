//! Convolutions as matrix products. Each row of the left matrix is one window of the input, and each column
//! of the right matrix is the kernel of one output channel. A thread copies 1 MiB of windows at a time, so
//! the memory for windows does not grow with the picture.

use ndarray::linalg::general_mat_mul;
use ndarray::{Array2, ArrayView2, ArrayViewMut2};
use rayon::prelude::*;

use super::network::Step;

/// Number of `f32` values in the windows that a thread copies at a time: 1 MiB, which fits a core's cache.
const WINDOW_VALUES: usize = 1 << 18;

/// The input or output of a layer: a picture with any number of channels.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct FeatureMap {
    /// Width and height, each at least 1.
    pub(super) size_px: [usize; 2],
    /// Values per pixel.
    pub(super) channels: usize,
    /// `[height, width, channels]`.
    pub(super) values: Vec<f32>,
}

impl FeatureMap {
    /// Max pooling with windows of `side_px` and a stride of two pixels. Incomplete windows at the right and
    /// bottom are dropped. The map must be at least as large as a window.
    pub(super) fn max_pooled(&self, side_px: usize) -> Self {
        let [width, height] = self.size_px.map(|side| (side - side_px) / 2 + 1);
        let mut values = vec![f32::NEG_INFINITY; width * height * self.channels];
        for (i, greatest) in values.chunks_exact_mut(self.channels).enumerate() {
            let (left, top) = (2 * (i % width), 2 * (i / width));
            for (y, x) in (0..side_px).flat_map(|y| (0..side_px).map(move |x| (top + y, left + x))) {
                let pixel = self.pixel(x, y).iter();
                greatest.iter_mut().zip(pixel).for_each(|(greatest, value)| *greatest = greatest.max(*value));
            }
        }
        Self { size_px: [width, height], channels: self.channels, values }
    }

    fn pixel(&self, x: usize, y: usize) -> &[f32] {
        let first = (y * self.size_px[0] + x) * self.channels;
        &self.values[first..first + self.channels]
    }

    /// Copies the window with its corner at `(left, top)` into `window`, with zeros outside the map.
    fn window(&self, left: isize, top: isize, side_px: usize, window: &mut [f32]) {
        let inside = |at: isize, side: usize| usize::try_from(at).ok().filter(|&at| at < side);
        for (i, part) in window.chunks_exact_mut(self.channels).enumerate() {
            let x = inside(left + (i % side_px) as isize, self.size_px[0]);
            let y = inside(top + (i / side_px) as isize, self.size_px[1]);
            match (x, y) {
                (Some(x), Some(y)) => part.copy_from_slice(self.pixel(x, y)),
                _ => part.fill(0.0),
            }
        }
    }
}

/// A convolution and the ReLU after it.
#[derive(Debug)]
pub(super) struct Convolution {
    pub(super) step: Step,
    /// A matrix with a row for each value of a window, in the order `[window row, window column, input
    /// channel]`, and a column for each output channel.
    pub(super) kernel: Array2<f32>,
    /// One value for each output channel.
    pub(super) bias: Vec<f32>,
}

impl Convolution {
    /// Computes the convolution and the ReLU. Panics if the input has another number of channels than the
    /// kernel, or if the padded input is smaller than a window.
    pub(super) fn run(&self, input: &FeatureMap) -> FeatureMap {
        let Step { side_px, stride_px, padding_px, .. } = self.step;
        let (window, channels) = self.kernel.dim();
        assert_eq!(window, side_px * side_px * input.channels, "values of a window");
        let [width, height] = input.size_px.map(|side| (side + 2 * padding_px - side_px) / stride_px + 1);
        let mut values = vec![0.0; width * height * channels];
        let pixels_a_task = (WINDOW_VALUES / window).max(1);
        values.par_chunks_mut(pixels_a_task * channels).enumerate().for_each_init(
            || vec![0.0; pixels_a_task * window],
            |windows, (task, out)| {
                let pixels = out.len() / channels;
                let windows = &mut windows[..pixels * window];
                for (i, values) in windows.chunks_exact_mut(window).enumerate() {
                    let pixel = task * pixels_a_task + i;
                    let corner = |at: usize| (at * stride_px) as isize - padding_px as isize;
                    input.window(corner(pixel % width), corner(pixel / width), side_px, values);
                }
                self.product(windows, out);
            },
        );
        FeatureMap { size_px: [width, height], channels, values }
    }

    /// Computes `out = max(0, windows · kernel + bias)`, with one row for each output pixel.
    fn product(&self, windows: &[f32], out: &mut [f32]) {
        let (window, channels) = self.kernel.dim();
        let pixels = out.len() / channels;
        out.chunks_exact_mut(channels).for_each(|pixel| pixel.copy_from_slice(&self.bias));
        let windows = ArrayView2::from_shape((pixels, window), windows).expect("whole windows");
        let mut sums = ArrayViewMut2::from_shape((pixels, channels), &mut *out).expect("whole pixels");
        general_mat_mul(1.0, &windows, &self.kernel, 1.0, &mut sums);
        out.iter_mut().for_each(|value| *value = value.max(0.0));
    }
}
