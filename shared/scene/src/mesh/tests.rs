//! Tests of round trips, of files as other tools write them, of damaged or forged files, and of
//! glTF's requirements.

#![allow(clippy::unwrap_used)]

use std::fs;

use glam::{DVec3, Quat, Vec3};
use serde_json::Value;

use super::*;

/// A corner of a box: three triangles that share a vertex, with colours, and with normals of which
/// one is unknown.
fn corner() -> Mesh {
    Mesh {
        positions: vec![[0.0; 3], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 4.0]],
        normals: vec![[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0; 3]],
        rgb: vec![[0, 1, 2], [30, 40, 50], [128, 128, 128], [255, 0, 255]],
        triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2]],
        ..Mesh::default()
    }
}

fn read_bytes(content: &[u8]) -> Result<Mesh, SceneError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    fs::write(&path, content).unwrap();
    Mesh::read(&path)
}

fn written(mesh: &Mesh, name: &str) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    mesh.write(&path).unwrap();
    fs::read(path).unwrap()
}

#[test]
fn meshes_and_clouds_survive_the_round_trip() {
    let bare = Mesh { normals: Vec::new(), rgb: Vec::new(), ..corner() };
    let cloud = Mesh { triangles: Vec::new(), ..corner() };
    for mesh in [corner(), bare, cloud, Mesh::default()] {
        assert_eq!(read_bytes(&written(&mesh, "a.ply")).unwrap(), mesh);
    }
}

#[test]
fn a_mesh_in_parts_gives_the_same_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let far = Mesh { origin: DVec3::new(500_000.0, 5_200_000.0, 0.0), ..corner() };
    let bare = Mesh { normals: Vec::new(), rgb: Vec::new(), ..corner() };
    for mesh in [corner(), far, bare] {
        let part = |range: std::ops::Range<usize>| Mesh {
            positions: mesh.positions[range.clone()].to_vec(),
            normals: mesh.normals.get(range.clone()).unwrap_or_default().to_vec(),
            rgb: mesh.rgb.get(range).unwrap_or_default().to_vec(),
            triangles: Vec::new(),
            ..mesh
        };
        let written_in_parts =
            part(0..1).write_ply_parts(&path, MeshCounts { vertices: 4, triangles: 3 }, |ply| {
                ply.vertices(&part(0..3))?;
                ply.vertices(&part(3..4))?;
                ply.triangles(&mesh.triangles[..1])?;
                ply.triangles(&mesh.triangles[1..])
            });
        written_in_parts.map_err(|error: SceneError| error).unwrap();
        assert_eq!(fs::read(&path).unwrap(), written(&mesh, "b.ply"));
        assert_eq!(Mesh::read(&path).unwrap(), mesh);
    }
    let nothing = corner().write_ply_parts(&path, MeshCounts::default(), |_| {
        Err(SceneError::malformed(&folder.path().join("other"), "is not there"))
    });
    assert!(nothing.unwrap_err().to_string().contains("other"), "the error is that of the parts");
    assert!(path.exists() && fs::read_dir(folder.path()).unwrap().count() == 1, "the file before stays");
}

/// By the specification of Wavefront, vertices are counted from 1, and a face names vertex and normal.
#[test]
fn an_obj_is_text_with_positions_colours_normals_and_faces() {
    let lines = |mesh: &Mesh| {
        String::from_utf8(written(mesh, "a.obj")).unwrap().lines().map(str::to_owned).collect::<Vec<_>>()
    };
    let found = lines(&corner());
    assert_eq!(found[2], "v 2 0 0 0.1176 0.1569 0.1961");
    assert_eq!((&*found[5], &*found[9]), ("vn 0.0000 0.0000 -1.0000", "f 1//1 3//3 2//2"));
    assert_eq!(found.len(), 1 + 4 + 4 + 3);
    let origin = DVec3::new(500_000.0, 5_200_000.0, 0.0);
    let far = Mesh { origin, normals: Vec::new(), rgb: Vec::new(), ..corner() };
    let found = lines(&far);
    assert_eq!((&*found[2], &*found[5]), ("v 500002.0000 5200000.0000 0.0000", "f 1 3 2"));
}

/// Coordinates of UTM keep their millimetres in a PLY, and the node of a GLB holds them in double precision.
#[test]
fn meshes_far_from_the_origin_keep_their_millimetres() {
    let origin = DVec3::new(500_000.0, 5_200_000.0, 0.0);
    let far = Mesh { origin, positions: vec![[0.001, 0.0, 412.25], [2.0, 0.5, 0.0], [0.0; 3]], ..corner() };
    let far = Mesh { normals: Vec::new(), rgb: Vec::new(), triangles: vec![[0, 1, 2]], ..far };
    let read = read_bytes(&written(&far, "a.ply")).unwrap();
    assert_eq!(read.origin, origin);
    for (read, expected) in read.positions.iter().zip(&far.positions) {
        assert!((0..3).all(|k| (read[k] - expected[k]).abs() < 1e-4), "{read:?} for {expected:?}");
    }
    let text = String::from_utf8_lossy(&written(&far, "a.glb")).into_owned();
    assert!(text.contains(r#""translation":[500000.0,0.0,-5200000.0]"#), "{text}");
    assert!(!String::from_utf8_lossy(&written(&corner(), "a.glb")).contains("translation"));
    let mut moved = read;
    moved.move_origin(origin + DVec3::X * 1000.0);
    assert_eq!(moved.positions[1], [-998.0, 0.5, 0.0]);
}

#[test]
fn other_tools_meshes_are_read() {
    let text = "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 4\nproperty double x\nproperty double y\n\
        property double z\nproperty float quality\nelement face 2\nproperty uchar flags\n\
        property list int uint vertex_index\nproperty list uchar float texcoord\nelement edge 1\n\
        property int vertex1\nend_header\n\
        0 0 0 1\n1 0 0 1\n1 1 0 1\n0 1 0.5 1\n7 4 0 1 2 3 2 0.5 0.5\n7 3 2 1 0 0\n1\n";
    let mesh = read_bytes(text.as_bytes()).unwrap();
    assert_eq!(mesh.positions[3], [0.0, 1.0, 0.5]);
    assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3], [2, 1, 0]]);
    assert!(mesh.normals.is_empty() && mesh.rgb.is_empty());
}

#[test]
fn unusable_normals_become_zero_and_long_ones_unit() {
    let text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
        property float nx\nproperty float ny\nproperty float nz\nend_header\n\
        0 0 0 nan 0 0\n0 0 0 0 0 0\n0 0 0 0 -4 0\n";
    let mesh = read_bytes(text.as_bytes()).unwrap();
    assert_eq!(mesh.normals, [[0.0; 3], [0.0; 3], [0.0, -1.0, 0.0]]);
}

#[test]
fn hostile_files_are_refused_in_one_line() {
    let vertices =
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n";
    let faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    for (body, complaint) in [
        (format!("{vertices}{faces}0 0 0 3 0 0 1\n"), "only 1 vertices"),
        (format!("{vertices}{faces}0 0 0 3 0 0 -1\n"), "-1 is not a vertex index"),
        (format!("{vertices}{faces}0 0 0 3 0 0 0.5\n"), "0.5 is not a vertex index"),
        (format!("{vertices}{faces}0 0 0 2 0 0\n"), "2 corners"),
        (format!("{vertices}{faces}0 0 0 0\n"), "without corners"),
        (format!("{vertices}{faces}0 0 0 3 0 0\n"), "cut short"),
        (format!("{vertices}{faces}0 nan 0 3 0 0 0\n"), "not finite"),
        (format!("{vertices}{faces}0 1e300 0 3 0 0 0\n"), "not finite"),
        (format!("{vertices}end_header\n"), "only 0 bytes are left"),
        (
            format!("{vertices}element face 1\nproperty int vertex_indices\nend_header\n0 0 0 1\n"),
            "no list vertex_indices",
        ),
        (format!("ply\nformat ascii 1.0\n{faces}3 0 0 0\n"), "no element called vertex"),
        ("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n".into(), "no x, y and z"),
    ] {
        let text = read_bytes(body.as_bytes()).unwrap_err().to_string();
        assert!(text.contains(complaint) && !text.contains('\n'), "{body:?}: {text}");
    }
}

#[test]
fn a_mesh_cut_short_anywhere_is_refused() {
    let whole = written(&corner(), "a.ply");
    for length in 0..whole.len() {
        assert!(read_bytes(&whole[..length]).is_err(), "{length} of {} bytes", whole.len());
    }
}

#[test]
fn glb_files_follow_the_specification() {
    let bytes = written(&corner(), "a.glb");
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    let json_end = 20 + word(12);
    assert_eq!((&bytes[16..20], json_end % 4), (&b"JSON"[..], 0));
    assert_eq!((&bytes[json_end + 4..json_end + 8], word(json_end) % 4), (&b"BIN\0"[..], 0));
    let json: Value = serde_json::from_slice(&bytes[20..json_end]).unwrap();
    let numbers = &bytes[json_end + 8..];
    assert_eq!(numbers.len(), json["buffers"][0]["byteLength"].as_u64().unwrap() as usize);
    assert_eq!(json["accessors"][0]["min"], serde_json::json!([0.0, 0.0, 0.0]));
    assert_eq!(json["accessors"][0]["max"], serde_json::json!([2.0, 3.0, 4.0]));
    let array = |accessor: &Value| {
        let view = &json["bufferViews"][accessor.as_u64().unwrap() as usize];
        let begin = view["byteOffset"].as_u64().unwrap() as usize;
        &numbers[begin..begin + view["byteLength"].as_u64().unwrap() as usize]
    };
    let primitive = &json["meshes"][0]["primitives"][0];
    let position = array(&primitive["attributes"]["POSITION"]);
    assert_eq!(position[12..16], 2.0f32.to_le_bytes());
    let normal = array(&primitive["attributes"]["NORMAL"]);
    assert_eq!(normal[44..48], 1.0f32.to_le_bytes(), "an unknown normal is written as up");
    let color = array(&primitive["attributes"]["COLOR_0"]);
    // sRGB 128 is 0.2159 in linear light.
    assert_eq!(color[16..24], [14_146u16, 14_146, 14_146, 65_535].map(u16::to_le_bytes).concat());
    let indices = array(&primitive["indices"]);
    assert_eq!(indices[4..8], 2u32.to_le_bytes());
}

#[test]
fn glb_files_have_extras_and_show_colours_as_they_are_without_normals() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    let json = |mesh: &Mesh, extras: Value| -> Value {
        mesh.write_glb(&path, extras.as_object().unwrap()).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
        serde_json::from_slice(&bytes[20..20 + length]).unwrap()
    };
    let with_normals = json(&corner(), serde_json::json!({}));
    assert!(with_normals.get("extensionsUsed").is_none() && with_normals["asset"].get("extras").is_none());
    let flat = json(&Mesh { normals: Vec::new(), ..corner() }, serde_json::json!({"epsg": 2180}));
    assert_eq!(flat["extensionsUsed"], serde_json::json!(["KHR_materials_unlit"]));
    assert_eq!(flat["asset"]["extras"]["epsg"], 2180);
}

/// The picture is whole in the file, and no colours of vertices are there to be multiplied with it.
#[test]
fn textures_are_in_the_glb_and_beside_the_obj() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::write(at("a.jpg"), [7; 9]).unwrap();
    let texture =
        Texture { uv: vec![[0.0, 0.25], [1.0, 0.25], [0.0, 1.0], [0.5, 0.5]], picture: at("a.jpg") };
    let bare = Mesh { normals: Vec::new(), ..corner() };
    bare.write_textured_glb(&at("a.glb"), &texture, &serde_json::Map::new()).unwrap();
    let bytes = fs::read(at("a.glb")).unwrap();
    let json_end = 20 + u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let json: Value = serde_json::from_slice(&bytes[20..json_end]).unwrap();
    let numbers = &bytes[json_end + 8..];
    assert_eq!(numbers.len(), json["buffers"][0]["byteLength"].as_u64().unwrap() as usize);
    let view = |index: &Value| {
        let view = &json["bufferViews"][index.as_u64().unwrap() as usize];
        let begin = view["byteOffset"].as_u64().unwrap() as usize;
        &numbers[begin..begin + view["byteLength"].as_u64().unwrap() as usize]
    };
    let attributes = &json["meshes"][0]["primitives"][0]["attributes"];
    assert!(attributes.get("COLOR_0").is_none());
    let uv = view(&json["accessors"][attributes["TEXCOORD_0"].as_u64().unwrap() as usize]["bufferView"]);
    assert_eq!(uv[8..16], [1.0f32, 0.25].map(f32::to_le_bytes).concat());
    assert_eq!(view(&json["images"][0]["bufferView"]), [7; 9]);
    assert_eq!(json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"], 0);

    bare.write_textured_obj(&at("a.obj"), &texture, "of a test").unwrap();
    let text = fs::read_to_string(at("a.obj")).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines[..4], ["# of a test", "mtllib a.mtl", "usemtl surface", "v 0 0 0"]);
    assert_eq!((lines[7], lines[11]), ("vt 0.000000 0.750000", "f 1/1 3/3 2/2"));
    assert!(fs::read_to_string(at("a.mtl")).unwrap().ends_with("\nmap_Kd a.jpg\n"));
    fs::remove_file(at("a.jpg")).unwrap();
    let missing = bare.write_textured_glb(&at("b.glb"), &texture, &serde_json::Map::new()).unwrap_err();
    assert!(missing.to_string().contains("a.jpg"), "{missing}");
}

#[test]
fn the_worlds_z_axis_is_up_in_gltf() {
    let json_of = |bytes: &[u8]| -> Value {
        let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
        serde_json::from_slice(&bytes[20..20 + length]).unwrap()
    };
    let json = json_of(&written(&corner(), "a.glb"));
    let rotation: [f32; 4] = serde_json::from_value(json["nodes"][0]["rotation"].clone()).unwrap();
    let up = Quat::from_array(rotation) * Vec3::Z;
    assert!(up.distance(Vec3::Y) < 1e-6, "{up}");
}

#[test]
fn unknown_extensions_and_empty_glb_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let refuse = |mesh: &Mesh, name: &str| mesh.write(&folder.path().join(name)).unwrap_err().to_string();
    assert!(refuse(&corner(), "a.stl").contains(".ply, .glb or .obj"));
    assert!(refuse(&Mesh::default(), "a.glb").contains("needs triangles"));
}

#[test]
fn areas_of_right_triangles_are_exact() {
    assert_eq!(corner().areas().collect::<Vec<_>>(), [3.0, 4.0, 6.0]);
}
