// Inputs of the passes over tile lists: the splats, and the pairs of each tile, nearest first.
// Needs: types.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> projected: array<Projected>;
// Slots of the pairs in the order of the tiles, and the splat of each slot.
@group(0) @binding(2) var<storage, read> sorted_slots: array<u32>;
@group(0) @binding(3) var<storage, read> id_of_slot: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;

// The splat of the pair at a place of the sorted order.
fn splat_at(at: u32) -> Projected {
    return projected[id_of_slot[sorted_slots[at]]];
}
