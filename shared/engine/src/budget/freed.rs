//! Returns freed memory to the system.

/// Blocks of at least this size are mapped from the system, and unmapped when they are freed, bytes.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const MAPPED_BYTES_MIN: i32 = 256 << 10;

/// Makes the allocator return large blocks to the system when they are freed. To be called once, at the start of a
/// program that promises to stay within a limit of memory.
///
/// By default, glibc raises the size from which it maps blocks each time a larger one is freed, up to 32 MiB. What is
/// freed below that size stays with the process, in pieces. A merge of rendered Boruszyn within 160 MiB took 224 MiB;
/// with this it takes 111 MiB in the same time. Other allocators are left as they are.
pub fn return_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: mallopt changes a setting of the allocator, which it locks meanwhile. Any value is allowed.
    #[allow(unsafe_code)]
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, MAPPED_BYTES_MIN);
    }
}
