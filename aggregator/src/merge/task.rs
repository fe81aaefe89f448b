//! The distillation of one tile as a task of its own: a file with everything that decides the result. Its hash names the
//! result, so a tile whose task has not changed since an earlier merge need not be distilled again.

mod limits;
mod sizes;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use blake3::{Hash, Hasher};
use bytes::Bytes;
use cosurf_engine::Device;
use cosurf_scene::{Camera, Frustum, SceneError, Splats};
use serde::{Deserialize, Serialize};

use super::crop::Part;
use super::error::MergeError;
use super::plan::{Plan, ViewKey, touches};
use super::settings::MergeSettings;
use super::site::Site;
use crate::scratch::{Floats, Scratch, numbers};
use crate::store::Store;
use sizes::check_sizes;

/// The rules by which a task is distilled. Another number must be written here with every change that gives other
/// results, so that no merge takes results of another version for its own.
const RULES: &str = "cosurf tile 4";
/// A task in a store begins with the length of its contents, in so many bytes. The contents and the numbers follow.
const HEAD: usize = size_of::<u32>();
/// Tasks are written to a store and read in parts of this size, bytes. A bucket takes no smaller parts than 5 MiB.
const PART_BYTES: usize = 8 << 20;

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
    /// Bytes that the distillation takes.
    bytes: u64,
}

/// What a local model shows of the tile.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Teaching {
    /// Place of its splats in the file, and their number.
    at: u64,
    splats: usize,
    /// The parts of its pictures that are needed.
    pub(super) views: Vec<Part>,
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
        let mut writer = Writer { floats: site.scratch.column()?, hasher: Hasher::new() };
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
            bytes: plan.bytes,
        };
        let Writer { floats, hasher } = writer;
        let hash = hashed(hasher, &contents.encoded(), device);
        Ok(Self { contents, floats, hash })
    }

    /// Writes the task to a store, for workers.
    pub(super) fn put(&self, store: &Store) -> Result<(), MergeError> {
        let mut first = Some(self.contents.encoded());
        let mut at = 0;
        let mut values = Vec::new();
        store.put_parts(&name(&self.hash), || {
            let mut part = Vec::with_capacity(PART_BYTES);
            if let Some(contents) = first.take() {
                part.extend((contents.len() as u32).to_le_bytes());
                part.extend(contents);
            }
            let room = PART_BYTES.saturating_sub(part.len()) / size_of::<f32>();
            values.resize(room.min((self.floats.len() - at) as usize), 0.0);
            self.floats.read(at, &mut values)?;
            at += values.len() as u64;
            values.iter().for_each(|value| part.extend(value.to_le_bytes()));
            Ok::<_, MergeError>((!part.is_empty()).then(|| part.into()))
        })
    }

    /// Reads a task from a store. `None` if the store does not have it. An error if it is not the one with this hash for
    /// a device of the class of `device`, if it asks for more than any merge does, or for more memory than
    /// `memory_bytes`.
    pub(super) fn get(
        store: &Store,
        hash: &Hash,
        device: &Device,
        scratch: &Scratch,
        memory_bytes: u64,
    ) -> Result<Option<Self>, MergeError> {
        let name = name(hash);
        let Some(bytes) = store.size(&name)? else { return Ok(None) };
        let read = |range: Range<u64>| -> Result<Bytes, MergeError> {
            let len = range.end - range.start;
            let read = if range.end <= bytes { store.get_range(&name, range)? } else { None };
            read.filter(|read| read.len() as u64 == len).ok_or(MergeError::BadTask)
        };
        let head: [u8; HEAD] = read(0..HEAD as u64)?[..].try_into().map_err(|_| MergeError::BadTask)?;
        let first = HEAD as u64 + u64::from(u32::from_le_bytes(head));
        check_sizes(first, bytes)?;
        let encoded = read(HEAD as u64..first)?;
        let contents: Contents = postcard::from_bytes(&encoded).map_err(|_| MergeError::BadTask)?;
        // The hash comes from whoever wrote the task, so numbers in it may be wrong all the same.
        if !contents.are_sound(bytes.saturating_sub(first)) {
            return Err(MergeError::BadTask);
        }
        contents.check(device, memory_bytes)?;
        let mut writer = Writer { floats: scratch.column()?, hasher: Hasher::new() };
        for at in (first..bytes).step_by(PART_BYTES) {
            let part = read(at..bytes.min(at + PART_BYTES as u64))?;
            let (values, rest) = part.as_chunks();
            if !rest.is_empty() {
                return Err(MergeError::BadTask);
            }
            let values: Vec<f32> = values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
            writer.hasher.update(&part);
            writer.floats.append(&values)?;
        }
        if hashed(writer.hasher, &encoded, device) != *hash {
            return Err(MergeError::BadTask);
        }
        Ok(Some(Self { contents, floats: writer.floats, hash: *hash }))
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
        self.contents.cameras()
    }

    /// The splats to train: those of the tile, then others that a part shows.
    pub(super) fn student(&self) -> Result<Splats, SceneError> {
        self.splats(0, self.contents.student)
    }

    /// The means of the splats of the tile.
    pub(super) fn own_means(&self) -> Result<Vec<[f32; 3]>, SceneError> {
        let mut means = vec![[0.0; 3]; self.contents.own];
        self.floats.read(0, means.as_flattened_mut())?;
        Ok(means)
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

/// Name of a task in a store. The result has the hash alone as its name.
pub(super) fn name(hash: &Hash) -> String {
    format!("{}.task", hash.to_hex())
}

/// The hash of a task: of its splats, of its encoded contents, of the class of the device, and of the rules.
fn hashed(mut splats: Hasher, encoded: &[u8], device: &Device) -> Hash {
    splats.update(encoded).update(device.class().as_bytes()).update(RULES.as_bytes());
    splats.finalize()
}

impl Contents {
    fn encoded(&self) -> Vec<u8> {
        postcard::to_stdvec(self).expect("numbers and lists have bytes")
    }

    /// The cameras of the lessons, best first.
    fn cameras(&self) -> Vec<Camera> {
        let of = |teacher: &Teaching| {
            teacher
                .lessons
                .iter()
                .map(|lesson| (lesson.rank, teacher.views[lesson.view].camera))
                .collect::<Vec<_>>()
        };
        let ranked: BTreeMap<usize, Camera> = self.teachers.iter().flat_map(of).collect();
        ranked.into_values().collect()
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
    let views: Vec<Part> = keys.iter().map(|key| plan.crops[key]).collect();
    let taught = |(rank, view): (usize, &ViewKey)| Taught {
        rank,
        view: places[view],
        neighbour: neighbour_of(view).map(|other| places[&other]),
    };
    let frusta: Vec<Frustum> = views.iter().map(Part::frustum).collect();
    let is_seen = |at, radius| frusta.iter().any(|frustum| frustum.touches(at, radius));
    let mut splats = Splats::with_capacity(0, site.models.sh_degree());
    site.models.read(site.pages[local].clone(), |bounds| touches(&frusta, bounds), is_seen, &mut splats)?;
    let at = writer.write(&splats)?;
    Ok(Teaching { at, splats: splats.len(), lessons: own.map(taught).collect(), views })
}
