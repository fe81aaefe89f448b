//! Running sums and a stable radix sort, 4 bits at a time, in blocks of 1024 numbers; the result does not depend on how
//! the GPU schedules workgroups.

use super::buffer::Buffer;
use super::context::{Gpu, GpuError};
use super::pass::Pass;
use super::recorder::Recorder;
use super::structs::{PAIRS, PAIRS_WANTED, SPLATS, ScanStep, SortStep, UNUSED, VISIBLE};

/// Invocations of a workgroup, as in the shaders.
pub(super) const GROUP: usize = 256;
/// Numbers that one workgroup scans or sorts, as in the shaders.
pub(super) const BLOCK: usize = 1024;
/// Values of a digit (as in the shaders), and its bits.
pub(super) const DIGITS: usize = 16;
const DIGIT_BITS: u32 = 4;

/// Keys and values in two buffers each: a step of the sort reads one and writes the other.
#[derive(Debug)]
pub(super) struct Sorted {
    keys: [Buffer<u32>; 2],
    values: [Buffer<u32>; 2],
    /// The counter with the number of keys.
    counter: Counted,
    steps: u32,
}

/// The numbers that are scanned or sorted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Counted {
    /// Visible splats.
    Visible,
    /// Splat–tile pairs.
    Pairs,
}

impl Sorted {
    /// Room for `len` keys of 32 bits.
    pub(super) fn new(gpu: &Gpu, counter: Counted, len: usize) -> Result<Self, GpuError> {
        let room = || Buffer::storage(gpu, "keys to sort", len);
        Ok(Self {
            keys: [room()?, room()?],
            values: [room()?, room()?],
            counter,
            steps: u32::BITS / DIGIT_BITS,
        })
    }

    /// Sets the largest possible key.
    pub(super) fn set_largest(&mut self, key: u32) {
        self.steps = (u32::BITS - key.leading_zeros()).div_ceil(DIGIT_BITS);
    }

    /// The buffers for keys and values before the sort.
    pub(super) fn input(&self) -> [&wgpu::Buffer; 2] {
        self.half(self.steps as usize % 2)
    }

    /// The buffers with keys and values after the sort.
    pub(super) fn result(&self) -> [&wgpu::Buffer; 2] {
        self.half(0)
    }

    fn half(&self, half: usize) -> [&wgpu::Buffer; 2] {
        [&self.keys[half].raw, &self.values[half].raw]
    }

    fn len(&self) -> usize {
        self.keys[0].len()
    }
}

/// The passes of scans and sorts with their buffers.
#[derive(Debug)]
pub(super) struct Sorter {
    scan_blocks: Pass,
    scan_sums: Pass,
    scan_add: Pass,
    count: Pass,
    scatter: Pass,
    counts: Buffer<u32>,
    block_sums: Buffer<u32>,
    /// Here and in the next two fields: for [`Counted::Visible`], then for [`Counted::Pairs`].
    scans: [Buffer<ScanStep>; 2],
    scan_digits: [Buffer<ScanStep>; 2],
    sort_steps: [Vec<Buffer<SortStep>>; 2],
}

impl Sorter {
    /// Room for sorts of up to `len` keys, and for scans of up to `len` numbers.
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

    /// Grows the buffers for `len` keys.
    pub(super) fn grow(&mut self, gpu: &Gpu, len: usize) -> Result<(), GpuError> {
        (self.counts, self.block_sums) = Self::room(gpu, len)?;
        Ok(())
    }

    fn room(gpu: &Gpu, len: usize) -> Result<(Buffer<u32>, Buffer<u32>), GpuError> {
        let counts = DIGITS * len.div_ceil(BLOCK);
        let sums = counts.max(len).div_ceil(BLOCK);
        Ok((Buffer::storage(gpu, "digit counts", counts)?, Buffer::storage(gpu, "block sums", sums)?))
    }

    /// Replaces up to `len_max` numbers by their running sums. For [`Counted::Visible`] these are the flags of all
    /// splats, and the total goes to the counter of visible splats; for [`Counted::Pairs`] these are the numbers of
    /// pairs of the visible splats, and the total goes to the counter of wanted pairs.
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
