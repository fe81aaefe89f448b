//! Spherical harmonics to packs, in the bytes that the rest leaves.

use std::io;

use cosurf_scene::Splats;
use cosurf_wire::body::PackKind;

use super::basis::Basis;
use super::layers::Group;
use super::packs::Packs;

/// Most bytes of a splat, cameras included, where the spherical harmonics can give way: at degree 1, 2, 3. Seven more
/// coefficients of each colour do not fit into the bytes of degree 2: in 16 bytes whole uploads at degree 3 lose 0.15 dB
/// (Caliterra, 240 px) and 0.25 dB (rendered Boruszyn), in 18 bytes 0.08 and 0.13.
const SPLAT_BYTES: [f64; 3] = [15.95, 15.95, 17.95];
/// How much less it may be.
const SLACK_BYTES: f64 = 0.1;
/// Bytes that the spherical harmonics of a splat get at least, and at most.
const SH_BYTES: [f64; 2] = [2.0, 7.0];
/// Times that these are packed at most: what their basis, the table and small packs cost beside their statistics is known
/// only then.
const TRIES: usize = 4;
/// Entropy of a coefficient's statistics beside the bytes that zstd makes of it.
const CODED: f64 = 0.97;

/// The spherical harmonics of a model.
#[derive(Default)]
pub(super) struct Harmonics {
    /// Their basis.
    pub(super) basis: Packs,
    /// The steps along it, a pack for each group.
    pub(super) packs: Vec<Packs>,
}

impl Harmonics {
    fn bytes(&self) -> usize {
        let packs = self.packs.iter().map(Packs::table_and_pack_bytes);
        self.basis.table_and_pack_bytes() + packs.sum::<usize>()
    }
}

/// Those of the splats in `groups`, where all else takes `spent_bytes`.
pub(super) fn harmonics(splats: &Splats, groups: &[Group], spent_bytes: usize) -> io::Result<Harmonics> {
    if splats.sh_degree == 0 || groups.is_empty() {
        return Ok(Harmonics::default());
    }
    let splat_bytes = SPLAT_BYTES[splats.sh_degree as usize - 1];
    let each = |bytes: usize| bytes as f64 / splats.len() as f64;
    let [least, most] = SH_BYTES;
    let mut bytes = (splat_bytes - SLACK_BYTES - each(spent_bytes)).clamp(least, most);
    let mut packed = in_about(splats, groups, bytes)?;
    for _ in 1..TRIES {
        let found = each(spent_bytes + packed.bytes());
        let next = (bytes + splat_bytes - 0.5 * SLACK_BYTES - found).clamp(least, most);
        if (splat_bytes - SLACK_BYTES..=splat_bytes).contains(&found) || next == bytes {
            break;
        }
        bytes = next;
        packed = in_about(splats, groups, bytes)?;
    }
    Ok(packed)
}

/// The same in about so many bytes a splat.
fn in_about(splats: &Splats, groups: &[Group], bytes: f64) -> io::Result<Harmonics> {
    let order: Vec<u32> = groups.iter().flat_map(|group| &group.ids).copied().collect();
    let basis = Basis::learn(splats, &order, 8.0 * bytes * CODED);
    let mut packed = Harmonics::default();
    packed.basis.add(PackKind::Basis, 0, 0, &basis.encode(splats.sh_degree as u8), &[])?;
    for Group { layer, ids } in groups {
        let mut steps = Vec::with_capacity(ids.len() * usize::from(basis.layout.components));
        ids.iter().for_each(|&i| basis.round(&splats.sh_of(i as usize)[3..], &mut steps));
        let mut planes = vec![0; ids.len() * basis.layout.splat_bytes()];
        basis.layout.write(&steps, &mut planes);
        let mut pack = Packs::default();
        pack.add(PackKind::Sh, *layer, ids.len(), &[], &planes)?;
        packed.packs.push(pack);
    }
    Ok(packed)
}
