//! Cuts a global model that is too large to be sent whole into tiles, and finds out which device gets which: those with
//! ground that the device observed.

use cosurf_link::{FirstLayer, Model, model_to_body};
use cosurf_scene::{LocalFrame, Splats};
use cosurf_wire::DeviceId;
use tracing::debug_span;

use super::pack::importance;
use crate::merge::{Ground, MergeError};

/// A model with more splats is sent in tiles. Unpacked, a model of so many splats takes up to 60 MB.
pub(super) const WHOLE_SPLATS_MAX: usize = 250_000;
/// A tile has at most this share of the splats of the largest model that is sent whole, one part in so many. On a site of
/// two million splats, a device whose ground is a twentieth of the site got half of the site in tiles of 250,000 splats,
/// because its ground touched the corners of four.
const TILES_IN_WHOLE: usize = 4;
/// A device gets a tile if at least this share of the device's splats lie there, or as many as this share of the tile's
/// splats: of an edge, a tile may be the ground of one of its devices.
const SHARE_MIN: f64 = 0.01;

/// A global model in tiles.
pub(super) struct Cut {
    /// The encoded tiles.
    pub(super) bodies: Vec<Vec<u8>>,
    /// The tiles that each device gets, by their places.
    pub(super) receivers: Vec<(DeviceId, Vec<u32>)>,
}

impl Cut {
    /// Cuts a model, which is in `frame`, with more than `whole_max` splats into tiles. `locals` has the splats of each
    /// device's model, where they were merged.
    pub(super) fn of(
        model: &Model,
        frame: &LocalFrame,
        whole_max: usize,
        locals: impl Iterator<Item = Result<(DeviceId, Splats), MergeError>>,
        threads: usize,
        is_stopped: &dyn Fn() -> bool,
    ) -> Result<Self, MergeError> {
        let _span = debug_span!("cut", splats = model.splats.len()).entered();
        let ground = Ground::of(model, whole_max.div_ceil(TILES_IN_WHOLE));
        let importance = importance(model, threads, is_stopped)?;
        let mut members = vec![Vec::new(); ground.tiles()];
        for (i, mean) in model.splats.means.iter().enumerate() {
            if let Some(tile) = ground.tile(*mean) {
                members[tile].push(i);
            }
        }
        let encode = |its: &Vec<usize>| {
            let importance: Vec<f32> = its.iter().map(|i| importance[*i]).collect();
            let mut splats = Splats::with_capacity(its.len(), model.splats.sh_degree);
            its.iter().for_each(|i| splats.push_from(&model.splats, *i));
            Ok(model_to_body(&splats, &[], frame, FirstLayer::ByImportance(&importance))?)
        };
        let bodies = members.iter().map(encode).collect::<Result<_, MergeError>>()?;
        let sizes: Vec<usize> = members.iter().map(Vec::len).collect();
        let gets = |local: Result<(DeviceId, Splats), MergeError>| {
            let find = |mean| ground.tile(mean);
            local.map(|(device, splats)| (device, observed(&sizes, &splats.means, find)))
        };
        Ok(Self { bodies, receivers: locals.map(gets).collect::<Result<_, _>>()? })
    }
}

/// The tiles in which a device has ground. `sizes` has the number of splats of each tile, `means` those of the device's
/// model, and `tile` finds the tile of a mean.
pub(super) fn observed(
    sizes: &[usize],
    means: &[[f32; 3]],
    tile: impl Fn([f32; 3]) -> Option<usize>,
) -> Vec<u32> {
    let mut counts = vec![0usize; sizes.len()];
    for tile in means.iter().filter_map(|mean| tile(*mean)) {
        counts[tile] += 1;
    }
    let least = |size: usize| SHARE_MIN * means.len().min(size) as f64;
    let is_observed = |(count, size): (&usize, &usize)| *count > 0 && *count as f64 >= least(*size);
    let tiles = counts.iter().zip(sizes).map(is_observed);
    (0u32..).zip(tiles).filter(|(_, is_observed)| *is_observed).map(|(place, _)| place).collect()
}
