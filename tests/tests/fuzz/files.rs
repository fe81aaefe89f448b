//! Fuzzes the readers of files that users provide: PLY, SPZ, COLMAP, transforms.json, reconstruction.json, and the cameras of
//! Metashape and RealityCapture.

use std::fs;
use std::io::{Read, Write};
use std::path::Path;

use cosurf_scene::colmap::{self, Form};
use cosurf_scene::{Dataset, LocalFrame, Mesh, model, ply, spz};
use cosurf_tests::dice::Dice;
use cosurf_tests::models::random_splats;
use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;

use crate::runner::{Target, hammer};

/// Limit on a reader's memory, bytes: 1 MiB for its buffers, and 32 bytes for each byte of the file.
pub(crate) const FILE_BYTES_MAX: fn(usize) -> usize = |bytes| (1 << 20) + 32 * bytes;

/// A temporary folder, which lies in memory if the system has `/dev/shm`.
pub(crate) fn folder() -> tempfile::TempDir {
    let shared = Path::new("/dev/shm");
    if shared.is_dir() { tempfile::tempdir_in(shared).unwrap() } else { tempfile::tempdir().unwrap() }
}

fn target(name: &str, samples: Vec<Vec<u8>>) -> Target<'_> {
    Target { name, samples, reseal: |_| (), bytes_max: FILE_BYTES_MAX }
}

/// The bytes of the file that `write` writes to `path`.
fn written(path: &Path, write: impl FnOnce(&Path)) -> Vec<u8> {
    write(path);
    fs::read(path).unwrap()
}

const ASCII_MESH: &[u8] =
    b"ply\nformat ascii 1.0\ncomment c\nelement vertex 3\nproperty float x\nproperty double y\n\
property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n\
property list uchar int vertex_indices\nend_header\n0 0 0 1 2 3\n1 0 0 4 5 6\n0 1e-1 0 7 8 9\n3 0 1 2\n";

#[test]
fn ply_files_are_read_or_refused() {
    let folder = folder();
    let path = folder.path().join("a.ply");
    let models = [(0, 0), (3, 0), (5, 1), (2, 3)].map(|(count, degree)| {
        written(&path, |path| ply::write(path, &random_splats(1, count, degree), &LocalFrame::WORLD).unwrap())
    });
    let mut samples = Vec::from(models);
    fs::write(&path, ASCII_MESH).unwrap();
    let mesh = Mesh::read(&path).unwrap();
    samples.push(written(&path, |path| mesh.write_ply(path).unwrap()));
    samples.push(ASCII_MESH.to_vec());
    hammer(target("PLY", samples), |bytes| {
        fs::write(&path, bytes).unwrap();
        let splats = ply::read(&path, &LocalFrame::WORLD);
        if let Ok(splats) = &splats {
            assert_eq!(splats.find_bad_value(), None);
        }
        let has_points = ply::read_points(&path).is_ok();
        let has_mesh = Mesh::read(&path).is_ok();
        splats.is_ok() || has_points || has_mesh
    });
}

/// A file whose words of 32 bits are random, with harmonics of degree 1, in the layout of SuperSplat.
fn compressed_ply(count: usize) -> Vec<u8> {
    let floats =
        |names: &[&str]| names.iter().map(|name| format!("property float {name}\n")).collect::<String>();
    let ends = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];
    let bounds: Vec<String> = ends
        .chunks(3)
        .flat_map(|of| ["min", "max"].map(|end| of.iter().map(move |name| format!("{end}_{name}"))))
        .flatten()
        .collect();
    let bounds: Vec<&str> = bounds.iter().map(String::as_str).collect();
    let mut text = format!("ply\nformat binary_little_endian 1.0\nelement chunk {}\n", count.div_ceil(256));
    text += &floats(&bounds);
    text += &format!("element vertex {count}\n");
    for name in ["position", "rotation", "scale", "color"] {
        text += &format!("property uint packed_{name}\n");
    }
    text += &format!("element sh {count}\n");
    (0..9).for_each(|i| text += &format!("property uchar f_rest_{i}\n"));
    let mut bytes = (text + "end_header\n").into_bytes();
    let mut dice = Dice(7);
    bytes.extend((0..count.div_ceil(256) * bounds.len()).flat_map(|i| (i as f32 - 9.0).to_le_bytes()));
    bytes.extend((0..count * (16 + 9)).map(|_| dice.bits() as u8));
    bytes
}

#[test]
fn compressed_ply_files_are_read_or_refused() {
    let folder = folder();
    let path = folder.path().join("a.compressed.ply");
    let limits = Target {
        bytes_max: |bytes| (1 << 20) + 400 * bytes,
        ..target("compressed PLY", [1, 40].map(compressed_ply).into())
    };
    hammer(limits, |bytes| {
        fs::write(&path, bytes).unwrap();
        let splats = model::read(&path, &LocalFrame::WORLD);
        if let Ok(splats) = &splats {
            assert_eq!(splats.find_bad_value(), None);
        }
        splats.is_ok()
    });
}

/// Changes head and table more often than the streams of zstd, whose library has its own tests: most samples are short.
#[test]
fn spz_files_of_version_4_are_read_or_refused() {
    let folder = folder();
    let path = folder.path().join("a.spz");
    let samples = [(1, 0), (3, 1), (2, 3)].map(|(count, degree)| {
        written(&path, |path| spz::write(path, &random_splats(1, count, degree), spz::Version::V4).unwrap())
    });
    let limits = Target { bytes_max: |bytes| (1 << 20) + 400 * bytes, ..target("SPZ 4", samples.into()) };
    hammer(limits, |bytes| {
        fs::write(&path, bytes).unwrap();
        let splats = spz::read(&path);
        if let Ok(splats) = &splats {
            assert_eq!(splats.find_bad_value(), None);
        }
        splats.is_ok()
    });
}

/// Changes the bytes before they are compressed by gzip. Changes of the compressed stream would only test the gzip
/// decoder.
#[test]
fn spz_files_are_read_or_refused() {
    let folder = folder();
    let path = folder.path().join("a.spz");
    let unpacked = |bytes: Vec<u8>| {
        let mut out = Vec::new();
        GzDecoder::new(&bytes[..]).read_to_end(&mut out).unwrap();
        out
    };
    let samples = [(0, 0), (3, 0), (5, 1), (2, 3)].map(|(count, degree)| {
        unpacked(written(&path, |path| {
            spz::write(path, &random_splats(1, count, degree), spz::Version::V3).unwrap()
        }))
    });
    let limits = Target { bytes_max: |bytes| (1 << 20) + 400 * bytes, ..target("SPZ", samples.into()) };
    hammer(limits, |bytes| {
        let mut gzip = GzEncoder::new(fs::File::create(&path).unwrap(), Compression::fast());
        gzip.write_all(bytes).unwrap();
        drop(gzip.finish().unwrap());
        let splats = spz::read(&path);
        if let Ok(splats) = &splats {
            assert_eq!(splats.find_bad_value(), None);
        }
        splats.is_ok()
    });
}

/// Fuzzes each of the three files of a COLMAP model in turn. The files stay in memory, because opening files takes
/// five times as long as decoding them.
fn hammer_colmap(form: Form, files: [(&str, Vec<u8>); 3]) {
    for (i, (name, right)) in files.iter().enumerate() {
        hammer(target(&format!("COLMAP {name}"), vec![right.clone()]), |bytes| {
            let mut model = files.each_ref().map(|(_, right)| &right[..]);
            model[i] = bytes;
            colmap::parse(form, model).is_ok_and(|dataset| !dataset.views.is_empty())
        });
    }
}

fn colmap_text() -> [(&'static str, Vec<u8>); 3] {
    [
        (
            "cameras.txt",
            b"# c\n1 PINHOLE 640 480 500 501.5 320 240\n2 SIMPLE_PINHOLE 64 48 50 32 24\n".to_vec(),
        ),
        (
            "images.txt",
            b"1 1 0 0 0 0.5 -1e3 7 1 a.jpg\n10 20 1 30.5 40 -1\n2 0.9 0.1 0 0 1 2 3 2 b/c.jpg\n\n".to_vec(),
        ),
        ("points3D.txt", b"1 0.5 1.5 -2 10 20 30 0.7 1 0 2 5\n9 1 1 1 0 0 0 0 1 1\n".to_vec()),
    ]
}

#[test]
fn colmap_texts_are_read_or_refused() {
    hammer_colmap(Form::Text, colmap_text());
}

#[test]
fn colmap_binaries_are_read_or_refused() {
    hammer_colmap(Form::Binary, colmap_binary());
}

/// The binary files of a COLMAP model with two views and one point.
fn colmap_binary() -> [(&'static str, Vec<u8>); 3] {
    let (u32s, u64s) = (|v: u32| v.to_le_bytes().to_vec(), |v: u64| v.to_le_bytes().to_vec());
    let f64s = |values: &[f64]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let camera = [u32s(1), u32s(1), u64s(640), u64s(480), f64s(&[500.0, 501.5, 320.0, 240.0])].concat();
    let view = |id: u32, name: &str| {
        let pose = f64s(&[1.0, 0.0, 0.0, 0.0, 0.5, -1.0, 7.0]);
        let keypoint = [f64s(&[10.0, 20.0]), u64s(4)].concat();
        [u32s(id), pose, u32s(1), name.as_bytes().to_vec(), vec![0], u64s(1), keypoint].concat()
    };
    let images = [u64s(2), view(1, "a.jpg"), view(2, "b/c.jpg")].concat();
    let track = [u64s(2), u32s(1), u32s(0), u32s(2), u32s(0)].concat();
    let point = [u64s(4), f64s(&[0.5, 1.5, -2.0]), vec![10, 20, 30], f64s(&[0.7]), track].concat();
    [
        ("cameras.bin", [u64s(1), camera].concat()),
        ("images.bin", images),
        ("points3D.bin", [u64s(1), point].concat()),
    ]
}

#[test]
fn transforms_are_read_or_refused() {
    let text = br#"{"w": 64, "h": 48, "fl_x": 50, "fl_y": 50.5, "cx": 32, "cy": 24, "frames": [
{"file_path": "a.jpg", "transform_matrix": [[1,0,0,0.5],[0,1,0,2],[0,0,1,-3],[0,0,0,1]]}]}"#;
    let folder = folder();
    let path = folder.path().join("transforms.json");
    hammer(target("transforms.json", vec![text.to_vec()]), |bytes| {
        fs::write(&path, bytes).unwrap();
        Dataset::cameras(&path).is_ok()
    });
}

#[test]
fn reconstructions_of_opensfm_are_read_or_refused() {
    let text = br#"[{"cameras": {"v2": {"projection_type": "brown", "width": 64, "height": 48, "focal_x": 0.8, "focal_y": 0.8,
"c_x": 0.1, "c_y": 0.0, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}}, "shots": {"a.jpg": {"camera": "v2",
"rotation": [0.1, 0.2, 3.0], "translation": [1, 2, 3]}}, "points": {"1": {"coordinates": [1, 2, 3], "color": [1, 2, 3]}}}]"#;
    let folder = folder();
    let path = folder.path().join("reconstruction.json");
    let limits = Target {
        bytes_max: |bytes| (1 << 20) + 200 * bytes,
        ..target("reconstruction.json", vec![text.to_vec()])
    };
    hammer(limits, |bytes| {
        fs::write(&path, bytes).unwrap();
        Dataset::cameras(&path).is_ok()
    });
}

#[test]
fn cameras_of_metashape_are_read_or_refused() {
    let text = r#"<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk><sensors><sensor id="0" type="frame">
<calibration class="adjusted"><resolution width="64" height="48"/><f>50</f><cx>1</cx><cy>-1</cy><k1>0</k1></calibration></sensor>
</sensors><components><component id="0"><transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>1 2 3</translation>
<scale>2</scale></transform></component></components><cameras><camera id="0" sensor_id="0" component_id="0" label="a.jpg">
<transform>1 0 0 0.5 0 1 0 2 0 0 1 -3 0 0 0 1</transform></camera></cameras></chunk></document>"#;
    read_or_refused("cameras.xml", text);
}

#[test]
fn cameras_of_realitycapture_are_read_or_refused() {
    let folder = folder();
    cosurf_scene::Picture::new([64, 48], vec![9; 64 * 48 * 3])
        .write_jpeg(&folder.path().join("a.jpg"), 90)
        .unwrap();
    let csv = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\na.jpg,1,2,3,10,20,30,35,0.1,0.2,0,0,0,0,0,0\n";
    let path = folder.path().join("cameras.csv");
    hammer(target("cameras.csv", vec![csv.into()]), |bytes| {
        fs::write(&path, bytes).unwrap();
        Dataset::cameras(&path).is_ok()
    });
    fs::remove_file(path).unwrap();
    let xmp = r#"<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xcr:DistortionModel="brown3" xcr:FocalLength35mm="35" xcr:Rotation="1 0 0 0 1 0 0 0 1"
xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Position>1 2 3</xcr:Position></rdf:Description></rdf:RDF></x:xmpmeta>"#;
    hammer(target("a.xmp", vec![xmp.into()]), |bytes| {
        fs::write(folder.path().join("a.xmp"), bytes).unwrap();
        Dataset::cameras(folder.path()).is_ok()
    });
}

fn read_or_refused(name: &str, sample: &str) {
    let folder = folder();
    let path = folder.path().join(name);
    hammer(target(name, vec![sample.into()]), |bytes| {
        fs::write(&path, bytes).unwrap();
        Dataset::cameras(&path).is_ok()
    });
}
