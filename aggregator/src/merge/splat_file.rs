//! Splats in a file, in parts that are read one by one.

use cosurf_scene::{SceneError, Splats};

use crate::scratch::{Floats, Scratch};

/// Splats in a file without a name.
#[derive(Debug)]
pub struct SplatFile {
    floats: Floats,
    sh_degree: u32,
    /// Place and number of the splats of each part, in the order in which they are read.
    parts: Vec<(u64, usize)>,
}

impl SplatFile {
    /// No splats yet. Those to come have this degree of spherical harmonics.
    pub(super) fn new(scratch: &Scratch, sh_degree: u32) -> Result<Self, SceneError> {
        Ok(Self { floats: scratch.column()?, sh_degree, parts: Vec::new() })
    }

    /// Appends a part. Returns its place among the parts.
    pub(super) fn append(&mut self, splats: &Splats) -> Result<usize, SceneError> {
        self.parts.push((self.floats.append_splats(splats)?, splats.len()));
        Ok(self.parts.len() - 1)
    }

    /// The same splats, with the parts in this order.
    pub(super) fn with_order(self, order: &[usize]) -> Self {
        let parts = order.iter().map(|part| self.parts[*part]).collect();
        Self { parts, ..self }
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.parts.iter().map(|(_, count)| count).sum()
    }

    /// True if there are no splats.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Degree of the spherical harmonics of all splats, 0 to 3.
    pub fn sh_degree(&self) -> u32 {
        self.sh_degree
    }

    /// Reads the parts one by one.
    pub fn parts(&self) -> impl Iterator<Item = Result<Splats, SceneError>> {
        self.parts.iter().map(|&(at, count)| {
            let mut splats = Splats::with_capacity(count, self.sh_degree);
            self.floats.read_splats(at, count, &mut splats)?;
            Ok(splats)
        })
    }

    /// Reads all splats.
    pub fn read(&self) -> Result<Splats, SceneError> {
        let mut splats = Splats::with_capacity(self.len(), self.sh_degree);
        self.parts.iter().try_for_each(|&(at, count)| self.floats.read_splats(at, count, &mut splats))?;
        Ok(splats)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::ground;

    #[test]
    fn parts_are_read_in_the_given_order() {
        let folder = tempfile::tempdir().unwrap();
        let [west, east] = [ground(-3.0, 0.0), ground(0.0, 5.0)];
        let mut file = SplatFile::new(&Scratch::new(folder.path()).unwrap(), west.sh_degree).unwrap();
        assert!(file.is_empty());
        let places = [&west, &east].map(|part| file.append(part).unwrap());
        let file = file.with_order(&[places[1], places[0]]);
        let parts: Vec<Splats> = file.parts().map(Result::unwrap).collect();
        assert_eq!(parts, [east.clone(), west.clone()]);
        let mut all = east;
        all.extend(&west);
        assert_eq!((file.read().unwrap(), file.len()), (all, parts[0].len() + parts[1].len()));
    }
}
