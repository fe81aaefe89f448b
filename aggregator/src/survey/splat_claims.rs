//! The splats with what the cameras tell of each: `splats.ply`, a PLY of 3DGS with further properties.
//!
//! A camera shows a splat if it shows its centre: the depths agree as they must for a pixel of the map. The model need not
//! fit into the memory: the depths of all cameras are read again for every few splats, as many as there is room for.
//!
//! What it knows nothing about: which splats float, and why.
//!
//! Where to start reading: [`write_splat_claims`].

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, Write};
use std::path::Path;

use cosurf_engine::budget::PROCESS_BYTES;
use cosurf_scene::{LocalFrame, SceneError, Splats, ply};
use glam::DVec3;
use rayon::prelude::*;

use super::confidence::Scale;
use super::depths::Depths;
use super::error::SurveyError;
use super::scene::Scene;
use super::views::{Picture, Views};

/// Name of the file.
const FILE: &str = "splats.ply";
/// The properties behind those of 3DGS.
const PROPERTIES: [&str; 4] = ["views", "through", "spread_m", "error_m"];
/// Splats that are read at once; with harmonics of degree 3, they take a MiB.
const PART: usize = 4096;
/// Bytes for a splat while its views are counted: its position, and the counts.
const BYTES_EACH: u64 = (size_of::<[f32; 3]>() + size_of::<Views>()) as u64;
/// Bytes for what is read and written meanwhile.
const READING_BYTES: u64 = 6 << 20;

/// Writes the splats of a scene that do not float to `splats.ply` in `out`. `on_view` gets the number of views that are
/// done, and of all: a camera counts as often as its depths are read.
pub(super) fn write_splat_claims(
    out: &Path,
    scene: &Scene,
    floats: &[bool],
    depths: &mut Depths,
    scale: &Scale,
    memory_bytes: u64,
    on_view: impl FnMut(usize, usize),
) -> Result<(), SurveyError> {
    let kept = floats.iter().filter(|floats| !**floats).count();
    let held_bytes = PROCESS_BYTES + READING_BYTES + floats.len() as u64 + depths.largest_bytes();
    let room_bytes = memory_bytes.saturating_sub(held_bytes);
    let at_once = ((room_bytes / BYTES_EACH) as usize).max(PART).min(kept.max(1));

    let failed = |cause| SceneError::io(out, cause);
    let mut views = tempfile::tempfile_in(out).map_err(failed)?;
    let passes = [0, kept.div_ceil(at_once)];
    let mut counter = Counter { depths, frame: &scene.frame, voxel_m: scale.voxel_m, passes, on_view };
    counter.count_all(scene, floats, at_once, |views_of_some| {
        views.write_all(bytemuck::cast_slice(views_of_some)).map_err(failed)
    })?;
    views.rewind().map_err(failed)?;
    write_file(&out.join(FILE), scene, floats, scale, &mut BufReader::new(views))
}

/// Counts the views of splats.
struct Counter<'a, F> {
    depths: &'a mut Depths,
    frame: &'a LocalFrame,
    /// Edge length of a voxel, metres.
    voxel_m: f64,
    /// How often the depths of all cameras have been read, and will have been in the end.
    passes: [usize; 2],
    on_view: F,
}

impl<F: FnMut(usize, usize)> Counter<'_, F> {
    /// Calls `visit` with the views of the splats that do not float, of `at_once` at a time.
    fn count_all(
        &mut self,
        scene: &Scene,
        floats: &[bool],
        at_once: usize,
        mut visit: impl FnMut(&[Views]) -> Result<(), SceneError>,
    ) -> Result<(), SurveyError> {
        let mut means = Vec::with_capacity(at_once);
        let (mut read, mut counted) = (0, Ok(()));
        let mut count = |means: &mut Vec<[f32; 3]>| {
            if counted.is_ok() && !means.is_empty() {
                counted = self.count(means).and_then(|views| Ok(visit(&views)?));
            }
            means.clear();
        };
        scene.splats(PART, |part| {
            for (mean, _) in part.means.iter().zip(&floats[read..]).filter(|(_, floats)| !**floats) {
                means.push(*mean);
                if means.len() == at_once {
                    count(&mut means);
                }
            }
            read += part.len();
        })?;
        count(&mut means);
        counted
    }

    /// The views of splats at these positions, in the frame of the scene.
    fn count(&mut self, means: &[[f32; 3]]) -> Result<Vec<Views>, SurveyError> {
        let mut views = vec![Views::default(); means.len()];
        let (frame, [pass, passes]) = (self.frame, self.passes);
        self.depths.each(|[done, of], map| {
            let picture = Picture::new(map, self.voxel_m);
            views.par_iter_mut().zip(means).with_min_len(4096).for_each(|(views, mean)| {
                picture.add_splat(views, frame.world_from_local(DVec3::from_array(mean.map(f64::from))));
            });
            (self.on_view)(pass * of + done, passes * of);
            Ok::<_, SurveyError>(())
        })?;
        self.passes[0] += 1;
        Ok(views)
    }
}

/// Writes the splats that do not float, with the properties of their `views`.
fn write_file(
    file: &Path,
    scene: &Scene,
    floats: &[bool],
    scale: &Scale,
    views: &mut BufReader<File>,
) -> Result<(), SurveyError> {
    let kept = floats.iter().filter(|floats| !**floats).count();
    ply::write_with_extra(file, kept, scene.sh_degree()?, &scene.frame, &PROPERTIES, |write| {
        let (mut read, mut written) = (0, Ok(()));
        let write_part = |part: &Splats| {
            let is_floating = |i: &u32| floats[read + *i as usize];
            let floating: Vec<u32> = (0..part.len() as u32).filter(is_floating).collect();
            read += part.len();
            if written.is_ok() {
                let kept = part.without(&floating);
                written = next_properties(views, kept.len(), scale).and_then(|values| write(&kept, &values));
            }
        };
        scene.splats(PART, write_part).map_err(io::Error::other)?;
        written
    })?;
    Ok(())
}

/// The values of [`PROPERTIES`] of the next `count` splats.
fn next_properties(views: &mut impl Read, count: usize, scale: &Scale) -> io::Result<Vec<f32>> {
    let mut counts = vec![Views::default(); count];
    views.read_exact(bytemuck::cast_slice_mut(&mut counts))?;
    Ok(counts.iter().flat_map(|views| properties(views, scale)).collect())
}

/// Where nothing is claimed, the error is 0, as no claim is. NaN would make other programs remove the splat: those that
/// search all properties for it, as `splat-transform --filter-nan` does.
fn properties(views: &Views, scale: &Scale) -> [f32; PROPERTIES.len()] {
    // Differences of height around do not count: they are those of the map, and a splat may lie on a wall or below a roof.
    let error_m = scale.claim(views, 0.0).error_m;
    [views.count, views.through, views.spread_m().unwrap_or_default(), error_m]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_views_have_a_spread_but_no_claim() {
        let scale = Scale { gsd_m: 0.1, voxel_m: 0.1 };
        let of = |count, through, spread_m| properties(&Views::of(count, through, spread_m), &scale);
        assert_eq!(of(0.0, 2.0, 0.0), [0.0, 2.0, 0.0, 0.0]);
        assert_eq!(of(2.0, 0.0, 0.25), [2.0, 0.0, 0.25, 0.0]);
        let [count, through, spread_m, error_m] = of(50.0, 0.0, 0.25);
        assert_eq!([count, through, spread_m], [50.0, 0.0, 0.25]);
        assert!(error_m > 0.1, "{error_m}");
    }
}
