//! Shapes to packs: by importance, or a base first.

use std::io;

use cosurf_scene::{Base, Splats};
use cosurf_wire::Bounds;
use cosurf_wire::body::{
    PACK_SPLATS_MAX, PackKind, SHAPE_BYTES, SHAPE_FRAME_BYTES, Shape, ShapeFrame, write_changes, write_shapes,
};

use super::order::{Region, even_chunks, layers, regions};
use super::packs::Packs;
use super::shapes::{self, Form};

/// Splats that share a pack.
pub(super) struct Group {
    pub(super) layer: u8,
    pub(super) ids: Vec<u32>,
}

/// A body's packs of shapes in the order in which they go.
#[derive(Default)]
pub(super) struct Parts {
    /// What goes first.
    pub(super) first: Packs,
    /// What follows, each with the groups whose spherical harmonics go with it.
    pub(super) parts: Vec<(Packs, Vec<usize>)>,
    /// All groups, those of the first layer first.
    pub(super) groups: Vec<Group>,
}

impl Parts {
    /// Bytes that the shapes add to a body.
    pub(super) fn bytes(&self) -> usize {
        let parts = self.parts.iter().map(|(packs, _)| packs.table_and_pack_bytes());
        self.first.table_and_pack_bytes() + parts.sum::<usize>()
    }
}

/// Layer by layer, the most important first; then all colours.
pub(super) fn by_importance(splats: &Splats, importance: &[f32], bounds: &Bounds) -> io::Result<Parts> {
    let mut parts = Parts::default();
    for (layer, ids) in (0..).zip(layers(&splats.means, importance, bounds)) {
        for ids in even_chunks(&ids, PACK_SPLATS_MAX) {
            parts.groups.push(add_shapes(&mut parts.first, splats, layer, ids)?);
        }
    }
    parts.parts.push((Packs::default(), (0..parts.groups.len()).collect()));
    Ok(parts)
}

/// The base, then region by region the others there, what becomes of the base with them, and the colours of all.
pub(super) fn by_base(splats: &Splats, base: &Base, bounds: &Bounds) -> io::Result<Parts> {
    let regions = regions(&splats.means, base, bounds);
    let mut parts = Parts::default();
    for Region { base: places, .. } in &regions {
        let ids: Vec<u32> = places.iter().map(|&place| base.ids[place]).collect();
        let becomes: Vec<Form> = ids.iter().map(|&i| Form::of(splats, i as usize)).collect();
        let is: Vec<Form> = places.iter().map(|&place| inside(bounds, &base.splats, place)).collect();
        let frame = shapes::frame(&[&is[..], &becomes[..]].concat());
        let rounded: Vec<Shape> = is.iter().map(|is| shapes::round_base(&frame, is)).collect();
        let to = rounded.iter().zip(&becomes);
        let changes: Vec<Shape> =
            to.map(|(is, becomes)| is.change_to(&shapes::round(&frame, becomes))).collect();
        add_rounded(&mut parts.first, 0, &frame, &rounded)?;
        let mut packs = Packs::default();
        add_changes(&mut packs, &changes)?;
        parts.parts.push((packs, vec![parts.groups.len()]));
        parts.groups.push(Group { layer: 0, ids });
    }
    for (Region { rest, .. }, (packs, its)) in regions.iter().zip(&mut parts.parts) {
        // Others first: a base that has changed before they come leaves holes.
        let changes = std::mem::take(packs);
        for ids in even_chunks(rest, PACK_SPLATS_MAX) {
            its.push(parts.groups.len());
            parts.groups.push(add_shapes(packs, splats, 1, ids)?);
        }
        packs.append(changes);
    }
    Ok(parts)
}

fn add_shapes(packs: &mut Packs, splats: &Splats, layer: u8, ids: &[u32]) -> io::Result<Group> {
    let forms: Vec<Form> = ids.iter().map(|&i| Form::of(splats, i as usize)).collect();
    let frame = shapes::frame(&forms);
    let rounded: Vec<Shape> = forms.iter().map(|form| shapes::round(&frame, form)).collect();
    add_rounded(packs, layer, &frame, &rounded)?;
    Ok(Group { layer, ids: ids.to_vec() })
}

fn add_rounded(packs: &mut Packs, layer: u8, frame: &ShapeFrame, rounded: &[Shape]) -> io::Result<()> {
    let mut head = [0; SHAPE_FRAME_BYTES];
    frame.encode(&mut head);
    let mut planes = vec![0; rounded.len() * SHAPE_BYTES];
    write_shapes(rounded, &mut planes);
    packs.add(PackKind::Shapes, layer, rounded.len(), &head, &planes)
}

fn add_changes(packs: &mut Packs, changes: &[Shape]) -> io::Result<()> {
    let mut planes = vec![0; changes.len() * SHAPE_BYTES];
    write_changes(changes, &mut planes);
    packs.add(PackKind::Changes, 0, changes.len(), &[], &planes)
}

/// A splat of a base, which is moved into the bounds of the model if training has moved it out.
fn inside(bounds: &Bounds, base: &Splats, place: usize) -> Form {
    let form = Form::of(base, place);
    Form { mean: bounds.clamp(form.mean), ..form }
}
