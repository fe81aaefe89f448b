//! The three stages of the forward rendering (`project`, `bin`, `rasterize`) and their buffers.

use cosurf_scene::Camera;

use super::buffer::Buffer;
use super::context::{Gpu, GpuError};
use super::model::Model;
use super::pass::Pass;
use super::recorder::Recorder;
use super::sort::{Counted, GROUP, Sorted, Sorter};
use super::structs::{self, COUNTERS, Projected, View};
use crate::backend::{BinCounts, Channels, Rendering};
use crate::layout::planes::{PLANES_COLOR, PLANES_GEOMETRY, planes};
use crate::layout::rendering;
use crate::layout::tiles::{TileImage, padded_pixels};
use crate::layout::view::ViewParams;

/// Number of pixels of a tile.
const TILE_PIXELS: usize = 256;

/// Buffers with an entry for each splat: its projection, the key for the sort by depth, and the slots of its pairs (see
/// [`Pairs`]).
#[derive(Debug)]
pub(super) struct Seen {
    pub(super) projected: Buffer<Projected>,
    depth_keys: Buffer<u32>,
    /// Before the sort by depth, the place of each splat in the list of visible splats; later the first slot of each
    /// visible splat, nearest first.
    places: Buffer<u32>,
    /// First slot and number of slots of each splat.
    pub(super) slots: Buffer<[u32; 2]>,
    /// The visible splats, sorted by depth.
    by_depth: Sorted,
}

/// Buffers with an entry for each splat–tile pair. The slot of a pair is its index before the sort by tile, in which
/// all pairs of a splat follow one another.
#[derive(Debug)]
pub(super) struct Pairs {
    /// The slots, sorted by tile.
    by_tile: Sorted,
    /// Index of the splat of each slot.
    pub(super) id_of_slot: Buffer<u32>,
}

/// The blended picture, and the lists of pairs of its tiles.
#[derive(Debug)]
pub(super) struct Picture {
    /// First index and end of each tile's pairs in [`Pairs::sorted_slots`].
    pub(super) ranges: Buffer<[u32; 2]>,
    /// Number of pairs of each tile that were processed before all its pixels were full.
    pub(super) blended: Buffer<u32>,
    pub(super) image: Buffer<f32>,
}

#[derive(Debug)]
struct Passes {
    project: Pass,
    compact: Pass,
    order_counts: Pass,
    emit: Pass,
    tile_ranges: Pass,
    rasterize: Pass,
}

/// The forward passes and their buffers.
#[derive(Debug)]
pub(super) struct Drawing {
    passes: Passes,
    sorter: Sorter,
    pub(super) view: Buffer<View>,
    pub(super) counters: Buffer<u32>,
    pub(super) seen: Seen,
    pub(super) pairs: Pairs,
    pub(super) picture: Picture,
    /// The camera of the last projection.
    pub(super) params: Option<ViewParams>,
    /// Number of planes of the picture last blended.
    pub(super) planes: usize,
}

impl Seen {
    fn new(gpu: &Gpu, splats: usize) -> Result<Self, GpuError> {
        Ok(Self {
            projected: Buffer::storage(gpu, "projected splats", splats)?,
            depth_keys: Buffer::storage(gpu, "depths", splats)?,
            places: Buffer::storage(gpu, "places", splats)?,
            slots: Buffer::storage(gpu, "slots", splats)?,
            by_depth: Sorted::new(gpu, Counted::Visible, splats)?,
        })
    }
}

impl Pairs {
    fn new(gpu: &Gpu, pairs: usize) -> Result<Self, GpuError> {
        let id_of_slot = Buffer::storage(gpu, "pairs", pairs)?;
        Ok(Self { by_tile: Sorted::new(gpu, Counted::Pairs, pairs)?, id_of_slot })
    }

    fn capacity(&self) -> usize {
        self.id_of_slot.len()
    }

    /// The slots of all pairs in the order of the tiles; within a tile, nearest splat first.
    pub(super) fn sorted_slots(&self) -> &wgpu::Buffer {
        self.by_tile.result()[1]
    }
}

impl Picture {
    fn new(gpu: &Gpu, size_px: [u32; 2]) -> Result<Self, GpuError> {
        let pixels = padded_pixels(size_px);
        Ok(Self {
            ranges: Buffer::storage(gpu, "tile ranges", pixels / TILE_PIXELS)?,
            blended: Buffer::storage(gpu, "blended", pixels / TILE_PIXELS)?,
            image: Buffer::storage(gpu, "picture", PLANES_GEOMETRY * pixels)?,
        })
    }

    fn pixels(&self) -> usize {
        self.image.len() / PLANES_GEOMETRY
    }
}

impl Drawing {
    pub(super) fn new(gpu: &Gpu, splats: usize, pairs: usize, size_px: [u32; 2]) -> Result<Self, GpuError> {
        Ok(Self {
            passes: Passes {
                project: gpu.pass(cosurf_shaders::PROJECT),
                compact: gpu.pass(cosurf_shaders::COMPACT),
                order_counts: gpu.pass(cosurf_shaders::ORDER_COUNTS),
                emit: gpu.pass(cosurf_shaders::EMIT),
                tile_ranges: gpu.pass(cosurf_shaders::TILE_RANGES),
                rasterize: gpu.pass(match gpu.adapter().is_software {
                    true => cosurf_shaders::RASTERIZE,
                    false => cosurf_shaders::RASTERIZE_BY_PIXEL,
                }),
            },
            sorter: Sorter::new(gpu, splats.max(pairs))?,
            view: Buffer::uniform(gpu, "view", bytemuck::Zeroable::zeroed()),
            counters: Buffer::storage(gpu, "counters", COUNTERS)?,
            seen: Seen::new(gpu, splats)?,
            pairs: Pairs::new(gpu, pairs)?,
            picture: Picture::new(gpu, size_px)?,
            params: None,
            planes: PLANES_COLOR,
        })
    }

    /// Replaces the buffers by ones for a view with `pairs` splat–tile pairs.
    pub(super) fn grow_pairs(&mut self, gpu: &Gpu, pairs: usize) -> Result<(), GpuError> {
        gpu.forget_bindings();
        self.sorter.grow(gpu, pairs.max(self.seen.slots.len()))?;
        self.pairs = Pairs::new(gpu, pairs)?;
        Ok(())
    }

    /// Grows the buffers, if necessary, for a picture of this size.
    pub(super) fn grow_picture(&mut self, gpu: &Gpu, size_px: [u32; 2]) -> Result<(), GpuError> {
        if padded_pixels(size_px) > self.picture.pixels() {
            gpu.forget_bindings();
            self.picture = Picture::new(gpu, size_px)?;
        }
        Ok(())
    }

    /// Number of tiles of the picture.
    pub(super) fn tiles(&self) -> usize {
        self.seen_view().tiles().iter().product()
    }

    /// Number of pixels of the tiles, including those outside the picture.
    pub(super) fn pixels(&self) -> usize {
        padded_pixels(self.seen_view().size_px)
    }

    pub(super) fn seen_view(&self) -> &ViewParams {
        self.params.as_ref().expect("`project` comes first")
    }

    pub(super) fn project(&mut self, gpu: &Gpu, model: &Model, camera: &Camera, sh_degree: u32, far: f64) {
        assert!(
            padded_pixels(camera.size_px) <= self.picture.pixels(),
            "{:?} px of {}",
            camera.size_px,
            self.picture.pixels()
        );
        let params = ViewParams::new(camera, sh_degree.min(model.sh_degree)).up_to(far);
        let mut counters = [0; COUNTERS];
        counters[structs::SPLATS] = model.len as u32;
        self.counters.write(gpu, 0, &counters);
        self.view.write(gpu, 0, &[self.view_of(&params, model)]);
        let Seen { projected, depth_keys, places, slots, .. } = &self.seen;
        let mut r = Recorder::new(gpu);
        r.run(
            &self.passes.project,
            &[
                &self.view.raw,
                &model.shape.raw,
                &model.sh.raw,
                &projected.raw,
                &depth_keys.raw,
                &places.raw,
                &slots.raw,
            ],
            model.len.div_ceil(GROUP),
        );
        r.submit();
        self.params = Some(params);
    }

    fn view_of(&self, params: &ViewParams, model: &Model) -> View {
        let mut view = View::new(params, model.len, model.stride, self.pairs.capacity());
        view.planes = self.planes as u32;
        view
    }

    pub(super) fn bin(&mut self, gpu: &Gpu, model: &Model) {
        let tiles = self.tiles();
        // Pairs without a tile (see `emit.wgsl`) have the number of tiles as their key, which is the largest key.
        self.pairs.by_tile.set_largest(tiles as u32);
        let mut r = Recorder::new(gpu);
        self.sort_by_depth(&mut r, model.len);
        self.emit(&mut r, model.len);
        self.sorter.sort(&mut r, &self.counters.raw, &self.pairs.by_tile);
        r.clear(&self.picture.ranges.raw);
        let [keys, _] = self.pairs.by_tile.result();
        r.run(
            &self.passes.tile_ranges,
            &[&self.view.raw, &self.counters.raw, keys, &self.picture.ranges.raw],
            self.pairs.capacity().div_ceil(GROUP),
        );
        r.submit();
    }

    /// Counts of the last binning pass.
    pub(super) fn counts(&self, gpu: &Gpu) -> BinCounts {
        counts(&self.counters.read(gpu, 0..COUNTERS))
    }

    /// Lists the visible splats, nearest first.
    fn sort_by_depth(&self, r: &mut Recorder, splats: usize) {
        let Seen { depth_keys, places, by_depth, .. } = &self.seen;
        self.sorter.scan(r, Counted::Visible, &self.counters.raw, places, splats);
        let [keys, ids] = by_depth.input();
        let buffers = [&self.view.raw, &depth_keys.raw, &places.raw, keys, ids];
        r.run(&self.passes.compact, &buffers, splats.div_ceil(GROUP));
        self.sorter.sort(r, &self.counters.raw, by_depth);
    }

    /// Assigns slots to the splats, nearest first, and writes their pairs.
    fn emit(&self, r: &mut Recorder, splats: usize) {
        let Seen { projected, places, slots, by_depth, .. } = &self.seen;
        let (counters, groups) = (&self.counters.raw, splats.div_ceil(GROUP));
        let [_, ids] = by_depth.result();
        r.run(&self.passes.order_counts, &[counters, ids, &slots.raw, &places.raw], groups);
        self.sorter.scan(r, Counted::Pairs, counters, places, splats);
        let [keys, values] = self.pairs.by_tile.input();
        let id_of_slot = &self.pairs.id_of_slot.raw;
        r.run(
            &self.passes.emit,
            &[
                &self.view.raw,
                counters,
                ids,
                &places.raw,
                &projected.raw,
                &slots.raw,
                keys,
                values,
                id_of_slot,
            ],
            groups,
        );
    }

    pub(super) fn rasterize(&mut self, gpu: &Gpu, model: &Model, channels: Channels) {
        self.planes = planes(channels);
        let params = *self.seen_view();
        self.view.write(gpu, 0, &[self.view_of(&params, model)]);
        let Picture { ranges, blended, image } = &self.picture;
        let mut r = Recorder::new(gpu);
        r.run(
            &self.passes.rasterize,
            &[
                &self.view.raw,
                &self.seen.projected.raw,
                self.pairs.sorted_slots(),
                &self.pairs.id_of_slot.raw,
                &ranges.raw,
                &blended.raw,
                &image.raw,
            ],
            self.tiles(),
        );
        r.submit();
    }

    /// Reads back the picture last blended.
    pub(super) fn rendering(&self, gpu: &Gpu) -> Rendering {
        let values = self.picture.image.read(gpu, 0..self.pixels() * self.planes);
        let view = self.seen_view();
        rendering::rendering(&TileImage::from_values(view.size_px, self.planes, &values), view)
    }
}

/// The counts of a binning pass, from the buffer of counters.
pub(super) fn counts(counters: &[u32]) -> BinCounts {
    let at = |place: usize| counters[place] as usize;
    BinCounts {
        visible: at(structs::VISIBLE),
        pairs: at(structs::PAIRS),
        dropped: at(structs::PAIRS_WANTED) - at(structs::PAIRS),
    }
}
