//! How much memory the distillation of a tile takes, and how many tiles are distilled at once.

use std::collections::BTreeMap;

use cosurf_engine::backend::Channels;
use cosurf_engine::budget::{Costs, DRIVER_BYTES, PAIRS_PER_SEEN_SPLAT, PAIRS_PER_SPLAT, PROCESS_BYTES};
use cosurf_engine::{Capacity, Device};
use cosurf_scene::{Camera, Splats};

use super::error::MergeError;
use super::locals::Locals;

/// Largest number of tiles that are distilled at once on a graphics card. A card would often wait for the processor with a
/// single tile: with 1, 2, 4 and 8 at once, a merge of rendered Boruszyn takes 15.7, 12.4, 11.9 and 11.8 s on an H200.
const TILES_OF_A_CARD: usize = 4;
/// Largest number of splats of a tile. With 36,000, rendered Boruszyn takes an eighth less time, but 141 MiB instead of
/// 101; with 56,000 a fifth less, and 167 MiB. The PSNR differs from that without tiles by -0.02 dB on rendered
/// Boruszyn, on Caliterra and in the city.
pub(super) const TILE_SPLATS_MAX: usize = 24_000;
/// Number of splats that are trained for a tile, its own and those around it, if cameras see much of the site.
pub(super) const STUDENT_SPLATS: usize = 4 * TILE_SPLATS_MAX;

/// Limit on the bytes of a teacher's renderings that are kept because a neighbouring view may need them.
pub(super) const CACHE_BYTES: u64 = 8 << 20;

/// Bytes of a lesson for each pixel, and of the loss's copies of it.
const LESSON_BYTES: usize = 4 * 8;
/// Bytes for each pixel of a teacher's picture: two renderings of 8 numbers, the trust, and what the renderer blends.
const TEACHER_BYTES: usize = 4 * (2 * 8 + 1 + 10);

/// Bytes that the training of `splats` splats takes, with pictures as large as those of `shape`. On the CPU, the splats
/// are copied before pairs are made and after the training state is freed, so the copy takes no memory beside these.
pub(super) fn student_bytes(device: &Device, shape: &Capacity, splats: usize) -> u64 {
    let costs = Costs::of(shape, device.binding_bytes_max());
    let copy = if device.is_gpu() { loaded_bytes(shape.sh_degree) } else { 0 };
    let each = costs.splat + PAIRS_PER_SEEN_SPLAT * costs.pair + copy;
    (costs.pictures + LESSON_BYTES * pixels(shape) + splats * each) as u64
}

/// Bytes that the pictures of a lesson with this camera take, without any splats.
pub(super) fn lesson_bytes(device: &Device, sh_degree: u32, camera: &Camera) -> u64 {
    let none = Splats::with_capacity(0, sh_degree);
    let shape = Capacity::to_train(&none, std::slice::from_ref(camera), Channels::Geometry);
    student_bytes(device, &shape, 0).max(teacher_bytes(device, &shape, 0, 1))
}

/// A limit below which no merge of models with these cameras is possible, however few splats the models have, bytes.
pub(crate) fn least_bytes(cameras: impl Iterator<Item = Camera>) -> u64 {
    let largest =
        cameras.max_by_key(|camera| camera.size_px.iter().map(|side| u64::from(*side)).product::<u64>());
    PROCESS_BYTES + largest.map_or(0, |camera| lesson_bytes(&Device::Cpu, 0, &camera))
}

/// Bytes of a picture of this size in which useless splats are looked for.
pub(super) fn survey_bytes(device: &Device, camera: &Camera) -> u64 {
    let to_render = Capacity::to_render(0);
    let shape = Capacity { size_px: camera.size_px, channels: Channels::Color, ..to_render };
    Costs::of(&shape, device.binding_bytes_max()).pictures as u64
}

/// Bytes of a merge that are not for tiles.
pub(super) fn beside_bytes(device: &Device) -> u64 {
    PROCESS_BYTES + if device.is_gpu() { DRIVER_BYTES } else { 0 }
}

/// An error if the pictures of some models alone take more memory than a merge may. `largest` has the bytes that the largest
/// picture of each model takes.
pub(super) fn check_pictures(
    largest: &BTreeMap<usize, u64>,
    memory_bytes: u64,
    device: &Device,
) -> Result<(), MergeError> {
    let beside = beside_bytes(device);
    let is_too_large = |(_, bytes): &(&usize, &u64)| beside.saturating_add(**bytes) > memory_bytes;
    let locals: Vec<usize> = largest.iter().filter(is_too_large).map(|(local, _)| *local).collect();
    // If all are too large, the limit is wrong rather than a model.
    if locals.is_empty() || locals.len() == largest.len() {
        return Ok(());
    }
    let needed_bytes = beside + largest.values().copied().fold(0, u64::max);
    Err(MergeError::PicturesTooLarge { locals, memory_bytes, needed_bytes })
}

/// An error if some models alone take more memory than a merge may. `held` of them are in memory at a time, 1 or 2.
pub(crate) fn check_models(locals: &dyn Locals, held: usize, memory_bytes: u64) -> Result<(), MergeError> {
    let bytes = |index| locals.size(index).map(|size| rendered_bytes(size.splats, size.sh_degree));
    let each = (0..locals.count()).map(bytes).collect::<Result<Vec<u64>, MergeError>>()?;
    let mut largest = each.clone();
    largest.sort_unstable_by(|a, b| b.cmp(a));
    largest.truncate(held);
    let needed_bytes = PROCESS_BYTES + largest.iter().sum::<u64>();
    if needed_bytes <= memory_bytes {
        return Ok(());
    }
    let share = memory_bytes.saturating_sub(PROCESS_BYTES) / largest.len().max(1) as u64;
    let too_large: Vec<usize> = (0..each.len()).filter(|index| each[*index] > share).collect();
    // If all are too large, the limit is wrong rather than a model.
    Err(match too_large.len() < each.len() {
        true => MergeError::ModelsTooLarge { locals: too_large, memory_bytes, needed_bytes },
        false => MergeError::TooLittleMemory { memory_bytes, needed_bytes },
    })
}

/// Bytes that the planning of a tile takes: its splats, and as much again for what cameras observed and plan.
pub(super) fn planning_bytes(sh_degree: u32) -> u64 {
    (2 * TILE_SPLATS_MAX * loaded_bytes(sh_degree)) as u64
}

/// Bytes that a model takes while small pictures of it are rendered on the CPU.
pub(crate) fn rendered_bytes(splats: usize, sh_degree: u32) -> u64 {
    (splats * rendered_splat_bytes(&Device::Cpu, sh_degree)) as u64
}

/// Bytes of a splat that is rendered, and of its copy while it is loaded.
fn rendered_splat_bytes(device: &Device, sh_degree: u32) -> usize {
    let costs = Costs::of(&Capacity::to_render(sh_degree), device.binding_bytes_max());
    costs.splat + PAIRS_PER_SPLAT * costs.pair + loaded_bytes(sh_degree)
}

/// Bytes that a teacher with `splats` splats takes, with pictures as large as those of `shape`, of which it keeps up to
/// `views`.
pub(super) fn teacher_bytes(device: &Device, shape: &Capacity, splats: usize, views: usize) -> u64 {
    let each = rendered_splat_bytes(device, shape.sh_degree);
    let kept = CACHE_BYTES.min((LESSON_BYTES * pixels(shape) * views) as u64);
    kept + (TEACHER_BYTES * pixels(shape) + splats * each) as u64
}

/// Bytes of a splat that is about to be copied into a backend.
fn loaded_bytes(sh_degree: u32) -> usize {
    4 * (11 + Splats::with_capacity(0, sh_degree).sh_stride())
}

fn pixels(shape: &Capacity) -> usize {
    shape.size_px.iter().map(|side| *side as usize).product()
}

/// Number of tiles that are distilled at once, at least 1: as many as there are threads, and as fit into the memory; on a
/// graphics card at most [`TILES_OF_A_CARD`]. `tiles` has the bytes that each tile takes; an error if the largest does not
/// fit.
pub(super) fn at_once(
    mut tiles: Vec<u64>,
    threads: usize,
    memory_bytes: u64,
    device: &Device,
) -> Result<usize, MergeError> {
    tiles.sort_unstable_by(|a, b| b.cmp(a));
    let beside = beside_bytes(device);
    let needed_bytes = beside + tiles.first().copied().unwrap_or_default();
    let Some(mut free) = memory_bytes.checked_sub(beside).filter(|_| needed_bytes <= memory_bytes) else {
        return Err(MergeError::TooLittleMemory { memory_bytes, needed_bytes });
    };
    let fits = |bytes: &u64| free.checked_sub(*bytes).inspect(|rest| free = *rest).is_some();
    let fitting = tiles.iter().copied().take_while(fits).count();
    let most = if device.is_gpu() { threads.min(TILES_OF_A_CARD) } else { threads };
    Ok(fitting.clamp(1, most))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_link::Model;

    use super::*;
    use crate::merge::ModelSize;

    #[test]
    fn models_that_do_not_fit_are_named_before_any_is_loaded() {
        /// Models with so many splats, which cannot be loaded.
        struct Sizes(&'static [usize]);
        impl Locals for Sizes {
            fn count(&self) -> usize {
                self.0.len()
            }
            fn size(&self, index: usize) -> Result<ModelSize, MergeError> {
                Ok(ModelSize { splats: self.0[index], sh_degree: 2 })
            }
            fn load(&self, _: usize) -> Result<Model, MergeError> {
                unreachable!("nothing is loaded")
            }
        }
        let with = |sizes: &'static [usize], held: usize, splats: usize| {
            check_models(&Sizes(sizes), held, PROCESS_BYTES + rendered_bytes(splats, 2))
        };
        with(&[10, 30, 20], 1, 30).unwrap();
        with(&[10, 30, 20], 2, 50).unwrap();
        let Err(MergeError::ModelsTooLarge { locals, needed_bytes, .. }) = with(&[10, 30, 20], 2, 49) else {
            panic!("two models do not fit")
        };
        assert_eq!((locals, needed_bytes), (vec![1], PROCESS_BYTES + rendered_bytes(50, 2)));
        let refused = with(&[30, 30], 2, 50);
        assert!(matches!(refused, Err(MergeError::TooLittleMemory { .. })), "{refused:?}");
        let refused = check_models(&Sizes(&[30]), 2, PROCESS_BYTES);
        assert!(matches!(refused, Err(MergeError::TooLittleMemory { .. })), "{refused:?}");
        with(&[], 2, 0).unwrap();
    }

    #[test]
    fn as_many_tiles_are_distilled_at_once_as_fit() {
        const MIB: u64 = 1 << 20;
        let with =
            |memory: u64, threads| at_once(vec![MIB, 30 * MIB, 20 * MIB], threads, memory, &Device::Cpu);
        assert_eq!(with(PROCESS_BYTES + 30 * MIB, 4).unwrap(), 1);
        assert_eq!(with(PROCESS_BYTES + 50 * MIB, 4).unwrap(), 2);
        assert_eq!(with(PROCESS_BYTES + 51 * MIB, 4).unwrap(), 3);
        assert_eq!(with(PROCESS_BYTES + 51 * MIB, 2).unwrap(), 2);
        let error = with(PROCESS_BYTES + 30 * MIB - 1, 4).unwrap_err().to_string();
        assert!(error.contains("--memory 58MiB"), "{error}");
        assert_eq!(at_once(Vec::new(), 2, 64 * MIB, &Device::Cpu).unwrap(), 1);
    }
}
