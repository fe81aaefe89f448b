//! Tests the sort by key; and dispatches with more workgroups than one axis allows, with running sums of seventeen million
//! numbers.

use super::adapter::gpu;
use crate::gpu::buffer::Buffer;
use crate::gpu::recorder::{GROUPS_MAX, Recorder};
use crate::gpu::sort::{BLOCK, Counted, GROUP, Sorted, Sorter};
use crate::gpu::structs::{COUNTERS, SPLATS, VISIBLE};
use crate::random::{Purpose, Random};

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

#[test]
fn keys_are_sorted_and_equal_keys_keep_their_order() {
    let Some(gpu) = gpu() else { return };
    let mut random = Random::new(5, Purpose::Test, 0, 0);
    // Numbers of keys around the borders of blocks, and largest keys that take one to four steps.
    for (len, largest) in [(1, 0), (BLOCK - 1, 510), (BLOCK, 200), (3 * BLOCK + 1, u32::MAX), (70_000, 3888)]
    {
        let mut draw = || (random.next_u64() % (u64::from(largest) + 1)) as u32;
        let keys: Vec<u32> = (0..len).map(|i| if i % 7 == 0 { largest } else { draw() }).collect();
        let mut expected: Vec<[u32; 2]> = keys.iter().copied().zip(0..).map(|(key, at)| [key, at]).collect();
        expected.sort_by_key(|pair| pair[0]);

        let mut counted = [0; COUNTERS];
        counted[VISIBLE] = len as u32;
        let counters = Buffer::storage(&gpu, "counters", COUNTERS).expect("room");
        counters.write(&gpu, 0, &counted);
        let mut sorted = Sorted::new(&gpu, Counted::Visible, len).expect("room");
        sorted.set_largest(largest);
        let values: Vec<u32> = (0..len as u32).collect();
        for (buffer, values) in sorted.input().into_iter().zip([&keys, &values]) {
            gpu.queue.write_buffer(buffer, 0, bytemuck::cast_slice(values));
        }
        let mut r = Recorder::new(&gpu);
        Sorter::new(&gpu, len).expect("room").sort(&mut r, &counters.raw, &sorted);
        r.submit();
        let found = sorted.read(&gpu).map(|values| values[..len].to_vec());
        let expected = [0, 1].map(|column| expected.iter().map(|pair| pair[column]).collect::<Vec<u32>>());
        assert!(found == expected, "{len} keys up to {largest}");
    }
}
