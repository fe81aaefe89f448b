//! Scratch: pictures of a city.
#![allow(clippy::unwrap_used)]
use cosurf_scene::{City, CitySettings};
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let out = &args[1];
    let size: u32 = args.get(2).map_or(320, |s| s.parse().unwrap());
    let seed: u64 = args.get(3).map_or(7, |s| s.parse().unwrap());
    let t = std::time::Instant::now();
    let city =
        City::build(&CitySettings { seed, size_px: [size, size * 3 / 4], ..Default::default() }).unwrap();
    eprintln!("built in {:?}, {} triangles", t.elapsed(), city.triangle_count());
    for v in args[4].split(',') {
        let i: usize = v.parse().unwrap();
        let t = std::time::Instant::now();
        let f = city.render(&city.cameras()[i]);
        let void = f.depth.iter().filter(|d| **d == 0.0).count();
        eprintln!("view {i}: {:?} void {void}", t.elapsed());
        image::save_buffer(
            format!("{out}/v{i}.png"),
            &f.picture.rgb,
            f.picture.size_px[0],
            f.picture.size_px[1],
            image::ColorType::Rgb8,
        )
        .unwrap();
    }
}
