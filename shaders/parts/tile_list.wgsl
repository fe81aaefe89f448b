// Inputs of the passes that go through the list of each tile: the splats, and the pairs of each tile, nearest splat
// first.
// Needs: types.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> projected: array<Projected>;
// The slots of all pairs in the order of the tiles, and the index of the splat of each slot. A slot is the index of a
// pair before the sort by tile.
@group(0) @binding(2) var<storage, read> sorted_slots: array<u32>;
@group(0) @binding(3) var<storage, read> id_of_slot: array<u32>;
// First and end of each tile's pairs in `sorted_slots`.
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;

// The splat of the pair at index `at` of `sorted_slots`.
fn splat_at(at: u32) -> Projected {
    return projected[id_of_slot[sorted_slots[at]]];
}
