//! The church square.

use glam::Vec2;

use super::common;
use super::site::Site;
use crate::building::{self, Footprint, Lot, Style};
use crate::facade::Wall;
use crate::paving::{Outline, Surface};
use crate::props;
use crate::roof;
use crate::roofing::Cover;

/// A church, a fountain, stalls and trees on a paved square.
pub(super) fn plaza(site: &mut Site) {
    let size = site.size();
    let turned = size.y > size.x;
    let (along, long, short) = if turned { (Vec2::Y, size.y, size.x) } else { (Vec2::X, size.x, size.y) };
    let nave = Vec2::new((0.42 * long).clamp(13.0, 26.0), (0.24 * short).clamp(7.5, 12.0));
    let uv = site.center() - along * (0.5 * long - 0.5 * nave.x - 8.5) + along.perp() * (0.16 * short);
    church(site, uv, along, nave);
    let square = site.center() + along * (0.22 * long);
    let fountain = square - along.perp() * (0.08 * short);
    let frame = site.frame(fountain, along);
    props::fountain(site.mesh, &frame, site.palette);
    site.reserve((fountain - 5.0, fountain + 5.0));
    site.cover(Outline::Ring(fountain, 5.4, 1.0), Surface::Flags(0.5));
    for i in 0..(long * short / 230.0) as usize {
        if let Some(uv) = site.free_spot(2.6) {
            let frame = site.frame(uv, if i % 2 == 0 { along } else { along.perp() });
            props::stall(site.mesh, &frame, site.palette, &mut site.rng);
            site.reserve((uv - 2.2, uv + 2.2));
        }
    }
    common::avenue(site, 8.5, 5.5);
    for _ in 0..8 {
        if let Some(uv) = site.free_spot(1.0) {
            let frame = site.frame(uv, along);
            props::bench(site.mesh, &frame, site.palette);
        }
    }
}

fn church(site: &mut Site, uv: Vec2, along: Vec2, nave: Vec2) {
    let cover = if site.rng.chance(0.5) { Cover::Slate } else { Cover::Tiles };
    let style = Style::random(site.mesh, &mut site.rng, Wall::Stone, cover, false);
    let lot = site.lot(uv, along, nave + Vec2::new(8.0, 5.0));
    let height = 7.4;
    let body = Footprint::around(0.0, 0.0, nave);
    building::walls(site.mesh, &lot, &body.outline(), height, &style, &mut site.rng);
    roof::gabled(site.mesh, &lot.frame, &body, height, 1.15, &style, &mut site.rng);
    // A transept and a choir.
    let transept = lot.frame.moved(0.18 * nave.x, 0.0, 0.0).turned(Vec2::Y);
    let arm = Footprint::around(0.0, 0.0, Vec2::new(nave.y + 6.0, 6.0));
    let arm_lot = Lot { frame: transept, ..lot };
    building::walls(site.mesh, &arm_lot, &arm.outline(), height, &style, &mut site.rng);
    roof::gabled(site.mesh, &transept, &arm, height, 1.15, &style, &mut site.rng);
    // The tower at the west end.
    let side = 5.4;
    let tower = Footprint::around(-0.5 * nave.x - 0.3 * side, 0.0, Vec2::splat(side));
    let tower_height = site.rng.range(15.0, 19.0);
    building::walls(site.mesh, &lot, &tower.outline(), tower_height, &style, &mut site.rng);
    roof::hipped(site.mesh, &lot.frame, &tower, tower_height, 2.6, &style);
    let c = tower.center();
    let cross = lot.frame.moved(c.x, c.y, tower_height + 2.6 * 0.5 * side);
    site.mesh.drum(&cross, [0.12, 0.05], [-0.5, 2.2], 5, [site.palette.dark; 2]);
}
