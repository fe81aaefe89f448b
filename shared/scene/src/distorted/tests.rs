//! Exports of other tools, written here by hand by the formulas of their documentation from known cameras, and found again.

#![allow(clippy::unwrap_used)]

use std::fs;

use glam::{DMat3, DQuat, DVec2, DVec3};
use tempfile::TempDir;

use super::*;
use crate::{Dataset, Distortion, FullBrown, Picture, Pose};

/// Two drones' cameras that look down and ahead, in a folder with pictures of 80 × 60 pixels in `images`.
struct Export {
    folder: TempDir,
    poses: [Pose; 2],
}

const NAMES: [&str; 2] = ["a b.JPG", "ü.jpg"];

impl Export {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("images")).unwrap();
        for name in NAMES {
            let picture = Picture::new([80, 60], vec![99; 80 * 60 * 3]);
            picture.write_jpeg(&folder.path().join("images").join(name), 90).unwrap();
        }
        let down = Pose::look_at(
            DVec3::new(10.0, 20.0, 90.0),
            DVec3::new(10.0, 20.0, 0.0),
            DVec3::new(0.3, 1.0, 0.0),
        );
        let ahead = Pose::look_at(
            DVec3::new(-5.0, 7.0, 40.0),
            DVec3::new(60.0, 30.0, 0.0),
            DVec3::new(0.1, 0.0, 1.0),
        );
        Self { folder, poses: [down, ahead] }
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.folder.path().join(name), text).unwrap();
    }

    fn open(&self) -> Result<(Vec<Shot>, bool), SceneError> {
        match Distorted::open(self.folder.path())? {
            Distorted::Shots { images, shots, is_geocentric, .. } => {
                assert!(shots.iter().all(|shot| images.join(&shot.name) == shot.path));
                Ok((shots, is_geocentric))
            }
            other => panic!("{other:?}"),
        }
    }

    /// Fails unless the shots have the export's poses, `lens` and the names of files.
    fn check(&self, shots: &[Shot], lens: &Lens) {
        assert_eq!(shots.iter().map(|shot| shot.name.as_str()).collect::<Vec<_>>(), NAMES);
        for (shot, pose) in shots.iter().zip(&self.poses) {
            let turn = shot.cam_from_world.rotation.dot(pose.rotation).abs();
            assert!(turn > 1.0 - 1e-9, "{}: {turn}", shot.name);
            assert!(shot.cam_from_world.center().distance(pose.center()) < 1e-6, "{}", shot.name);
            assert!(shot.lens.focal_px.distance(lens.focal_px) < 1e-9, "{:?}", shot.lens);
            assert!(shot.lens.center_px.distance(lens.center_px) < 1e-9, "{:?}", shot.lens);
            assert_eq!((shot.lens.size_px, shot.lens.distortion), (lens.size_px, lens.distortion));
        }
    }

    fn complaint(&self) -> String {
        let error = self.open().unwrap_err().to_string();
        assert!(!error.contains('\n'), "{error}");
        error
    }
}

fn words(numbers: &[f64]) -> String {
    numbers.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")
}

fn by_rows(matrix: DMat3) -> [f64; 9] {
    matrix.transpose().to_cols_array()
}

fn brown(radial: [f64; 3], tangential: [f64; 2]) -> Distortion {
    Distortion::Brown { radial, tangential }
}

/// The export of a chunk of which a component lies at `scale`, `rotation` and `translation`.
fn metashape(poses: &[Pose], placed: (f64, DQuat, DVec3), reference: &str, more: &str) -> String {
    let (scale, rotation, translation) = placed;
    let camera = |(id, pose): (usize, &Pose)| {
        let center = rotation.inverse() * (pose.center() - translation) / scale;
        let r = by_rows(DMat3::from_quat(rotation.inverse() * pose.rotation.inverse()));
        let matrix = [
            r[0], r[1], r[2], center.x, r[3], r[4], r[5], center.y, r[6], r[7], r[8], center.z, 0.0, 0.0,
            0.0, 1.0,
        ];
        // One label has its extension, the other has not.
        let label = ["a b.JPG", "ü"][id];
        format!(
            r#"<camera id="{id}" sensor_id="3" component_id="0" label="{label}"><transform>{}</transform></camera>"#,
            words(&matrix)
        )
    };
    let cameras: String = poses.iter().enumerate().map(camera).collect();
    format!(
        r#"<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1" enabled="true">
        <sensors next_id="4"><sensor id="3" label="FC330" type="frame"><resolution width="160" height="120"/>
        <calibration type="frame" class="adjusted"><resolution width="160" height="120"/><f>150</f><cx>3</cx><cy>-2</cy>
        <k1>-0.1</k1><k2>0.02</k2><k3>0.003</k3><p1>0.0004</p1><p2>-0.0005</p2><b1>2</b1>{more}</calibration></sensor></sensors>
        <components next_id="1"><component id="0"><transform><rotation locked="false">{}</rotation>
        <translation locked="false">{}</translation><scale locked="false">{scale}</scale></transform></component></components>
        <cameras next_id="3">{cameras}<camera id="2" sensor_id="3" label="not aligned"/></cameras>
        <reference>{reference}</reference></chunk></document>"#,
        words(&by_rows(DMat3::from_quat(rotation))),
        words(&translation.to_array()),
    )
}

#[test]
fn cameras_of_metashape_are_found_again() {
    let export = Export::new();
    let placed =
        (12.5, DQuat::from_rotation_y(0.4) * DQuat::from_rotation_x(-1.1), DVec3::new(100.0, -7.0, 3.0));
    export.write("cameras.xml", &metashape(&export.poses, placed, "LOCAL_CS[&quot;Local&quot;]", ""));
    let (shots, is_geocentric) = export.open().unwrap();
    assert!(!is_geocentric);
    // The pictures have half the size of the export. P1 and P2 are OpenCV's p2 and p1; b1 widens the x axis.
    let lens = Lens {
        focal_px: DVec2::new(76.0, 75.0),
        center_px: DVec2::new(41.5, 29.0),
        size_px: [80, 60],
        distortion: brown([-0.1, 0.02, 0.003], [-0.0005, 0.0004]),
    };
    export.check(&shots, &lens);
    let error = Dataset::open(export.folder.path()).unwrap_err().to_string();
    assert!(error.contains("cosurf-agent ingest") && !error.contains('\n'), "{error}");
    let straight = fs::read_to_string(export.folder.path().join("cameras.xml")).unwrap();
    let straight = ["k1", "k2", "k3", "p1", "p2"].iter().fold(straight, |text, name| {
        let (begin, end) =
            (text.find(&format!("<{name}>")).unwrap(), text.find(&format!("</{name}>")).unwrap());
        format!("{}{}", &text[..begin], &text[end + name.len() + 3..])
    });
    export.write("cameras.xml", &straight);
    assert_eq!(Dataset::open(export.folder.path()).unwrap().views[0].camera.focal_px, DVec2::new(76.0, 75.0));
}

#[test]
fn metashape_tells_where_its_world_is() {
    let export = Export::new();
    let placed = (1.0, DQuat::IDENTITY, DVec3::new(3e6, 3e6, 4.7e6));
    let geocentric = |reference: &str| {
        export.write("doc.xml", &metashape(&export.poses, placed, reference, ""));
        export.open().unwrap().1
    };
    assert!(
        geocentric("GEOGCS[&quot;WGS 84&quot;]")
            && geocentric("PROJCS[&quot;UTM&quot;]")
            && !geocentric("LOCAL_CS[]")
    );
}

#[test]
fn all_terms_of_metashapes_frame_cameras_are_read() {
    let export = Export::new();
    let of = |more: &str| {
        let placed = (1.0, DQuat::IDENTITY, DVec3::ZERO);
        export.write("cameras.xml", &metashape(&export.poses, placed, "", more));
    };
    let full = FullBrown {
        radial: [-0.1, 0.02, 0.003, -0.004],
        tangential: [-0.0005, 0.0004],
        growth: [0.3, -0.2],
        skew: -1.9 / 152.0,
    };
    of("<k4>-0.004</k4><p3>0.3</p3><p4>-0.2</p4><b2>-1.9</b2>");
    let lens = Lens {
        focal_px: DVec2::new(76.0, 75.0),
        center_px: DVec2::new(41.5, 29.0),
        size_px: [80, 60],
        distortion: Distortion::FullBrown(full),
    };
    let (shots, _) = export.open().unwrap();
    export.check(&shots, &lens);
    assert!(Dataset::open(export.folder.path()).unwrap_err().to_string().contains("cosurf-agent ingest"));
    for (term, alone) in [
        ("k4", FullBrown { radial: [-0.1, 0.02, 0.003, 1e-5], ..FullBrown::default() }),
        ("p3", FullBrown { growth: [1e-5, 0.0], ..FullBrown::default() }),
        ("p4", FullBrown { growth: [0.0, 1e-5], ..FullBrown::default() }),
        ("b2", FullBrown { skew: 1e-5 / 152.0, ..FullBrown::default() }),
    ] {
        of(&format!("<{term}>1e-5</{term}>"));
        let radial = if term == "k4" { alone.radial } else { [-0.1, 0.02, 0.003, 0.0] };
        let wanted = FullBrown { radial, tangential: [-0.0005, 0.0004], ..alone };
        let found = export.open().unwrap().0[0].lens;
        assert_eq!(found.distortion, Distortion::FullBrown(wanted), "{term}");
        assert!(!found.is_known_to_colmap());
    }
    of("<k4>0</k4><b2>0</b2>");
    assert!(export.open().unwrap().0[0].lens.is_known_to_colmap());
    for wrong in ["nan", "1e999", "x"] {
        of(&format!("<k4>{wrong}</k4>"));
        assert!(export.complaint().contains("finite"), "{wrong}: {}", export.complaint());
    }
    export.write("cameras.xml", r#"<!DOCTYPE d [<!ENTITY a "aaa">]><document><chunk>&a;</chunk></document>"#);
    assert!(export.complaint().contains("not valid XML"));
}

#[test]
fn fisheyes_with_terms_that_colmap_lacks_are_refused() {
    let export = Export::new();
    let placed = (1.0, DQuat::IDENTITY, DVec3::ZERO);
    let fisheye = metashape(&export.poses, placed, "", "").replace("\"frame\"", "\"fisheye\"");
    export.write("cameras.xml", &fisheye);
    assert!(export.complaint().contains("p1 to p4 or b2 of its fisheye"), "{}", export.complaint());
    export.write("cameras.xml", &fisheye.replace("fisheye", "spherical"));
    assert!(export.complaint().contains("type spherical"), "{}", export.complaint());
}

/// Points about the place that the cameras look at, as Metashape's *Export Tie Points* writes them.
fn tie_points(by: DVec3) -> String {
    let header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
        property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
    let points = [[10.0, 20.0], [12.0, 21.0], [8.0, 19.0], [10.0, 22.0]];
    let rows = points.map(|[x, y]| {
        let at = DVec3::new(x, y, 0.0) + by;
        format!("{} {} {} 10 20 30\n", at.x, at.y, at.z)
    });
    format!("{header}{}", rows.concat())
}

#[test]
fn tie_points_beside_the_cameras_of_metashape_are_read() {
    let export = Export::new();
    let placed = (2.0, DQuat::IDENTITY, DVec3::ZERO);
    let points = || match Distorted::open(export.folder.path()).unwrap() {
        Distorted::Shots { points, unused, .. } => (points, unused.map(|(_, reason)| reason)),
        other => panic!("{other:?}"),
    };
    export.write("cameras.xml", &metashape(&export.poses, placed, "LOCAL_CS[]", ""));
    assert_eq!(points(), (Vec::new(), None));
    export.write("sparse cloud.ply", &tie_points(DVec3::ZERO));
    let (found, unused) = points();
    assert_eq!(
        (found.len(), found[1].position, found[1].rgb),
        (4, DVec3::new(12.0, 21.0, 0.0), [10, 20, 30])
    );
    assert_eq!(unused, None);
    export.write("cameras.ply", &tie_points(DVec3::Z));
    assert_eq!(points().0[0].position.z, 1.0, "of several, the one of the same name");
    let notes = || Dataset::notes(export.folder.path());
    assert_eq!(notes(), [""; 0]);
    for (text, told) in [
        (tie_points(DVec3::new(4e5, 5e6, 0.0)), "most are not where the cameras look"),
        (tie_points(DVec3::ZERO).replace("12 21", "nan 21"), "not finite"),
        ("ply\nformat".to_owned(), "its points are not used"),
    ] {
        export.write("cameras.ply", &text);
        let (found, unused) = points();
        let reason = unused.unwrap();
        assert!(found.is_empty() && reason.contains(told), "{reason}");
        assert!(
            notes().iter().any(|note| note.contains("cameras.ply: ") && note.contains(told)),
            "{:?}",
            notes()
        );
    }
    export.write("cameras.ply", &tie_points(DVec3::ZERO));
    export.write("cameras.xml", &metashape(&export.poses, placed, "GEOGCS[&quot;WGS 84&quot;]", ""));
    assert!(points().1.unwrap().contains("earth-centred"), "a PLY does not say what its numbers are");
    export.write("cameras.xml", &metashape(&export.poses, placed, "", ""));
    fs::remove_file(export.folder.path().join("cameras.ply")).unwrap();
    export.write("mesh.ply", &tie_points(DVec3::ZERO));
    assert_eq!(points(), (Vec::new(), None), "two files, and none has the name of the cameras");
}

/// The line of a camera by the formula of the module `csv`, solved for the angles.
fn csv_line(name: &str, pose: &Pose) -> String {
    let upright =
        DMat3::from_quat(pose.rotation.inverse()) * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    // Rz(-h) Rx(p) Ry(r) has sin p in the last row, second column.
    let (pitch, roll) = (upright.y_axis.z.asin(), (-upright.x_axis.z).atan2(upright.z_axis.z));
    let heading = upright.y_axis.x.atan2(upright.y_axis.y);
    let [heading, pitch, roll] = [heading, pitch, roll].map(f64::to_degrees);
    let DVec3 { x, y, z } = pose.center();
    format!("{name},{x},{y},{z},{heading},{pitch},{roll},33.75,0.025,-0.0125,-0.1,0.02,0.003,0,0,0\n")
}

/// 33.75 mm of 36 mm on 80 pixels; the principal point 2 pixels to the right of the middle and 1 above.
fn film_lens() -> Lens {
    Lens {
        focal_px: DVec2::splat(75.0),
        center_px: DVec2::new(42.0, 29.0),
        size_px: [80, 60],
        distortion: brown([-0.1, 0.02, 0.003], [0.0; 2]),
    }
}

/// With t1 = 0.0004 and t2 = -0.0005, which are p2 and p1 of OpenCV.
fn with_tangential(k4: f64) -> Lens {
    let tangential = [-0.0005, 0.0004];
    let full = FullBrown { radial: [-0.1, 0.02, 0.003, k4], tangential, ..FullBrown::default() };
    let distortion = match k4 == 0.0 {
        true => brown([-0.1, 0.02, 0.003], tangential),
        false => Distortion::FullBrown(full),
    };
    Lens { distortion, ..film_lens() }
}

#[test]
fn cameras_of_realitycapture_are_found_again_in_csv() {
    let export = Export::new();
    let header = "#cameras 2\r\n#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\r\n";
    let lines: String = NAMES.iter().zip(&export.poses).map(|(name, pose)| csv_line(name, pose)).collect();
    export.write("registration.csv", &format!("{header}{lines}\n"));
    export.check(&export.open().unwrap().0, &film_lens());
    let renamed = header.replace("heading", "yaw").replace(",f,px,py,", ",f_35mm,px_norm,py_norm,");
    export.write("registration.csv", &format!("{renamed}{lines}"));
    export.check(&export.open().unwrap().0, &film_lens());
    export
        .write("registration.csv", &format!("{header}{}", lines.replace(",0,0,0\n", ",0,0.0004,-0.0005\n")));
    export.check(&export.open().unwrap().0, &with_tangential(0.0));
    export.write(
        "registration.csv",
        &format!("{header}{}", lines.replace(",0,0,0\n", ",0.01,0.0004,-0.0005\n")),
    );
    export.check(&export.open().unwrap().0, &with_tangential(0.01));
    export.write("registration.csv", &format!("{header}{}", lines.replace(",0,0,0\n", ",0,nan,0\n")));
    assert!(export.complaint().contains("line 3: 'nan' is not a finite number"), "{}", export.complaint());
    export.write("registration.csv", &format!("{header}{}", lines.replace("33.75", "x")));
    assert!(export.complaint().contains("'x' is not a finite number"));
    export.write("registration.csv", &format!("{header}{}", lines.replace("a b", "../images/a b")));
    assert!(export.complaint().contains("is not a picture in"), "{}", export.complaint());
}

fn xmp(pose: &Pose, model: &str) -> String {
    let rotation = words(&by_rows(DMat3::from_quat(pose.rotation)));
    format!(
        r#"<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
        <rdf:Description xcr:Version="3" xcr:PosePrior="locked" xcr:DistortionModel="{model}" xcr:FocalLength35mm="33.75"
        xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="0.025" xcr:PrincipalPointV="-0.0125" xcr:Rotation="{rotation}"
        xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Position>{}</xcr:Position>
        <xcr:DistortionCoeficients>-0.1 0.02 0.003 0 0 0</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"#,
        words(&pose.center().to_array())
    )
}

#[test]
fn cameras_of_realitycapture_are_found_again_in_xmp() {
    let export = Export::new();
    for (name, pose) in ["images/a b.xmp", "images/ü.XMP"].iter().zip(&export.poses) {
        export.write(name, &xmp(pose, "brown3"));
    }
    assert!(Dataset::has_poses(export.folder.path()));
    export.check(&export.open().unwrap().0, &film_lens());
    for (model, k4) in [("brown3t2", 0.0), ("brown4t2", 0.01)] {
        let tangential = format!("-0.1 0.02 0.003 {k4} 0.0004 -0.0005");
        for (name, pose) in ["images/a b.xmp", "images/ü.XMP"].iter().zip(&export.poses) {
            export.write(name, &xmp(pose, model).replace("-0.1 0.02 0.003 0 0 0", &tangential));
        }
        export.check(&export.open().unwrap().0, &with_tangential(k4));
    }
    export.write("images/ü.XMP", &xmp(&export.poses[1], "rationalP2D1T2"));
    assert!(export.complaint().contains("the model 'rationalP2D1T2' of its lens is not supported"));
    export.write("images/ü.XMP", &xmp(&export.poses[1], "division"));
    assert!(export.complaint().contains("the model 'division' of its lens is not supported"));
    export.write("images/ü.XMP", "<x/>");
    assert_eq!(export.open().unwrap().0.len(), 1, "a photograph that was not aligned");
}

#[test]
fn distorted_frames_of_nerfstudio_are_opened() {
    let export = Export::new();
    let frames: Vec<String> = NAMES
        .iter()
        .zip(&export.poses)
        .map(|(name, pose)| {
            let r = by_rows(DMat3::from_quat(pose.rotation.inverse()));
            let c = pose.center();
            format!(
                r#"{{"file_path": "./images/{name}", "transform_matrix": [[{},{},{},{}],[{},{},{},{}],[{},{},{},{}],[0,0,0,1]]}}"#,
                r[0], -r[1], -r[2], c.x, r[3], -r[4], -r[5], c.y, r[6], -r[7], -r[8], c.z
            )
        })
        .collect();
    let text = |model: &str| {
        format!(
            r#"{{"camera_model": "{model}", "w": 80, "h": 60, "fl_x": 75, "fl_y": 75, "cx": 42, "cy": 29, "k1": -0.1, "k2": 0.02,
            "k3": 0.003, "p1": 0, "frames": [{}]}}"#,
            frames.join(",")
        )
    };
    export.write("transforms.json", &text("OPENCV"));
    let (mut shots, _) = export.open().unwrap();
    for (shot, name) in shots.iter_mut().zip(NAMES) {
        assert_eq!(shot.name, format!("images/{name}"));
        shot.name = name.into();
    }
    export.check(&shots, &film_lens());
    export.write("transforms.json", &text("OPENCV_FISHEYE"));
    assert_eq!(export.open().unwrap().0[0].lens.distortion, Distortion::Fisheye([-0.1, 0.02, 0.003, 0.0]));
}
