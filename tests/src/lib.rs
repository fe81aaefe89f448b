//! Tests of what crosses crates live in `tests/tests`; this library is empty.
