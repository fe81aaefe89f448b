//! Finds the views that look at the agent's cell of the site's plan, by the rule by which a mission divides pictures.

use anyhow::{Context, Result, bail};
use cosurf_contract::counted;
use cosurf_link::PlannedCell;
use cosurf_scene::{Dataset, Ground, Outline, footprints};

use crate::session::{Split, VIEWS_MIN};

/// Divides the views of a dataset that look at the cell. A training view belongs to the cell if the centre of its
/// footprint lies in the cell or its margin, a held-out view if it lies in the cell itself. Every n-th view of the whole
/// dataset is held out, `eval_every`; 0 holds out none. Fails if fewer than three training views are left.
pub fn split_by_cell(dataset: &Dataset, cell: &PlannedCell, eval_every: u32) -> Result<Split> {
    let outline = Outline::polygon(&cell.corners).context("the cell of the plan is not a polygon")?;
    let prints = footprints(dataset, &Ground::along(dataset, cell.vertical.index()));
    let (train, held_out) = dataset.split(eval_every);
    let names = |views: Vec<usize>, margin| -> Vec<String> {
        let is_in = |view: &usize| outline.reaches(prints[*view].center, margin);
        views.into_iter().filter(is_in).map(|view| dataset.views[view].name.clone()).collect()
    };
    let (train, held_out) = (names(train, cell.margin), names(held_out, 0.0));
    if train.len() < VIEWS_MIN {
        bail!(
            "{} of {} to train on {} at this drone's cell of the plan, {VIEWS_MIN} are needed: check that pictures and cell \
             have the same coordinates (x and y, with z up), draw a larger cell, or name `views` in agent.toml",
            train.len(),
            counted(dataset.views.len() as u64, "picture"),
            if train.len() == 1 { "looks" } else { "look" },
        );
    }
    Ok(Split::Named { train, held_out })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use cosurf_scene::{Camera, Pose, View};
    use cosurf_wire::VerticalAxis;
    use glam::{DVec2, DVec3};

    use super::*;

    /// Nadir views in a row from west to east, 10 m apart.
    fn row(count: usize) -> Dataset {
        let view = |i: usize| {
            let eye = DVec3::new(i as f64 * 10.0, 0.0, 50.0);
            let camera = Camera {
                cam_from_world: Pose::look_at(eye, eye - DVec3::Z, DVec3::Y),
                focal_px: DVec2::splat(100.0),
                center_px: DVec2::splat(50.0),
                size_px: [100, 100],
            };
            View { name: format!("{i:03}.jpg"), camera, path: "x".into(), mask: None }
        };
        Dataset { views: (0..count).map(view).collect(), points: Vec::new() }
    }

    /// A cell from `west` to `east`.
    fn cell(west: f64, east: f64, margin: f64) -> PlannedCell {
        let corners = vec![[west, -5.0], [east, -5.0], [east, 5.0], [west, 5.0]];
        PlannedCell { vertical: VerticalAxis::Z, corners, margin }
    }

    #[test]
    fn training_views_lie_in_the_cell_or_its_margin_and_held_out_views_in_the_cell() {
        let names = |views: &[usize]| views.iter().map(|i| format!("{i:03}.jpg")).collect::<Vec<_>>();
        // The margin is 15 m wide.
        let split = split_by_cell(&row(18), &cell(25.0, 75.0, 0.3), 8).unwrap();
        assert_eq!(split, Split::Named { train: names(&[1, 2, 3, 4, 5, 6, 7, 9]), held_out: names(&[]) });
        let split = split_by_cell(&row(18), &cell(25.0, 85.0, 0.0), 8).unwrap();
        assert_eq!(split, Split::Named { train: names(&[3, 4, 5, 6, 7]), held_out: names(&[8]) });
        let split = split_by_cell(&row(18), &cell(25.0, 85.0, 0.0), 0).unwrap();
        assert_eq!(split, Split::Named { train: names(&[3, 4, 5, 6, 7, 8]), held_out: names(&[]) });
    }

    #[test]
    fn too_few_views_are_refused_with_the_remedy() {
        for (east, count) in [(15.0, 2), (5.0, 1)] {
            let error = split_by_cell(&row(18), &cell(-5.0, east, 0.0), 0).unwrap_err().to_string();
            let start = format!("{count} of 18 pictures to train on");
            assert!(error.starts_with(&start) && error.contains("name `views`"), "{error}");
        }
        assert!(split_by_cell(&row(18), &cell(-5.0, 25.0, 0.0), 0).is_ok());
        // Held-out views are not trained on.
        assert!(split_by_cell(&row(18), &cell(-5.0, 25.0, 0.0), 8).is_err());
    }
}
