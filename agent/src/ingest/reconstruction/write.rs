//! Writes the binary form, as COLMAP's `src/colmap/scene/reconstruction_io.cc` reads it.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use cosurf_scene::{atomic, files};

use super::Reconstruction;
use crate::ingest::error::IngestError;

/// COLMAP's number for the camera model `OPENCV`.
const OPENCV: u32 = 4;

type Out = BufWriter<File>;

impl Reconstruction {
    /// Writes a folder, which is created.
    pub(crate) fn write(&self, folder: &Path) -> Result<(), IngestError> {
        files::create_folder(folder)?;
        // For each mark, its number in the list of its photograph.
        let mut counts = vec![0_u32; self.posed.len()];
        let places: Vec<u32> = self
            .marks
            .iter()
            .map(|mark| {
                let count = &mut counts[mark.photograph as usize];
                *count += 1;
                *count - 1
            })
            .collect();
        atomic::write(&folder.join("cameras.bin"), |out| self.write_lenses(out))?;
        atomic::write(&folder.join("images.bin"), |out| self.write_photographs(out, &counts))?;
        atomic::write(&folder.join("points3D.bin"), |out| self.write_points(out, &places))?;
        Ok(())
    }

    fn write_lenses(&self, out: &mut Out) -> io::Result<()> {
        put_count(out, self.lenses.len())?;
        for (id, lens) in (1_u32..).zip(&self.lenses) {
            out.write_all(&id.to_le_bytes())?;
            out.write_all(&OPENCV.to_le_bytes())?;
            lens.size_px.iter().try_for_each(|side| out.write_all(&u64::from(*side).to_le_bytes()))?;
            put_numbers(out, &lens.parameters())?;
        }
        Ok(())
    }

    fn write_photographs(&self, out: &mut Out, counts: &[u32]) -> io::Result<()> {
        let mut shown: Vec<Vec<usize>> =
            counts.iter().map(|count| Vec::with_capacity(*count as usize)).collect();
        for (i, mark) in self.marks.iter().enumerate() {
            shown[mark.photograph as usize].push(i);
        }
        put_count(out, self.posed.len())?;
        for ((id, posed), shown) in (1_u32..).zip(&self.posed).zip(&shown) {
            let pose = &posed.cam_from_world;
            out.write_all(&id.to_le_bytes())?;
            put_numbers(out, &[pose.rotation.w, pose.rotation.x, pose.rotation.y, pose.rotation.z])?;
            put_numbers(out, &pose.translation.to_array())?;
            out.write_all(&(posed.lens as u32 + 1).to_le_bytes())?;
            out.write_all(posed.name.as_bytes())?;
            out.write_all(&[0])?;
            put_count(out, shown.len())?;
            for mark in shown.iter().map(|i| &self.marks[*i]) {
                put_numbers(out, &mark.at_px.to_array())?;
                out.write_all(&(u64::from(mark.point) + 1).to_le_bytes())?;
            }
        }
        Ok(())
    }

    fn write_points(&self, out: &mut Out, places: &[u32]) -> io::Result<()> {
        put_count(out, self.points.len())?;
        let mut begin = 0;
        for (i, point) in self.points.iter().enumerate() {
            let count = self.marks[begin..].iter().take_while(|mark| mark.point as usize == i).count();
            out.write_all(&(i as u64 + 1).to_le_bytes())?;
            put_numbers(out, &point.position.to_array())?;
            out.write_all(&point.rgb)?;
            put_numbers(out, &[0.0])?; // the error, which nobody reads
            put_count(out, count)?;
            for k in begin..begin + count {
                out.write_all(&(self.marks[k].photograph + 1).to_le_bytes())?;
                out.write_all(&places[k].to_le_bytes())?;
            }
            begin += count;
        }
        Ok(())
    }
}

fn put_count(out: &mut Out, count: usize) -> io::Result<()> {
    out.write_all(&(count as u64).to_le_bytes())
}

fn put_numbers(out: &mut Out, numbers: &[f64]) -> io::Result<()> {
    numbers.iter().try_for_each(|number| out.write_all(&number.to_le_bytes()))
}
