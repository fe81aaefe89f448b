//! The drone's side of cosurf: pictures with poses in, a local model out.
//!
//! What it is: a training session within a memory budget ([`session`]) that can be killed at any time and
//! goes on to the same bits ([`checkpoint`]), the scoring of models on held-out pictures ([`evaluate`]),
//! pictures of what a model shows ([`pictures`]), publishing over a link ([`publish`]) with or without ground that others
//! show as well ([`flights`]), and what changed on its ground ([`changes`]).
//!
//! What it refuses to know: the aggregator, and what becomes of its model there. It never sends a picture.
//!
//! Where to start reading: [`session`].

pub mod changes;
pub mod checkpoint;
pub mod evaluate;
pub mod flights;
pub mod outputs;
pub mod pictures;
pub mod publish;
pub mod session;
pub mod usage;
pub mod warm;
