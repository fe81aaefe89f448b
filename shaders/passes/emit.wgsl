// Writes the pairs of each splat to its slots, nearest splat first. A slot is the index of a pair before the sort by
// tile. If a splat needs slots beyond the capacity, neither this splat nor the splats behind it get slots.
// Parts: types, spans.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> counters: array<u32>;
@group(0) @binding(2) var<storage, read> ids: array<u32>;
// For each visible splat, nearest first, the number of pairs of the splats before it.
@group(0) @binding(3) var<storage, read> places: array<u32>;
@group(0) @binding(4) var<storage, read> projected: array<Projected>;
@group(0) @binding(5) var<storage, read_write> slots: array<vec2<u32>>;
// For each slot: its tile as the key, the slot itself as the value, and the id of its splat. Keys and values are sorted
// next.
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> values: array<u32>;
@group(0) @binding(8) var<storage, read_write> id_of_slot: array<u32>;

@compute @workgroup_size(GROUP)
fn emit(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let k = group_index(group) * GROUP + lane;
    let visible = counters[VISIBLE];
    if (k >= visible) {
        return;
    }
    let id = ids[k];
    let first = places[k];
    var end = counters[PAIRS_WANTED];
    if (k + 1u < visible) {
        end = places[k + 1u];
    }
    if (end > view.pair_capacity) {
        if (first <= view.pair_capacity) {
            counters[PAIRS] = first;
        }
        slots[id] = vec2(0u, 0u);
        return;
    }
    if (k + 1u == visible) {
        counters[PAIRS] = end;
    }
    let splat = projected[id];
    let rows = tile_rows(splat);
    var slot = first;
    for (var y = rows.x; y < rows.y; y++) {
        let span = tile_span(splat, y);
        for (var x = span.x; x < span.y && slot < end; x++) {
            write_pair(slot, u32(y) * view.tiles.x + u32(x), id);
            slot++;
        }
    }
    slots[id] = vec2(first, slot - first);
    // If a driver rounds differently here than in the count of tiles, the remaining slots belong to no tile.
    for (; slot < end; slot++) {
        write_pair(slot, view.tiles.x * view.tiles.y, id);
    }
}

fn write_pair(slot: u32, tile: u32, id: u32) {
    keys[slot] = tile;
    values[slot] = slot;
    id_of_slot[slot] = id;
}
