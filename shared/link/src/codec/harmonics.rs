//! Encodes the spherical harmonics into the bytes that the rest of a body leaves of its target size.

use std::io;

use cosurf_scene::Splats;
use cosurf_wire::body::PackKind;

use super::basis::Basis;
use super::layers::Group;
use super::packs::Packs;

/// Target size of a whole body, in bytes per splat, at degrees 1, 2 and 3 of the spherical harmonics. If the
/// body would be larger, the spherical harmonics are quantised more coarsely. Degree 3 has more coefficients
/// and would lose quality at the size of degree 2.
const SPLAT_BYTES: [f64; 3] = [15.95, 15.95, 17.95];
/// A body may be smaller than its target by this many bytes per splat. Otherwise the spherical harmonics are
/// packed again with a finer step.
const SLACK_BYTES: f64 = 0.1;
/// Minimum and maximum bytes per splat that the encoder plans for spherical harmonics.
const SH_BYTES: [f64; 2] = [2.0, 7.0];
/// Maximum number of attempts to meet the target. The exact size of the basis, the table and small packs is
/// known only after packing.
const ATTEMPTS: usize = 4;
/// Entropy of the quantised coefficients divided by their size after zstd.
const ENTROPY_PER_CODED_BIT: f64 = 0.97;

/// The spherical harmonics of a model.
#[derive(Default)]
pub(super) struct Harmonics {
    /// The pack of the basis.
    pub(super) basis: Packs,
    /// The packs of the quantised coordinates along the directions of the basis, one for each [`Group`].
    pub(super) packs: Vec<Packs>,
}

impl Harmonics {
    fn bytes(&self) -> usize {
        let packs = self.packs.iter().map(Packs::table_and_pack_bytes);
        self.basis.table_and_pack_bytes() + packs.sum::<usize>()
    }
}

/// Packs the spherical harmonics of the splats in `groups`. `spent_bytes` is the size of the rest of the
/// body.
pub(super) fn pack_harmonics(splats: &Splats, groups: &[Group], spent_bytes: usize) -> io::Result<Harmonics> {
    if splats.sh_degree == 0 || groups.is_empty() {
        return Ok(Harmonics::default());
    }
    let splat_bytes = SPLAT_BYTES[splats.sh_degree as usize - 1];
    let per_splat = |bytes: usize| bytes as f64 / splats.len() as f64;
    let [least, most] = SH_BYTES;
    let mut bytes = (splat_bytes - SLACK_BYTES - per_splat(spent_bytes)).clamp(least, most);
    let mut packed = pack_into(splats, groups, bytes)?;
    for _ in 1..ATTEMPTS {
        let found = per_splat(spent_bytes + packed.bytes());
        let next = (bytes + splat_bytes - 0.5 * SLACK_BYTES - found).clamp(least, most);
        if (splat_bytes - SLACK_BYTES..=splat_bytes).contains(&found) || next == bytes {
            break;
        }
        bytes = next;
        packed = pack_into(splats, groups, bytes)?;
    }
    Ok(packed)
}

/// Packs the spherical harmonics of all `groups` into about `bytes` per splat.
fn pack_into(splats: &Splats, groups: &[Group], bytes: f64) -> io::Result<Harmonics> {
    let order: Vec<u32> = groups.iter().flat_map(|group| &group.ids).copied().collect();
    let basis = Basis::learn(splats, &order, 8.0 * bytes * ENTROPY_PER_CODED_BIT);
    let mut packed = Harmonics::default();
    packed.basis.add(PackKind::Basis, 0, 0, &basis.encode(splats.sh_degree as u8), &[])?;
    for Group { layer, ids } in groups {
        let mut steps = Vec::with_capacity(ids.len() * usize::from(basis.layout.components));
        ids.iter().for_each(|&i| basis.quantise(&splats.sh_of(i as usize)[3..], &mut steps));
        let mut planes = vec![0; ids.len() * basis.layout.splat_bytes()];
        basis.layout.write(&steps, &mut planes);
        let mut pack = Packs::default();
        pack.add(PackKind::Sh, *layer, ids.len(), &[], &planes)?;
        packed.packs.push(pack);
    }
    Ok(packed)
}
