//! Packs in a row, and their entries in the table.

use std::io;

use cosurf_wire::body::{BodyHead, HEAD_BYTES, PACK_ENTRY_BYTES, PackEntry, PackKind};

use super::pack::{entry, pack};

/// Packs and their entries.
#[derive(Default)]
pub(super) struct Packs {
    entries: Vec<PackEntry>,
    bytes: Vec<u8>,
}

impl Packs {
    /// How many there are.
    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    /// Bytes of a body with them.
    pub(super) fn body_bytes(&self) -> usize {
        HEAD_BYTES + self.table_and_pack_bytes()
    }

    /// Bytes that they add to a body.
    pub(super) fn table_and_pack_bytes(&self) -> usize {
        self.entries.len() * PACK_ENTRY_BYTES + self.bytes.len()
    }

    /// Adds a pack of `splats` (0 where it holds none): a frame, then planes of one byte a splat.
    pub(super) fn add(
        &mut self,
        kind: PackKind,
        layer: u8,
        splats: usize,
        frame: &[u8],
        planes: &[u8],
    ) -> io::Result<()> {
        let plane_bytes = if splats > 0 { splats } else { planes.len() };
        let (form, bytes) = pack(frame, planes, plane_bytes)?;
        self.entries.push(entry(kind, layer, splats, form, &bytes));
        self.bytes.extend_from_slice(&bytes);
        Ok(())
    }

    /// Adds `others` behind these.
    pub(super) fn append(&mut self, others: Self) {
        self.entries.extend(others.entries);
        self.bytes.extend(others.bytes);
    }

    /// The body of a head that fits these.
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
