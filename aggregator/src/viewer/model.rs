//! A model as the viewer reads it: splats as SPZ, and the scene that they stand in as JSON. If the model is too large for a
//! page or for the memory, only its most important splats are kept.

use std::path::{Path, PathBuf};

use cosurf_geo::{GeoError, Geodetic, Georeference};
use cosurf_link::plain_importance;
use cosurf_scene::{Camera, Dataset, LocalFrame, SceneError, Splats, evenly_spaced, model, ply, spz};
use glam::DMat3;
use serde::Serialize;

use super::lie::Lie;

/// Number of splats that are read at a time.
const READ_AT_ONCE: usize = 4096;
/// Largest number of photographs whose places the viewer offers.
const CAMERAS_MAX: usize = 500;
/// Share of the splats that is kept beyond what the last file's size asks for: other splats compress a little worse.
const CAUTION: f64 = 0.97;

/// How large a model for the viewer may become.
#[derive(Clone, Copy, Debug)]
pub struct Room {
    /// Limit on the splats in memory and on what is made of them, bytes; `None` for no limit.
    pub memory_bytes: Option<u64>,
    /// Limit on the SPZ, bytes; `None` for no limit.
    pub file_bytes: Option<usize>,
}

impl Room {
    /// No limits.
    pub const UNLIMITED: Self = Self { memory_bytes: None, file_bytes: None };

    /// Largest number of splats in memory, together with their SPZ before and after its compression, and its text in a page.
    fn splats_max(&self, sh_degree: u32) -> usize {
        let body = spz::body_bytes(sh_degree);
        let each = Splats::bytes_per_splat(sh_degree) + body + 4 * body / 3;
        self.memory_bytes.map_or(usize::MAX, |bytes| (bytes / each as u64) as usize)
    }
}

/// Why there is no model for the viewer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WalkableError {
    /// The model or its cameras cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The georeference cannot be read.
    #[error(transparent)]
    Geo(#[from] GeoError),
    /// The model has no splats, or no splat fits into the memory.
    #[error("{}: no splats to show", path.display())]
    Nothing {
        /// The file.
        path: PathBuf,
    },
    /// SPZ, the viewer's format, cannot hold the positions.
    #[error("{}: coordinates beyond 8,388,607 cannot be shown; move the model nearer to its origin", path.display())]
    TooFar {
        /// The file.
        path: PathBuf,
    },
}

/// What the viewer is told beside the splats; the content of `scene.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Scene {
    /// Name of the model.
    name: String,
    /// World position of the model's origin, world units.
    origin: [f64; 3],
    /// Length of the model's unit, world units.
    unit: f64,
    /// Up direction, an axis.
    up: [f64; 3],
    /// Place of the world's origin on the earth; absent if the model is not georeferenced.
    geo: Option<Geodetic>,
    /// Some of the cameras, in the model's frame.
    cameras: Vec<SceneCamera>,
    /// Number of splats in the file.
    splats: usize,
    /// Number of splats of the whole model.
    of_splats: usize,
}

/// A camera as `viewer/draw.js` describes it.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct SceneCamera {
    /// `cam_from_world`, row by row.
    rotation: [f64; 9],
    translation: [f64; 3],
    focal_px: [f64; 2],
    center_px: [f64; 2],
    size_px: [u32; 2],
}

impl SceneCamera {
    fn of(camera: &Camera) -> Self {
        let rotation = DMat3::from_quat(camera.cam_from_world.rotation.normalize());
        Self {
            // The columns of the transpose are the rows.
            rotation: rotation.transpose().to_cols_array(),
            translation: camera.cam_from_world.translation.to_array(),
            focal_px: camera.focal_px.to_array(),
            center_px: camera.center_px.to_array(),
            size_px: camera.size_px,
        }
    }
}

/// A model for the viewer.
#[derive(Clone, Debug)]
pub struct Walkable {
    scene: Scene,
    spz: Vec<u8>,
    frame: LocalFrame,
    lie: Lie,
}

impl Walkable {
    /// Reads a model: a file of a known format, or the folder of a training, a merge, a service or a mission. Cameras and `geo.json`
    /// beside the model are used if they are there.
    pub fn read(model: &Path, room: Room) -> Result<Self, WalkableError> {
        let path = ply::of_model(model)?;
        let beside = path.parent().unwrap_or(Path::new(""));
        let world_cameras = match beside.join("cameras.json").is_file() {
            true => Dataset::cameras(beside)?,
            false => Vec::new(),
        };
        let geo = Georeference::of_folder(beside)?.map(|georeference| georeference.origin);
        let (splats, of_splats, frame) = read(&path, &world_cameras, room)?;
        if splats.is_empty() {
            return Err(WalkableError::Nothing { path });
        }
        let cameras = evenly_spaced(&world_cameras, CAMERAS_MAX);
        let cameras: Vec<Camera> = cameras.iter().map(|camera| frame.local_camera(camera)).collect();
        let lie = Lie::of(&splats, &cameras, geo.is_some());
        let spz = encode(splats, room.file_bytes, &path)?;
        let scene = Scene {
            name: model.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned()),
            origin: frame.origin().to_array(),
            unit: frame.unit(),
            up: lie.up.to_array(),
            geo,
            cameras: cameras.iter().map(SceneCamera::of).collect(),
            splats: spz.splats,
            of_splats,
        };
        Ok(Self { scene, spz: spz.bytes, frame, lie })
    }

    /// The scene as JSON.
    pub(crate) fn scene_json(&self) -> String {
        serde_json::to_string(&self.scene).expect("numbers and texts")
    }

    /// The splats as an SPZ file.
    pub(crate) fn spz(&self) -> &[u8] {
        &self.spz
    }

    /// The splats as an SPZ file.
    pub(crate) fn into_spz(self) -> Vec<u8> {
        self.spz
    }

    /// Name of the model: that of its file or folder.
    pub(crate) fn name(&self) -> &str {
        &self.scene.name
    }

    /// The frame of splats and cameras.
    pub(crate) fn frame(&self) -> &LocalFrame {
        &self.frame
    }

    /// A camera that looks at the whole model, in its frame.
    pub(crate) fn overview(&self, size_px: [u32; 2]) -> Camera {
        self.lie.overview(size_px)
    }

    /// Median length on the ground that a pixel of the photographs covers, world units; `None` without cameras.
    pub(crate) fn pixel(&self) -> Option<f64> {
        self.lie.pixel.map(|length| length * self.frame.unit())
    }

    /// Area of the ground between the points that the photographs are centred on, squared world units; `None` if there is
    /// none.
    pub(crate) fn area(&self) -> Option<f64> {
        self.lie.area.map(|area| area * self.frame.unit().powi(2))
    }

    /// Number of splats that are shown, and number of splats of the whole model.
    pub fn shown(&self) -> [usize; 2] {
        [self.scene.splats, self.scene.of_splats]
    }
}

/// The splats of a file, or its most important ones if the memory is small; the number of all; and their frame.
fn read(path: &Path, cameras: &[Camera], room: Room) -> Result<(Splats, usize, LocalFrame), WalkableError> {
    let frame = match cameras {
        [] => LocalFrame::at(model::origin(path)?),
        cameras => LocalFrame::of(cameras.iter()),
    };
    let (count, sh_degree) = model::size(path)?;
    let most = room.splats_max(sh_degree);
    if count <= most {
        return Ok((model::read(path, &frame)?, count, frame));
    }
    let mut importances = Vec::with_capacity(count);
    model::read_parts(path, &frame, READ_AT_ONCE, |part| importances.extend(plain_importance(part)))?;
    let least = least_of(importances, most);
    let mut kept = Splats::with_capacity(most, sh_degree);
    model::read_parts(path, &frame, READ_AT_ONCE, |part| keep(part, least, most, &mut kept))?;
    Ok((kept, count, frame))
}

/// The smallest importance of the `most` most important splats. `most` must be below the number of splats.
fn least_of(mut importances: Vec<f32>, most: usize) -> f32 {
    let at = importances.len() - most.max(1);
    *importances.select_nth_unstable_by(at, f32::total_cmp).1
}

/// Appends the splats that are at least so important, until there are `most`.
fn keep(from: &Splats, least: f32, most: usize, kept: &mut Splats) {
    for (i, importance) in plain_importance(from).into_iter().enumerate() {
        if importance >= least && kept.len() < most {
            kept.push_from(from, i);
        }
    }
}

struct Encoded {
    bytes: Vec<u8>,
    splats: usize,
}

/// Encodes as many splats as the limit allows, the most important ones.
fn encode(mut splats: Splats, file_bytes: Option<usize>, path: &Path) -> Result<Encoded, WalkableError> {
    loop {
        let bytes = spz::to_bytes(&splats).ok_or_else(|| WalkableError::TooFar { path: path.into() })?;
        let limit = file_bytes.unwrap_or(usize::MAX);
        if bytes.len() <= limit {
            return Ok(Encoded { bytes, splats: splats.len() });
        }
        let most = ((splats.len() as f64 * limit as f64 / bytes.len() as f64 * CAUTION) as usize).max(1);
        let least = least_of(plain_importance(&splats), most);
        let mut kept = Splats::with_capacity(most, splats.sh_degree);
        keep(&splats, least, most, &mut kept);
        splats = kept;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::camera_list;
    use glam::DVec3;

    use super::*;
    use crate::testing::{above, ground};

    /// The ground with the importances of its splats falling from west to east.
    fn model() -> Splats {
        let mut model = ground(0.0, 100.0);
        let means = model.means.clone();
        for (log_scale, mean) in model.log_scales.iter_mut().zip(means) {
            log_scale[0] -= mean[0] / 50.0;
        }
        model
    }

    fn written(folder: &Path) -> PathBuf {
        let path = folder.join("global.ply");
        ply::write(&path, &model(), &LocalFrame::WORLD).unwrap();
        path
    }

    #[test]
    fn a_folder_gives_splats_cameras_and_place() {
        let folder = tempfile::tempdir().unwrap();
        written(folder.path());
        camera_list::write(&folder.path().join("cameras.json"), &[above(10.0), above(50.0)]).unwrap();
        let origin = Geodetic { latitude_deg: 53.3, longitude_deg: 16.4, height_m: 70.0 };
        std::fs::write(folder.path().join("geo.json"), Georeference::at(origin).unwrap().to_json()).unwrap();
        let walkable = Walkable::read(folder.path(), Room::UNLIMITED).unwrap();
        assert_eq!(walkable.shown(), [model().len(); 2]);
        assert_eq!((walkable.scene.cameras.len(), walkable.scene.geo), (2, Some(origin)));
        let camera = &walkable.scene.cameras[0];
        let world = above(10.0).cam_from_world;
        let corner = DVec3::new(3.0, 4.0, 5.0);
        let row = |k: usize| DVec3::from_slice(&camera.rotation[3 * k..]).dot(corner) + camera.translation[k];
        let expected = world.rotation * corner + world.translation;
        assert!((DVec3::from_array([0, 1, 2].map(row)) - expected).length() < 1e-9, "rows of the rotation");
        let text: serde_json::Value = serde_json::from_str(&walkable.scene_json()).unwrap();
        assert_eq!(text["geo"]["latitude_deg"], 53.3);
    }

    #[test]
    fn a_small_page_gets_the_most_important_splats() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let whole = Walkable::read(&path, Room::UNLIMITED).unwrap();
        let limit = whole.spz().len() / 2;
        let room = Room { file_bytes: Some(limit), ..Room::UNLIMITED };
        let small = Walkable::read(&path, room).unwrap();
        let [shown, of] = small.shown();
        assert!(small.spz().len() <= limit && shown > of / 4 && of == model().len(), "{shown} of {of}");
        check_western(&small, folder.path());
    }

    #[test]
    fn little_memory_gets_the_most_important_splats() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let each = (1 << 20) / Room { memory_bytes: Some(1 << 20), file_bytes: None }.splats_max(0) as u64;
        let room = Room { memory_bytes: Some(each * model().len() as u64 / 3), ..Room::UNLIMITED };
        let small = Walkable::read(&path, room).unwrap();
        let [shown, of] = small.shown();
        assert!(shown > of / 4 && shown <= of / 3, "{shown} of {of}");
        check_western(&small, folder.path());
        let nothing = Walkable::read(&path, Room { memory_bytes: Some(0), ..room });
        assert!(matches!(nothing, Err(WalkableError::Nothing { .. })));
    }

    /// The shown splats must be the most important ones, which lie in the west.
    fn check_western(small: &Walkable, folder: &Path) {
        let file = folder.join("small.spz");
        std::fs::write(&file, small.spz()).unwrap();
        let kept = spz::read(&file).unwrap();
        let middle =
            |splats: &Splats| splats.means.iter().map(|mean| mean[0]).sum::<f32>() / splats.len() as f32;
        assert!(middle(&kept) < middle(&model()) - 10.0, "{} {}", middle(&kept), middle(&model()));
    }
}
