//! The materials that objects all over the city share.

use glam::Vec3;

use super::material::Material;
use super::mesh::Mesh;
use super::random::Rng;

/// Indices of shared materials.
#[derive(Clone, Debug)]
pub(super) struct Palette {
    pub(super) white: u32,
    pub(super) dark: u32,
    pub(super) steel: u32,
    pub(super) concrete: u32,
    pub(super) stone: u32,
    pub(super) brick: u32,
    pub(super) terracotta: u32,
    pub(super) wood: u32,
    pub(super) bark: u32,
    pub(super) straw: u32,
    pub(super) glass: u32,
    pub(super) water: u32,
    pub(super) solar: u32,
    pub(super) fence: u32,
    pub(super) hedge: u32,
    pub(super) conifer: u32,
    /// Broad leaves of several species.
    pub(super) leaves: Vec<u32>,
    /// Car bodies.
    pub(super) paints: Vec<u32>,
    /// Awnings and containers.
    pub(super) stripes: Vec<u32>,
}

impl Palette {
    pub(super) fn new(mesh: &mut Mesh, rng: &mut Rng) -> Self {
        let mut plain = |rgb: [f32; 3], contrast| {
            let seed = rng.seed();
            mesh.add(Material::Plain { albedo: Vec3::from(rgb), contrast, seed })
        };
        let [white, dark] = [plain([0.62, 0.61, 0.58], 0.12), plain([0.035, 0.035, 0.038], 0.2)];
        let [steel, concrete] = [plain([0.33, 0.34, 0.35], 0.16), plain([0.34, 0.33, 0.30], 0.25)];
        let [stone, brick] = [plain([0.40, 0.36, 0.29], 0.25), plain([0.24, 0.11, 0.075], 0.3)];
        let [terracotta, wood] = [plain([0.36, 0.15, 0.08], 0.15), plain([0.21, 0.13, 0.075], 0.3)];
        let [bark, straw] = [plain([0.105, 0.08, 0.055], 0.35), plain([0.46, 0.36, 0.16], 0.3)];
        let mut leaves = |rgb: [f32; 3]| {
            let seed = rng.seed();
            mesh.add(Material::Leaves { albedo: Vec3::from(rgb), seed })
        };
        let hedge = leaves([0.05, 0.085, 0.024]);
        let conifer = leaves([0.032, 0.062, 0.032]);
        let crowns = [
            [0.062, 0.105, 0.026],
            [0.085, 0.125, 0.030],
            [0.050, 0.088, 0.030],
            [0.115, 0.130, 0.034],
            [0.070, 0.095, 0.050],
            [0.120, 0.062, 0.036],
        ];
        let crowns = crowns.map(leaves);
        // Common species are listed several times.
        let leaves = [0, 1, 2, 0, 1, 2, 3, 4, 0, 1, 2, 5].map(|species| crowns[species]).to_vec();
        let paints = [
            [0.60, 0.60, 0.60],
            [0.30, 0.31, 0.33],
            [0.10, 0.105, 0.11],
            [0.022, 0.023, 0.026],
            [0.34, 0.022, 0.020],
            [0.025, 0.06, 0.22],
            [0.05, 0.10, 0.075],
            [0.48, 0.40, 0.26],
            [0.55, 0.24, 0.03],
            [0.18, 0.30, 0.42],
        ];
        let paints = paints.map(|rgb| mesh.add(Material::Paint(Vec3::from(rgb))));
        let paints = [0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 4, 5, 9, 6, 7, 4, 8].map(|paint| paints[paint]).to_vec();
        let pale = Vec3::new(0.62, 0.60, 0.54);
        let mut striped = |albedos: [Vec3; 2], width_m: f32| mesh.add(Material::Stripes { albedos, width_m });
        let stripes = [[0.40, 0.05, 0.04], [0.05, 0.14, 0.34], [0.08, 0.26, 0.12], [0.52, 0.36, 0.05]]
            .map(|rgb| striped([Vec3::from(rgb), pale], 0.42))
            .to_vec();
        let fence = striped([Vec3::new(0.24, 0.15, 0.085), Vec3::new(0.17, 0.105, 0.06)], 0.16);
        Self {
            white,
            dark,
            steel,
            concrete,
            stone,
            brick,
            terracotta,
            wood,
            bark,
            straw,
            glass: mesh.add(Material::Glass),
            water: mesh.add(Material::Water),
            solar: mesh.add(Material::Solar),
            fence,
            hedge,
            conifer,
            leaves,
            paints,
            stripes,
        }
    }
}
