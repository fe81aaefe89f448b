//! The distillation of one tile as a task of its own: a file with everything that decides the result. Its hash names the
//! result, so a tile whose task has not changed since an earlier merge need not be distilled again.

use std::collections::{BTreeMap, BTreeSet};

use blake3::{Hash, Hasher};
use cosurf_engine::Device;
use cosurf_scene::{Camera, Frustum, SceneError, Splats};
use serde::{Deserialize, Serialize};

use super::error::MergeError;
use super::plan::{Plan, ViewKey, touches};
use super::scratch::{Floats, numbers};
use super::settings::MergeSettings;
use super::site::Site;

/// The rules by which a task is distilled. Another number must be written here with every change that gives other
/// results, so that no merge takes results of another version for its own.
const RULES: &str = "cosurf tile 1";

/// What a tile is distilled from.
#[derive(Debug)]
pub(super) struct Task {
    contents: Contents,
    /// The splats of the student, then those of each teacher.
    floats: Floats,
    hash: Hash,
}

#[derive(Debug, Serialize, Deserialize)]
struct Contents {
    sh_degree: u32,
    epochs: u32,
    seed: u64,
    /// Number of splats of the tile. They come first in the student.
    own: usize,
    /// Number of splats that are trained.
    student: usize,
    /// The part of each camera's picture with splats of the tile, visible or hidden; one for each pose.
    wide_crops: Vec<Camera>,
    teachers: Vec<Teaching>,
}

/// What a local model shows of the tile.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Teaching {
    /// Place of its splats in the file, and their number.
    at: u64,
    splats: usize,
    /// The parts of its pictures that are needed.
    pub(super) views: Vec<Camera>,
    pub(super) lessons: Vec<Taught>,
}

/// A lesson of a teacher.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Taught {
    /// Place among the lessons of all teachers, best first.
    pub(super) rank: usize,
    /// The view that is taught.
    pub(super) view: usize,
    /// The view of a neighbouring camera, which confirms the surface.
    pub(super) neighbour: Option<usize>,
}

impl Task {
    /// The task of a planned tile, for a device of the class of `device`.
    pub(super) fn of(
        site: &Site,
        plan: &Plan,
        settings: &MergeSettings,
        device: &Device,
    ) -> Result<Self, MergeError> {
        let mut writer = Writer { floats: site.scratch.floats()?, hasher: Hasher::new() };
        let (student, own) = plan.student(site)?;
        writer.write(&student)?;
        let student = student.len();
        let locals: BTreeSet<usize> = plan.lessons.iter().map(|view| view.local).collect();
        let teachers = locals.into_iter().map(|local| teaching(site, plan, local, &mut writer));
        let contents = Contents {
            sh_degree: site.joined.sh_degree(),
            epochs: settings.epochs,
            seed: settings.seed,
            own,
            student,
            wide_crops: plan.wide_crops.clone(),
            teachers: teachers.collect::<Result<_, _>>()?,
        };
        let Writer { floats, mut hasher } = writer;
        hasher.update(&postcard::to_stdvec(&contents).expect("numbers and lists have bytes"));
        hasher.update(device.class().as_bytes());
        hasher.update(RULES.as_bytes());
        Ok(Self { contents, floats, hash: hasher.finalize() })
    }

    /// The hash of everything that decides the result.
    pub(super) fn hash(&self) -> Hash {
        self.hash
    }

    /// Degree of spherical harmonics of all splats.
    pub(super) fn sh_degree(&self) -> u32 {
        self.contents.sh_degree
    }

    pub(super) fn epochs(&self) -> u32 {
        self.contents.epochs
    }

    pub(super) fn seed(&self) -> u64 {
        self.contents.seed
    }

    /// The parts of pictures with splats of the tile, visible or hidden; one for each pose.
    pub(super) fn wide_crops(&self) -> &[Camera] {
        &self.contents.wide_crops
    }

    pub(super) fn teachers(&self) -> &[Teaching] {
        &self.contents.teachers
    }

    /// The cameras of the lessons, best first.
    pub(super) fn cameras(&self) -> Vec<Camera> {
        let of = |teacher: &Teaching| {
            teacher.lessons.iter().map(|lesson| (lesson.rank, teacher.views[lesson.view])).collect::<Vec<_>>()
        };
        let ranked: BTreeMap<usize, Camera> = self.contents.teachers.iter().flat_map(of).collect();
        ranked.into_values().collect()
    }

    /// The splats to train: those of the tile, then others that a part shows.
    pub(super) fn student(&self) -> Result<Splats, SceneError> {
        self.splats(0, self.contents.student)
    }

    /// Number of splats of the tile.
    pub(super) fn own(&self) -> usize {
        self.contents.own
    }

    /// The splats of a teacher.
    pub(super) fn teacher(&self, teaching: &Teaching) -> Result<Splats, SceneError> {
        self.splats(teaching.at, teaching.splats)
    }

    fn splats(&self, at: u64, count: usize) -> Result<Splats, SceneError> {
        let mut splats = Splats::with_capacity(count, self.contents.sh_degree);
        self.floats.read_splats(at, count, &mut splats)?;
        Ok(splats)
    }
}

/// Writes splats to a file and adds them to a hash.
struct Writer {
    floats: Floats,
    hasher: Hasher,
}

impl Writer {
    /// Returns the place of the splats.
    fn write(&mut self, splats: &Splats) -> Result<u64, SceneError> {
        for values in numbers(splats) {
            self.hasher.update(bytemuck::cast_slice(values));
        }
        self.floats.append_splats(splats)
    }
}

/// Writes what the model `local` shows of a tile.
fn teaching(site: &Site, plan: &Plan, local: usize, writer: &mut Writer) -> Result<Teaching, MergeError> {
    let own = plan.lessons.iter().enumerate().filter(|(_, view)| view.local == local);
    let neighbour_of = |view: &ViewKey| {
        let other = site.neighbours[local].nearest(view.camera).map(|camera| ViewKey { camera, ..*view });
        other.filter(|other| plan.crops.contains_key(other))
    };
    let keys: BTreeSet<ViewKey> =
        own.clone().flat_map(|(_, view)| [Some(*view), neighbour_of(view)]).flatten().collect();
    let places: BTreeMap<ViewKey, usize> =
        keys.iter().enumerate().map(|(place, key)| (*key, place)).collect();
    let views: Vec<Camera> = keys.iter().map(|key| plan.crops[key]).collect();
    let taught = |(rank, view): (usize, &ViewKey)| Taught {
        rank,
        view: places[view],
        neighbour: neighbour_of(view).map(|other| places[&other]),
    };
    let frusta: Vec<Frustum> = views.iter().map(Frustum::new).collect();
    let is_seen = |at, radius| frusta.iter().any(|frustum| frustum.touches(at, radius));
    let mut splats = Splats::with_capacity(0, site.models.sh_degree());
    site.models.read(site.pages[local].clone(), |bounds| touches(&frusta, bounds), is_seen, &mut splats)?;
    let at = writer.write(&splats)?;
    Ok(Teaching { at, splats: splats.len(), lessons: own.map(taught).collect(), views })
}
