//! Reads weights from a safetensors file. Every name, shape and number is checked, so the file of another
//! network is refused with an error of one line.

use ndarray::Array2;
use safetensors::{Dtype, SafeTensors};

use super::convolution::Convolution;
use super::network::{Network, Step};

/// Channels of the first convolution's input.
const COLORS: usize = 3;

/// The weights of a network, as read from a file.
#[derive(Debug)]
pub(super) struct Weights {
    pub(super) convolutions: Vec<Convolution>,
    /// For each convolution with [`Step::tapped`]: the weight of the squared difference of each channel.
    pub(super) heads: Vec<Vec<f32>>,
}

/// Parses the bytes of a weight file. An error says in one line what is wrong with them.
pub(super) fn parse(bytes: &[u8], network: Network) -> Result<Weights, String> {
    let file =
        SafeTensors::deserialize(bytes).map_err(|error| format!("not a safetensors file ({error})"))?;
    let (mut convolutions, mut heads) = (Vec::new(), Vec::new());
    let mut channels = COLORS;
    for (i, step) in network.steps().into_iter().enumerate() {
        let convolution = convolution(&file, i, step, channels)?;
        channels = convolution.bias.len();
        convolutions.push(convolution);
        if step.tapped {
            heads.push(tensor(&file, &format!("lin{}.weight", heads.len()), &[Some(channels)])?.1);
        }
    }
    Ok(Weights { convolutions, heads })
}

fn convolution(file: &SafeTensors, i: usize, step: Step, channels_in: usize) -> Result<Convolution, String> {
    let side = step.side_px;
    let shape = [None, Some(channels_in), Some(side), Some(side)];
    let (shape, oihw) = tensor(file, &format!("conv{i}.weight"), &shape)?;
    let channels_out = shape[0];
    let (_, bias) = tensor(file, &format!("conv{i}.bias"), &[Some(channels_out)])?;
    let area = side * side;
    let kernel = Array2::from_shape_fn((area * channels_in, channels_out), |(row, out)| {
        let (place, channel) = (row / channels_in, row % channels_in);
        oihw[(out * channels_in + channel) * area + place]
    });
    Ok(Convolution { step, kernel, bias })
}

/// Returns shape and values of a tensor. Its shape must be `wanted`, where `None` stands for any length
/// but 0.
fn tensor(
    file: &SafeTensors,
    name: &str,
    wanted: &[Option<usize>],
) -> Result<(Vec<usize>, Vec<f32>), String> {
    let view = file.tensor(name).map_err(|_| format!("{name} is missing"))?;
    let shape = view.shape();
    let fits = |(&side, wanted): (&usize, &Option<usize>)| wanted.map_or(side > 0, |wanted| side == wanted);
    if shape.len() != wanted.len() || !shape.iter().zip(wanted).all(fits) {
        return Err(format!("{name} has the shape {shape:?}, which is that of another network"));
    }
    let values: Vec<f32> = match view.dtype() {
        Dtype::F16 => {
            view.data().as_chunks().0.iter().map(|&b| f32_from_f16(u16::from_le_bytes(b))).collect()
        }
        Dtype::F32 => view.data().as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect(),
        other => return Err(format!("{name} has numbers of type {other:?}, not F16 or F32")),
    };
    if values.iter().any(|value| !value.is_finite()) {
        return Err(format!("{name} has a number that is not finite"));
    }
    Ok((shape.to_vec(), values))
}

/// Converts an IEEE 754 half-precision number; infinities become NaN.
fn f32_from_f16(bits: u16) -> f32 {
    // The exponent biases of the two formats differ by 112. The product with 2^112 corrects this, and
    // also normalises subnormal numbers.
    let rebias = f32::from_bits((127 + 112) << 23);
    let magnitude = f32::from_bits(u32::from(bits & 0x7fff) << 13) * rebias;
    let magnitude = if bits & 0x7c00 == 0x7c00 { f32::NAN } else { magnitude };
    if bits >> 15 == 1 { -magnitude } else { magnitude }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Computes the expected value from the definition: sign, exponent and mantissa.
    #[test]
    fn every_half_is_read_as_defined() {
        for bits in 0..=u16::MAX {
            let (exponent, mantissa) = (i32::from(bits >> 10 & 31), f64::from(bits & 1023));
            let magnitude = match exponent {
                0 => mantissa * 2f64.powi(-24),
                31 => f64::NAN,
                _ => (1024.0 + mantissa) * 2f64.powi(exponent - 25),
            };
            let expected = if bits >> 15 == 1 { -magnitude } else { magnitude };
            let got = f64::from(f32_from_f16(bits));
            assert!(
                got == expected || got.is_nan() && expected.is_nan(),
                "{bits:#x}: {got} is not {expected}"
            );
        }
    }
}
