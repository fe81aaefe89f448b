//! Measures the peak of the memory that a thread has allocated.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

#[global_allocator]
static COUNTED: Counted = Counted;

struct Counted;

thread_local! {
    static NOW_BYTES: Cell<isize> = const { Cell::new(0) };
    static PEAK_BYTES: Cell<isize> = const { Cell::new(0) };
}

fn count(bytes: isize) {
    // A thread that ends still frees memory after its counters are gone. No decoder runs then, so nothing is missed.
    let _ = NOW_BYTES.try_with(|now| {
        now.set(now.get() + bytes);
        let _ = PEAK_BYTES.try_with(|peak| peak.set(peak.get().max(now.get())));
    });
}

// SAFETY: every call is passed on unchanged to the system's allocator; the counters are cells, which allocate nothing.
unsafe impl GlobalAlloc for Counted {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as isize);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as isize);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        count(-(layout.size() as isize));
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(memory, layout) }
    }
}

/// Runs `work`, and returns the peak of the memory that it allocates, bytes. Memory allocated before does not count.
pub(crate) fn peak_bytes_of(work: impl FnOnce()) -> usize {
    let before = NOW_BYTES.get();
    PEAK_BYTES.set(before);
    work();
    (PEAK_BYTES.get() - before).max(0) as usize
}

/// Bytes that this thread has allocated and not freed. It may be negative: other threads allocate, too.
pub(crate) fn allocated_bytes() -> isize {
    NOW_BYTES.get()
}

#[test]
fn short_lived_allocations_are_counted() {
    let peak = peak_bytes_of(|| {
        let long = std::hint::black_box(vec![1u8; 1 << 20]);
        drop(long);
        std::hint::black_box(vec![0u64; 10]);
    });
    assert!((1 << 20..2 << 20).contains(&peak), "{peak}");
}
