//! `survey`: writes what a surveyor delivers of a model.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Result, bail, ensure};
use clap::Args;
use cosurf_aggregator::outputs::deliver;
use cosurf_aggregator::survey::{Accuracy, CONTOURS_M, SurveyOrder};
use cosurf_contract::counted;
use cosurf_geo::{Geodetic, Georeference};
use cosurf_scene::bytes::parse_bytes;
use cosurf_scene::files;

use super::arguments::parse_length;
use super::host::{cores, display};

/// Make maps, points, a mesh, contours and volumes of a georeferenced model, with a statement of their accuracy.
///
/// Writes to the folder OUT: dsm.tif (heights of the highest surface: ground, roofs and trees), dtm.tif (heights of the bare
/// ground), ortho.tif (a true orthophoto) and confidence.tif (views of each pixel, how far apart they are, and how wrong its
/// height may be), all Cloud-Optimised GeoTIFF; points.laz, a Cloud-Optimised Point Cloud; mesh.glb and mesh.obj, with the
/// picture mesh.jpg; tileset.json and the folder tiles, the mesh as 3D Tiles; splats/tileset.json, the splats as 3D Tiles;
/// splats.ply, the splats with how many views show each, how far apart they are, and how wrong its place may be;
/// contours.geojson, of the bare ground; volumes.json with --volumes; and accuracy.json, last. Heights are metres above the
/// ellipsoid of WGS 84, or above a geoid with --geoid.
///
/// The world of the model must be metres east, north and up of an origin. geo.json in DIR tells where that is, or
/// --origin does.
#[derive(Args)]
pub(crate) struct SurveyArgs {
    /// Output folder of a mission, a service, a merge or an agent: a model, and cameras.json
    #[arg(value_name = "DIR")]
    folder: PathBuf,
    /// Folder to write to
    #[arg(long, value_name = "OUT")]
    out: PathBuf,
    /// Where the world's origin is: degrees north, degrees east, metres above the ellipsoid of WGS 84. Instead of geo.json
    #[arg(long, value_name = "LAT,LON,HEIGHT", allow_hyphen_values = true)]
    origin: Option<Geodetic>,
    /// Coordinate system of the maps and points, as its EPSG number; it must be in metres [default: that of geo.json, or
    /// the UTM zone of the origin]
    #[arg(long, value_name = "N")]
    epsg: Option<u32>,
    /// Grid of a geoid: heights of maps, points, contours and mesh.obj are then above it. A GeoTIFF of PROJ
    /// (us_nga_egm96_15.tif) or a .gtx file
    #[arg(long, value_name = "FILE")]
    geoid: Option<PathBuf>,
    /// Side of a pixel of the maps, metres [default: median length that a pixel of the cameras covers on the surface]
    #[arg(long, value_name = "M", value_parser = parse_length)]
    gsd: Option<f64>,
    /// Difference of height between two contours, metres
    #[arg(long, value_name = "M", default_value_t = CONTOURS_M, value_parser = parse_length)]
    contours: f64,
    /// GeoJSON file of polygons, in longitude and latitude, whose volumes to measure: above and below a plane through the
    /// polygon's border
    #[arg(long, value_name = "FILE")]
    volumes: Option<PathBuf>,
    /// Memory limit, for example 500MiB. If it is small, the mesh is coarser, and a line on standard error tells that; if it is
    /// too small for the model or the maps, it is refused
    #[arg(long, value_name = "BYTES", default_value = "2GiB", value_parser = parse_bytes)]
    memory: u64,
    /// Print progress and result as lines of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &SurveyArgs) -> Result<()> {
    let folder = files::folder_of(&args.folder);
    let order = SurveyOrder {
        folder: folder.to_owned(),
        out: args.out.clone(),
        georeference: georeference(folder, args)?,
        mesh: None,
        geoid: args.geoid.clone(),
        gsd_m: args.gsd,
        contours_m: args.contours,
        volumes: args.volumes.clone(),
        memory_bytes: args.memory,
        threads: cores(),
    };
    let begun = Instant::now();
    let accuracy = deliver(&order, display(args.json), || begun.elapsed())?;
    print(&accuracy, &args.out, begun.elapsed().as_secs_f64(), args.json)
}

/// Where the model lies, from the options or from its folder.
fn georeference(folder: &Path, args: &SurveyArgs) -> Result<Georeference> {
    ensure!(folder.is_dir(), "{}: there is no such folder; name that of a model", folder.display());
    let mut georeference = match (args.origin, Georeference::of_folder(folder)?) {
        (Some(origin), _) => Georeference::at(origin)?,
        (None, Some(georeference)) => georeference,
        (None, None) => bail!(
            "{}: there is no {} with an origin, which tells where on the earth the model lies; give the world's origin with --origin LAT,LON,HEIGHT if its unit is the metre and z is up",
            folder.display(),
            Georeference::FILE
        ),
    };
    if let Some(epsg) = args.epsg {
        georeference.epsg = epsg;
    }
    if let Some(doubt) = georeference.projection()?.doubt(&georeference.origin)? {
        eprintln!("{doubt}");
    }
    Ok(georeference)
}

/// Prints what a survey made in the folder `out`.
pub(super) fn print(accuracy: &Accuracy, out: &Path, seconds: f64, json: bool) -> Result<()> {
    let mut stdout = io::stdout().lock();
    if json {
        let line = serde_json::json!({"event": "survey", "accuracy": accuracy, "seconds": seconds});
        writeln!(stdout, "{line}")?;
        return Ok(());
    }
    let Accuracy { epsg, gsd_m, size_px: [width, height], covered_m2, points, .. } = accuracy;
    let [low_m, high_m] = accuracy.height_range_m;
    writeln!(
        stdout,
        "EPSG:{epsg} · {width} × {height} pixels of {gsd_m} m · {covered_m2:.0} m² · heights {low_m:.2} m to {high_m:.2} m, {} · {} · {seconds:.1} s",
        accuracy.heights,
        counted(*points, "point"),
    )?;
    for left_out in &accuracy.volumes_left_out {
        eprintln!("left out of volumes.json: {left_out}");
    }
    for made in &accuracy.made {
        writeln!(stdout, "{}", out.join(made.file).display())?;
    }
    writeln!(stdout, "{}", out.join("accuracy.json").display())?;
    Ok(())
}
