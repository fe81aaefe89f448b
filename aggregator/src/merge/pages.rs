//! Splats in a file, in pages of neighbouring splats, so that those of one place can be read without the others.

use std::ops::Range;

use cosurf_scene::{SceneError, Splats};
use glam::DVec3;

use crate::scratch::{Floats, Scratch};

/// Number of splats in a page.
const PAGE: usize = 256;
/// Number of pages in a chapter. Whole chapters that lie elsewhere are passed over, so that the time for one place grows
/// little with the site.
const CHAPTER: usize = 64;
/// Number of numbers of a splat before its spherical harmonics.
const SHAPE: usize = 11;
/// A splat reaches this many standard deviations.
const REACH: f64 = 3.0;

/// Splats in a file.
#[derive(Debug)]
pub(super) struct Pages {
    floats: Floats,
    sh_degree: u32,
    pages: Vec<Page>,
    /// The bounds of all pages of each chapter.
    chapters: Vec<Bounds>,
}

#[derive(Clone, Copy, Debug)]
struct Page {
    at: u64,
    count: u32,
    /// The box around the means, and the radius of the largest splat, in as few bytes as possible: large sites have
    /// many pages.
    low: [f32; 3],
    high: [f32; 3],
    reach: f32,
}

/// A box around the means of some splats.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    pub(super) low: DVec3,
    pub(super) high: DVec3,
    /// Radius of the largest splat, world units.
    reach: f64,
}

impl Page {
    fn bounds(&self) -> Bounds {
        Bounds { low: place(self.low), high: place(self.high), reach: f64::from(self.reach) }
    }
}

impl Bounds {
    const NOWHERE: Self = Self { low: DVec3::INFINITY, high: DVec3::NEG_INFINITY, reach: 0.0 };

    fn joined(&self, other: &Self) -> Self {
        Self {
            low: self.low.min(other.low),
            high: self.high.max(other.high),
            reach: self.reach.max(other.reach),
        }
    }

    /// Centre and radius of a ball that contains all splats.
    pub(super) fn ball(&self) -> (DVec3, f64) {
        (0.5 * (self.low + self.high), 0.5 * self.low.distance(self.high) + self.reach)
    }
}

/// Radius of a splat, world units.
pub(super) fn radius(log_scale: [f32; 3]) -> f64 {
    REACH * libm::exp(f64::from(log_scale.into_iter().fold(f32::MIN, f32::max)))
}

/// A mean as a world point.
pub(super) fn place(mean: [f32; 3]) -> DVec3 {
    DVec3::from_array(mean.map(f64::from))
}

impl Pages {
    /// No splats yet. Those to come have this degree of spherical harmonics.
    pub(super) fn new(scratch: &Scratch, sh_degree: u32) -> Result<Self, SceneError> {
        Ok(Self { floats: scratch.column()?, sh_degree, pages: Vec::new(), chapters: Vec::new() })
    }

    pub(super) fn sh_degree(&self) -> u32 {
        self.sh_degree
    }

    /// Appends splats. A lower degree of spherical harmonics is padded with zeros. Returns their pages.
    ///
    /// `area` decides on the order of the splats, and must contain them. Splats of the same area are in the same order,
    /// whatever other splats are left out.
    pub(super) fn append(&mut self, splats: &Splats, area: &Area) -> Result<Range<usize>, SceneError> {
        let first = self.pages.len();
        let stride = Splats::with_capacity(0, self.sh_degree).sh_stride();
        let mut numbers = Vec::with_capacity(PAGE * (SHAPE + stride));
        for page in area.order(&splats.means).chunks(PAGE) {
            numbers.clear();
            for &i in page {
                let i = i as usize;
                numbers.extend(splats.means[i]);
                numbers.extend(splats.quats[i]);
                numbers.extend(splats.log_scales[i]);
                numbers.push(splats.opacity_logits[i]);
                numbers.extend(splats.sh_of(i));
                numbers.resize(numbers.len() + stride - splats.sh_stride(), 0.0);
            }
            let at = self.floats.append(&numbers)?;
            let Bounds { low, high, reach } = bounds(splats, page);
            // The corners are values of means, so they are exact. The radius is rounded up.
            self.pages.push(Page {
                at,
                count: page.len() as u32,
                low: low.as_vec3().to_array(),
                high: high.as_vec3().to_array(),
                reach: (reach as f32).next_up(),
            });
        }
        self.chapters.truncate(first / CHAPTER);
        for pages in self.pages[self.chapters.len() * CHAPTER..].chunks(CHAPTER) {
            let join = |all: Bounds, page: &Page| all.joined(&page.bounds());
            self.chapters.push(pages.iter().fold(Bounds::NOWHERE, join));
        }
        Ok(first..self.pages.len())
    }

    /// Those of `pages` for which `near` holds.
    fn near(&self, pages: Range<usize>, near: impl Fn(&Bounds) -> bool) -> impl Iterator<Item = &Page> {
        let mut at = pages.start;
        std::iter::from_fn(move || {
            while at < pages.end {
                let page = at;
                if page.is_multiple_of(CHAPTER) && !near(&self.chapters[page / CHAPTER]) {
                    at += CHAPTER;
                    continue;
                }
                at += 1;
                if near(&self.pages[page].bounds()) {
                    return Some(&self.pages[page]);
                }
            }
            None
        })
    }

    /// All pages.
    pub(super) fn all(&self) -> Range<usize> {
        0..self.pages.len()
    }

    /// The number of splats in those of `pages` for which `near` holds.
    pub(super) fn count(&self, pages: Range<usize>, near: impl Fn(&Bounds) -> bool) -> usize {
        self.near(pages, near).map(|page| page.count as usize).sum()
    }

    /// Number of splats that [`Self::read`] would append.
    pub(super) fn count_wanted(
        &self,
        pages: Range<usize>,
        near: impl Fn(&Bounds) -> bool,
        mut wanted: impl FnMut(DVec3, f64) -> bool,
    ) -> Result<usize, SceneError> {
        let mut none = Splats::with_capacity(0, self.sh_degree());
        let mut count = 0;
        let counted = |at: DVec3, radius: f64| {
            count += usize::from(wanted(at, radius));
            false
        };
        self.read(pages, near, counted, &mut none)?;
        Ok(count)
    }

    /// Appends to `splats` those that satisfy `wanted`, of those of `pages` for which `near` holds. `wanted` gets the
    /// mean and the radius of a splat.
    pub(super) fn read(
        &self,
        pages: Range<usize>,
        near: impl Fn(&Bounds) -> bool,
        mut wanted: impl FnMut(DVec3, f64) -> bool,
        splats: &mut Splats,
    ) -> Result<(), SceneError> {
        let each = SHAPE + splats.sh_stride();
        let mut numbers = vec![0.0; PAGE * each];
        for page in self.near(pages, near) {
            let numbers = &mut numbers[..page.count as usize * each];
            self.floats.read(page.at, numbers)?;
            for splat in numbers.chunks_exact(each) {
                let [x, y, z, qw, qx, qy, qz, a, b, c, opacity_logit] = *splat.first_chunk().expect("SHAPE");
                if wanted(place([x, y, z]), radius([a, b, c])) {
                    splats.push([x, y, z], [qw, qx, qy, qz], [a, b, c], opacity_logit, &splat[SHAPE..]);
                }
            }
        }
        Ok(())
    }
}

/// A box around the means of splats.
#[derive(Clone, Copy, Debug)]
pub(super) struct Area {
    low: [f32; 3],
    /// Length of its longest side.
    side: f32,
}

impl Area {
    /// The box around `means`.
    pub(super) fn of(means: &[[f32; 3]]) -> Self {
        let (low, high) = means.iter().fold(([f32::MAX; 3], [f32::MIN; 3]), |(mut low, mut high), mean| {
            for k in 0..3 {
                (low[k], high[k]) = (low[k].min(mean[k]), high[k].max(mean[k]));
            }
            (low, high)
        });
        Self { low, side: (0..3).map(|k| high[k] - low[k]).fold(f32::MIN_POSITIVE, f32::max) }
    }

    /// The indices of splats in this box, neighbours near each other: along a Z-order curve.
    fn order(&self, means: &[[f32; 3]]) -> Vec<u32> {
        let code = |i: &u32| {
            let mean = means[*i as usize];
            let steps = [0, 1, 2].map(|k| (f64::from((mean[k] - self.low[k]) / self.side) * 2e6) as u64);
            (0..21)
                .flat_map(|bit| (0..3).map(move |k| (bit, k)))
                .fold(0, |code: u64, (bit, k)| code | (steps[k] >> bit & 1) << (3 * bit + k))
        };
        let mut order: Vec<u32> = (0..means.len() as u32).collect();
        order.sort_by_cached_key(code);
        order
    }
}

fn bounds(splats: &Splats, page: &[u32]) -> Bounds {
    page.iter().fold(Bounds::NOWHERE, |Bounds { low, high, reach }, &i| {
        let mean = place(splats.means[i as usize]);
        let own = radius(splats.log_scales[i as usize]);
        Bounds { low: low.min(mean), high: high.max(mean), reach: reach.max(own) }
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::ground;

    fn near(bounds: &Bounds, limit: f64) -> bool {
        bounds.low.x < limit
    }

    #[test]
    fn splats_of_one_place_are_read_without_the_others() {
        let folder = tempfile::tempdir().unwrap();
        let splats = ground(-30.0, 30.0);
        let mut pages = Pages::new(&Scratch::new(folder.path()).unwrap(), splats.sh_degree).unwrap();
        pages.append(&splats, &Area::of(&splats.means)).unwrap();
        let read = |limit: f64| {
            let mut some = Splats::with_capacity(0, splats.sh_degree);
            pages
                .read(pages.all(), |bounds| near(bounds, limit), |mean, _| mean.x < limit, &mut some)
                .unwrap();
            some
        };
        let mut sorted = read(f64::INFINITY);
        let key = |mean: &[f32; 3]| mean.map(|x| (x * 1000.0) as i64);
        sorted.means.sort_by_key(key);
        let mut all = splats.means.clone();
        all.sort_by_key(key);
        assert_eq!(sorted.means, all, "every splat is read once");
        let west = splats.means.iter().filter(|mean| mean[0] < -20.0).count();
        assert_eq!(read(-20.0).len(), west);
        let touched = pages.count(pages.all(), |bounds| near(bounds, -20.0));
        assert!(touched >= west && touched < splats.len() / 2, "{west} of {touched} of {}", splats.len());
    }

    #[test]
    fn a_lower_degree_is_padded_and_numbers_keep_their_places() {
        let folder = tempfile::tempdir().unwrap();
        let mut pages = Pages::new(&Scratch::new(folder.path()).unwrap(), 1).unwrap();
        let mut one = Splats::with_capacity(1, 0);
        one.push([1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], [-1.0, -2.0, -3.0], 8.0, &[9.0, 10.0, 11.0]);
        pages.append(&one, &Area::of(&one.means)).unwrap();
        let mut read = Splats::with_capacity(1, 1);
        let is_its = |_, radius: f64| (radius - 3.0 / std::f64::consts::E).abs() < 1e-6;
        pages.read(pages.all(), |_| true, is_its, &mut read).unwrap();
        let mut padded = Splats::with_capacity(1, 1);
        let sh = [9.0, 10.0, 11.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        padded.push(one.means[0], one.quats[0], one.log_scales[0], 8.0, &sh);
        assert_eq!(read, padded);
    }
}
