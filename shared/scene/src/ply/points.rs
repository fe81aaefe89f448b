//! Reads coloured points from a PLY: the sparse clouds that other tools write.

use std::path::Path;

use glam::DVec3;

use super::rows::read_vertices;
use crate::sieve::Sieve;
use crate::{SceneError, SparsePoint};

/// Reads the vertices as points with empty tracks; without colours in the file, the points are
/// grey. Errors: a missing coordinate, or a position that is not finite.
pub fn read_points(path: &Path) -> Result<Vec<SparsePoint>, SceneError> {
    let mut sieve = Sieve::new(usize::MAX);
    read_points_into(&mut sieve, path)?;
    Ok(sieve.end().0)
}

/// As [`read_points`], as far as there is room for the points.
pub(crate) fn read_points_into(sieve: &mut Sieve, path: &Path) -> Result<(), SceneError> {
    read_vertices(path, |element, rows| {
        let position = [element.column("x"), element.column("y"), element.column("z")];
        let [Some(x), Some(y), Some(z)] = position else {
            return Err("has no x, y and z for its vertices".into());
        };
        let rgb = ["red", "green", "blue"].map(|name| element.column(name));
        let origin = rows.origin();
        let mut vertex = 0u64;
        while let Some(row) = rows.next()? {
            let position = origin + DVec3::new(row[x], row[y], row[z]);
            if !position.is_finite() {
                return Err(format!("vertex {vertex}: its position {position} is not finite").into());
            }
            let rgb = rgb.map(|column| column.map_or(128, |column| row[column] as u8));
            sieve.add(SparsePoint { position, rgb, views: Vec::new() });
            vertex += 1;
        }
        Ok(())
    })
}
