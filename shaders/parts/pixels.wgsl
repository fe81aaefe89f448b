// Pixels and tiles of a picture. `pixel_place` returns the index of a pixel's value in a picture that is stored in
// tiles. `line_place` returns its index in a buffer that holds one number for each pixel, row by row.
// Needs: types; the binding `view`.

fn pixel_place(planes: u32, plane: u32, pixel: vec2<u32>) -> u32 {
    let tile = pixel.y / TILE * view.tiles.x + pixel.x / TILE;
    return (tile * planes + plane) * TILE_PIXELS + pixel.y % TILE * TILE + pixel.x % TILE;
}

fn line_place(pixel: vec2<u32>) -> u32 {
    return pixel.y * view.size_px.x + pixel.x;
}

fn is_inside(pixel: vec2<u32>) -> bool {
    return all(pixel < view.size_px);
}

// Number of tiles of the picture.
fn tiles() -> u32 {
    return view.tiles.x * view.tiles.y;
}

// The first pixel of a tile.
fn corner_of(tile: u32) -> vec2<u32> {
    return TILE * vec2(tile % view.tiles.x, tile / view.tiles.x);
}

// The pixel of invocation `lane`, in passes where a workgroup processes one tile and an invocation one pixel.
fn pixel_of(tile: u32, lane: u32) -> vec2<u32> {
    return corner_of(tile) + vec2(lane % TILE, lane / TILE);
}
