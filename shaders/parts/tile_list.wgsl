// What the passes over each tile's list read: the splats, and the tile's pairs, nearest first.
// Needs: types.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> projected: array<Projected>;
// Slots of the pairs, tile by tile; and their splats.
@group(0) @binding(2) var<storage, read> sorted_slots: array<u32>;
@group(0) @binding(3) var<storage, read> id_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;

// The splat at a place among the sorted pairs.
fn splat_at(at: u32) -> Projected {
    return projected[id_of_slot[sorted_slots[at]]];
}
