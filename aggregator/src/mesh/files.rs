//! A mesh that need not fit into the memory: while it grows, it is in temporary files in the folder of the PLY that is written at
//! the end. In memory are only the triangles of the blocks that are being fused, and at the end eight bytes for each vertex, which
//! tell the connected piece that it belongs to.

use std::ops::Range;
use std::path::Path;

use cosurf_scene::files::with_space;
use cosurf_scene::{LocalFrame, Mesh, MeshCounts, SceneError, atomic};
use glam::Vec3;

use super::budget::MeshBytes;
use super::clean::{self, Kept, Pieces};
use super::error::MeshError;
use super::event::{FuseEvent, Stage};
use super::extract::{Extraction, LateCorner, Layout};
use super::keeper::Keeper;
use crate::scratch::{Column, Scratch, beside};

/// Triangles that are read at once.
const TRIANGLES_AT_ONCE: usize = 1 << 13;
/// Bytes of a vertex while its part of the file is made: position, normal and colour.
const VERTEX_BYTES: u64 = 12 + 12 + 3;
/// Fewest vertices whose part of the file is made at once.
const VERTICES_LEAST: u64 = 1 << 12;
/// Bytes that writing the PLY takes at least, beside those for each vertex of the mesh.
const END_BYTES: u64 = VERTICES_LEAST * VERTEX_BYTES + (TRIANGLES_AT_ONCE * 2 * size_of::<[u32; 3]>()) as u64;

/// Keeps a growing mesh in temporary files, and writes it as a PLY.
pub(super) struct InFiles<'a> {
    /// The PLY.
    out: &'a Path,
    /// The frame that the mesh is in. The PLY is in the world.
    frame: &'a LocalFrame,
    /// Makes files in the folder of the PLY.
    scratch: Scratch,
    grown: Columns,
}

/// The mesh so far. In `corners`, each triangle has the indices of its three vertices.
struct Columns {
    positions: Column<[f32; 3]>,
    rgb: Column<[u8; 3]>,
    corners: Column<u32>,
}

impl<'a> InFiles<'a> {
    /// Makes empty files, for a mesh in `frame` that is to become the PLY `out`.
    pub(super) fn new(out: &'a Path, frame: &'a LocalFrame) -> Result<Self, SceneError> {
        let scratch = Scratch::new(atomic::folder_of(out))?;
        let grown = Columns::new(&scratch)?;
        Ok(Self { out, frame, scratch, grown })
    }
}

impl Keeper for InFiles<'_> {
    type Made = MeshCounts;
    const BYTES: MeshBytes = MeshBytes::IN_FILES;

    fn made_bytes(layout: &Layout) -> u64 {
        layout.moved_bytes()
    }

    fn end_bytes(layout: &Layout) -> u64 {
        layout.after.vertices * Pieces::VERTEX_BYTES + END_BYTES
    }

    fn forget(&mut self) -> Result<(), MeshError> {
        self.grown = Columns::new(&self.scratch)?;
        Ok(())
    }

    fn keep(&mut self, extraction: &mut Extraction) -> Result<(), MeshError> {
        let (mesh, late) = extraction.move_out();
        Ok(self.grown.append(&mesh, &late)?)
    }

    fn finish(
        &mut self,
        _: Extraction,
        memory_bytes: u64,
        on_event: &mut impl FnMut(FuseEvent) -> Result<(), MeshError>,
    ) -> Result<MeshCounts, MeshError> {
        let kept = self.grown.without_specks()?;
        if kept.counts.triangles == 0 {
            return Err(MeshError::NoAgreement);
        }
        let vertices = self.grown.positions.len();
        let left_bytes = memory_bytes.saturating_sub(END_BYTES + vertices * size_of::<u32>() as u64);
        let parts = parts_of(vertices, (left_bytes / VERTEX_BYTES).max(VERTICES_LEAST));
        let kind =
            Mesh { normals: vec![[0.0; 3]], rgb: vec![[0; 3]], ..Mesh::default() }.out_of_frame(self.frame);
        let written = kind.write_ply_parts(self.out, kept.counts, |ply| {
            for (done, part) in parts.iter().enumerate() {
                ply.vertices(&self.grown.part(part.clone(), &kept)?.out_of_frame(self.frame))?;
                on_event(FuseEvent::Progress { stage: Stage::Write, done: done + 1, of: parts.len() })?;
            }
            self.grown.for_each_triangles(|triangles| {
                let left: Vec<_> = triangles.iter().filter_map(|triangle| kept.triangle(*triangle)).collect();
                ply.triangles(&left)
            })?;
            Ok(())
        });
        written.map(|()| kept.counts).map_err(|error| self.not_written(error, kept.counts))
    }
}

impl InFiles<'_> {
    /// The error of writing a mesh with these counts. That of a full disk counts the temporary files as free and as needed: they
    /// are gone when the user reads it, and the next attempt needs them again.
    fn not_written(&self, error: MeshError, MeshCounts { vertices, triangles }: MeshCounts) -> MeshError {
        let MeshError::Scene(error) = error else { return error };
        let bytes = vertices * VERTEX_BYTES + triangles * (1 + size_of::<[u32; 3]>() as u64);
        beside(with_space(error, self.scratch.folder(), bytes), self.grown.bytes()).into()
    }
}

impl Columns {
    fn new(scratch: &Scratch) -> Result<Self, SceneError> {
        Ok(Self { positions: scratch.column()?, rgb: scratch.column()?, corners: scratch.column()? })
    }

    /// Appends a part of the mesh, and fills in vertices that triangles of earlier parts were waiting for.
    fn append(&mut self, part: &Mesh, late: &[LateCorner]) -> Result<(), SceneError> {
        let others = self.bytes() - self.positions.bytes();
        self.positions.append(&part.positions).map_err(|error| beside(error, others))?;
        let others = self.bytes() - self.rgb.bytes();
        self.rgb.append(&part.rgb).map_err(|error| beside(error, others))?;
        for LateCorner { triangle, corner, vertex } in late {
            self.corners.set(3 * u64::from(*triangle) + u64::from(*corner), *vertex)?;
        }
        let others = self.bytes() - self.corners.bytes();
        self.corners.append(part.triangles.as_flattened()).map_err(|error| beside(error, others))?;
        Ok(())
    }

    /// Bytes of the files.
    fn bytes(&self) -> u64 {
        self.positions.bytes() + self.rgb.bytes() + self.corners.bytes()
    }

    fn without_specks(&self) -> Result<Kept, SceneError> {
        let mut pieces = Pieces::new(self.positions.len() as usize);
        self.for_each_triangles(|triangles| {
            pieces.join(triangles);
            Ok(())
        })?;
        self.for_each_triangles(|triangles| {
            pieces.count(triangles);
            Ok(())
        })?;
        Ok(pieces.without_specks())
    }

    /// Calls `visit` with all triangles, some at a time.
    fn for_each_triangles(
        &self,
        mut visit: impl FnMut(&[[u32; 3]]) -> Result<(), SceneError>,
    ) -> Result<(), SceneError> {
        let mut triangles = Vec::new();
        let (mut at, end) = (0, self.corners.len());
        while at < end {
            triangles.resize(((end - at) / 3).min(TRIANGLES_AT_ONCE as u64) as usize, [0; 3]);
            self.corners.read(at, triangles.as_flattened_mut())?;
            visit(&triangles)?;
            at += triangles.as_flattened().len() as u64;
        }
        Ok(())
    }

    /// The vertices of a range that belong to no speck, with normals, without triangles. Reads all triangles once, and adds up
    /// their normals in their order, so the sums are those of [`clean::normals`], to the bit.
    fn part(&self, vertices: Range<u64>, kept: &Kept) -> Result<Mesh, SceneError> {
        let count = (vertices.end - vertices.start) as usize;
        let (mut positions, mut rgb) = (vec![[0.0; 3]; count], vec![[0; 3]; count]);
        self.positions.read(vertices.start, &mut positions)?;
        self.rgb.read(vertices.start, &mut rgb)?;
        let mut normals = vec![[0.0; 3]; count];
        let place = |vertex: u32| {
            vertices.contains(&u64::from(vertex)).then(|| (u64::from(vertex) - vertices.start) as usize)
        };
        self.for_each_triangles(|triangles| {
            for triangle in triangles {
                let places = triangle.map(place);
                if places == [None; 3] {
                    continue;
                }
                let mut corners = [Vec3::ZERO; 3];
                for ((corner, place), vertex) in corners.iter_mut().zip(places).zip(triangle) {
                    *corner = Vec3::from_array(match place {
                        Some(place) => positions[place],
                        None => self.position(*vertex)?,
                    });
                }
                let normal = clean::area_normal(corners);
                places.into_iter().flatten().for_each(|place| clean::add(&mut normals[place], normal));
            }
            Ok(())
        })?;
        normals.iter_mut().for_each(clean::normalize);
        let first = vertices.start as usize;
        kept.retain(first, &mut positions);
        kept.retain(first, &mut rgb);
        kept.retain(first, &mut normals);
        Ok(Mesh { positions, normals, rgb, ..Mesh::default() })
    }

    fn position(&self, vertex: u32) -> Result<[f32; 3], SceneError> {
        let mut position = [[0.0; 3]];
        self.positions.read(u64::from(vertex), &mut position)?;
        Ok(position[0])
    }
}

/// Divides so many vertices into parts of at most `most`.
fn parts_of(vertices: u64, most: u64) -> Vec<Range<u64>> {
    (0..vertices.div_ceil(most)).map(|part| part * most..((part + 1) * most).min(vertices)).collect()
}
