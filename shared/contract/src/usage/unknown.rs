//! A system that this program cannot ask.

pub(super) fn peak_bytes() -> u64 {
    0
}

pub(super) fn resident_bytes() -> u64 {
    0
}

pub(super) fn available_bytes() -> Option<u64> {
    None
}

pub(super) fn limit_bytes() -> Option<u64> {
    None
}

pub(super) fn cpu_seconds() -> f64 {
    0.0
}
