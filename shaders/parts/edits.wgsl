// The rows that a step of an edit moves.
// Needs: types; the binding `edit`.

// Where the row of job `job` begins. Jobs are numbered row by row; a row has as many jobs as there are moves.
fn row_of(job: u32) -> u32 {
    return (edit.first_row + job / edit.moves) * edit.splat_stride;
}
