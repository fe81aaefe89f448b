//! Checks that the distances equal those of other implementations. The pictures, and the weights of small networks,
//! are computed from integers, so that other implementations can compute them too. The expected distances here are
//! the results of those implementations.
//!
//! With the real weights, the results come from the published implementation (`lpips` 0.1.4 under PyTorch 1.13.1):
//! it used the convolutions of the same files, and its own heads. With the weights of small networks, they come
//! from the same operations in PyTorch.
#![allow(clippy::unwrap_used)]

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use safetensors::Dtype;
use safetensors::tensor::TensorView;

use super::*;

const SIZE_PX: [u32; 2] = [80, 64];
/// The project promises distances that differ from those of the published implementation by less than this.
const TOLERANCE: f64 = 1e-3;

fn hash(i: u32) -> u32 {
    let mut i = i.wrapping_mul(2_654_435_761).wrapping_add(0x9E37_79B9);
    i = (i ^ (i >> 16)).wrapping_mul(0x85EB_CA6B);
    i = (i ^ (i >> 13)).wrapping_mul(0xC2B2_AE35);
    i ^ (i >> 16)
}

fn noise(seed: u32, [x, y, c]: [u32; 3]) -> u32 {
    hash(seed * 1_000_003 + (y * SIZE_PX[0] + x) * 3 + c) & 255
}

fn board([x, y, c]: [u32; 3]) -> u32 {
    let square = if (x / 8 + y / 8) % 2 == 1 { 200 } else { 60 };
    square - 20 * c
}

fn gradient([x, y, c]: [u32; 3]) -> u32 {
    (3 * x + 2 * y + 40 * c) % 256
}

fn picture(byte: impl Fn([u32; 3]) -> u32) -> Vec<f32> {
    let places =
        (0..SIZE_PX[1]).flat_map(|y| (0..SIZE_PX[0]).flat_map(move |x| (0..3).map(move |c| [x, y, c])));
    places.map(|place| byte(place) as f32 / 255.0).collect()
}

/// Three pairs of pictures: noise, and that noise mixed with other noise; a chessboard, and the board moved by 3 px
/// to the left and 1 px up; a gradient, and the gradient with grain.
fn pairs() -> [[Vec<f32>; 2]; 3] {
    let mixed = |p| (3 * noise(1, p) + noise(2, p)) / 4;
    let grain = |p| (7 * gradient(p) + noise(3, p)) / 8;
    [
        [picture(|p| noise(1, p)), picture(mixed)],
        [picture(board), picture(|[x, y, c]| board([x + 3, y + 1, c]))],
        [picture(gradient), picture(grain)],
    ]
}

fn assert_distances(lpips: &Lpips, expected: [f64; 3], tolerance: f64) {
    for ([a, b], expected) in pairs().iter().zip(expected) {
        let got = lpips.distance(a, b, SIZE_PX).unwrap();
        assert!((got - expected).abs() < tolerance, "{:?}: {got} is not {expected}", lpips.network);
        assert_eq!(lpips.distance(a, a, SIZE_PX), Some(0.0), "equal pictures");
    }
}

/// The folder of the weights: the one that `COSURF_LPIPS` names, or else `shared/lpips` beside the repository.
/// If it has no weights, reports the test as skipped and returns `None`.
fn weights() -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/lpips");
    let folder = std::env::var_os("COSURF_LPIPS").map_or(beside, PathBuf::from);
    if folder.join("vgg.safetensors").is_file() {
        return Some(folder);
    }
    let reason = format!("{} has no LPIPS weights; COSURF_LPIPS names another folder", folder.display());
    cosurf_tests::skips::skip("REQUIRE_DATASETS", reason);
    None
}

#[test]
fn distances_match_the_published_implementation() {
    let Some(folder) = weights() else { return };
    let LpipsPair { vgg, alex } = LpipsPair::read(&folder).unwrap();
    assert_distances(&vgg, [0.069_821, 0.346_423, 0.254_217], TOLERANCE);
    assert_distances(&alex, [0.037_193, 0.156_216, 0.047_640], TOLERANCE);
}

/// The weights of a small network: shape and values of each tensor by its name.
type Tensors = HashMap<String, (Vec<usize>, Vec<f32>)>;

fn small_tensors(network: Network) -> Tensors {
    let widths: &[usize] = match network {
        Network::Vgg => &[4, 4, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8],
        Network::Alex => &[4, 5, 6, 7, 8],
    };
    let signed = |seed: u32, i: u32| (hash(seed * 7919 + i) & 0xFFFF) as f32 / 32768.0 - 1.0;
    let mut tensors = Tensors::new();
    let (mut channels, mut heads) = (3, 0);
    for (i, (step, &width)) in network.steps().iter().zip(widths).enumerate() {
        let window = channels * step.side_px * step.side_px;
        let scale = 1.5 / (window as f32).sqrt();
        let kernel = (0..(width * window) as u32).map(|j| scale * signed(10 + i as u32, j));
        let shape = vec![width, channels, step.side_px, step.side_px];
        tensors.insert(format!("conv{i}.weight"), (shape, kernel.collect()));
        let bias = (0..width as u32).map(|j| 0.15 * signed(40 + i as u32, j)).collect();
        tensors.insert(format!("conv{i}.bias"), (vec![width], bias));
        if step.tapped {
            let weight = |j| (hash((70 + heads) * 7919 + j) & 0xFFFF) as f32 / 65536.0;
            let head = (0..width as u32).map(weight).collect();
            tensors.insert(format!("lin{heads}.weight"), (vec![width], head));
            heads += 1;
        }
        channels = width;
    }
    tensors
}

fn file_of(tensors: &Tensors) -> Vec<u8> {
    let bytes: Vec<(&String, &Vec<usize>, Vec<u8>)> = tensors
        .iter()
        .map(|(name, (shape, values))| (name, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect()))
        .collect();
    let view = |shape: &Vec<usize>, bytes| TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap();
    safetensors::serialize(bytes.iter().map(|(name, shape, bytes)| (name, view(shape, bytes))), None).unwrap()
}

#[test]
fn small_networks_match_another_implementation() {
    for (network, expected) in [
        (Network::Vgg, [0.143_381_69, 0.618_617_09, 0.029_515_40]),
        (Network::Alex, [0.226_971_97, 0.893_418_73, 0.108_672_75]),
    ] {
        let lpips = Lpips::parse(&file_of(&small_tensors(network)), network).unwrap();
        assert_distances(&lpips, expected, 1e-5);
    }
}

#[test]
fn pictures_below_the_minimum_size_have_no_distance() {
    for network in [Network::Vgg, Network::Alex] {
        let lpips = Lpips::parse(&file_of(&small_tensors(network)), network).unwrap();
        let min = network.size_min_px();
        let of_size = |size_px: [u32; 2]| {
            let gray = vec![0.5; (3 * size_px[0] * size_px[1]) as usize];
            lpips.distance(&gray, &gray, size_px)
        };
        assert_eq!(of_size([min, min]), Some(0.0));
        assert_eq!(of_size([min, min - 1]), None);
    }
}

#[test]
fn weights_of_another_network_are_refused_in_one_line() {
    let good = small_tensors(Network::Alex);
    let refused = |tensors: &Tensors| Lpips::parse(&file_of(tensors), Network::Alex).unwrap_err();
    let with = |name: &str, shape: Vec<usize>, value: f32| {
        let values = vec![value; shape.iter().product()];
        let mut tensors = good.clone();
        tensors.insert(name.into(), (shape, values));
        refused(&tensors)
    };
    let without = good.iter().filter(|(name, _)| *name != "lin3.weight");
    let without: Tensors = without.map(|(name, tensor)| (name.clone(), tensor.clone())).collect();
    assert!(refused(&without).contains("lin3.weight is missing"));
    assert!(with("conv1.weight", vec![5, 3, 5, 5], 0.0).contains("conv1.weight has the shape"));
    assert!(with("conv0.weight", vec![0, 3, 11, 11], 0.0).contains("conv0.weight has the shape"));
    assert!(with("conv2.bias", vec![6], f32::INFINITY).contains("not finite"));
    let whole = file_of(&good);
    for length in [0, 7, 100, whole.len() - 1] {
        let reason = Lpips::parse(&whole[..length], Network::Alex).unwrap_err();
        assert!(reason.contains("not a safetensors file") && !reason.contains('\n'), "{reason}");
    }
}

#[test]
fn a_missing_file_is_named_with_its_remedy() {
    let error = LpipsPair::read(Path::new("no/such/folder")).unwrap_err().to_string();
    assert!(error.contains("vgg.safetensors") && error.contains("--lpips"), "{error}");
    assert_eq!(error.lines().count(), 1);
}
