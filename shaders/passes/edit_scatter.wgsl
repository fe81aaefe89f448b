// The second half of an edit: writes the numbers that edit_gather copied to the new places of their splats.
// Parts: types, edits.

@group(0) @binding(0) var<uniform> edit: EditStep;
@group(0) @binding(1) var<storage, read> moves: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> moved: array<f32>;
@group(0) @binding(3) var<storage, read_write> rows: array<f32>;

@compute @workgroup_size(GROUP)
fn edit_scatter(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let job = group_index(group) * GROUP + lane;
    if (job < edit.rows * edit.moves) {
        rows[row_of(job) + moves[job % edit.moves].x] = moved[job];
    }
}
