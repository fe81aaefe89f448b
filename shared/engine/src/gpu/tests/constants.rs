//! Compares every constant of the shaders with its counterpart in Rust. A constant without a counterpart must be listed
//! in [`SHADERS_ONLY`].

use std::collections::BTreeMap;
use std::f32::consts::{LN_2, LOG2_E};

use cosurf_scene::picture::MASKED;
use naga::front::wgsl;
use naga::{Expression, Handle, Literal, Module};

use crate::backend::{BETA_1, BETA_2, EPSILON, PatchSide};
use crate::budget::PARTIALS;
use crate::gpu::context::SUBGROUPS;
use crate::gpu::pass::Constants;
use crate::gpu::recorder::GROUPS_MAX;
use crate::gpu::sort::{BLOCK, DIGITS, GROUP};
use crate::gpu::structs::{PAIRS, PAIRS_WANTED, SPLATS, VISIBLE};
use crate::gpu::surface::{SAMPLES_AT_ONCE, reach_of};
use crate::gpu::train::{PIPELINED, SUMS};
use crate::layout::constants::{
    ALPHA_MAX, ALPHA_MIN, DISAGREEMENT_MAX, GRAZING, LOW_PASS_PX2, LUMA_WEIGHTS, MASKED_LUMA, NEAR,
    NORMAL_REACH, OBSERVED_TRANSMITTANCE, PATCH_MAX, RETURN_MAX_PX, SLACK_PX, SSIM_C1, SSIM_C2, SSIM_REACH,
    SSIM_TAPS, SURFACE_ALPHA, TRANSMITTANCE_MIN, VARIANCES_MIN, ssim_window,
};
use crate::layout::harmonics;
use crate::layout::planes::{DISTANCE, NORMAL, PLANES_GEOMETRY, TRANSMITTANCE};
use crate::layout::rows::{
    GRADIENT_RGB, GRADIENT_ROWS, HITS, LOG_SCALE, MEAN, OBSERVED, OPACITY, QUAT, RECORD_LEN, SQUARED_WEIGHT,
    STAT_ABSOLUTE_GRADIENT, STAT_SCREEN_GRADIENT, STAT_VIEWS,
};
use crate::layout::tiles::TILE;

/// The value of a constant: an integer, or one or several floats.
#[derive(Clone, Debug, PartialEq)]
enum Value {
    Integer(u64),
    Floats(Vec<f32>),
}

impl From<usize> for Value {
    fn from(value: usize) -> Self {
        Self::Integer(value as u64)
    }
}

impl From<u32> for Value {
    fn from(value: u32) -> Self {
        Self::Integer(value.into())
    }
}

impl From<f32> for Value {
    fn from(value: f32) -> Self {
        Self::Floats(vec![value])
    }
}

impl<const N: usize> From<[f32; N]> for Value {
    fn from(values: [f32; N]) -> Self {
        Self::Floats(values.to_vec())
    }
}

/// `pairs! { NAME … }`: constants that have one name in Rust and in the shaders.
macro_rules! pairs {
    ($($name:ident)*) => {
        [$((stringify!($name), Value::from($name))),*]
    };
}

/// Expected values of the shaders' constants, by name.
fn shared() -> BTreeMap<&'static str, Value> {
    let same = pairs! {
        TILE GROUP BLOCK DIGITS NEAR ALPHA_MIN ALPHA_MAX TRANSMITTANCE_MIN LOW_PASS_PX2 LN_2 SPLATS VISIBLE PAIRS_WANTED
        PAIRS MEAN QUAT LOG_SCALE OPACITY TRANSMITTANCE NORMAL DISTANCE PLANES_GEOMETRY GRADIENT_RGB GRADIENT_ROWS
        STAT_SCREEN_GRADIENT STAT_VIEWS STAT_ABSOLUTE_GRADIENT SQUARED_WEIGHT HITS OBSERVED OBSERVED_TRANSMITTANCE
        SLACK_PX GRAZING SURFACE_ALPHA NORMAL_REACH SSIM_REACH SSIM_TAPS SSIM_C1 SSIM_C2 LUMA_WEIGHTS PARTIALS
        RECORD_LEN SAMPLES_AT_ONCE RETURN_MAX_PX PATCH_MAX VARIANCES_MIN DISAGREEMENT_MAX MASKED_LUMA BETA_1
        BETA_2 EPSILON
    };
    let renamed = [
        ("TILE_PIXELS", (TILE * TILE).into()),
        ("LOG2_ALPHA_MIN", ((1.0f64 / 255.0).log2() as f32).into()),
        ("LOG2_E", LOG2_E.into()),
        ("GROUPS_ACROSS", GROUPS_MAX.into()),
        ("RECORD_VECTORS", (RECORD_LEN / 4).into()),
        ("LOSS_VECTORS", (SUMS / 4).into()),
        ("MASKED", u32::from_le_bytes([MASKED[0], MASKED[1], MASKED[2], 0]).into()),
        ("SSIM_WINDOW", ssim_window().into()),
        ("SH_C0", harmonics::C0.into()),
        ("SH_C1", harmonics::C1.into()),
        ("SH_C2", harmonics::C2.into()),
        ("SH_C3", harmonics::C3.into()),
    ];
    same.into_iter().chain(renamed).collect()
}

/// Constants that only the shaders have: sizes for the division of work within a pass, and markers that the CPU never
/// reads.
const SHADERS_ONLY: [&str; 8] =
    ["NOT_SEEN", "HALF_BITS", "ROWS", "NOWHERE", "SSIM_SIDE", "LANES", "PIXELS", "BATCH"];

fn integer_or_floats(module: &Module, at: Handle<Expression>) -> Option<Value> {
    match &module.global_expressions[at] {
        Expression::Literal(Literal::U32(value)) => Some((*value).into()),
        Expression::Literal(Literal::F32(value)) => Some((*value).into()),
        Expression::Compose { components, .. } => {
            let parts = components.iter().map(|part| match integer_or_floats(module, *part)? {
                Value::Floats(values) => Some(values),
                Value::Integer(_) => None,
            });
            Some(Value::Floats(parts.collect::<Option<Vec<_>>>()?.concat()))
        }
        _ => None,
    }
}

/// The named constants of a source with their values; `None` for a value that is neither an integer nor floats.
fn constants(source: &str) -> Vec<(String, Option<Value>)> {
    let module = wgsl::parse_str(source).unwrap_or_else(|error| panic!("{}", error.emit_to_string(source)));
    let named = |(_, constant): (_, &naga::Constant)| {
        Some((constant.name.clone()?, integer_or_floats(&module, constant.init)))
    };
    module.constants.iter().filter_map(named).collect()
}

/// The error in a constant of the shaders, if any.
fn fault(name: &str, value: Option<&Value>, shared: &BTreeMap<&str, Value>) -> Option<String> {
    match shared.get(name) {
        Some(expected) if value == Some(expected) => None,
        Some(expected) => Some(format!("{name} is {value:?}, in Rust {expected:?}")),
        None if SHADERS_ONLY.contains(&name) => None,
        None => Some(format!("{name} is in no list")),
    }
}

#[test]
fn rust_and_shaders_have_the_same_constants() {
    let shared = shared();
    let mut seen = Vec::new();
    for shader in cosurf_shaders::ALL {
        for (name, value) in constants(shader.source) {
            assert_eq!(fault(&name, value.as_ref(), &shared), None, "{}", shader.name);
            seen.push(name);
        }
    }
    for name in shared.keys().copied().chain(SHADERS_ONLY) {
        assert!(seen.iter().any(|other| other == name), "no shader has {name}");
    }
}

#[test]
fn the_comparison_of_constants_detects_wrong_and_unknown_ones() {
    let (shared, found) =
        (shared(), constants("const NEAR: f32 = 0.3; const TILE: u32 = 8u + 8u; const X = 1u;"));
    let faults = found.iter().map(|(name, value)| fault(name, value.as_ref(), &shared).is_some());
    assert_eq!(faults.collect::<Vec<_>>(), [true, false, true]);
}

#[test]
fn every_override_is_set_and_every_setting_has_an_override() {
    for constants in PIPELINED {
        for shader in [cosurf_shaders::RASTERIZE_BACKWARD, cosurf_shaders::SCORE] {
            assert_set(shader, constants);
        }
        let product: f64 = constants.iter().map(|(_, value)| value).product();
        assert!(product <= (TILE * TILE) as f64, "pairs would meet in a chunk of pixels");
    }
    for patch in [PatchSide::Px3, PatchSide::Px7] {
        assert_set(cosurf_shaders::MULTIVIEW, reach_of(patch));
    }
    for (size, constants) in SUBGROUPS {
        assert_set(cosurf_shaders::RASTERIZE_BACKWARD_BY_PIXEL, constants);
        assert_eq!(constants[0].1, f64::from(size));
    }
}

/// Asserts that `constants` sets each override of a shader, and nothing else.
fn assert_set(shader: cosurf_shaders::Shader, constants: Constants) {
    let module = wgsl::parse_str(shader.source).expect("it is valid");
    let mut names: Vec<&str> = module.overrides.iter().filter_map(|(_, over)| over.name.as_deref()).collect();
    let mut set: Vec<&str> = constants.iter().map(|(name, _)| *name).collect();
    [&mut names, &mut set].into_iter().for_each(|names| names.sort_unstable());
    assert_eq!(names, set, "{}", shader.name);
}
