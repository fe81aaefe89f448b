//! Grids that the test writes: undulations that are linear in longitude and latitude, so that interpolation is exact.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::process::Command;

use tempfile::TempDir;
use tiff::encoder::{TiffEncoder, colortype::Gray32Float};
use tiff::tags::Tag;

use super::*;

/// Undulation at a longitude and latitude, metres.
fn truth(longitude_deg: f64, latitude_deg: f64) -> f64 {
    30.0 + 2.0 * (longitude_deg - 16.0) - 3.0 * (latitude_deg - 53.0)
}

const STEP_DEG: f64 = 0.25;

/// Column by column from 15° east, row by row from 55° to 51° north, with a missing value at 15° east, 55° north.
fn values() -> Vec<f32> {
    let at = |i: usize| [15.0 + STEP_DEG * (i % 13) as f64, 55.0 - STEP_DEG * (i / 13) as f64];
    let mut values: Vec<f32> = (0..13 * 17).map(|i| truth(at(i)[0], at(i)[1]) as f32).collect();
    values[0] = -88.8888;
    values
}

fn gtx(folder: &TempDir) -> PathBuf {
    let mut bytes = Vec::new();
    for number in [51.0, 15.0, STEP_DEG, STEP_DEG] {
        bytes.extend(f64::to_be_bytes(number));
    }
    bytes.extend(17_u32.to_be_bytes());
    bytes.extend(13_u32.to_be_bytes());
    for row in values().chunks(13).rev() {
        row.iter().for_each(|value| bytes.extend(value.to_be_bytes()));
    }
    let path = folder.path().join("poland.gtx");
    fs::write(&path, bytes).unwrap();
    path
}

/// A GeoTIFF whose pixels are points or areas, in strips, with this metadata of GDAL.
fn geotiff(folder: &TempDir, is_point: bool, metadata: &str) -> PathBuf {
    let path = folder.path().join("poland.tif");
    let mut encoder = TiffEncoder::new(fs::File::create(&path).unwrap()).unwrap();
    let mut image = encoder.new_image::<Gray32Float>(13, 17).unwrap();
    image.rows_per_strip(4).unwrap();
    let half = if is_point { 0.0 } else { 0.5 * STEP_DEG };
    let tags = image.encoder();
    tags.write_tag(Tag::ModelPixelScaleTag, &[STEP_DEG, STEP_DEG, 0.0][..]).unwrap();
    tags.write_tag(Tag::ModelTiepointTag, &[0.0, 0.0, 0.0, 15.0 - half, 55.0 + half, 0.0][..]).unwrap();
    let raster_type = if is_point { 2_u16 } else { 1 };
    let keys = [1, 1, 0, 2, MODEL_KEY, 0, 1, 2, RASTER_KEY, 0, 1, raster_type];
    tags.write_tag(Tag::GeoKeyDirectoryTag, &keys[..]).unwrap();
    tags.write_tag(Tag::GdalNodata, "-88.8888").unwrap();
    tags.write_tag(GDAL_METADATA, metadata).unwrap();
    image.write_data(&values()).unwrap();
    path
}

const GDAL_METADATA: Tag = Tag::Unknown(42_112);
const MODEL_KEY: u16 = 1024;
const RASTER_KEY: u16 = 1025;
const METADATA: &str = r#"<GDALMetadata><Item name="target_crs_epsg_code">5773</Item>
    <Item name="TYPE">VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL</Item></GDALMetadata>"#;

fn place(longitude_deg: f64, latitude_deg: f64) -> Geodetic {
    Geodetic { latitude_deg, longitude_deg, height_m: 100.0 }
}

#[test]
fn grids_of_all_kinds_tell_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let here = place(16.4, 53.3);
    let of = |path: PathBuf| Geoid::read(&path, &here).unwrap();
    let grids =
        [of(gtx(&folder)), of(geotiff(&folder, true, METADATA)), of(geotiff(&folder, false, METADATA))];
    for geoid in &grids {
        for (longitude, latitude) in [(16.4, 53.3), (16.0, 53.0), (16.77, 53.61), (15.95, 52.85)] {
            let undulation_m = geoid.undulation_m(&place(longitude, latitude)).unwrap();
            assert!((undulation_m - truth(longitude, latitude)).abs() < 1e-5, "{geoid:?}: {undulation_m}");
        }
        let error = geoid.undulation_m(&place(17.9, 53.3)).unwrap_err().to_string();
        assert!(error.contains("poland") && error.contains("covers the site"), "{error}");
    }
    assert_eq!([grids[0].vertical_epsg(), grids[1].vertical_epsg()], [None, Some(5773)]);
    assert_eq!(grids[1].heights(), "metres above the geoid of poland.tif, EPSG:5773");
    assert!(
        grids[1].wkt().starts_with("VERT_CS[") && grids[1].wkt().ends_with(r#"AUTHORITY["EPSG","5773"]]"#)
    );
}

#[test]
fn borders_and_missing_values_have_no_undulation() {
    let folder = tempfile::tempdir().unwrap();
    let path = gtx(&folder);
    let geoid = Geoid::read(&path, &place(15.0, 54.0)).unwrap();
    assert!(
        (geoid.undulation_m(&place(15.0, 54.0)).unwrap() - truth(15.0, 54.0)).abs() < 1e-5,
        "the western border"
    );
    let geoid = Geoid::read(&path, &place(15.4, 54.9)).unwrap();
    assert!(geoid.undulation_m(&place(15.1, 54.9)).is_err(), "beside the missing value");
    for outside in [place(14.9, 53.0), place(18.1, 53.0), place(16.0, 55.1), place(16.0, 50.9)] {
        let error = Geoid::read(&path, &outside).unwrap_err().to_string();
        assert!(error.contains("does not cover"), "{error}");
    }
}

#[test]
fn grids_of_the_whole_earth_have_no_seam() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("earth.gtx");
    let mut bytes = Vec::new();
    for number in [-90.0, -180.0, 1.0, 1.0] {
        bytes.extend(f64::to_be_bytes(number));
    }
    bytes.extend(181_u32.to_be_bytes());
    bytes.extend(360_u32.to_be_bytes());
    for i in 0..181 * 360 {
        // 10 m at 180° east and west, 9 m at 179° east, 11 m at 179° west.
        let longitude = f64::from(i % 360) - 180.0;
        let undulation = if longitude < 0.0 { 190.0 + longitude } else { longitude - 170.0 };
        bytes.extend((undulation as f32).to_be_bytes());
    }
    fs::write(&path, bytes).unwrap();
    for around in [179.9, -179.9, 180.0, -180.0] {
        let geoid = Geoid::read(&path, &place(around, 10.0)).unwrap();
        for (longitude, wanted) in [(179.5, 9.5), (180.0, 10.0), (-180.0, 10.0), (-179.5, 10.5)] {
            let undulation_m = geoid.undulation_m(&place(longitude, 10.0)).unwrap();
            assert!((undulation_m - wanted).abs() < 1e-5, "{around}: {longitude}: {undulation_m}");
        }
    }
}

#[test]
fn files_that_are_no_geoids_are_refused_in_a_line() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |path: &Path| {
        let error = Geoid::read(path, &place(16.4, 53.3)).unwrap_err().to_string();
        assert!(error.contains(&path.display().to_string()) && !error.contains('\n'), "{error}");
        error
    };
    assert!(refused(&folder.path().join("absent.gtx")).contains("absent.gtx"));
    let other = METADATA.replace("GEOGRAPHIC_TO_VERTICAL", "VERTICAL_TO_VERTICAL");
    assert!(refused(&geotiff(&folder, true, &other)).contains("something else"));
    let short = gtx(&folder);
    let bytes = fs::read(&short).unwrap();
    fs::write(&short, &bytes[..bytes.len() - 1]).unwrap();
    assert!(refused(&short).contains("cut short"));
    fs::write(&short, &bytes[..30]).unwrap();
    refused(&short);
    let mut endless = bytes.clone();
    endless[32..40].fill(0xff);
    fs::write(&short, endless).unwrap();
    assert!(refused(&short).contains("no grid"));
    let text = folder.path().join("geoid.tif");
    fs::write(&text, "no picture").unwrap();
    assert!(refused(&text).contains("not a GeoTIFF"));
    let name = folder.path().join("geoid.bin");
    fs::write(&name, "").unwrap();
    assert!(refused(&name).contains(".gtx"));
}

/// The grid of Debian's package proj-data, compared with PROJ itself.
#[test]
fn undulations_are_those_of_proj() {
    let grid = Path::new("/usr/share/proj/egm96_15.gtx");
    let from_proj = |longitude: f64, latitude: f64| -> Option<f64> {
        let pipeline = format!(
            "echo {longitude} {latitude} 0 | cct -d 6 +proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=vgridshift +grids={} +multiplier=-1",
            grid.display()
        );
        let output = Command::new("sh").args(["-c", &pipeline]).output().ok()?;
        let text = String::from_utf8(output.stdout).ok()?;
        text.split_whitespace().nth(2)?.parse::<f64>().ok().map(|height| -height)
    };
    if !grid.is_file() || from_proj(0.0, 0.0).is_none() {
        return; // PROJ and its grids are no part of CI
    }
    for (longitude, latitude) in
        [(16.4, 53.3), (-98.0897, 30.1712), (179.99, -5.0), (-0.001, 51.5), (151.2, -33.87)]
    {
        let geoid = Geoid::read(grid, &place(longitude, latitude)).unwrap();
        let (is, wanted) = (
            geoid.undulation_m(&place(longitude, latitude)).unwrap(),
            from_proj(longitude, latitude).unwrap(),
        );
        assert!((is - wanted).abs() < 1e-4, "{longitude} {latitude}: {is} {wanted}");
        assert_eq!(geoid.vertical_epsg(), Some(5773));
    }
}
