//! Tests dispatches with more workgroups than one axis allows, with running sums of seventeen million numbers.

use super::adapter::gpu;
use crate::gpu::buffer::Buffer;
use crate::gpu::recorder::{GROUPS_MAX, Recorder};
use crate::gpu::sort::{Counted, GROUP, Sorter};
use crate::gpu::structs::{COUNTERS, SPLATS, VISIBLE};

#[test]
fn running_sums_work_beyond_one_row_of_workgroups() {
    let Some(gpu) = gpu() else { return };
    let len = GROUP * (GROUPS_MAX as usize + 2) + 3;
    let mut counted = [0; COUNTERS];
    counted[SPLATS] = len as u32;
    let counters = Buffer::storage(&gpu, "counters", COUNTERS).expect("room");
    counters.write(&gpu, 0, &counted);
    let flags = Buffer::storage(&gpu, "flags", len).expect("room");
    flags.write(&gpu, 0, &vec![1; len]);
    let sorter = Sorter::new(&gpu, len).expect("room");
    let mut r = Recorder::new(&gpu);
    sorter.scan(&mut r, Counted::Visible, &counters.raw, &flags, len);
    r.submit();
    assert_eq!(counters.read(&gpu, VISIBLE..VISIBLE + 1), [len as u32]);
    let wrong = flags.read(&gpu, 0..len).into_iter().enumerate().find(|(i, sum)| *i != *sum as usize);
    assert_eq!(wrong, None, "{len} numbers");
}
