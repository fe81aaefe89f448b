//! Writes the synthetic city as a dataset, with a contact sheet to look at.
//!
//! `cargo run --release -p cosurf-city --example city -- OUT_DIR [SEED [EXTENT_M [VIEWS [WIDTH HEIGHT]]]]`

use std::path::PathBuf;
use std::process::ExitCode;
use std::str::FromStr;
use std::time::Instant;

use cosurf_city::{City, CitySettings};
use cosurf_scene::{Dataset, Picture, SceneError};

/// Columns of the contact sheet, and its largest number of rows.
const SHEET: [u32; 2] = [5, 6];

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let Some((folder, settings)) = parse(&args) else {
        eprintln!("usage: city OUT_DIR [SEED [EXTENT_M [VIEWS [WIDTH HEIGHT]]]]");
        return ExitCode::FAILURE;
    };
    match run(&folder, &settings) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn parse(args: &[String]) -> Option<(PathBuf, CitySettings)> {
    let mut settings = CitySettings::default();
    fn set<T: FromStr>(target: &mut T, text: Option<&String>) -> Option<()> {
        text.map_or(Some(()), |text| text.parse().map(|value| *target = value).ok())
    }
    set(&mut settings.seed, args.get(1))?;
    set(&mut settings.extent_m, args.get(2))?;
    set(&mut settings.views, args.get(3))?;
    set(&mut settings.size_px[0], args.get(4))?;
    set(&mut settings.size_px[1], args.get(5))?;
    Some((PathBuf::from(args.first()?), settings))
}

fn run(folder: &std::path::Path, settings: &CitySettings) -> Result<(), Box<dyn std::error::Error>> {
    let start = Instant::now();
    let city = City::build(settings)?;
    println!("built {} triangles in {:.2} s", city.triangle_count(), start.elapsed().as_secs_f64());
    let mut rendered = start.elapsed();
    let dataset = city.write(folder, |_, _| rendered = start.elapsed())?;
    let [width, height] = settings.size_px.map(f64::from);
    let pixels = width * height * f64::from(settings.views);
    println!(
        "{} views, {} sparse points, pictures at {:.2} million pixels/s, all in {:.2} s",
        dataset.views.len(),
        dataset.points.len(),
        pixels / 1e6 / (rendered.as_secs_f64()),
        start.elapsed().as_secs_f64()
    );
    contact_sheet(&dataset)?.write_png(&folder.join("contact.png"))?;
    Ok(())
}

/// Thumbnails of pictures that are evenly spread over the flight.
fn contact_sheet(dataset: &Dataset) -> Result<Picture, SceneError> {
    let columns = SHEET[0];
    let shown = (SHEET[0] * SHEET[1]).min(dataset.views.len() as u32);
    let rows = shown.div_ceil(columns);
    let [width, height] = dataset.views[0].camera.fitted_size(320);
    let mut sheet = vec![0; (3 * columns * width * rows * height) as usize];
    for slot in 0..shown {
        let view = &dataset.views[dataset.views.len() * slot as usize / shown as usize];
        let thumbnail = Picture::read_fitted(&view.path, [width, height])?;
        let (left, top) = (slot % columns * width, slot / columns * height);
        for (y, row) in (0..).zip(thumbnail.rgb.chunks_exact(3 * width as usize)) {
            let from = (3 * ((top + y) * columns * width + left)) as usize;
            sheet[from..from + row.len()].copy_from_slice(row);
        }
    }
    Ok(Picture::new([columns * width, rows * height], sheet))
}
