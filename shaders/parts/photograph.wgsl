// Reads a value of the photograph, 0..1. The photograph is stored as bytes r g b r …, four in a word, or as floats in
// the same order.
// Needs: types; the bindings `settings` and `photograph`.

fn photograph_value(at: u32) -> f32 {
    if (settings.is_floats == 1u) {
        return bitcast<f32>(photograph[at]);
    }
    return f32((photograph[at / 4u] >> (8u * (at % 4u))) & 255u) / 255.0;
}
