// Draws the pixels that are compared with the neighbouring view, one in each square cell, with numbers of 64 bits, each
// as a vector of its low and its high word.
// Needs: types; the bindings `view` and `weights`.

// The sampled pixel of a cell. Cells are numbered row by row. The pixel may lie outside the picture.
fn sampled_pixel(cell: u32) -> vec2<u32> {
    let across = (view.size_px.x + weights.cell_px - 1u) / weights.cell_px;
    let corner = weights.cell_px * vec2(cell % across, cell / across);
    return corner + (mixed(weights.draw ^ corner) & vec2(weights.cell_px - 1u));
}

// Mixes all bits of a number: the finaliser of SplitMix64.
fn mixed(seed: vec2<u32>) -> vec2<u32> {
    var z = seed;
    z = product(z ^ shifted(z, 30u), vec2(0x1ce4e5b9u, 0xbf58476du));
    z = product(z ^ shifted(z, 27u), vec2(0x133111ebu, 0x94d049bbu));
    return z ^ shifted(z, 31u);
}

// `z` shifted right by 1 to 31 bits.
fn shifted(z: vec2<u32>, bits: u32) -> vec2<u32> {
    return vec2((z.x >> bits) | (z.y << (32u - bits)), z.y >> bits);
}

// The product modulo 2^64.
fn product(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = long_product(a.x, b.x);
    return vec2(low.x, low.y + a.x * b.y + a.y * b.x);
}

// The 64 bits of the product of two words.
fn long_product(a: u32, b: u32) -> vec2<u32> {
    let a_low = a & 0xffffu;
    let a_high = a >> 16u;
    let b_low = b & 0xffffu;
    let b_high = b >> 16u;
    let low = a_low * b_low;
    let middle = a_low * b_high;
    let other = a_high * b_low;
    let carried = (low >> 16u) + (middle & 0xffffu) + (other & 0xffffu);
    let high = a_high * b_high + (middle >> 16u) + (other >> 16u) + (carried >> 16u);
    return vec2((low & 0xffffu) | (carried << 16u), high);
}
