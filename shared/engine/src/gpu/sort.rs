//! Running sums, and a stable radix sort with digits of 8 bits. Both work on blocks of 1024 numbers. Their results do
//! not depend on how the GPU schedules workgroups.

use super::buffer::Buffer;
use super::context::{Gpu, GpuError};
use super::pass::Pass;
use super::recorder::Recorder;
use super::structs::{PAIRS, PAIRS_WANTED, SPLATS, ScanStep, SortStep, UNUSED, VISIBLE};

/// Invocations of a workgroup, as in the shaders.
pub(super) const GROUP: usize = 256;
/// Numbers that one workgroup scans or sorts, as in the shaders.
pub(super) const BLOCK: usize = 1024;
/// Number of values of a digit, as in the shaders.
pub(super) const DIGITS: usize = 256;
/// Number of bits of a digit.
const DIGIT_BITS: u32 = DIGITS.ilog2();

/// Keys to sort and their values, each in two buffers. A step of the sort reads from one and writes to the other.
#[derive(Debug)]
pub(super) struct Sorted {
    keys: [Buffer<u32>; 2],
    values: [Buffer<u32>; 2],
    /// Which counter holds the number of keys.
    counter: Counted,
    /// Number of steps of the sort: one for each digit of the largest key.
    steps: u32,
}

/// What is scanned or sorted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Counted {
    /// Visible splats.
    Visible,
    /// Splat–tile pairs.
    Pairs,
}

impl Sorted {
    /// Allocates room for `len` keys of 32 bits.
    pub(super) fn new(gpu: &Gpu, counter: Counted, len: usize) -> Result<Self, GpuError> {
        let room = || Buffer::storage(gpu, "keys to sort", len);
        Ok(Self {
            keys: [room()?, room()?],
            values: [room()?, room()?],
            counter,
            steps: u32::BITS / DIGIT_BITS,
        })
    }

    /// Sets the largest possible key, which decides how many steps the sort takes.
    pub(super) fn set_largest(&mut self, key: u32) {
        self.steps = (u32::BITS - key.leading_zeros()).div_ceil(DIGIT_BITS);
    }

    /// The buffers into which keys and values are written before the sort.
    pub(super) fn input(&self) -> [&wgpu::Buffer; 2] {
        self.half(self.steps as usize % 2)
    }

    /// The buffers that hold keys and values after the sort.
    pub(super) fn result(&self) -> [&wgpu::Buffer; 2] {
        self.half(0)
    }

    fn half(&self, half: usize) -> [&wgpu::Buffer; 2] {
        [&self.keys[half].raw, &self.values[half].raw]
    }

    fn len(&self) -> usize {
        self.keys[0].len()
    }

    /// Reads keys and values after the sort.
    #[cfg(test)]
    pub(super) fn read(&self, gpu: &Gpu) -> [Vec<u32>; 2] {
        [&self.keys[0], &self.values[0]].map(|buffer| buffer.read(gpu, 0..buffer.len()))
    }
}

/// The passes of scans (running sums) and sorts, and their buffers.
#[derive(Debug)]
pub(super) struct Sorter {
    scan_blocks: Pass,
    scan_sums: Pass,
    scan_add: Pass,
    count: Pass,
    scatter: Pass,
    counts: Buffer<u32>,
    block_sums: Buffer<u32>,
    /// Parameters of the scans. Here and in the next two arrays, the first entry is for [`Counted::Visible`], the
    /// second for [`Counted::Pairs`].
    scans: [Buffer<ScanStep>; 2],
    /// Parameters of the scans of digit counts within a sort.
    scan_digits: [Buffer<ScanStep>; 2],
    /// Parameters of the steps of the sorts.
    sort_steps: [Vec<Buffer<SortStep>>; 2],
}

impl Sorter {
    /// Allocates room for sorts of up to `len` keys, and for scans of up to `len` numbers.
    pub(super) fn new(gpu: &Gpu, len: usize) -> Result<Self, GpuError> {
        let scan = |counter: usize, digits: u32, total: usize| {
            let step = ScanStep { counter: counter as u32, digits, total: total as u32, unused: 0 };
            Buffer::uniform(gpu, "scan step", step)
        };
        let steps = |counter: usize| {
            let step = |shift| SortStep { counter: counter as u32, shift };
            let shifts = (0..u32::BITS).step_by(DIGIT_BITS as usize);
            shifts.map(|shift| Buffer::uniform(gpu, "sort step", step(shift))).collect()
        };
        let (counts, block_sums) = Self::room(gpu, len)?;
        Ok(Self {
            scan_blocks: gpu.pass(cosurf_shaders::SCAN_BLOCKS),
            scan_sums: gpu.pass(cosurf_shaders::SCAN_SUMS),
            scan_add: gpu.pass(cosurf_shaders::SCAN_ADD),
            count: gpu.pass(cosurf_shaders::SORT_COUNT),
            scatter: gpu.pass(cosurf_shaders::SORT_SCATTER),
            counts,
            block_sums,
            scans: [scan(SPLATS, 0, VISIBLE), scan(VISIBLE, 0, PAIRS_WANTED)],
            scan_digits: [scan(VISIBLE, 1, UNUSED), scan(PAIRS, 1, UNUSED)],
            sort_steps: [steps(VISIBLE), steps(PAIRS)],
        })
    }

    /// Replaces the buffers by ones for `len` keys.
    pub(super) fn grow(&mut self, gpu: &Gpu, len: usize) -> Result<(), GpuError> {
        (self.counts, self.block_sums) = Self::room(gpu, len)?;
        Ok(())
    }

    fn room(gpu: &Gpu, len: usize) -> Result<(Buffer<u32>, Buffer<u32>), GpuError> {
        let counts = DIGITS * len.div_ceil(BLOCK);
        let sums = counts.max(len).div_ceil(BLOCK);
        Ok((Buffer::storage(gpu, "digit counts", counts)?, Buffer::storage(gpu, "block sums", sums)?))
    }

    /// Replaces each of up to `len_max` numbers in `values` by the sum of the numbers before it.
    ///
    /// For [`Counted::Visible`] the numbers are flags of all splats, and the total goes to the counter of visible
    /// splats. For [`Counted::Pairs`] each number is that of the pairs of a visible splat, and the total goes to the
    /// counter of wanted pairs.
    pub(super) fn scan(
        &self,
        r: &mut Recorder,
        what: Counted,
        counters: &wgpu::Buffer,
        values: &Buffer<u32>,
        len_max: usize,
    ) {
        let step = &self.scans[what as usize];
        self.scan_within(r, step, counters, values, len_max);
        let groups = len_max.div_ceil(GROUP);
        r.run(&self.scan_add, &[&step.raw, counters, &self.block_sums.raw, &values.raw], groups);
    }

    fn scan_within(
        &self,
        r: &mut Recorder,
        step: &Buffer<ScanStep>,
        counters: &wgpu::Buffer,
        values: &Buffer<u32>,
        len_max: usize,
    ) {
        let sums = &self.block_sums.raw;
        r.run(&self.scan_blocks, &[&step.raw, counters, &values.raw, sums], len_max.div_ceil(BLOCK));
        r.run(&self.scan_sums, &[&step.raw, counters, sums], 1);
    }

    /// Sorts by key; equal keys keep their order.
    pub(super) fn sort(&self, r: &mut Recorder, counters: &wgpu::Buffer, sorted: &Sorted) {
        let which = sorted.counter as usize;
        let blocks = sorted.len().div_ceil(BLOCK);
        let mut from = sorted.steps as usize % 2;
        for step in &self.sort_steps[which][..sorted.steps as usize] {
            let [keys, values] = sorted.half(from);
            let [to_keys, to_values] = sorted.half(1 - from);
            r.run(&self.count, &[&step.raw, counters, keys, &self.counts.raw], blocks);
            self.scan_within(r, &self.scan_digits[which], counters, &self.counts, DIGITS * blocks);
            let (counts, sums) = (&self.counts.raw, &self.block_sums.raw);
            let buffers = [&step.raw, counters, counts, sums, keys, values, to_keys, to_values];
            r.run(&self.scatter, &buffers, blocks);
            from = 1 - from;
        }
    }
}
