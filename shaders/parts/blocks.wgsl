// The division of a tile into blocks of 8 × 4 pixels, for passes where each invocation has one pixel. Invocations that
// a graphics card runs in step then have pixels close together, which the same splats reach.
// Needs: types.

// Place in the tile of the pixel with this number. Pixels are numbered block by block, and row by row in a block.
fn place_in_blocks(number: u32) -> vec2<u32> {
    let block = number / 32u;
    return vec2(block % 2u * 8u + number % 8u, block / 2u * 4u + number % 32u / 8u);
}
