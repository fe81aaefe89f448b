//! A sparse volume: blocks of 8³ voxels, sorted by position. Each voxel has a truncated signed distance (positive
//! outside), a colour, and a weight for each of the two.

use glam::{DVec3, IVec3, Vec2, Vec3};
use rayon::prelude::*;

use super::frame::Frame;

/// Number of voxels along the edge of a block.
pub(super) const SIDE: usize = 8;
/// Number of voxels in a block.
pub(super) const VOXELS: usize = SIDE * SIDE * SIDE;
/// Truncation distance, voxels: signed distances are cut off this far from the surface.
pub(super) const TRUNCATION: f64 = 4.0;
/// Behind the surface, the weight of a measurement fades to 0 over this last share of the truncation distance (after
/// Bylow et al. 2013). Behind the edge of a roof lies open air, which a view from one side would otherwise fill. If the
/// weight faded from the surface on, the view that shows the farthest surface would win where views disagree, and the
/// F-score would be lower.
const FADING: f32 = 0.5;
/// Bytes that a block takes in the volume: its voxels and its key.
pub(super) const STORED_BLOCK_BYTES: u64 = (VOXELS * size_of::<Voxel>() + size_of::<Key>()) as u64;
/// Number of bits of each coordinate in a [`Key`].
const KEY_BITS: u32 = 21;
/// Limit of the blocks' coordinates: they are in `-COORDINATE_END..COORDINATE_END` along each axis.
const COORDINATE_END: i32 = 1 << (KEY_BITS - 1);
/// Sums of colour weights are stored in 16 bits, in units of 1/256, so they saturate at 256. From then on, the colour
/// is a moving average in which later views count more.
const RGB_WEIGHT_UNIT: f32 = 256.0;

/// A voxel. Its values are those at its lowest corner.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(16))]
pub(super) struct Voxel {
    /// Signed distance divided by the truncation distance, -1..=1.
    pub(super) distance: f32,
    /// Sum of the weights of all measurements; 0 if no view has measured the voxel.
    pub(super) weight: f32,
    /// sRGB, 0..=65280: 256 times the 8-bit value.
    rgb: [u16; 3],
    /// Sum of the weights of all colours, in units of 1 / [`RGB_WEIGHT_UNIT`].
    rgb_weight: u16,
}

/// Coordinates of a block, counted in blocks and packed into one number. Keys are ordered along a Z-order curve (Morton 1966)
/// over x and y, then by z. So keys that follow each other are of blocks near each other on the ground, and a block precedes
/// its neighbours towards +x, +y and +z.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Key(u64);

impl Key {
    /// `None` if the block lies too far from the origin.
    pub(super) fn new(block: IVec3) -> Option<Self> {
        let end = IVec3::splat(COORDINATE_END);
        let inside = block.cmpge(-end).all() && block.cmplt(end).all();
        inside.then(|| {
            let [x, y, z] = (block + end).to_array().map(|v| v as u64);
            Self((spread(y) << 1 | spread(x)) << KEY_BITS | z)
        })
    }

    pub(super) fn block(self) -> IVec3 {
        let curve = self.0 >> KEY_BITS;
        let parts = [gathered(curve), gathered(curve >> 1), self.0 & ((1 << KEY_BITS) - 1)];
        IVec3::from_array(parts.map(|part| part as i32 - COORDINATE_END))
    }
}

/// The lowest 21 bits of a number, moved apart: bit i becomes bit 2 i.
fn spread(number: u64) -> u64 {
    (0..KEY_BITS).fold(0, |spread, bit| spread | (number >> bit & 1) << (2 * bit))
}

/// The inverse of [`spread`]; the bits between are ignored.
fn gathered(spread: u64) -> u64 {
    (0..KEY_BITS).fold(0, |number, bit| number | (spread >> (2 * bit) & 1) << bit)
}

/// The blocks within the truncation distance of a point along each axis. Blocks too far from the origin for a [`Key`]
/// are left out.
pub(super) fn blocks_around(point: DVec3, voxel_m: f64) -> impl Iterator<Item = Key> {
    let block_m = SIDE as f64 * voxel_m;
    let reach_m = DVec3::splat(TRUNCATION * voxel_m);
    let [low, high] = [point - reach_m, point + reach_m].map(|p| (p / block_m).floor().as_ivec3());
    (low.z..=high.z).flat_map(move |z| {
        (low.y..=high.y)
            .flat_map(move |y| (low.x..=high.x).filter_map(move |x| Key::new(IVec3::new(x, y, z))))
    })
}

/// Blocks that are fused at the same time.
#[derive(Debug)]
pub(super) struct Volume {
    /// Keys of the blocks, ascending.
    keys: Vec<Key>,
    /// Voxels of all blocks, `[block, z, y, x]`.
    voxels: Vec<Voxel>,
    pub(super) voxel_m: f64,
}

impl Volume {
    /// Allocates the blocks of `keys`, which must ascend.
    pub(super) fn new(mut keys: Vec<Key>, voxel_m: f64) -> Self {
        keys.shrink_to_fit();
        assert!(keys.is_sorted(), "the keys of blocks must ascend");
        let voxels = vec![Voxel::default(); keys.len() * VOXELS];
        Self { keys, voxels, voxel_m }
    }

    /// Bytes that the volume has allocated.
    pub(super) fn bytes(&self) -> u64 {
        (self.keys.capacity() * size_of::<Key>() + self.voxels.capacity() * size_of::<Voxel>()) as u64
    }

    pub(super) fn keys(&self) -> &[Key] {
        &self.keys
    }

    /// Index of a block; `None` if the volume does not have it.
    pub(super) fn find(&self, block: IVec3) -> Option<usize> {
        self.keys.binary_search(&Key::new(block)?).ok()
    }

    /// Voxels of a block, `[z, y, x]`.
    pub(super) fn block(&self, index: usize) -> &[Voxel] {
        &self.voxels[index * VOXELS..][..VOXELS]
    }

    /// World position of a block's lowest corner.
    pub(super) fn origin(&self, block: IVec3) -> DVec3 {
        block.as_dvec3() * (SIDE as f64 * self.voxel_m)
    }

    /// Whether a view may touch a block. The pixels of the view need not be there.
    pub(super) fn is_in_view(&self, frame: &Frame) -> bool {
        let block_m = SIDE as f64 * self.voxel_m;
        self.keys.par_iter().any(|key| {
            may_see(frame, (key.block().as_dvec3() * block_m - frame.center).as_vec3(), block_m as f32)
        })
    }

    /// Fuses a view into the volume.
    pub(super) fn fuse(&mut self, frame: &Frame) {
        let Self { keys, voxels, voxel_m } = self;
        let block_m = SIDE as f64 * *voxel_m;
        keys.par_iter().zip(voxels.par_chunks_exact_mut(VOXELS)).for_each(|(key, voxels)| {
            // The block's corner relative to the camera, so that a distant world origin costs no precision.
            let origin = (key.block().as_dvec3() * block_m - frame.center).as_vec3();
            if may_see(frame, origin, block_m as f32) {
                fuse_block(frame, origin, *voxel_m as f32, voxels);
            }
        });
    }
}

/// Whether the view's frustum may touch a block. `origin` is the block's lowest corner relative to the camera's centre,
/// along the axes of the world.
fn may_see(frame: &Frame, origin: Vec3, block_m: f32) -> bool {
    // Half the diagonal of the block.
    let radius = 0.867 * block_m;
    let middle = frame.rotation * (origin + 0.5 * block_m);
    if middle.z < -radius {
        return false;
    }
    let size = Vec2::new(frame.size_px[0] as f32, frame.size_px[1] as f32);
    let (low, high) = (frame.ray(0.0, 0.0), frame.ray(size.x, size.y));
    // How far the middle of the block lies beyond each of the four planes through the camera's centre and a side of the
    // picture. Each distance is scaled by the length of its plane's normal, which is at most the length of the ray. So
    // the comparison keeps every block that the view sees.
    let beyond = [
        (low.x * middle.z - middle.x, low),
        (middle.x - high.x * middle.z, high),
        (low.y * middle.z - middle.y, low),
        (middle.y - high.y * middle.z, high),
    ];
    beyond.iter().all(|(distance, ray)| *distance < radius * ray.length())
}

fn fuse_block(frame: &Frame, origin: Vec3, voxel_m: f32, voxels: &mut [Voxel]) {
    let truncation_m = TRUNCATION as f32 * voxel_m;
    let steps = [0, 1, 2].map(|axis| frame.rotation.col(axis) * voxel_m);
    let corner = frame.rotation * origin;
    for (i, voxel) in voxels.iter_mut().enumerate() {
        let [x, y, z] = [i % SIDE, i / SIDE % SIDE, i / (SIDE * SIDE)].map(|v| v as f32);
        let p = corner + steps[0] * x + steps[1] * y + steps[2] * z;
        if p.z <= 0.0 {
            continue;
        }
        let p_px = frame.focal_px * p.truncate() / p.z + frame.center_px;
        let Some(texel) = frame.sample(p_px, truncation_m) else { continue };
        let distance = (texel.depth_m - p.z) * texel.facing / truncation_m;
        if distance > -1.0 {
            let behind = ((1.0 + distance) / FADING).clamp(0.0, 1.0);
            voxel.add(distance, texel.weight * behind, texel.rgb);
        }
    }
}

impl Voxel {
    /// A voxel that no view has measured.
    pub(super) const UNKNOWN: Self = Self { distance: 0.0, weight: 0.0, rgb: [0; 3], rgb_weight: 0 };

    #[inline]
    fn add(&mut self, distance: f32, weight: f32, [r, g, b, _]: [u8; 4]) {
        self.weight += weight;
        self.distance += (distance.min(1.0) - self.distance) * (weight / self.weight);
        // Far in front of the surface, the pixel's colour says nothing about the voxel.
        if distance < 1.0 {
            let old = f32::from(self.rgb_weight);
            let new = (old + weight * RGB_WEIGHT_UNIT).min(f32::from(u16::MAX));
            let share = (weight * RGB_WEIGHT_UNIT / new).min(1.0);
            for (mean, byte) in self.rgb.iter_mut().zip([r, g, b]) {
                let wanted = f32::from(byte) * 256.0;
                *mean = (f32::from(*mean) + (wanted - f32::from(*mean)) * share + 0.5) as u16;
            }
            self.rgb_weight = new as u16;
        }
    }

    /// Colour, 0..=255, and the weight of the colour.
    pub(super) fn color(&self) -> ([f32; 3], f32) {
        (self.rgb.map(|v| f32::from(v) / 256.0), f32::from(self.rgb_weight))
    }
}
