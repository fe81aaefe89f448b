//! The ground station in a browser: an HTTP server that shows a model.
//!
//! What it knows nothing about: how models are merged, and what the viewer draws.
//!
//! The server answers the computer that it runs on. Beyond that, everybody needs a token ([`Token`]). Sizes, times and the
//! number of connections are bounded ([`listen`]). A page loads nothing from elsewhere and can be part of no other page
//! ([`guard`]).
//!
//! Where to start reading: [`Server`], then [`pages`], what there is to see.

mod error;
mod guard;
mod listen;
mod pages;
mod token;

pub use error::StationError;
pub use listen::Server;
pub use pages::serve_model;
pub use token::Token;
