//! Every shader is valid, stays within the default limits of WebGPU, and has the same structure layouts as Rust.

use naga::front::wgsl;
use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{AddressSpace, Module, TypeInner};

use crate::gpu::structs::{
    BackwardWeights, EditStep, LossSettings, Pair, Projected, Rates, ScanStep, SortStep, SurfaceWeights, View,
};

/// Largest number of storage buffers that a pass may bind: WebGPU's default limit.
const STORAGE_BUFFERS_MAX: usize = 8;
/// Largest memory of a workgroup, bytes: WebGPU's default limit.
const GROUP_BYTES_MAX: u32 = 16_384;

fn parsed(source: &str) -> Module {
    wgsl::parse_str(source).unwrap_or_else(|error| panic!("{}", error.emit_to_string(source)))
}

#[test]
fn every_shader_is_valid_and_portable() {
    for shader in cosurf_shaders::ALL {
        let module = parsed(shader.source);
        let capabilities = match shader == &cosurf_shaders::RASTERIZE_BACKWARD_BY_PIXEL {
            true => Capabilities::SUBGROUP,
            false => Capabilities::empty(),
        };
        let info = Validator::new(ValidationFlags::all(), capabilities).validate(&module);
        assert!(
            info.is_ok(),
            "{}: {}",
            shader.name,
            info.expect_err("invalid").emit_to_string(shader.source)
        );
        assert_eq!(module.entry_points.len(), 1, "{}", shader.name);
        assert_eq!(module.entry_points[0].name, shader.name, "a pass is called like its file");
        let globals = || module.global_variables.iter().map(|(_, global)| global);
        let storage = globals().filter(|global| matches!(global.space, AddressSpace::Storage { .. })).count();
        assert!(storage <= STORAGE_BUFFERS_MAX, "{} binds {storage} storage buffers", shader.name);
        let group_bytes: u32 = globals()
            .filter(|global| global.space == AddressSpace::WorkGroup)
            .map(|global| module.types[global.ty].inner.size(module.to_ctx()))
            .sum();
        assert!(group_bytes <= GROUP_BYTES_MAX, "{}: {group_bytes} bytes of a group's memory", shader.name);
    }
}

/// Names and offsets of the fields of a structure, and its size, bytes, as a shader sees them.
fn layout_in(module: &Module, structure: &str) -> (Vec<(String, u32)>, u32) {
    let (_, found) = module
        .types
        .iter()
        .find(|(_, ty)| ty.name.as_deref() == Some(structure))
        .unwrap_or_else(|| panic!("no {structure}"));
    let TypeInner::Struct { members, span } = &found.inner else { panic!("{structure} is no structure") };
    let fields = members.iter().map(|m| (m.name.clone().expect("a name"), m.offset)).collect();
    (fields, *span)
}

/// Names and offsets of the listed fields of a Rust structure, and its size, bytes.
macro_rules! layout_of {
    ($structure:ident: $($field:ident)*) => {
        (
            vec![$((stringify!($field).to_owned(), std::mem::offset_of!($structure, $field) as u32)),*],
            size_of::<$structure>() as u32,
        )
    };
}

/// Asserts that each structure has the listed fields at the same offsets in Rust and in the shaders.
macro_rules! laid_out_alike {
    ($module:expr, $($structure:ident: $($field:ident)*;)*) => {
        $(assert_eq!(
            layout_in($module, stringify!($structure)),
            layout_of!($structure: $($field)*),
            stringify!($structure)
        );)*
    };
}

#[test]
fn rust_and_shaders_lay_structures_out_alike() {
    laid_out_alike! { &parsed(cosurf_shaders::PROJECT.source),
        View: cam_from_world eye sh_degree focal_px center_px slope_min slope_max size_px tiles splats splat_stride
            pair_capacity planes far unused_1 unused_2 unused_3;
        Projected: mean_px extent_px falloff log2_opacity rgb falloff_max normal plane_distance;
        SortStep: counter shift;
        ScanStep: counter digits total unused;
        Rates: mean quat log_scale opacity sh_dc sh_rest first_correction second_correction;
        BackwardWeights: scale;
        LossSettings: gain offset l1_weight ssim_weight is_floats unused_1 unused_2 unused_3;
        SurfaceWeights: normal reprojection ncc teacher_depth teacher_normal samples sums_first cell_px draw;
        EditStep: first_row rows splat_stride moves copied;
        Pair: there_from_here focal_px center_px size_px unused_1 unused_2;
    }
    // The comparison must also notice fields in another order.
    let moved = parsed("struct SortStep { shift: u32, counter: u32 } @compute @workgroup_size(1) fn f() {}");
    assert_ne!(layout_in(&moved, "SortStep"), layout_of!(SortStep: counter shift));
}
