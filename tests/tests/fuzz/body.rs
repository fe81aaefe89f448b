//! Fuzzes the decoders of packed models, for whole bodies and for incomplete ones, and of lists of tiles.

use cosurf_link::{
    FirstLayer, Manifest, Offer, Receiver, TileEntry, body_to_model, model_to_body, part_to_model,
};
use cosurf_scene::{Base, LocalFrame, Splats};
use cosurf_tests::dice::Dice;
use cosurf_tests::models::{cameras, random_splats};
use cosurf_wire::body::{HEAD_BYTES, PACK_ENTRY_BYTES};
use cosurf_wire::{DeviceId, ModelHeader, ModelId, ModelKind};
use glam::DVec3;

use crate::runner::{Target, hammer};

/// A body with a base of every third splat.
/// An origin in UTM.
const FAR: DVec3 = DVec3::new(500_000.0, 5_200_000.0, 0.0);

fn with_base(count: usize, sh_degree: u32) -> Vec<u8> {
    let (splats, others) = (random_splats(1, count, sh_degree), random_splats(1, count, 0));
    let mut base = Base { ids: (0..count as u32).step_by(3).collect(), splats: Splats::with_capacity(0, 0) };
    base.ids.iter().for_each(|&i| base.splats.push_from(&others, i as usize));
    model_to_body(&splats, &cameras(1), &LocalFrame::WORLD, FirstLayer::Base(&base)).unwrap()
}

/// Bodies with small packs, which are stored uncompressed, and bodies with large, compressed packs. Some bodies have
/// a base.
fn bodies() -> Vec<Vec<u8>> {
    let far = LocalFrame::at(FAR);
    let plain = [(0, 0, 1), (1, 0, 0), (2, 1, 1), (3, 3, 0), (60, 0, 9), (200, 2, 2), (40, 3, 1)].map(
        |(count, sh_degree, views)| {
            let splats = random_splats(1, count, sh_degree);
            model_to_body(
                &splats,
                &cameras(views),
                if count % 20 == 0 { &far } else { &LocalFrame::WORLD },
                FirstLayer::ByImportance(&splats.opacity_logits),
            )
            .unwrap()
        },
    );
    plain.into_iter().chain([with_base(9, 1), with_base(250, 2)]).collect()
}

/// Recomputes the checksums of the packs and of the head, if `body` has a complete head and table. A truncated pack
/// gets the checksum of its remaining bytes.
fn reseal(body: &mut [u8]) {
    let Some([low, high]) = body.get(6..8).and_then(|count| count.first_chunk().copied()) else { return };
    let packs = usize::from(u16::from_le_bytes([low, high]));
    let table = HEAD_BYTES..HEAD_BYTES + packs * PACK_ENTRY_BYTES;
    if body.len() < table.end {
        return;
    }
    let mut at = table.end;
    for entry in (table.start..table.end).step_by(PACK_ENTRY_BYTES) {
        let Some(bytes) = body[entry + 4..].first_chunk().map(|bytes| u32::from_le_bytes(*bytes)) else {
            return;
        };
        let end = at.saturating_add(bytes as usize).min(body.len());
        let checksum = crc32fast::hash(&body[at..end]).to_le_bytes();
        body[entry + 8..entry + 12].copy_from_slice(&checksum);
        at = end;
    }
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&body[..HEAD_BYTES - 4]);
    hasher.update(&body[table]);
    body[HEAD_BYTES - 4..HEAD_BYTES].copy_from_slice(&hasher.finalize().to_le_bytes());
}

#[test]
fn bodies_are_unpacked_or_refused() {
    let target = Target {
        name: "bodies",
        samples: bodies(),
        reseal,
        // A packed splat takes at least 2.5 bytes, and an unpacked splat of degree 3 takes 236 bytes: less than 128
        // times as much. 1 MiB is for the buffers of one pack.
        bytes_max: |bytes| (1 << 20) + 128 * bytes,
    };
    let mut dice = Dice(2);
    hammer(target, move |bytes| {
        let whole = body_to_model(bytes, &LocalFrame::WORLD);
        if let Ok(model) = &whole {
            assert_eq!(model.splats.find_bad_value(), None);
            let part = part_to_model(bytes, |_| true, &LocalFrame::WORLD)
                .expect("what is right as a whole is right in part");
            assert_eq!(part.map_or(0, |part| part.splats.len()), model.splats.len());
        }
        let end = dice.below(bytes.len());
        if let Ok(Some(part)) = part_to_model(bytes, |range| range.end <= end, &LocalFrame::WORLD) {
            assert_eq!(part.splats.find_bad_value(), None);
        }
        whole.is_ok()
    });
}

/// The list of the tiles of a global model.
fn manifest(tiles: usize) -> Vec<u8> {
    let (device, splats) = (DeviceId::new("ground").unwrap(), random_splats(1, 4, 0));
    let tile = |index: usize| {
        let number = ModelId::of_tile(ModelId(7), index);
        let Offer { header, .. } = Offer::new(device, number, ModelKind::Global, 0, &splats, &[]).unwrap();
        let ModelHeader { model, blake3, splats, body_bytes, bounds, .. } = header;
        TileEntry { model, blake3, splats, body_bytes, bounds }
    };
    let receiver = |i: u32| Receiver {
        device: DeviceId::new(&format!("drone-{i}")).unwrap(),
        tiles: (0..tiles as u32).filter(|tile| tile % 4 == i).collect(),
    };
    let manifest = Manifest {
        tiles: (0..tiles).map(tile).collect(),
        receivers: (0..4).map(receiver).collect(),
        origin: if tiles > 1 { FAR } else { DVec3::ZERO },
    };
    Offer::of_manifest(device, ModelId(7), 9, &manifest).unwrap().body
}

#[test]
fn manifests_are_read_or_refused() {
    let target = Target {
        name: "manifests",
        samples: [0, 1, 30].map(manifest).into(),
        reseal: |_| (),
        // What the wire promises: see `ModelHeader::unpacked_bytes`.
        bytes_max: |bytes| 4096 + 128 * bytes,
    };
    hammer(target, |bytes| {
        let manifest = Manifest::decode(bytes);
        if let Ok(manifest) = &manifest {
            let its = manifest.receivers.iter().flat_map(|receiver| manifest.of(receiver.device));
            assert!(its.into_iter().all(|tile| tile.model.is_tile()));
        }
        manifest.is_ok()
    });
}
