//! Surveys of a synthetic slope.
