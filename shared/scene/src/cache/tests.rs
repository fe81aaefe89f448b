//! Tests that the pixels are right and that the budget is kept, for several budgets and any timing
//! of the threads.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

use super::*;
use crate::{Mask, Shrinking};

const SIZE_PX: [u32; 2] = [24, 16];
const RAW_BYTES: u64 = 24 * 16 * 3;

/// `n` sources whose picture files are twice as wide and high as the source asks for. Noise makes
/// the pictures compress only partly.
fn made_up(folder: &Path, n: u32) -> Vec<Source> {
    let source = |i: u32| {
        let noise = |x: u32, y: u32| ((x * 48 + y * 977 + i) ^ 0x5A5A).wrapping_mul(2_654_435_761) >> 25;
        let at = |x: u32, y: u32| [3 * x + noise(x, y), 4 * y + i, noise(y, x)].map(|v| v as u8);
        let rgb = (0..32).flat_map(|y| (0..48).flat_map(move |x| at(x, y))).collect();
        let path = folder.join(format!("{i}.png"));
        Picture::new([48, 32], rgb).write_png(&path).unwrap();
        Source { path, mask: None, size_px: SIZE_PX, shrinking: Shrinking::AfterDecoding }
    };
    (0..n).map(source).collect()
}

fn expected(sources: &[Source]) -> Vec<Picture> {
    sources.iter().map(|source| Picture::read_fitted(&source.path, source.size_px).unwrap()).collect()
}

/// Gets every picture in each of two epochs, and asks for the next `prefetched` pictures at each
/// step. Checks every picture, and the bytes in use after every step.
fn two_epochs(sources: &[Source], budget_bytes: u64, prefetched: usize) -> CacheUse {
    let expected = expected(sources);
    let cache = PictureCache::new(sources.to_vec(), budget_bytes).unwrap();
    let n = sources.len();
    for step in 0..2 * n {
        let index = step * 7 % n;
        let picture = cache.get(index).unwrap();
        for ahead in 1..=prefetched {
            cache.prefetch((step + ahead) * 7 % n);
        }
        assert_eq!(*picture, expected[index], "picture {index} with {budget_bytes} bytes");
        let used_bytes = cache.usage().used_bytes;
        assert!(used_bytes <= budget_bytes, "{used_bytes} of {budget_bytes}");
    }
    cache.usage()
}

#[test]
fn pictures_that_fit_are_decoded_once_and_kept_raw() {
    let folder = tempfile::tempdir().unwrap();
    let sources = made_up(folder.path(), 10);
    assert_eq!(PictureCache::most_bytes(&sources), 10 * RAW_BYTES);
    let usage = two_epochs(&sources, 10 * RAW_BYTES, 3);
    assert_eq!(usage, CacheUse { used_bytes: 10 * RAW_BYTES, raw: 10, packed: 0, on_disk: 0, decoded: 10 });
}

#[test]
fn pictures_that_do_not_fit_raw_are_compressed_and_decoded_once() {
    let folder = tempfile::tempdir().unwrap();
    let sources = made_up(folder.path(), 10);
    let usage = two_epochs(&sources, 10 * RAW_BYTES - 1, 3);
    assert_eq!((usage.raw, usage.packed, usage.on_disk, usage.decoded), (0, 10, 0, 10));
}

#[test]
fn pictures_that_do_not_fit_compressed_are_read_again() {
    let folder = tempfile::tempdir().unwrap();
    let sources = made_up(folder.path(), 10);
    assert_eq!(PictureCache::least_bytes(&sources), 2 * RAW_BYTES);
    for prefetched in [0, 3] {
        let usage = two_epochs(&sources, 2 * RAW_BYTES, prefetched);
        assert_eq!((usage.raw, usage.packed, usage.on_disk), (0, 0, 10));
    }
    let usage = two_epochs(&sources, 5 * RAW_BYTES, 0);
    assert!(usage.packed > 2 && usage.packed + usage.on_disk == 10, "{usage:?}");
    assert_eq!(usage.decoded, 10 + usage.on_disk as u64);
}

#[test]
fn the_error_for_a_small_budget_names_the_least() {
    let folder = tempfile::tempdir().unwrap();
    let sources = made_up(folder.path(), 3);
    let text = PictureCache::new(sources.clone(), 2 * RAW_BYTES - 1).err().unwrap().to_string();
    assert_eq!(
        text,
        "the pictures need 2.25 KiB, but their memory budget is 2.25 KiB; raise the budget or use smaller pictures"
    );
    assert!(PictureCache::new(sources[..1].to_vec(), RAW_BYTES).is_ok());
    assert!(PictureCache::new(Vec::new(), 0).is_ok());
}

#[test]
fn held_pictures_count_towards_the_budget() {
    let folder = tempfile::tempdir().unwrap();
    let cache = PictureCache::new(made_up(folder.path(), 4), 2 * RAW_BYTES).unwrap();
    let first = cache.get(0).unwrap();
    let second = cache.get(1).unwrap();
    assert!(Arc::ptr_eq(&first, &cache.get(0).unwrap()), "a copy in memory must be shared");
    assert_eq!(cache.usage().used_bytes, 2 * RAW_BYTES);
    assert!(matches!(cache.get(2), Err(SceneError::OverBudget { .. })));
    drop(second);
    cache.get(2).unwrap();
    drop(first);
    assert_eq!(cache.usage().used_bytes, 0);
}

#[test]
fn holding_many_pictures_evicts_compressed_ones() {
    let folder = tempfile::tempdir().unwrap();
    let cache = PictureCache::new(made_up(folder.path(), 6), 4 * RAW_BYTES).unwrap();
    (0..6).for_each(|index| drop(cache.get(index).unwrap()));
    let packed = cache.usage().packed;
    let held: Vec<_> = (0..4).map(|index| cache.get(index).unwrap()).collect();
    let usage = cache.usage();
    assert_eq!(usage.used_bytes, 4 * RAW_BYTES);
    assert!(packed > 0 && usage.packed == 0, "{packed}, then {usage:?}");
    assert!(cache.get(4).is_err());
    drop(held);
    cache.get(4).unwrap();
}

#[test]
fn a_prefetched_picture_does_not_need_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let sources = made_up(folder.path(), 4);
    let expected = expected(&sources);
    for budget_bytes in [2 * RAW_BYTES, 4 * RAW_BYTES] {
        let cache = PictureCache::new(sources.clone(), budget_bytes).unwrap();
        cache.prefetch(3);
        while cache.usage().decoded == 0 || cache.shared.lock().is_making() {
            thread::yield_now();
        }
        let kept = fs::read(&sources[3].path).unwrap();
        fs::remove_file(&sources[3].path).unwrap();
        assert_eq!(*cache.get(3).unwrap(), expected[3]);
        fs::write(&sources[3].path, kept).unwrap();
    }
}

#[test]
fn prefetched_pictures_make_room_for_requested_ones() {
    let folder = tempfile::tempdir().unwrap();
    let sources = made_up(folder.path(), 12);
    let expected = expected(&sources);
    let cache = PictureCache::new(sources, 2 * RAW_BYTES).unwrap();
    (0..12).for_each(|index| cache.prefetch(index));
    for index in (0..12).rev() {
        assert_eq!(*cache.get(index).unwrap(), expected[index]);
        assert!(cache.usage().used_bytes <= 2 * RAW_BYTES);
    }
}

#[test]
fn several_threads_get_the_same_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let sources = made_up(folder.path(), 6);
    let expected = expected(&sources);
    let cache = PictureCache::new(sources, 5 * RAW_BYTES).unwrap();
    thread::scope(|scope| {
        for first in 0..3 {
            let (cache, expected) = (&cache, &expected);
            scope.spawn(move || {
                for index in (0..60).map(|step| (first + step * 5) % 6) {
                    cache.prefetch((index + 5) % 6);
                    assert_eq!(*cache.get(index).unwrap(), expected[index]);
                    assert!(cache.usage().used_bytes <= 5 * RAW_BYTES);
                }
            });
        }
    });
}

#[test]
fn a_damaged_file_is_an_error_each_time_and_affects_no_other() {
    let folder = tempfile::tempdir().unwrap();
    let sources = made_up(folder.path(), 3);
    fs::remove_file(&sources[1].path).unwrap();
    fs::write(&sources[1].path, b"no picture").unwrap();
    let cache = PictureCache::new(sources, 3 * RAW_BYTES).unwrap();
    cache.prefetch(1);
    for _ in 0..2 {
        assert!(cache.get(1).unwrap_err().to_string().contains("1.png"));
        cache.get(0).unwrap();
    }
    // Requests are served in turn: once picture 2 is there, the other thread has tried picture 1 and left it.
    cache.prefetch(2);
    let is_there = (0..30_000).any(|_| {
        thread::sleep(std::time::Duration::from_millis(1));
        cache.usage().raw == 2
    });
    assert!(is_there);
    assert_eq!(cache.usage().used_bytes, 2 * RAW_BYTES);
}

#[test]
fn scratch_covers_the_most_demanding_source() {
    let folder = tempfile::tempdir().unwrap();
    let mut sources = made_up(folder.path(), 2);
    let small = PictureCache::scratch_bytes(&sources).unwrap();
    Picture::new([2_000, 1_500], vec![200; 9_000_000]).write_jpeg(&sources[1].path, 90).unwrap();
    sources[1].size_px = [200, 150];
    let large = PictureCache::scratch_bytes(&sources).unwrap();
    assert!(small < 6 << 20, "{small}");
    assert!((9_000_000..13 << 20).contains(&large), "{large}");
    sources[1].shrinking = Shrinking::WhileDecoding;
    let scaled = PictureCache::scratch_bytes(&sources).unwrap();
    assert!(scaled < 5 << 20, "{scaled}");
}

#[test]
fn masked_pixels_are_masked_in_every_form_and_take_no_memory() {
    let folder = tempfile::tempdir().unwrap();
    let mut sources = made_up(folder.path(), 6);
    let path = folder.path().join("mask.png");
    let rows = (0..32).flat_map(|y| [if y < 8 { 0 } else { 255 }; 3 * 48]);
    Picture::new([48, 32], rows.collect()).write_png(&path).unwrap();
    sources.iter_mut().for_each(|source| source.mask = Some(Mask { path: path.clone(), is_inverted: false }));
    for budget_bytes in [6 * RAW_BYTES, 4 * RAW_BYTES, PictureCache::least_bytes(&sources)] {
        let cache = PictureCache::new(sources.clone(), budget_bytes).unwrap();
        for index in (0..6).chain(0..6) {
            let picture = cache.get(index).unwrap();
            let masked = picture.counted().position(|counts| counts);
            assert_eq!(masked, Some(4 * 24), "picture {index} with {budget_bytes} bytes");
        }
        assert!(cache.usage().used_bytes <= budget_bytes);
    }
}
