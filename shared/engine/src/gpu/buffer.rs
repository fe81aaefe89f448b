//! Typed buffers on the GPU, and how the processor writes and reads their values.

use std::marker::PhantomData;
use std::ops::Range;

use bytemuck::Pod;
use wgpu::BufferUsages;

use super::context::{Gpu, GpuError};

/// `len` values of `T` in the GPU's memory.
#[derive(Debug)]
pub(super) struct Buffer<T> {
    pub(super) raw: wgpu::Buffer,
    len: usize,
    holds: PhantomData<T>,
}

impl<T: Pod> Buffer<T> {
    /// A storage buffer of `len` values, or of one value if `len` is 0. Fails if the adapter cannot bind it.
    pub(super) fn storage(gpu: &Gpu, label: &'static str, len: usize) -> Result<Self, GpuError> {
        let len = len.max(1);
        let bytes = (len * size_of::<T>()) as u64;
        let bytes_max = gpu.adapter().binding_bytes_max;
        if bytes > bytes_max {
            return Err(GpuError::TooLarge { label, bytes, bytes_max, name: gpu.adapter().name.clone() });
        }
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
        let buffer = Self::new(gpu, label, len, usage);
        #[cfg(test)]
        buffer.poison(gpu);
        Ok(buffer)
    }

    /// Fills a buffer with values that spoil the results of a pass that reads them before it writes. They are about
    /// -4e37 as floats, and larger than any count as integers.
    #[cfg(test)]
    fn poison(&self, gpu: &Gpu) {
        gpu.queue.write_buffer(&self.raw, 0, &vec![0xfd; self.raw.size() as usize]);
    }

    /// One value that passes read as a uniform.
    pub(super) fn uniform(gpu: &Gpu, label: &'static str, value: T) -> Self {
        let buffer = Self::new(gpu, label, 1, BufferUsages::UNIFORM | BufferUsages::COPY_DST);
        buffer.write(gpu, 0, &[value]);
        buffer
    }

    fn new(gpu: &Gpu, label: &'static str, len: usize, usage: BufferUsages) -> Self {
        // wgpu copies whole words of 4 bytes only.
        let size = ((len * size_of::<T>()) as u64).next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT);
        let descriptor =
            wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false };
        Self { raw: gpu.device.create_buffer(&descriptor), len, holds: PhantomData }
    }

    pub(super) fn len(&self) -> usize {
        self.len
    }

    /// Replaces the values from index `first` on. All work that is submitted later sees the new values.
    pub(super) fn write(&self, gpu: &Gpu, first: usize, values: &[T]) {
        assert!(first + values.len() <= self.len, "{first} + {} of {}", values.len(), self.len);
        gpu.queue.write_buffer(&self.raw, (first * size_of::<T>()) as u64, bytemuck::cast_slice(values));
    }

    /// Replaces the bytes from word `first` on, a word having 4 bytes. Up to three bytes behind them become 0, because
    /// only whole words can be written.
    pub(super) fn write_bytes(&self, gpu: &Gpu, first: usize, bytes: &[u8]) {
        let (words, rest) = bytes.as_chunks::<4>();
        gpu.queue.write_buffer(&self.raw, 4 * first as u64, words.as_flattened());
        if !rest.is_empty() {
            let mut last = [0; 4];
            last[..rest.len()].copy_from_slice(rest);
            gpu.queue.write_buffer(&self.raw, 4 * (first + words.len()) as u64, &last);
        }
    }

    /// Sets every value to zero, after all work submitted so far.
    pub(super) fn clear(&self, gpu: &Gpu) {
        let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.clear_buffer(&self.raw, 0, None);
        gpu.queue.submit([encoder.finish()]);
    }

    /// Reads the values of a range, after all work submitted so far. Returns zeros once the device is lost.
    pub(super) fn read(&self, gpu: &Gpu, range: Range<usize>) -> Vec<T> {
        let [bytes] = read_together(gpu, [self.part(range)]);
        bytemuck::pod_collect_to_vec(&bytes)
    }

    /// A range of the values, for [`read_together`].
    pub(super) fn part(&self, range: Range<usize>) -> Part<'_> {
        assert!(range.end <= self.len, "{range:?} of {}", self.len);
        let [first, end] = [range.start, range.end].map(|at| (at * size_of::<T>()) as u64);
        Part { buffer: &self.raw, bytes: first..end }
    }
}

/// A range of bytes of a buffer.
pub(super) struct Part<'a> {
    buffer: &'a wgpu::Buffer,
    bytes: Range<u64>,
}

/// Reads several parts of buffers, waiting only once, after all work submitted so far. Returns zeros once the device is
/// lost.
pub(super) fn read_together<const N: usize>(gpu: &Gpu, parts: [Part; N]) -> [Vec<u8>; N] {
    read_with(gpu, parts, |parts| parts.map(<[u8]>::to_vec))
}

/// As [`read_together`], but hands the bytes to `take`, where they lie in the memory that the card writes to.
pub(super) fn read_with<const N: usize, R>(
    gpu: &Gpu,
    parts: [Part; N],
    take: impl FnOnce([&[u8]; N]) -> R,
) -> R {
    let lens = parts.each_ref().map(|part| part.bytes.end - part.bytes.start);
    let bytes: u64 = lens.iter().sum();
    if bytes == 0 {
        return take(lens.map(|_| &[][..]));
    }
    let staging = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("staging"),
        size: bytes,
        usage: BufferUsages::MAP_READ | BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    let mut to = 0;
    for (part, len) in parts.iter().zip(lens).filter(|(_, len)| *len > 0) {
        encoder.copy_buffer_to_buffer(part.buffer, part.bytes.start, &staging, to, len);
        to += len;
    }
    let submission = gpu.queue.submit([encoder.finish()]);
    let (sender, mapped) = std::sync::mpsc::channel();
    staging.map_async(wgpu::MapMode::Read, .., move |result| {
        let _ = sender.send(result);
    });
    let wait = wgpu::PollType::Wait { submission_index: Some(submission), timeout: None };
    let polled = gpu.device.poll(wait);
    match (polled, mapped.recv(), staging.get_mapped_range(..)) {
        (Ok(_), Ok(Ok(())), Ok(view)) => {
            let mut rest = &view[..];
            take(lens.map(|len| rest.split_off(..len as usize).unwrap_or_default()))
        }
        failed => {
            gpu.lose(&format!("{:?}, {:?}", failed.0, failed.1));
            // Whole words, because they may be read as numbers of 4 bytes.
            let zeros = lens.map(|len| vec![0u32; len.div_ceil(4) as usize]);
            take(zeros.each_ref().map(|zeros| bytemuck::cast_slice(zeros)))
        }
    }
}
