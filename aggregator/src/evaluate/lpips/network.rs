//! VGG16 and AlexNet as lists of convolutions.

/// The network whose features are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Network {
    /// VGG16 up to its 13th convolution.
    Vgg,
    /// AlexNet up to its fifth convolution.
    Alex,
}

/// A convolution, the pooling before it, and the ReLU after it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Step {
    /// Side of the square window.
    pub(super) side_px: usize,
    /// Distance from one window to the next, pixels.
    pub(super) stride_px: usize,
    /// Width of the border of zeros that is added around the input.
    pub(super) padding_px: usize,
    /// Whether the input is first reduced by max pooling.
    pub(super) pooled: bool,
    /// Whether the distance compares the output of this step.
    pub(super) tapped: bool,
}

impl Network {
    /// The convolutions in order.
    pub(super) fn steps(self) -> Vec<Step> {
        match self {
            Self::Vgg => (0..13).map(vgg_step).collect(),
            Self::Alex => (0..5).map(alex_step).collect(),
        }
    }

    /// Side of the windows of max pooling; their stride is two pixels.
    pub(super) fn pool_side_px(self) -> usize {
        match self {
            Self::Vgg => 2,
            Self::Alex => 3,
        }
    }

    /// Least width and height of a picture. With a smaller one, no pixel would be left after the last pooling.
    pub(super) fn size_min_px(self) -> u32 {
        match self {
            Self::Vgg => 16,
            Self::Alex => 31,
        }
    }
}

fn vgg_step(i: usize) -> Step {
    let (pooled, tapped) = (matches!(i, 2 | 4 | 7 | 10), matches!(i, 1 | 3 | 6 | 9 | 12));
    Step { side_px: 3, stride_px: 1, padding_px: 1, pooled, tapped }
}

fn alex_step(i: usize) -> Step {
    let (side_px, stride_px, padding_px) = [(11, 4, 2), (5, 1, 2), (3, 1, 1)][i.min(2)];
    Step { side_px, stride_px, padding_px, pooled: matches!(i, 1 | 2), tapped: true }
}
