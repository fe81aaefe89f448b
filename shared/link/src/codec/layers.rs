//! Arranges the shapes of splats in packs: by importance, or with a base first.

use std::io;

use cosurf_scene::{Base, Splats};
use cosurf_wire::Bounds;
use cosurf_wire::body::{
    PACK_SPLATS_MAX, PackKind, SHAPE_BYTES, SHAPE_FRAME_BYTES, Shape, ShapeFrame, write_changes, write_shapes,
};

use super::order::{Region, even_chunks, split_layers, split_regions};
use super::packs::Packs;
use super::shapes::{self, FloatShape};

/// The splats of one shapes pack.
pub(super) struct Group {
    pub(super) layer: u8,
    pub(super) ids: Vec<u32>,
}

/// The packs of shapes and changes in a body, in order, and the places of the spherical harmonics between them.
#[derive(Default)]
pub(super) struct Parts {
    /// The packs of the first part of the body. They contain all shapes if the shapes are ordered by importance.
    /// Otherwise they contain only those of the base, a small model that stands in for the whole model until all of it
    /// has arrived.
    pub(super) first: Packs,
    /// The parts that follow `first`. Each part has packs and indices of `groups`. The spherical harmonics of
    /// these groups come after the packs.
    pub(super) parts: Vec<(Packs, Vec<usize>)>,
    /// All groups, layer by layer.
    pub(super) groups: Vec<Group>,
}

impl Parts {
    /// Size of the shapes and changes packs with their table entries, in bytes.
    pub(super) fn bytes(&self) -> usize {
        let parts = self.parts.iter().map(|(packs, _)| packs.table_and_pack_bytes());
        self.first.table_and_pack_bytes() + parts.sum::<usize>()
    }
}

/// Arranges the shapes in layers of falling importance. All spherical harmonics come after the last layer.
pub(super) fn pack_by_importance(splats: &Splats, importance: &[f32], bounds: &Bounds) -> io::Result<Parts> {
    let mut parts = Parts::default();
    for (layer, ids) in (0..).zip(split_layers(&splats.means, importance, bounds)) {
        for ids in even_chunks(&ids, PACK_SPLATS_MAX) {
            parts.groups.push(add_shapes(&mut parts.first, splats, layer, ids)?);
        }
    }
    parts.parts.push((Packs::default(), (0..parts.groups.len()).collect()));
    Ok(parts)
}

/// Arranges the base first. Then, for each region, come its other splats, the changes to its base splats, and
/// the spherical harmonics of all its splats.
pub(super) fn pack_by_base(splats: &Splats, base: &Base, bounds: &Bounds) -> io::Result<Parts> {
    let regions = split_regions(&splats.means, base, bounds);
    let mut parts = Parts::default();
    for Region { base: places, .. } in &regions {
        let ids: Vec<u32> = places.iter().map(|&place| base.ids[place]).collect();
        let last: Vec<FloatShape> = ids.iter().map(|&i| FloatShape::of(splats, i as usize)).collect();
        let first: Vec<FloatShape> =
            places.iter().map(|&place| base_splat_in_bounds(bounds, &base.splats, place)).collect();
        let frame = shapes::choose_frame(&[&first[..], &last[..]].concat());
        let quantised: Vec<Shape> = first.iter().map(|splat| shapes::quantise_base(&frame, splat)).collect();
        let pairs = quantised.iter().zip(&last);
        let changes: Vec<Shape> =
            pairs.map(|(first, last)| first.change_to(&shapes::quantise(&frame, last))).collect();
        add_quantised(&mut parts.first, 0, &frame, &quantised)?;
        let mut packs = Packs::default();
        add_changes(&mut packs, &changes)?;
        parts.parts.push((packs, vec![parts.groups.len()]));
        parts.groups.push(Group { layer: 0, ids });
    }
    for (Region { rest, .. }, (packs, groups)) in regions.iter().zip(&mut parts.parts) {
        // The other splats come before the changes. Base splats in their final form, without the other
        // splats, would leave holes.
        let changes = std::mem::take(packs);
        for ids in even_chunks(rest, PACK_SPLATS_MAX) {
            groups.push(parts.groups.len());
            parts.groups.push(add_shapes(packs, splats, 1, ids)?);
        }
        packs.append(changes);
    }
    Ok(parts)
}

fn add_shapes(packs: &mut Packs, splats: &Splats, layer: u8, ids: &[u32]) -> io::Result<Group> {
    let exact: Vec<FloatShape> = ids.iter().map(|&i| FloatShape::of(splats, i as usize)).collect();
    let frame = shapes::choose_frame(&exact);
    let quantised: Vec<Shape> = exact.iter().map(|splat| shapes::quantise(&frame, splat)).collect();
    add_quantised(packs, layer, &frame, &quantised)?;
    Ok(Group { layer, ids: ids.to_vec() })
}

fn add_quantised(packs: &mut Packs, layer: u8, frame: &ShapeFrame, shapes: &[Shape]) -> io::Result<()> {
    let mut head = [0; SHAPE_FRAME_BYTES];
    frame.encode(&mut head);
    let mut planes = vec![0; shapes.len() * SHAPE_BYTES];
    write_shapes(shapes, &mut planes);
    packs.add(PackKind::Shapes, layer, shapes.len(), &head, &planes)
}

fn add_changes(packs: &mut Packs, changes: &[Shape]) -> io::Result<()> {
    let mut planes = vec![0; changes.len() * SHAPE_BYTES];
    write_changes(changes, &mut planes);
    packs.add(PackKind::Changes, 0, changes.len(), &[], &planes)
}

/// Returns splat `place` of a base. If training has moved the splat out of the model's bounds, it is moved
/// back into them.
fn base_splat_in_bounds(bounds: &Bounds, base: &Splats, place: usize) -> FloatShape {
    let splat = FloatShape::of(base, place);
    FloatShape { mean: bounds.clamp(splat.mean), ..splat }
}
