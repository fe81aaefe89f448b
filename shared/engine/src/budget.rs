//! The memory promise: from bytes to the size of every buffer, before anything is allocated.

use crate::backend::Channels;
use crate::cpu::CpuCapacity;
#[cfg(feature = "gpu")]
use crate::gpu::GpuCapacity;

/// What a process takes before it does anything: code, stacks, allocator, tables.
pub const PROCESS_BYTES: u64 = 28 << 20;

/// What graphics cards take of the process beside all buffers: drivers, compiled passes, staging. Mesa's software
/// driver takes 240 MiB while it trains, 30 MiB when it is only looked for.
pub const DRIVER_BYTES: u64 = 256 << 20;

/// Splat–tile pairs that there is room for, per splat. Aerial scenes need 2 to 4 per splat in the whole
/// model; a view that needs more loses its farthest splats, and the report says so.
const PAIRS_PER_SPLAT: usize = 4;

/// Fewest splats with which a training makes sense.
const SPLATS_MIN: usize = 2000;

/// Refinement reads every shape (64 B) and writes children; at the end the whole model is read out once, when
/// refinement's share is free again. Bytes per splat for the larger of the two.
const fn scratch_bytes(sh_degree: u32) -> usize {
    let model = 4 * (11 + 3 * cosurf_scene::splats::sh_coefficients(sh_degree));
    let refinement = 64 + 48 + model / 2;
    if model > refinement { model } else { refinement }
}

/// What a training wants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wish {
    /// Bytes for the whole process.
    pub memory_bytes: u64,
    /// Size of the largest picture, as the user asked for it.
    pub size_px: [u32; 2],
    /// SH degree, 0..=3.
    pub sh_degree: u32,
    /// Whether a graphics card trains: its bytes count like those of the process, and so does its driver.
    pub on_gpu: bool,
    /// What will be blended in training.
    pub channels: Channels,
    /// Splats that the training would make if memory did not matter.
    pub splats: usize,
    /// Bytes of the picture cache that would hold everything ready.
    pub cache_bytes_most: u64,
    /// Bytes of the picture cache below which it cannot work.
    pub cache_bytes_least: u64,
    /// Bytes that reading the dataset and decoding its largest picture take for a moment.
    pub loading_bytes: u64,
}

/// Sizes that keep a training within its bytes.
#[derive(Clone, Debug, PartialEq)]
pub struct Budget {
    /// Sizes of the backend's buffers.
    pub capacity: CpuCapacity,
    /// Bytes of the picture cache.
    pub cache_bytes: u64,
    /// What had to be given up, one sentence each.
    pub given_up: Vec<String>,
}

/// The bytes do not suffice for the smallest training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{memory_bytes} bytes of memory are too few; this training needs at least {least_bytes} (--memory {}MiB)", least_bytes.div_ceil(1 << 20))]
pub struct TooLittleMemory {
    /// What was given.
    pub memory_bytes: u64,
    /// The smallest amount that would do.
    pub least_bytes: u64,
}

/// Bytes of a backend.
struct Costs {
    /// Of the process without pictures and splats.
    fixed: u64,
    pictures: usize,
    splat: usize,
    pair: usize,
}

impl Costs {
    fn of(wish: &Wish) -> Self {
        #[cfg(feature = "gpu")]
        if wish.on_gpu {
            return Self {
                fixed: PROCESS_BYTES + DRIVER_BYTES,
                pictures: GpuCapacity::picture_bytes(wish.size_px, wish.channels),
                splat: GpuCapacity::splat_bytes(wish.sh_degree),
                pair: GpuCapacity::PAIR_BYTES,
            };
        }
        Self {
            fixed: PROCESS_BYTES,
            pictures: CpuCapacity::picture_bytes(wish.size_px, wish.channels, true),
            splat: CpuCapacity::splat_bytes(wish.sh_degree, true),
            pair: CpuCapacity::pair_bytes(true),
        }
    }
}

impl Budget {
    /// Divides the bytes: first what cannot be less, then splats up to the wish, then the cache.
    pub fn plan(wish: &Wish) -> Result<Self, TooLittleMemory> {
        let costs = Costs::of(wish);
        let fixed = costs.fixed + costs.pictures as u64 + wish.cache_bytes_least + wish.loading_bytes;
        let per_splat = (costs.splat + PAIRS_PER_SPLAT * costs.pair + scratch_bytes(wish.sh_degree)) as u64;
        let least_bytes = fixed + SPLATS_MIN.min(wish.splats) as u64 * per_splat;
        if wish.memory_bytes < least_bytes {
            return Err(TooLittleMemory { memory_bytes: wish.memory_bytes, least_bytes });
        }
        let mut given_up = Vec::new();
        let free = wish.memory_bytes - fixed;
        // A cache that holds everything saves time; splats decide the quality: they get three quarters first.
        let extra_wanted = wish.cache_bytes_most.saturating_sub(wish.cache_bytes_least);
        let splats_wanted = wish.splats as u64 * per_splat;
        let for_splats = splats_wanted.min(free.saturating_sub(extra_wanted).max(free / 4 * 3));
        let splats = (for_splats / per_splat) as usize;
        if splats < wish.splats {
            given_up.push(format!("at most {splats} splats instead of {}", wish.splats));
        }
        let extra = extra_wanted.min(free - for_splats);
        if extra < extra_wanted {
            let (has, wants) = ((wish.cache_bytes_least + extra) >> 20, wish.cache_bytes_most >> 20);
            given_up.push(format!("{has} MiB of picture cache instead of {wants} MiB"));
        }
        let capacity = CpuCapacity {
            splats,
            pairs: PAIRS_PER_SPLAT * splats,
            size_px: wish.size_px,
            sh_degree: wish.sh_degree,
            channels: wish.channels,
            training: true,
        };
        Ok(Self { capacity, cache_bytes: wish.cache_bytes_least + extra, given_up })
    }
}
