//! The data types of cosurf and the files that hold them.
//!
//! What it is: [`Splats`], [`Camera`], [`View`], [`Picture`], [`Dataset`], [`Mesh`], their files
//! (COLMAP, `transforms.json`, OpenSfM, Metashape, RealityCapture, PLY, SPZ, GLB, OBJ, JPEG, PNG and others), picture quality ([`metrics`]), exact
//! depth of triangle meshes ([`raycast`], which uses [`bvh`]), and the ground that views look at
//! ([`footprint`], [`outline`]).
//!
//! What it knows nothing about: the rendering of splats, training, communication, clocks and command
//! lines.
//!
//! Where to start reading: [`camera`] for the coordinate frames and pixel conventions of the whole
//! workspace, then [`splats`], then [`dataset`].

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

mod advice;
pub mod atomic;
mod base;
pub mod bvh;
pub mod bytes;
pub mod cache;
pub mod camera;
pub mod camera_list;
pub mod colmap;
pub mod colormap;
pub mod dataset;
mod distorted;
pub mod error;
pub mod files;
pub mod footprint;
mod frustum;
mod glb;
mod layout;
mod leftovers;
mod lens;
mod loader;
mod local_frame;
mod lock;
pub mod mask;
mod mask_files;
pub mod mesh;
mod metashape;
pub mod metrics;
pub mod model;
mod opensfm;
pub mod outline;
mod parts;
pub mod picture;
pub mod ply;
pub mod raycast;
mod realitycapture;
mod rotation;
mod shot;
mod sieve;
mod space;
pub mod splat_glb;
pub mod splats;
pub mod spz;
mod tie_points;
mod transforms;
pub mod turn;
mod xml;

pub use advice::{FRAMES_COMMAND, is_video};
pub use base::Base;
pub use cache::PictureCache;
pub use camera::{Camera, Pose, evenly_spaced};
pub use dataset::{Dataset, SparsePoint, View};
pub use distorted::Distorted;
pub use error::SceneError;
pub use footprint::{Footprint, Ground, footprints};
pub use frustum::{Frustum, Watchers};
pub use lens::{Distortion, FullBrown, Lens};
pub use loader::Opened;
pub use local_frame::{LocalFrame, ORIGIN_MAX, SCENE_SIZES};
pub use lock::FolderLock;
pub use mask::Mask;
pub use mask_files::{is_of_masks, mask_of};
pub use mesh::{Mesh, MeshCounts, MeshWriter, Texture};
pub use outline::Outline;
pub use picture::{Picture, Shrinking};
pub use raycast::{Cast, Caster};
pub use shot::Shot;
pub use space::check_space;
pub use splats::Splats;
