//! Materials: functions from a position on a surface to its colour and gloss.
//!
//! Textures are functions of position, so they have detail at every scale. Each gets the distance of
//! its samples and omits detail that would alias.

use glam::{Vec2, Vec3};

use super::appearance::{Appearance, Spot};
use super::facade::Facade;
use super::noise::{fractal, grain, noise3, step, visible};
use super::paving::Land;
use super::plan::Plan;
use super::random::{floor_i32, fraction};
use super::roofing::Roofing;
use super::street::{self, kerbstone};

/// A material. Texture positions are in metres unless stated otherwise.
#[derive(Clone, Debug)]
pub(super) enum Material {
    /// Carriageways; the texture position is the plan position.
    Street,
    /// Kerbstones; the texture position is the plan position.
    Kerb,
    /// The ground of the block with this index; the texture position is the plan position.
    Ground(u32),
    /// Walls with windows; the texture position counts bays and floors.
    Facade(Facade),
    /// Roofs, steep and flat.
    Roofing(Roofing),
    /// One colour with blotches and dirt.
    Plain {
        /// Mean colour.
        albedo: Vec3,
        /// Strength of the blotches, 0 to 1.
        contrast: f32,
        /// Seed of the texture.
        seed: u32,
    },
    /// Tree crowns; the texture position is (exposure to light, 0 to 1; hue, −1 to 1).
    Leaves {
        /// Mean colour.
        albedo: Vec3,
        /// Seed of the texture.
        seed: u32,
    },
    /// Stripes across u of two colours, such as awnings, fences and containers.
    Stripes {
        /// The two colours.
        albedos: [Vec3; 2],
        /// Width of one stripe.
        width_m: f32,
    },
    /// Glossy paint of one colour.
    Paint(Vec3),
    /// Window panes.
    Glass,
    /// Still water.
    Water,
    /// Solar panels.
    Solar,
}

impl Material {
    /// The surface at a spot.
    pub(super) fn appearance(&self, spot: &Spot, plan: &Plan, land: &Land) -> Appearance {
        let (p, f) = (spot.uv, spot.footprint_m);
        match self {
            Self::Street => street::carriageway(spot, plan),
            Self::Kerb => Appearance::matt(kerbstone(p.x + p.y, f)),
            Self::Ground(block) => land.appearance(*block as usize, spot, plan),
            Self::Facade(facade) => facade.appearance(spot),
            Self::Roofing(roofing) => roofing.appearance(spot),
            Self::Plain { albedo, contrast, seed } => {
                let blotches = noise3(spot.position * 1.1, *seed) * visible(0.9, f)
                    + 0.6 * noise3(spot.position * 4.3, *seed ^ 1) * visible(0.23, f);
                Appearance::matt(*albedo * (1.0 + contrast * blotches))
            }
            Self::Leaves { albedo, seed } => leaves(*albedo, *seed, spot),
            Self::Stripes { albedos, width_m } => {
                let stripe = floor_i32(p.x / width_m);
                let worn = 1.0 + 0.12 * grain(p, 0.7, f, stripe as u32);
                Appearance::matt(albedos[(stripe & 1) as usize] * worn)
            }
            Self::Paint(albedo) => Appearance::glossy(*albedo, 0.10),
            Self::Glass => Appearance::glossy(Vec3::new(0.025, 0.032, 0.038), 0.16),
            Self::Water => {
                let murk = 1.0 + 0.25 * fractal(spot.position.truncate(), 7.0, 4, f, 77);
                Appearance::glossy(Vec3::new(0.020, 0.042, 0.036) * murk, 0.05)
            }
            Self::Solar => solar(p, f),
        }
    }
}

fn leaves(albedo: Vec3, seed: u32, spot: &Spot) -> Appearance {
    let f = spot.footprint_m;
    let clumps = noise3(spot.position * 0.9, seed);
    let sprays = noise3(spot.position * 3.1, seed ^ 7) * visible(0.32, f);
    let leaf = noise3(spot.position * 9.7, seed ^ 13) * visible(0.10, f);
    let light = 1.0 + 0.22 * clumps + 0.38 * sprays + 0.3 * leaf;
    let yellow = 0.25 * spot.uv.y + 0.15 * clumps;
    let tint = Vec3::new(1.0 + 0.55 * yellow, 1.0 + 0.2 * yellow, 1.0 - 0.3 * yellow);
    Appearance { albedo: albedo * tint * (light * spot.uv.x).max(0.1), mirror: 0.0, translucent: 0.35 }
}

fn solar(p: Vec2, footprint_m: f32) -> Appearance {
    // Modules are 1.0 by 1.65 m with aluminium frames, cells are 0.16 m wide.
    let module = Vec2::new(fraction(p.x) - 0.5, fraction(p.y / 1.65) - 0.5).abs();
    if module.x > 0.465 || module.y > 0.48 {
        return Appearance::matt(Vec3::splat(0.42));
    }
    let cell = Vec2::new(fraction(p.x / 0.16) - 0.5, fraction(p.y / 0.16) - 0.5).abs();
    let line = step(0.42, 0.5, cell.max_element()) * visible(0.16, footprint_m);
    Appearance::glossy(Vec3::new(0.014, 0.02, 0.05) + Vec3::splat(0.08 * line), 0.12)
}
