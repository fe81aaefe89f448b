//! Where everything is in a body, and that it can be.

use core::ops::Range;

use super::head::{BodyHead, HEAD_BYTES, PACK_ENTRY_BYTES, PackEntry, PackKind};
use super::{BodyError, ShLayout};

/// A pack and where it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pack {
    /// Its entry in the table.
    pub entry: PackEntry,
    /// Its bytes in the body.
    pub range: Range<usize>,
}

/// The packs of some splats.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SplatPacks {
    /// Their shapes.
    pub shapes: Pack,
    /// What becomes of these, where they belong to a base.
    pub changes: Option<Pack>,
    /// Their spherical harmonics, where the model has some.
    pub sh: Option<Pack>,
    /// The next changes of a base, which make room for them.
    pub room: Option<Pack>,
}

/// Head and table of a body, checked: where everything is, and that it can be.
#[derive(Clone, Copy, Debug)]
pub struct BodyPlan<'a> {
    head: BodyHead,
    table: &'a [[u8; PACK_ENTRY_BYTES]],
}

impl<'a> BodyPlan<'a> {
    /// Reads the plan at the start of a body, of which head and table at least must be there.
    pub fn new(body: &'a [u8]) -> Result<Self, BodyError> {
        let head = BodyHead::decode(body)?;
        let plan = Self { head, table: body[HEAD_BYTES..head.packs_at()].as_chunks().0 };
        plan.check_table()?;
        Ok(plan)
    }

    /// The same of a body that is all there.
    pub fn of_whole(body: &'a [u8]) -> Result<Self, BodyError> {
        let plan = Self::new(body)?;
        let (expected, found) = (plan.body_bytes(), body.len() as u64);
        if expected != found {
            return Err(BodyError::WrongSize { expected, found });
        }
        Ok(plan)
    }

    /// The head.
    pub fn head(&self) -> &BodyHead {
        &self.head
    }

    /// Bytes of the whole body.
    pub fn body_bytes(&self) -> u64 {
        self.head.packs_at() as u64 + self.entries().map(|entry| u64::from(entry.bytes)).sum::<u64>()
    }

    /// The packs in order.
    pub fn packs(&self) -> impl Iterator<Item = Pack> + 'a {
        let mut at = self.head.packs_at();
        self.entries().map(move |entry| {
            let start = at;
            at = at.saturating_add(entry.bytes as usize);
            Pack { entry, range: start..at }
        })
    }

    /// The packs of one kind, in order.
    pub fn packs_of(&self, kind: PackKind) -> impl Iterator<Item = Pack> + 'a {
        self.packs().filter(move |pack| pack.entry.kind == kind)
    }

    /// What belongs together, in the order of the shapes.
    pub fn splat_packs(&self) -> impl Iterator<Item = SplatPacks> + 'a {
        let mut changes = self.packs_of(PackKind::Changes);
        let sh = |is_first: bool| {
            self.packs_of(PackKind::Sh).filter(move |pack| (pack.entry.layer == 0) == is_first)
        };
        let (mut of_first, mut of_others) = (sh(true), sh(false));
        let mut rooms = self.packs_of(PackKind::Changes).peekable();
        self.packs_of(PackKind::Shapes).map(move |shapes| {
            if shapes.entry.layer == 0 {
                return SplatPacks { shapes, changes: changes.next(), sh: of_first.next(), room: None };
            }
            while rooms.next_if(|room| room.range.start < shapes.range.start).is_some() {}
            SplatPacks { shapes, changes: None, sh: of_others.next(), room: rooms.peek().cloned() }
        })
    }

    /// Whether the first layer is a base, which stands in for the whole.
    pub fn has_base(&self) -> bool {
        self.packs_of(PackKind::Changes).next().is_some()
    }

    /// Bytes that `pack` unpacks to; of spherical harmonics with the layout that the basis says.
    pub fn unpacked_bytes(&self, entry: &PackEntry, layout: ShLayout) -> usize {
        match entry.kind {
            PackKind::Sh => usize::from(entry.splats) * layout.splat_bytes(),
            _ => self.head.unpacked_bytes(entry),
        }
    }

    fn entries(&self) -> impl Iterator<Item = PackEntry> + 'a {
        // An entry that is none does not pass `check_table`.
        self.table.iter().map_while(PackEntry::decode)
    }

    fn check_table(&self) -> Result<(), BodyError> {
        let head = &self.head;
        let of = |kind| self.entries().filter(move |entry| entry.kind == kind);
        let count = |kind| of(kind).count();
        let shapes = count(PackKind::Shapes);
        let colored = if head.sh_degree > 0 { shapes } else { 0 };
        let splats: u64 = of(PackKind::Shapes).map(|entry| u64::from(entry.splats)).sum();
        let same = |(a, b): (PackEntry, PackEntry)| (a.splats, a.layer) == (b.splats, b.layer);
        let in_layer = |kind, is_first: bool| of(kind).filter(move |entry| (entry.layer == 0) == is_first);
        let base = || in_layer(PackKind::Shapes, true);
        let changes = count(PackKind::Changes);
        let first_colored = if head.sh_degree > 0 { base().count() } else { 0 };
        let is_sane = self.entries().count() == self.table.len()
            && self.entries().is_sorted_by_key(|entry| entry.kind.place())
            && self.entries().all(|entry| head.fits(&entry))
            && count(PackKind::Cameras) == usize::from(head.cameras > 0)
            && count(PackKind::Basis) == usize::from(colored > 0)
            && count(PackKind::Sh) == colored
            && splats == u64::from(head.splats)
            && in_layer(PackKind::Sh, true).count() == first_colored
            && base().zip(in_layer(PackKind::Sh, true)).all(same)
            && in_layer(PackKind::Shapes, false).zip(in_layer(PackKind::Sh, false)).all(same)
            && (changes == 0 || changes == base().count())
            && base().zip(of(PackKind::Changes)).all(same);
        is_sane.then_some(()).ok_or(BodyError::BadTable)
    }
}
