//! The plan of a body: the position of every pack. It is read from the head and the table, which are
//! checked.

use core::ops::Range;

use super::error::BodyError;
use super::head::{BodyHead, HEAD_BYTES, PACK_ENTRY_BYTES, PackEntry, PackKind};
use super::sh::ShLayout;

/// A pack and its position in the body.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pack {
    /// The pack's table entry.
    pub entry: PackEntry,
    /// The pack's byte range in the body.
    pub range: Range<usize>,
}

/// The packs that describe one group of splats.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SplatPacks {
    /// The shapes of the splats.
    pub shapes: Pack,
    /// The changes that turn base splats into their final form, if the group belongs to a base.
    pub changes: Option<Pack>,
    /// The spherical harmonics of the splats, if the model has any.
    pub sh: Option<Pack>,
    /// The changes to the base splats in the region of this group. Until they arrive, the base stands in for
    /// the group, so the group must not be shown. `None` if the group belongs to the first layer, or if the
    /// model has no base.
    pub required_changes: Option<Pack>,
}

/// The checked head and table of a body.
#[derive(Clone, Copy, Debug)]
pub struct BodyPlan<'a> {
    head: BodyHead,
    table: &'a [[u8; PACK_ENTRY_BYTES]],
}

impl<'a> BodyPlan<'a> {
    /// Reads and checks the head and the table of a body. `body` may end after the table.
    pub fn new(body: &'a [u8]) -> Result<Self, BodyError> {
        let head = BodyHead::decode(body)?;
        let plan = Self { head, table: body[HEAD_BYTES..head.packs_at()].as_chunks().0 };
        plan.check_table()?;
        Ok(plan)
    }

    /// Like [`Self::new`], but also checks that `body` has the size that the table requires.
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

    /// Size of the whole body in bytes.
    pub fn body_bytes(&self) -> u64 {
        self.head.packs_at() as u64 + self.entries().map(|entry| u64::from(entry.bytes)).sum::<u64>()
    }

    /// All packs, in the order of the body.
    pub fn packs(&self) -> impl Iterator<Item = Pack> + 'a {
        let mut at = self.head.packs_at();
        self.entries().map(move |entry| {
            let start = at;
            at = at.saturating_add(entry.bytes as usize);
            Pack { entry, range: start..at }
        })
    }

    /// The packs of one kind, in the order of the body.
    pub fn packs_of(&self, kind: PackKind) -> impl Iterator<Item = Pack> + 'a {
        self.packs().filter(move |pack| pack.entry.kind == kind)
    }

    /// The packs of each group of splats, in the order of the shapes packs.
    pub fn splat_packs(&self) -> impl Iterator<Item = SplatPacks> + 'a {
        let mut changes = self.packs_of(PackKind::Changes);
        let sh = |is_first: bool| {
            self.packs_of(PackKind::Sh).filter(move |pack| (pack.entry.layer == 0) == is_first)
        };
        let (mut first_sh, mut other_sh) = (sh(true), sh(false));
        let mut later_changes = self.packs_of(PackKind::Changes).peekable();
        self.packs_of(PackKind::Shapes).map(move |shapes| {
            if shapes.entry.layer == 0 {
                return SplatPacks {
                    shapes,
                    changes: changes.next(),
                    sh: first_sh.next(),
                    required_changes: None,
                };
            }
            while later_changes.next_if(|changes| changes.range.start < shapes.range.start).is_some() {}
            SplatPacks {
                shapes,
                changes: None,
                sh: other_sh.next(),
                required_changes: later_changes.peek().cloned(),
            }
        })
    }

    /// Whether the first layer is a base, which stands in for the whole model.
    pub fn has_base(&self) -> bool {
        self.packs_of(PackKind::Changes).next().is_some()
    }

    /// Unpacked size of a pack in bytes. `layout` is the layout of spherical harmonics that the basis
    /// states.
    pub fn unpacked_bytes(&self, entry: &PackEntry, layout: ShLayout) -> usize {
        match entry.kind {
            PackKind::Sh => usize::from(entry.splats) * layout.splat_bytes(),
            _ => self.head.unpacked_bytes(entry),
        }
    }

    fn entries(&self) -> impl Iterator<Item = PackEntry> + 'a {
        // The iterator ends at an invalid entry. `check_table` refuses a table that has one.
        self.table.iter().map_while(PackEntry::decode)
    }

    fn check_table(&self) -> Result<(), BodyError> {
        let head = &self.head;
        let entries_of = |kind| self.entries().filter(move |entry| entry.kind == kind);
        let count = |kind| entries_of(kind).count();
        let shapes = count(PackKind::Shapes);
        let sh = if head.sh_degree > 0 { shapes } else { 0 };
        let splats: u64 = entries_of(PackKind::Shapes).map(|entry| u64::from(entry.splats)).sum();
        let same_splats = |(a, b): (PackEntry, PackEntry)| (a.splats, a.layer) == (b.splats, b.layer);
        let in_layer =
            |kind, is_first: bool| entries_of(kind).filter(move |entry| (entry.layer == 0) == is_first);
        let base = || in_layer(PackKind::Shapes, true);
        let changes = count(PackKind::Changes);
        let first_sh = if head.sh_degree > 0 { base().count() } else { 0 };
        let is_sane = self.entries().count() == self.table.len()
            && self.entries().is_sorted_by_key(|entry| entry.kind.rank())
            && self.entries().all(|entry| head.fits(&entry))
            && count(PackKind::Cameras) == usize::from(head.cameras > 0)
            && count(PackKind::Origin) <= 1
            && count(PackKind::Basis) == usize::from(sh > 0)
            && count(PackKind::Sh) == sh
            && splats == u64::from(head.splats)
            && in_layer(PackKind::Sh, true).count() == first_sh
            && base().zip(in_layer(PackKind::Sh, true)).all(same_splats)
            && in_layer(PackKind::Shapes, false).zip(in_layer(PackKind::Sh, false)).all(same_splats)
            && (changes == 0 || changes == base().count())
            && base().zip(entries_of(PackKind::Changes)).all(same_splats);
        is_sane.then_some(()).ok_or(BodyError::BadTable)
    }
}
