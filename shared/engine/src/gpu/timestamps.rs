//! Measures how long each pass takes, by the clock of the graphics card.
//!
//! Every pass writes two timestamps into a query set of fixed size. [`Timestamps::read`] waits for the card, reads the
//! set and empties it. Passes that do not fit into the set are not measured.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use wgpu::{BufferUsages, MapMode, PollType, QuerySet, QuerySetDescriptor, QueryType};

/// Largest number of passes that are measured between two reads. Each pass takes two queries, and wgpu allows 4096
/// queries in a set.
const PASSES_MAX: usize = 2048;

/// The time that one pass took, summed over its dispatches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PassTime {
    /// Name of the pass.
    pub name: &'static str,
    /// Number of dispatches that were measured.
    pub dispatches: usize,
    /// Time of all measured dispatches together, ms.
    pub milliseconds: f64,
}

/// The timestamp queries of a device.
#[derive(Debug)]
pub(super) struct Timestamps {
    queries: QuerySet,
    resolved: wgpu::Buffer,
    readable: wgpu::Buffer,
    /// Names of the passes recorded since the last read.
    names: Mutex<Vec<&'static str>>,
}

/// The two queries of one pass.
pub(super) struct Timed<'a> {
    queries: &'a QuerySet,
    /// Index of the pass in the set.
    place: usize,
}

impl Timed<'_> {
    /// The timestamps that the pass writes.
    pub(super) fn writes(&self) -> wgpu::ComputePassTimestampWrites<'_> {
        let first = 2 * self.place as u32;
        wgpu::ComputePassTimestampWrites {
            query_set: self.queries,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        }
    }
}

impl Timestamps {
    /// The queries of `device`, which must have `TIMESTAMP_QUERY`.
    pub(super) fn new(device: &wgpu::Device) -> Self {
        let count = 2 * PASSES_MAX as u32;
        let buffer = |label, usage| {
            let size = u64::from(count) * 8;
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size,
                usage,
                mapped_at_creation: false,
            })
        };
        Self {
            queries: device.create_query_set(&QuerySetDescriptor {
                label: Some("timestamps"),
                ty: QueryType::Timestamp,
                count,
            }),
            resolved: buffer("timestamps", BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC),
            readable: buffer("timestamps to read", BufferUsages::COPY_DST | BufferUsages::MAP_READ),
            names: Mutex::default(),
        }
    }

    /// Reserves the two queries of a pass; `None` once the set is full.
    pub(super) fn start(&self, name: &'static str) -> Option<Timed<'_>> {
        let mut names = self.names.lock().unwrap_or_else(PoisonError::into_inner);
        let place = names.len();
        (place < PASSES_MAX).then(|| {
            names.push(name);
            Timed { queries: &self.queries, place }
        })
    }

    /// The time of each pass since the last read, longest first; empty once the device is lost. All recorded passes
    /// must have been submitted.
    pub(super) fn read(&self, device: &wgpu::Device, queue: &wgpu::Queue) -> Vec<PassTime> {
        let names = std::mem::take(&mut *self.names.lock().unwrap_or_else(PoisonError::into_inner));
        if names.is_empty() {
            return Vec::new();
        }
        let bytes = 16 * names.len() as u64;
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.resolve_query_set(&self.queries, 0..2 * names.len() as u32, &self.resolved, 0);
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.readable, 0, bytes);
        let submission = queue.submit([encoder.finish()]);
        self.readable.map_async(MapMode::Read, ..bytes, |_| ());
        let waited = device.poll(PollType::Wait { submission_index: Some(submission), timeout: None });
        let Ok(view) = self.readable.get_mapped_range(..bytes) else { return Vec::new() };
        let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&view);
        drop(view);
        self.readable.unmap();
        match waited {
            Ok(_) => summed(&names, &ticks, f64::from(queue.get_timestamp_period()) * 1e-6),
            Err(_) => Vec::new(),
        }
    }
}

/// Sums the times by the name of the pass, longest first. `ticks` holds the beginning and the end of each dispatch.
fn summed(names: &[&'static str], ticks: &[u64], milliseconds_per_tick: f64) -> Vec<PassTime> {
    let mut times = BTreeMap::new();
    for (name, pair) in names.iter().zip(ticks.chunks_exact(2)) {
        let time = times.entry(*name).or_insert(PassTime { name, dispatches: 0, milliseconds: 0.0 });
        time.dispatches += 1;
        time.milliseconds += pair[1].saturating_sub(pair[0]) as f64 * milliseconds_per_tick;
    }
    let mut times: Vec<PassTime> = times.into_values().collect();
    times.sort_by(|a, b| b.milliseconds.total_cmp(&a.milliseconds));
    times
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_of_one_pass_are_added_and_the_longest_comes_first() {
        let times = summed(&["sort", "blend", "sort"], &[0, 10, 10, 100, 100, 120], 0.5);
        let pass = |name, dispatches, milliseconds| PassTime { name, dispatches, milliseconds };
        assert_eq!(times, [pass("blend", 1, 45.0), pass("sort", 2, 15.0)]);
    }
}
