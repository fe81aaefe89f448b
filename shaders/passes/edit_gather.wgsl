// The first half of an edit: copies the numbers of the splats that move, and of the parents of new splats, to `moved`.
// An invocation copies one number. The second half is edit_scatter. Both halves can be neither one pass nor in place,
// since a splat may move to a place from which another one is copied.
// Parts: types, edits.

@group(0) @binding(0) var<uniform> edit: EditStep;
// For each splat that moves, its place after and before the edit; then for each new splat its place, and its parent's.
@group(0) @binding(1) var<storage, read> moves: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> rows: array<f32>;
@group(0) @binding(3) var<storage, read_write> moved: array<f32>;

@compute @workgroup_size(GROUP)
fn edit_gather(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let job = group_index(group) * GROUP + lane;
    if (job >= edit.rows * edit.moves) {
        return;
    }
    let place = job % edit.moves;
    moved[job] = select(0.0, rows[row_of(job) + moves[place].y], place < edit.copied);
}
