//! What the cameras tell of each splat.
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

use cosurf_scene::splats::SH_C0;
use cosurf_scene::{LocalFrame, ply};
use glam::DVec3;

use super::{MEMORY_BYTES, SLOPE, SPLATS, cameras, model};
use crate::survey::confidence::Scale;
use crate::survey::depths::Depths;
use crate::survey::scene::Scene;
use crate::survey::splat_claims::write_splat_claims;

const SCALE: Scale = Scale { gsd_m: 0.1, voxel_m: 0.1 };

/// The model with three more splats, nearly transparent: 0.45 m above the slope, 1 m below it, and far beside it.
fn model_with_outliers(folder: &Path) {
    model(folder);
    let file = folder.join("global.ply");
    let mut splats = ply::read(&file, &LocalFrame::WORLD).unwrap();
    for at in [[1.0, 1.0, 0.2 + 0.45], [1.0, 1.0, 0.2 - 1.0], [60.0, 0.0, 0.0]] {
        splats.push(at, [1.0, 0.0, 0.0, 0.0], [-3.0; 3], -4.0, &[0.5 / SH_C0; 3]);
    }
    ply::write(&file, &splats, &LocalFrame::WORLD).unwrap();
}

/// Writes the splats with this memory limit, and returns how many views were counted.
fn write(folder: &Path, memory_bytes: u64) -> usize {
    let scene = Scene::open(folder).unwrap();
    let mut depths = Depths::new(folder).unwrap();
    let rendered = scene.render_each(MEMORY_BYTES, 0, 2, |_, map| Ok(depths.push(map)?));
    rendered.unwrap();
    let floats: Vec<bool> = (0..SPLATS + 4).map(|splat| splat == SPLATS).collect();
    let (mut counted, mut of_all) = (0, 0);
    let on_view = |done, of| (counted, of_all) = (counted.max(done), of);
    write_splat_claims(folder, &scene, &floats, &mut depths, &SCALE, memory_bytes, on_view).unwrap();
    assert_eq!(counted, of_all);
    counted
}

/// The last four properties of each splat of a file.
pub(super) fn properties(file: &Path) -> Vec<[f32; 4]> {
    let bytes = fs::read(file).unwrap();
    let names = ["views", "through", "spread_m", "error_m"];
    let end = names.map(|name| format!("property float {name}\n")).concat() + "end_header\n";
    let begin = end.len() + bytes.windows(end.len()).position(|window| window == end.as_bytes()).unwrap();
    let row_bytes = (bytes.len() - begin) / ply::size(file).unwrap().0;
    let number = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().unwrap());
    let of = |row: &[u8]| [16, 12, 8, 4].map(|back| number(&row[row.len() - back..row.len() - back + 4]));
    bytes[begin..].chunks(row_bytes).map(of).collect()
}

#[test]
fn splats_have_the_views_that_show_them() {
    let folder = tempfile::tempdir().unwrap();
    model_with_outliers(folder.path());
    write(folder.path(), MEMORY_BYTES);
    let file = folder.path().join("splats.ply");
    let (splats, found) = (ply::read(&file, &LocalFrame::WORLD).unwrap(), properties(&file));
    assert_eq!((splats.len(), found.len()), (SPLATS + 3, SPLATS + 3), "the red one is not there");
    let mut claims = 0;
    for (mean, [views, through, spread_m, error_m]) in splats.means.iter().zip(&found).take(SPLATS) {
        let at = DVec3::from_array(mean.map(f64::from));
        let shows = |camera: &&cosurf_scene::Camera| camera.project(at).is_some_and(|px| camera.contains(px));
        let wanted = cameras().iter().filter(shows).count() as f32;
        // At the edge of the slope, pixels show too little to have a depth.
        if at.x.abs() < 9.9 && at.y.abs() < 7.4 {
            assert_eq!([*views, *through], [wanted, 0.0], "{at}");
        }
        assert!(*spread_m < 0.1, "{at}: {spread_m}");
        assert_eq!(*error_m > 0.0, *views >= 3.0, "{at}: {error_m}");
        claims += usize::from(*error_m > 0.0);
    }
    assert!(claims > SPLATS / 3, "{claims}");
    let [lifted, below, beside] = [0, 1, 2].map(|i| found[SPLATS + i]);
    assert!(lifted[0] == 0.0 && lifted[1] > 3.0, "{lifted:?}");
    assert_eq!([below, beside], [[0.0; 4]; 2], "nobody sees them, or through them");
    assert!((f64::from(splats.means[SPLATS][2]) - SLOPE - 0.45).abs() < 1e-6);
}

/// Goal: the model need not fit into the memory. Method: with no memory to spare, the same file is written in two passes.
#[test]
fn views_are_the_same_with_little_memory() {
    let folder = tempfile::tempdir().unwrap();
    model_with_outliers(folder.path());
    let file = folder.path().join("splats.ply");
    let [(once, much), (twice, little)] =
        [MEMORY_BYTES, 0].map(|bytes| (write(folder.path(), bytes), fs::read(&file).unwrap()));
    assert_eq!([once, twice], [1, 2].map(|passes| passes * cameras().len()));
    assert!(much == little);
}
