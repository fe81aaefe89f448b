//! A sequence of packs with their table entries.

use std::io;

use cosurf_wire::body::{BodyHead, HEAD_BYTES, PACK_ENTRY_BYTES, PackEntry, PackKind};

use super::pack::{compress, make_entry};

/// A sequence of packs with their table entries.
#[derive(Default)]
pub(super) struct Packs {
    entries: Vec<PackEntry>,
    bytes: Vec<u8>,
}

impl Packs {
    /// Number of packs.
    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    /// Size of a body with these packs, in bytes.
    pub(super) fn body_bytes(&self) -> usize {
        HEAD_BYTES + self.table_and_pack_bytes()
    }

    /// Size of the packs and their table entries, in bytes.
    pub(super) fn table_and_pack_bytes(&self) -> usize {
        self.entries.len() * PACK_ENTRY_BYTES + self.bytes.len()
    }

    /// Compresses and adds a pack of `splats` splats (0 for cameras and the basis). The pack contains `frame`
    /// and then `planes`. A plane has one byte per splat. Without splats, `planes` is a single plane.
    pub(super) fn add(
        &mut self,
        kind: PackKind,
        layer: u8,
        splats: usize,
        frame: &[u8],
        planes: &[u8],
    ) -> io::Result<()> {
        let plane_bytes = if splats > 0 { splats } else { planes.len() };
        let (form, bytes) = compress(frame, planes, plane_bytes)?;
        self.entries.push(make_entry(kind, layer, splats, form, &bytes));
        self.bytes.extend_from_slice(&bytes);
        Ok(())
    }

    /// Appends `others`.
    pub(super) fn append(&mut self, others: Self) {
        self.entries.extend(others.entries);
        self.bytes.extend(others.bytes);
    }

    /// Makes the body. `head` must describe the same packs.
    pub(super) fn into_body(self, head: &BodyHead) -> Vec<u8> {
        let mut body = vec![0; head.packs_at()];
        for (entry, out) in self.entries.iter().zip(body[HEAD_BYTES..].as_chunks_mut::<PACK_ENTRY_BYTES>().0)
        {
            entry.encode(out);
        }
        head.encode(&mut body);
        body.extend_from_slice(&self.bytes);
        body
    }
}
