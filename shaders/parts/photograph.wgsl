// Reads a value of the photograph, 0..1. The photograph is stored as bytes r g b r …, four in a word, or as floats in
// the same order.
// Needs: types; the bindings `settings` and `photograph`.

// The colour of masked pixels of a photograph, red in the lowest byte: they add nothing to any loss.
const MASKED: u32 = 0xff00ffu;

fn photograph_value(at: u32) -> f32 {
    if (settings.is_floats == 1u) {
        return bitcast<f32>(photograph[at]);
    }
    return f32(photograph_byte(at)) / 255.0;
}

fn photograph_byte(at: u32) -> u32 {
    return (photograph[at / 4u] >> (8u * (at % 4u))) & 255u;
}

// Whether the pixel whose red value is at index `at` is masked.
fn is_masked(at: u32) -> bool {
    let pixel = photograph_byte(at) | (photograph_byte(at + 1u) << 8u) | (photograph_byte(at + 2u) << 16u);
    return settings.is_floats == 0u && pixel == MASKED;
}
