//! What a worker checks before it works on a task. Whoever can write to the store may have made it, with a hash that
//! fits.

use std::collections::BTreeSet;

use cosurf_engine::backend::Channels;
use cosurf_engine::{Capacity, Device};
use cosurf_scene::{Camera, Splats};

use super::super::error::MergeError;
use super::super::memory::{beside_bytes, student_bytes, survey_bytes, teacher_bytes};
use super::sizes::at_most;
use super::{Contents, Teaching};

/// Largest width or height of a picture in a task, px.
const SIDE_MAX_PX: u32 = 1 << 14;
/// Largest number of epochs; a merge has 5 unless it is told otherwise.
const EPOCHS_MAX: u32 = 1000;
/// Largest number of pixels of all steps, where five splats that are trained count as a pixel. A core takes a day and a
/// half for them.
const WORK_MAX: u64 = 1 << 38;
/// A lesson counts as at least so many pixels.
const LESSON_PX_MIN: u64 = 1 << 10;
/// Largest number of bytes that a task may say it takes.
const BYTES_MAX: u64 = 1 << 40;

impl Contents {
    /// An error if the task asks for more than any merge does, or for more memory than `memory_bytes`.
    pub(super) fn check(&self, device: &Device, memory_bytes: u64) -> Result<(), MergeError> {
        at_most("epochs", u64::from(self.epochs), u64::from(EPOCHS_MAX))?;
        at_most("pixels to distil", self.work(), WORK_MAX)?;
        at_most("bytes of memory to take", self.bytes, BYTES_MAX)?;
        let needed_bytes = beside_bytes(device).saturating_add(self.needed(device));
        if needed_bytes > memory_bytes {
            return Err(MergeError::TooLittleMemory { memory_bytes, needed_bytes });
        }
        Ok(())
    }

    /// See [`WORK_MAX`].
    fn work(&self) -> u64 {
        let each = |camera: &Camera| {
            let [width, height] = camera.size_px.map(u64::from);
            (width * height).max(LESSON_PX_MIN).saturating_add(self.student as u64 / 5)
        };
        let epoch = self.cameras().iter().map(each).fold(0, u64::saturating_add);
        epoch.saturating_mul(u64::from(self.epochs))
    }

    /// Bytes that the distillation takes: what the task says, or more if its own numbers give more.
    fn needed(&self, device: &Device) -> u64 {
        let shape = |cameras: &[Camera]| {
            let none = Splats::with_capacity(0, self.sh_degree);
            Capacity::to_train(&none, cameras, Channels::Geometry)
        };
        let student = student_bytes(device, &shape(&self.cameras()), self.student);
        let teacher = |teacher: &Teaching| {
            let cameras: Vec<Camera> = teacher.views.iter().map(|view| view.camera).collect();
            teacher_bytes(device, &shape(&cameras), teacher.splats, cameras.len())
        };
        let survey = |camera: &Camera| survey_bytes(device, camera);
        let teachers = self.teachers.iter().map(teacher);
        let needed = teachers.chain(self.wide_crops.iter().map(survey)).fold(student, u64::max);
        needed.max(self.bytes)
    }

    /// Whether all places and numbers are possible with splats that have so many `bytes`.
    pub(super) fn are_sound(&self, bytes: u64) -> bool {
        if self.sh_degree > 3 || self.own > self.student {
            return false;
        }
        let each = 11 + Splats::with_capacity(0, self.sh_degree).sh_stride() as u64;
        // The student comes first, then one teacher after the other.
        let end = |at: u64, splats: usize| (splats as u64).checked_mul(each)?.checked_add(at);
        let after = |at: Option<u64>, teacher: &Teaching| {
            at.filter(|at| *at == teacher.at).and_then(|at| end(at, teacher.splats))
        };
        let end = self.teachers.iter().fold(end(0, self.student), after);
        let lessons = || self.teachers.iter().flat_map(|teacher| &teacher.lessons);
        let ranks: BTreeSet<usize> = lessons().map(|lesson| lesson.rank).collect();
        let count = lessons().count();
        let are_known = |teacher: &Teaching| {
            let is_known = |view: usize| view < teacher.views.len();
            teacher
                .lessons
                .iter()
                .all(|lesson| is_known(lesson.view) && lesson.neighbour.is_none_or(is_known))
        };
        let views = self.teachers.iter().flat_map(|teacher| &teacher.views);
        end.and_then(|end| end.checked_mul(size_of::<f32>() as u64)) == Some(bytes)
            && self.teachers.iter().all(are_known)
            && ranks.len() == count
            && ranks.last().is_none_or(|last| last + 1 == count)
            && views.clone().all(|view| view.far.is_finite())
            && views.map(|view| &view.camera).chain(&self.wide_crops).all(is_sound)
    }
}

fn is_sound(camera: &Camera) -> bool {
    let Camera { cam_from_world, focal_px, center_px, size_px } = camera;
    cam_from_world.rotation.is_finite()
        && cam_from_world.translation.is_finite()
        && focal_px.is_finite()
        && focal_px.min_element() > 0.0
        && center_px.is_finite()
        && size_px.iter().all(|side| (1..=SIDE_MAX_PX).contains(side))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::cell::Cell;

    use blake3::{Hash, Hasher};

    use super::super::super::carry_out::{CarriedOut, carry_out};
    use super::super::super::crop::Part;
    use super::super::{Taught, hashed, name};
    use super::*;
    use crate::scratch::numbers;
    use crate::store::Store;
    use crate::testing::{above, ground};

    /// A worker's limit on the memory, bytes.
    const MEMORY_BYTES: u64 = 1 << 30;

    /// A task with one lesson.
    fn contents() -> Contents {
        let splats = ground(-3.0, 3.0).len();
        let camera = above(0.0);
        let lesson = Taught { rank: 0, view: 0, neighbour: None };
        let at = (splats * (11 + ground(-3.0, 3.0).sh_stride())) as u64;
        let views = vec![Part { camera, far: 1e3 }];
        Contents {
            sh_degree: ground(-3.0, 3.0).sh_degree,
            epochs: 2,
            seed: 0,
            own: splats,
            student: splats,
            wide_crops: vec![camera],
            teachers: vec![Teaching { at, splats, views, lessons: vec![lesson] }],
            bytes: 1 << 20,
        }
    }

    /// Writes a task with a hash that fits.
    fn put(store: &Store, contents: &Contents) -> Hash {
        let (encoded, mut hasher) = (contents.encoded(), Hasher::new());
        let mut bytes = (encoded.len() as u32).to_le_bytes().to_vec();
        bytes.extend(&encoded);
        for _ in 0..2 {
            for values in numbers(&ground(-3.0, 3.0)) {
                bytes.extend_from_slice(bytemuck::cast_slice(values));
                hasher.update(bytemuck::cast_slice(values));
            }
        }
        let hash = hashed(hasher, &encoded, &Device::Cpu);
        store.put(&name(&hash), bytes.into()).unwrap();
        hash
    }

    #[test]
    fn a_worker_refuses_a_task_that_no_merge_makes() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::in_folder(&folder.path().join("store")).unwrap();
        let carried_out = |change: &dyn Fn(&mut Contents)| {
            let mut contents = contents();
            change(&mut contents);
            let hash = put(&store, &contents);
            let steps = Cell::new(0);
            let goes_on = || steps.replace(steps.get() + 1) < 100;
            carry_out(&hash, &store, folder.path(), &Device::Cpu, 1, MEMORY_BYTES, &goes_on)
        };
        let sound = carried_out(&|_| {}).unwrap();
        assert!(matches!(sound, CarriedOut::Distilled { splats } if splats > 0), "{sound:?}");
        let told = |change: &dyn Fn(&mut Contents)| carried_out(change).unwrap_err().to_string();
        assert!(told(&|its| its.epochs = 1_000_000).contains("1000000 epochs, more than 1000"));
        assert!(told(&|its| its.bytes = u64::MAX).contains("bytes of memory"));
        assert!(told(&|its| its.bytes = 2 * MEMORY_BYTES).contains("--memory"));
        let many = told(&|its| {
            let teacher = &mut its.teachers[0];
            teacher.views[0].camera.size_px = [1 << 11; 2];
            teacher.lessons = (0..100).map(|rank| Taught { rank, ..teacher.lessons[0] }).collect();
            its.epochs = EPOCHS_MAX;
        });
        assert!(many.contains("pixels to distil"), "{many}");
        let huge = [SIDE_MAX_PX; 2];
        assert!(told(&|its| its.wide_crops[0].size_px = huge).contains("--memory"));
        assert!(told(&|its| its.teachers[0].views[0].camera.size_px = huge).contains("--memory"));
        assert!(told(&|its| its.wide_crops[0].size_px[0] *= 1000).contains("damaged"));
        assert!(told(&|its| its.teachers[0].at -= 1).contains("damaged"));
    }
}
