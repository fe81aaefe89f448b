//! A model as the viewer reads it: splats as SPZ, and the scene that they stand in as JSON. If the model is too large for a
//! page or for the memory, only its most important splats are kept.

use std::path::{Path, PathBuf};

use cosurf_geo::{Geodetic, Georeference};
use cosurf_link::{ModelKey, ModelStore, body_to_model, scene_frame};
use cosurf_scene::{Camera, Dataset, LocalFrame, Splats, evenly_spaced, ply};
use glam::{DMat3, DVec3};
use serde::Serialize;

use super::error::WalkableError;
use super::lie::Lie;
use super::room::{Read, Room, encode, first_of, read};
use crate::colors::device_color;
use crate::service::Contribution;

/// Largest number of photographs whose places the viewer offers.
const CAMERAS_MAX: usize = 500;
/// The upper ends of the classes of errors but the last one, metres: from a good survey's error to one that everybody sees.
const ERROR_BOUNDS_M: [f32; 6] = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5];

/// What the viewer is told beside the splats; the content of `scene.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Scene {
    /// Name of the model.
    name: String,
    /// Its number, if it is a revision of a running site.
    #[serde(skip_serializing_if = "Option::is_none")]
    revision: Option<u64>,
    /// World position of the model's origin, world units.
    origin: [f64; 3],
    /// Length of the model's unit, world units.
    unit: f64,
    /// Up direction, an axis.
    up: [f64; 3],
    /// Place of the world's origin on the earth; absent if the model is not georeferenced.
    geo: Option<Geodetic>,
    /// The devices that photographs are known to be of.
    devices: Vec<SceneDevice>,
    /// Absent if the page has the whole model, or cannot get tiles of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    tiles: Option<SceneTiles>,
    /// Absent if the true surface is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    errors: Option<SceneErrors>,
    /// Some of the cameras, in the model's frame.
    cameras: Vec<SceneCamera>,
    /// Number of all cameras.
    of_cameras: usize,
    /// Number of splats in the file.
    splats: usize,
    /// Number of splats in the first part; 0 if there is none.
    first_splats: usize,
    /// Number of splats of the whole model, without the broken ones.
    of_splats: usize,
    /// Number of splats of the file that no viewer can draw: infinite, or not a number.
    broken_splats: usize,
}

/// A device whose photographs show the model.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct SceneDevice {
    name: String,
    /// Its colour, as red, green and blue.
    color: [u8; 3],
    /// When its model arrived, seconds since 1970; absent if that is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    arrived_s: Option<u64>,
}

/// The tiles of a large model, which the viewer shows in full near the camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct SceneTiles {
    /// The revision that they are of. Tile `i` is at `tiles/REVISION/i`, as SPZ.
    revision: u64,
    boxes: Vec<TileBox>,
}

/// Where a tile is.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct TileBox {
    /// Number of splats.
    splats: usize,
    /// Opposite corners of the box around them, in the model's frame.
    low: [f64; 3],
    high: [f64; 3],
}

/// How far the splats are from the true surface.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct SceneErrors {
    /// The upper ends of all classes but the last one, metres.
    bounds_m: [f32; 6],
    /// The class of each splat of the file, a digit; `x` if it is not known.
    classes: String,
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
    /// Its device by the place in [`Scene::devices`]; absent if that is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    device: Option<usize>,
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
            device: None,
        }
    }
}

/// What a model for the viewer is made of.
struct Source {
    name: String,
    /// The file or folder, for errors.
    path: PathBuf,
    /// The splats in `frame`: all, or the most important ones.
    splats: Splats,
    of_splats: usize,
    broken_splats: usize,
    frame: LocalFrame,
    world_cameras: Vec<Camera>,
    geo: Option<Geodetic>,
}

/// A model for the viewer.
#[derive(Clone, Debug)]
pub struct Walkable {
    scene: Scene,
    spz: Vec<u8>,
    /// The first part as SPZ, if there is one.
    first: Option<Vec<u8>>,
    frame: LocalFrame,
    lie: Lie,
    /// Where the splats of the file are, in the frame.
    means: Vec<[f32; 3]>,
    /// Those of the scene.
    cameras: Vec<Camera>,
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
        let Read { splats, of_splats, broken_splats, frame } = read(&path, &world_cameras, room)?;
        // A path like `.` has no name of its own.
        let whole = model.canonicalize().unwrap_or_else(|_| model.to_owned());
        let name =
            whole.file_name().map_or_else(|| "model".into(), |name| name.to_string_lossy().into_owned());
        Self::of(Source { name, path, splats, of_splats, broken_splats, frame, world_cameras, geo }, room)
    }

    /// Reads a stored revision of a service's global model. `folder` is that of the service. A revision that takes more than
    /// the memory is not shown.
    pub(crate) fn stored(
        store: &Path,
        key: ModelKey,
        folder: &Path,
        room: Room,
    ) -> Result<Self, WalkableError> {
        let models = ModelStore::beside(store);
        let header = models.header(key)?;
        let (of_splats, path) = (header.splats as usize, store.to_owned());
        if of_splats > room.splats_max(header.sh_degree.into()) {
            return Err(WalkableError::TooLarge { path, splats: of_splats });
        }
        let (_, body) = models.get(key)?;
        let broken = |fault| WalkableError::Body { path: path.clone(), fault };
        let frame = scene_frame(&body).map_err(broken)?;
        let model = body_to_model(&body, &frame).map_err(broken)?;
        drop(body);
        let world_cameras = model.cameras.iter().map(|camera| frame.world_camera(camera)).collect();
        let geo = Georeference::of_folder(folder)?.map(|georeference| georeference.origin);
        let name = format!("revision {}", key.model);
        let (splats, broken_splats) = (model.splats, 0); // what a service stores is checked
        Self::of(Source { name, path, splats, of_splats, broken_splats, frame, world_cameras, geo }, room)
    }

    fn of(source: Source, room: Room) -> Result<Self, WalkableError> {
        let Source { name, path, splats, of_splats, broken_splats, frame, world_cameras, geo } = source;
        if splats.is_empty() {
            return Err(WalkableError::Nothing { path });
        }
        let cameras = evenly_spaced(&world_cameras, CAMERAS_MAX);
        let cameras: Vec<Camera> = cameras.iter().map(|camera| frame.local_camera(camera)).collect();
        let lie = Lie::of(&splats, &cameras, geo.is_some());
        let first = room.first_splats.and_then(|most| first_of(&splats, most));
        let first = first.map(|splats| encode(splats, None, &path)).transpose()?;
        let (first, first_splats) = first.map_or((None, 0), |(spz, splats)| (Some(spz), splats.len()));
        let (spz, splats) = encode(splats, room.file_bytes, &path)?;
        let scene = Scene {
            name,
            revision: None,
            origin: frame.origin().to_array(),
            unit: frame.unit(),
            up: lie.up.to_array(),
            geo,
            devices: Vec::new(),
            tiles: None,
            errors: None,
            cameras: cameras.iter().map(SceneCamera::of).collect(),
            of_cameras: world_cameras.len(),
            splats: splats.len(),
            first_splats,
            of_splats,
            broken_splats,
        };
        Ok(Self { scene, spz, first, frame, lie, means: splats.means, cameras })
    }

    /// Names the devices that took the photographs. Cameras beside the model beyond theirs are of no known device.
    pub fn with_devices(mut self, devices: Vec<Contribution>) -> Self {
        let cameras_of = |(i, its): (usize, &Contribution)| std::iter::repeat_n(i, its.cameras);
        let of: Vec<usize> = devices.iter().enumerate().flat_map(cameras_of).collect();
        let (listed, all) = (self.scene.cameras.len(), self.scene.of_cameras);
        // As `evenly_spaced` has chosen them.
        for (i, camera) in self.scene.cameras.iter_mut().enumerate() {
            camera.device = of.get(i * all / listed).copied();
        }
        let device = |Contribution { device: name, arrived_s, .. }: Contribution| SceneDevice {
            color: device_color(&name),
            name,
            arrived_s,
        };
        self.scene.devices = devices.into_iter().map(device).collect();
        self
    }

    /// Tells which revision of a running site it is.
    pub(crate) fn with_revision(mut self, revision: u64) -> Self {
        self.scene.revision = Some(revision);
        self
    }

    /// Tells where the tiles of this revision are: the number of splats of each, and opposite corners of the box around them, in
    /// the world.
    pub(crate) fn with_tiles(
        mut self,
        revision: u64,
        boxes: impl Iterator<Item = (usize, [DVec3; 2])>,
    ) -> Self {
        let tile_box = |(splats, corners): (usize, [DVec3; 2])| {
            let [low, high] = corners.map(|corner| self.frame.local_from_world(corner).to_array());
            TileBox { splats, low, high }
        };
        self.scene.tiles = Some(SceneTiles { revision, boxes: boxes.map(tile_box).collect() });
        self
    }

    /// Tells how far each splat is from the true surface, metres; not a number where that is not known. `errors` gets the places
    /// of the splats and some cameras, in the world.
    pub(crate) fn with_errors(mut self, errors: impl FnOnce(&[DVec3], &[Camera]) -> Vec<f32>) -> Self {
        let place = |mean: &[f32; 3]| self.frame.world_from_local(DVec3::from(mean.map(f64::from)));
        let places: Vec<DVec3> = self.means.iter().map(place).collect();
        let cameras: Vec<Camera> =
            self.cameras.iter().map(|camera| self.frame.world_camera(camera)).collect();
        let class = |error: f32| match error.is_nan() {
            true => 'x',
            false => char::from(b'0' + ERROR_BOUNDS_M.iter().filter(|bound| error >= **bound).count() as u8),
        };
        let classes = errors(&places, &cameras).into_iter().map(class).collect();
        self.scene.errors = Some(SceneErrors { bounds_m: ERROR_BOUNDS_M, classes });
        self
    }

    /// The scene as JSON.
    pub(crate) fn scene_json(&self) -> String {
        serde_json::to_string(&self.scene).expect("numbers and texts")
    }

    /// The splats as an SPZ file.
    pub(crate) fn spz(&self) -> &[u8] {
        &self.spz
    }

    /// The most important splats as an SPZ file, if there are many more.
    pub(crate) fn first(&self) -> Option<&[u8]> {
        self.first.as_deref()
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

    /// Number of splats that are shown, and number of splats of the whole model, without the broken ones.
    pub fn shown(&self) -> [usize; 2] {
        [self.scene.splats, self.scene.of_splats]
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::{above, ground};
    use cosurf_link::{FirstLayer, Offer, model_to_body};
    use cosurf_scene::{Base, camera_list, spz};
    use cosurf_wire::{DeviceId, ModelId, ModelKind};

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
    fn listed_cameras_keep_their_devices() {
        let folder = tempfile::tempdir().unwrap();
        written(folder.path());
        let cameras: Vec<Camera> = (0..2 * CAMERAS_MAX).map(|i| above(i as f64 / 20.0)).collect();
        camera_list::write(&folder.path().join("cameras.json"), &cameras).unwrap();
        let device =
            |name: &str, cameras, arrived_s| Contribution { device: name.into(), cameras, arrived_s };
        let devices = vec![device("a", 500, Some(1_700_000_000)), device("b", 300, None)];
        let walkable = Walkable::read(folder.path(), Room::UNLIMITED).unwrap().with_devices(devices);
        let of = |device: Option<usize>| {
            walkable.scene.cameras.iter().filter(|camera| camera.device == device).count()
        };
        assert_eq!([of(Some(0)), of(Some(1)), of(None)], [250, 150, 100]);
        assert_eq!((walkable.scene.devices.len(), walkable.scene.of_cameras), (2, 2 * CAMERAS_MAX));
        let text: serde_json::Value = serde_json::from_str(&walkable.scene_json()).unwrap();
        assert_eq!(text["devices"][0]["arrived_s"], 1_700_000_000);
        assert!(text["devices"][1]["arrived_s"].is_null());
    }

    #[test]
    fn errors_are_told_in_classes_of_the_splats_that_are_shown() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let limit = Walkable::read(&path, Room::UNLIMITED).unwrap().spz().len() / 2;
        let small = Walkable::read(&path, Room { file_bytes: Some(limit), ..Room::UNLIMITED }).unwrap();
        let shown = small.shown()[0];
        let small = small.with_errors(|places, _| {
            assert_eq!(places.len(), shown);
            let mut errors = vec![0.03; shown];
            errors[..4].copy_from_slice(&[0.0, 0.01, 7.0, f32::NAN]);
            errors
        });
        let errors = small.scene.errors.unwrap();
        assert_eq!((&errors.classes[..6], errors.classes.len()), ("016x22", shown));
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

    /// Broken splats are not left out to keep a page small.
    #[test]
    fn broken_splats_are_counted_apart() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("broken.ply");
        let mut splats = model();
        splats.means[7][0] = f32::NAN;
        splats.log_scales[9][1] = f32::INFINITY;
        ply::write(&path, &splats, &LocalFrame::WORLD).unwrap();
        let usable = splats.len() - 2;
        let whole = Walkable::read(&path, Room::UNLIMITED).unwrap();
        assert_eq!((whole.shown(), whole.scene.broken_splats), ([usable; 2], 2));
        // All usable ones fit although all of the file do not.
        let just = Walkable::read(&path, Room { splats: Some(usable + 1), ..Room::UNLIMITED }).unwrap();
        assert_eq!((just.shown(), just.scene.broken_splats), ([usable; 2], 2));
        let few = Walkable::read(&path, Room { splats: Some(usable / 2), ..Room::UNLIMITED }).unwrap();
        assert_eq!((few.shown(), few.scene.broken_splats), ([usable / 2, usable], 2));
    }

    #[test]
    fn little_memory_gets_the_most_important_splats() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let each = (1 << 20) / Room { memory_bytes: Some(1 << 20), ..Room::UNLIMITED }.splats_max(0) as u64;
        let room = Room { memory_bytes: Some(each * model().len() as u64 / 3), ..Room::UNLIMITED };
        let small = Walkable::read(&path, room).unwrap();
        let [shown, of] = small.shown();
        assert!(shown > of / 4 && shown <= of / 3, "{shown} of {of}");
        check_western(&small, folder.path());
        let nothing = Walkable::read(&path, Room { memory_bytes: Some(0), ..room });
        assert!(matches!(nothing, Err(WalkableError::Nothing { .. })));
    }

    #[test]
    fn a_large_model_has_a_first_part() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let most = model().len() / 4;
        let room = Room { first_splats: Some(most), ..Room::UNLIMITED };
        let whole = Walkable::read(&path, room).unwrap();
        assert_eq!((whole.scene.first_splats, whole.scene.splats), (most, model().len()));
        std::fs::write(folder.path().join("first.spz"), whole.first().unwrap()).unwrap();
        assert_eq!(spz::read(&folder.path().join("first.spz")).unwrap().len(), most);
        let few = Room { first_splats: Some(model().len() * 2 / 3), ..room };
        assert_eq!(Walkable::read(&path, few).unwrap().first(), None);
    }

    #[test]
    fn a_stored_revision_is_shown_in_the_world() {
        let folder = tempfile::tempdir().unwrap();
        let store = folder.path().join("global");
        let (models, _) = ModelStore::open(&store).unwrap();
        let (camera, device, number) = (above(10.0), DeviceId::new("ground").unwrap(), ModelId(4));
        let body = model_to_body(&model(), &[camera], &LocalFrame::WORLD, FirstLayer::Base(&Base::default()))
            .unwrap();
        let offer = Offer::from_body(device, number, ModelKind::Global, 1, body).unwrap();
        models.put(&offer.header, &offer.body).unwrap();
        let key = ModelKey { device, model: number };
        let shown = Walkable::stored(&store, key, folder.path(), Room::UNLIMITED).unwrap();
        assert_eq!((shown.shown(), shown.name()), ([model().len(); 2], "revision 4"));
        let eye = shown.frame.world_camera(&shown.frame.local_camera(&camera)).cam_from_world.center();
        assert!((eye - camera.cam_from_world.center()).length() < 1e-6);
        let small = Room { memory_bytes: Some(1000), ..Room::UNLIMITED };
        let refused = Walkable::stored(&store, key, folder.path(), small).unwrap_err();
        assert!(refused.to_string().contains("too much memory"), "{refused}");
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
