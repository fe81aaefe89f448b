//! The ground station in a browser: an HTTP server that shows a model, or a running site with its devices, log and model.
//!
//! What it knows nothing about: how models are merged, and what the viewer draws.
//!
//! The server answers the computer that it runs on. Beyond that, everybody needs a token ([`Token`]), and acting always
//! needs it. Sizes, times and the number of connections are bounded ([`listen`]). A page loads nothing from elsewhere and
//! can be part of no other page ([`guard`]).
//!
//! Where to start reading: [`serve_site`] and [`serve_model`]; then [`Board`], what is known of a site, and [`live`], what
//! there is to see and to do.

mod action;
mod audit;
mod board;
mod error;
mod guard;
mod listen;
mod live;
mod metrics;
mod models;
mod pages;
mod refusals;
mod serve;
mod site_map;
mod state;
#[cfg(test)]
mod tests;
mod token;
mod waiting;

pub use action::{Act, Action};
pub use board::Board;
pub use error::StationError;
pub use listen::Server;
pub use models::PAGE_BYTES;
pub use serve::{serve_model, serve_site};
pub use token::Token;
