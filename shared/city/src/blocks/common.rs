//! Objects that several kinds of blocks share.

use glam::Vec2;

use super::site::Site;
use crate::building::{self, Footprint, Style};
use crate::facade::Wall;
use crate::paving::PAVEMENT_M;
use crate::roof;
use crate::roofing::Cover;
use crate::shapes::Block3;
use crate::tree::Habit;

/// A low outbuilding.
pub(super) fn shed(site: &mut Site, uv: Vec2, along: Vec2, size_m: Vec2) {
    let cover = if site.rng.chance(0.5) { Cover::Felt } else { Cover::Sheet };
    let style = Style::random(site.mesh, &mut site.rng, Wall::Boards, cover, false);
    let lot = site.lot(uv, along, size_m);
    let part = Footprint::around(0.0, 0.0, size_m);
    let height = site.rng.range(2.2, 2.8);
    building::walls(site.mesh, &lot, &part.outline(), height, &style, &mut site.rng);
    if site.rng.chance(0.5) {
        roof::gabled(site.mesh, &lot.frame, &part, height, 0.5, &style, &mut site.rng);
    } else {
        let roof = part.inset(-0.25);
        let lid = Block3 { min: roof.min.extend(height), max: roof.max.extend(height + 0.16) };
        site.mesh.block(&lot.frame, lid, style.trim, style.roof);
    }
}

/// Adds rows of trees just inside the pavement.
pub(super) fn avenue(site: &mut Site, every_m: f32, height_m: f32) {
    for side in site.sides() {
        let count = ((side.length_m - 10.0) / every_m).max(0.0) as usize;
        for i in 0..count {
            let uv = side.at(5.0 + every_m * (i as f32 + 0.5), PAVEMENT_M + 2.0);
            if site.is_free(uv, 1.5) && site.rng.chance(0.8) {
                let height = height_m * site.rng.range(0.85, 1.35);
                site.plant(uv, Habit::Broad, height);
            }
        }
    }
}
