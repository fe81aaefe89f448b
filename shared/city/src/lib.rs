//! The synthetic city: a dataset with exact geometry that needs no download.
//!
//! What it is: [`City::build`] makes a small city from [`CitySettings`], as one triangle mesh with procedural
//! materials, and a drone's flight over it. Pictures, depth, normals, cameras, the sparse cloud and the true surface
//! all come from that mesh, so they agree exactly. World frame: x east, y north, z up, metres, the middle of the flown
//! square at the origin.
//!
//! [`City::write_raw`] writes the same flight as a drone's memory card has it: photographs with EXIF, through a real lens.
//!
//! What it refuses to know: splats, training, links, clocks. Random numbers come from integer hashes, and no function
//! of the platform's mathematics library is used, so the same settings give the same bytes on every machine.
//!
//! Where to start reading: `city.rs`, then `world.rs`, which builds the city, and `render.rs`, which draws it.
//!
//! ```
//! use cosurf_city::{City, CitySettings};
//!
//! let settings = CitySettings { extent_m: 10.0, views: 3, size_px: [32, 24], ..CitySettings::default() };
//! let city = City::build(&settings)?;
//! let frame = city.render(&city.cameras()[0]);
//! assert_eq!(frame.picture.size_px, [32, 24]);
//! assert!(frame.depth.iter().all(|depth_m| *depth_m >= 0.0));
//! // `city.write(folder, progress)` writes pictures, poses, cloud and truth as a COLMAP dataset.
//! # Ok::<(), cosurf_city::CityError>(())
//! ```

mod appearance;
mod blocks;
mod building;
mod city;
mod detail;
mod exif;
mod facade;
mod flight;
mod ground;
mod light;
mod material;
mod mesh;
mod noise;
mod optics;
mod palette;
mod paving;
mod plan;
mod props;
mod random;
mod raw;
mod render;
mod roadside;
mod roof;
mod roofing;
mod settings;
mod shapes;
mod sight;
mod sparse;
mod street;
mod targets;
mod terrain;
#[cfg(test)]
mod tests;
mod tree;
mod truth;
mod world;
mod write;

pub use city::City;
pub use raw::{RawError, RawSettings};
pub use render::CityFrame;
pub use settings::{CityError, CitySettings};
pub use truth::TruthPoint;
