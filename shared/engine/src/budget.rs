//! The memory budget: derives the size of every buffer from a number of bytes, before anything is allocated.

mod capacity;
mod costs;
mod freed;
mod viewing;

use crate::backend::Channels;
use crate::layout::rows::parameter_rows;
pub use capacity::{Capacity, PAIRS_PER_SEEN_SPLAT, PAIRS_PER_SPLAT};
pub use costs::{Costs, DRIVER_BYTES};
#[cfg(feature = "gpu")]
pub(crate) use costs::{PARTIALS, PROJECTED_BYTES, TAUGHT_NUMBERS};
pub use freed::return_freed_memory;
pub(crate) use viewing::Viewing;

/// Bytes that a process takes beside the planned buffers: code, stacks, the allocator, small tables, and the threads'
/// scratch memory.
pub const PROCESS_BYTES: u64 = 28 << 20;

/// Smallest number of splats that is worth training.
const SPLATS_MIN: usize = 2000;

/// Temporary bytes per splat: the larger of two needs that never coincide. Refinement copies the shape of every splat
/// (64 bytes are reserved) and builds the new splats. The end of training copies all parameters once.
const fn scratch_bytes(sh_degree: u32) -> usize {
    let model = 4 * parameter_rows(sh_degree);
    let refinement = 64 + 48 + model / 2;
    if model > refinement { model } else { refinement }
}

/// What a training needs at least, and what it uses if the memory suffices.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wish {
    /// Memory limit of the whole process, bytes.
    pub memory_bytes: u64,
    /// Width and height of the largest picture, px, as the user requested it.
    pub size_px: [u32; 2],
    /// SH degree, 0..=3.
    pub sh_degree: u32,
    /// Bytes of the largest buffer that the graphics card can bind, or `None` for the CPU. The memory of the card and
    /// of its driver counts as memory of the process.
    pub binding_bytes_max: Option<u64>,
    /// Channels that will be blended in training.
    pub channels: Channels,
    /// Number of splats that training uses if memory does not limit it.
    pub splats: usize,
    /// Bytes of a picture cache that holds all pictures.
    pub cache_bytes_most: u64,
    /// Bytes of the smallest usable picture cache.
    pub cache_bytes_least: u64,
    /// Peak bytes of reading the dataset and decoding its largest picture.
    pub loading_bytes: u64,
}

/// Sizes that keep a training within its memory limit.
#[derive(Clone, Debug, PartialEq)]
pub struct Budget {
    /// Sizes of the backend's buffers.
    pub capacity: Capacity,
    /// Bytes of the picture cache.
    pub cache_bytes: u64,
    /// Reductions that the memory limit forced, one sentence each, for the report.
    pub given_up: Vec<String>,
}

/// Why no sizes fit the memory limit or the graphics card.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BudgetError {
    /// The memory is too small for the smallest training.
    #[error("a memory limit of {memory_bytes} bytes is too small; this training needs at least {least_bytes} (--memory {}MiB)", least_bytes.div_ceil(1 << 20))]
    TooLittleMemory {
        /// The memory limit, bytes.
        memory_bytes: u64,
        /// The smallest sufficient limit, bytes.
        least_bytes: u64,
    },
    /// The pictures are larger than the largest buffer that the graphics card can bind.
    #[error("a picture of {} × {} px takes {bytes} bytes, but the graphics card binds at most {bytes_max} at once; use smaller pictures or --compute cpu", size_px[0], size_px[1])]
    PictureTooLarge {
        /// Width and height of the picture, px.
        size_px: [u32; 2],
        /// Bytes of the picture's largest buffer.
        bytes: u64,
        /// Bytes of the largest buffer that the card can bind.
        bytes_max: u64,
    },
}

impl BudgetError {
    /// This error, or another one that needs less memory.
    pub fn or_less(self, other: Self) -> Self {
        match (&self, &other) {
            (Self::TooLittleMemory { least_bytes, .. }, Self::TooLittleMemory { least_bytes: less, .. })
                if less < least_bytes =>
            {
                other
            }
            (Self::PictureTooLarge { .. }, Self::TooLittleMemory { .. }) => other,
            _ => self,
        }
    }
}

impl Budget {
    /// Divides the memory limit: first come the fixed costs; the rest is for the splats and the picture cache.
    pub fn plan(wish: &Wish) -> Result<Self, BudgetError> {
        let Wish { size_px, sh_degree, channels, .. } = *wish;
        let shape = Capacity { splats: 0, pairs: 0, size_px, sh_degree, channels, training: true };
        let costs = Costs::of(&shape, wish.binding_bytes_max);
        if let Some((bytes, bytes_max)) = costs.unbindable_picture() {
            return Err(BudgetError::PictureTooLarge { size_px, bytes, bytes_max });
        }
        let fixed = PROCESS_BYTES
            + costs.driver
            + costs.pictures as u64
            + wish.cache_bytes_least
            + wish.loading_bytes;
        let per_splat = (costs.splat + PAIRS_PER_SPLAT * costs.pair + scratch_bytes(sh_degree)) as u64;
        let least_bytes = fixed + SPLATS_MIN.min(wish.splats) as u64 * per_splat;
        if wish.memory_bytes < least_bytes {
            return Err(BudgetError::TooLittleMemory { memory_bytes: wish.memory_bytes, least_bytes });
        }
        let mut given_up = Vec::new();
        let free = wish.memory_bytes - fixed;
        // A larger cache saves time, but the number of splats decides the quality. So splats may take three quarters of
        // the free memory, and more if the cache does not need the rest.
        let extra_wanted = wish.cache_bytes_most.saturating_sub(wish.cache_bytes_least);
        let bound = costs.splats_max(PAIRS_PER_SPLAT);
        let splats_wanted = wish.splats.min(bound) as u64 * per_splat;
        let for_splats = splats_wanted.min(free.saturating_sub(extra_wanted).max(free / 4 * 3));
        let splats = (for_splats / per_splat) as usize;
        if splats < wish.splats {
            let why = if splats == bound { ": the graphics card binds no more at once" } else { "" };
            given_up.push(format!("at most {splats} splats instead of {}{why}", wish.splats));
        }
        let extra = extra_wanted.min(free - for_splats);
        if extra < extra_wanted {
            let (has, wants) = ((wish.cache_bytes_least + extra) >> 20, wish.cache_bytes_most >> 20);
            given_up.push(format!("{has} MiB of picture cache instead of {wants} MiB"));
        }
        let capacity = Capacity { splats, pairs: PAIRS_PER_SPLAT * splats, ..shape };
        Ok(Self { capacity, cache_bytes: wish.cache_bytes_least + extra, given_up })
    }
}
