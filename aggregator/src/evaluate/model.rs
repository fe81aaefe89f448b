//! The command `eval`: scores a model against the photographs and the true surface of a dataset. A mission scores
//! its global model in the same way at its end.

use std::path::PathBuf;

use cosurf_engine::{DeviceChoice, Place, ViewError, Views};
use cosurf_scene::{Dataset, LocalFrame, SceneError, View, ply};
use serde::{Deserialize, Serialize};
use tracing::info_span;

use super::judge::Judge;
use super::quality::{Quality, YardstickError, Yardsticks};
use crate::terminal::aligned;

/// Which model to score, and against what.
#[derive(Clone, Debug)]
pub struct EvalOrder {
    /// A PLY file of splats, or the output folder of an agent or a mission.
    pub model: PathBuf,
    /// Path of the dataset.
    pub data: PathBuf,
    /// Folder of the LPIPS weights; `None` computes no LPIPS.
    pub lpips: Option<PathBuf>,
    /// Mesh of the true surface; `None` takes the mesh of the dataset, if it has one.
    pub truth: Option<PathBuf>,
    /// Every n-th view by sorted name is held out; n is at least 1.
    pub eval_every: u32,
    /// Limit on the longer side of the compared pictures, px; `None` compares at full size.
    pub max_size_px: Option<u32>,
    /// Whether each view is first aligned with the model, for models whose poses were learnt.
    pub align: bool,
    /// Number of threads that render, at least 1.
    pub threads: usize,
}

/// The figures of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EvalReport {
    /// Number of splats of the model.
    pub splats: usize,
    /// Means over the held-out views.
    pub mean: Quality,
    /// The held-out views, by name.
    pub views: Vec<ViewQuality>,
}

/// The figures of one view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewQuality {
    /// The view's name.
    pub name: String,
    /// The figures of the view.
    #[serde(flatten)]
    pub quality: Quality,
}

/// Why a model cannot be scored.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvalError {
    /// The model, the dataset or a picture cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A picture cannot be rendered.
    #[error(transparent)]
    View(#[from] ViewError),
    /// The LPIPS weights or the true surface cannot be read.
    #[error(transparent)]
    Yardstick(#[from] YardstickError),
    /// The dataset has no views to compare with.
    #[error("{data} has no views: name a dataset with pictures")]
    NoViews {
        /// The dataset.
        data: PathBuf,
    },
}

/// Scores the model on every held-out view.
pub fn evaluate_model(order: &EvalOrder) -> Result<EvalReport, EvalError> {
    let _span = info_span!("evaluate").entered();
    let dataset = Dataset::open(&order.data)?;
    let frame = LocalFrame::of(dataset.cameras_of_views());
    let dataset = dataset.into_frame(&frame);
    let (lpips, truth) = (order.lpips.as_deref(), order.truth.as_deref());
    let yardsticks = Yardsticks::read(&order.data, lpips, truth, &frame)?;
    let model =
        Views::open(ply::of_model(&order.model)?, &frame, Place::On(DeviceChoice::Cpu), order.threads)?;
    let splats = model.splats();
    let extent = order.align.then(|| dataset.extent());
    let mut judge = Judge::new(model, order.max_size_px, &yardsticks).aligning(extent);
    let (_, held_out) = dataset.split(order.eval_every);
    let score = |view: &View| Ok(ViewQuality { name: view.name.clone(), quality: judge.quality(view)? });
    let views =
        held_out.iter().map(|&i| &dataset.views[i]).map(score).collect::<Result<Vec<_>, EvalError>>()?;
    let qualities: Vec<Quality> = views.iter().map(|view| view.quality).collect();
    let mean = Quality::mean(&qualities).ok_or_else(|| EvalError::NoViews { data: order.data.clone() })?;
    Ok(EvalReport { splats, mean, views })
}

/// The figures as a table for a terminal: one row for each view and one for the means, and one column for each
/// figure that is known.
pub fn table(report: &EvalReport) -> String {
    let columns: Vec<Column> = COLUMNS.into_iter().filter(|(_, cell)| cell(&report.mean).is_some()).collect();
    let row = |name: &str, quality: &Quality| {
        let cells = columns.iter().map(|(_, cell)| cell(quality).unwrap_or("–".into()));
        std::iter::once(name.to_string()).chain(cells).collect::<Vec<String>>()
    };
    let headings = columns.iter().map(|(heading, _)| heading.to_string());
    let mut lines = vec![std::iter::once(String::new()).chain(headings).collect()];
    lines.extend(report.views.iter().map(|view| row(&view.name, &view.quality)));
    lines.push(row(&format!("mean of {}", report.views.len()), &report.mean));
    aligned(&lines)
}

/// The heading of a column, and the function that gives its cells. The function returns `None` if the figure is not
/// known.
type Column = (&'static str, fn(&Quality) -> Option<String>);

const COLUMNS: [Column; 11] = [
    ("PSNR", |q| Some(format!("{:.2} dB", q.psnr))),
    ("SSIM", |q| Some(format!("{:.4}", q.ssim))),
    ("LPIPS VGG", |q| q.lpips.map(|lpips| format!("{:.4}", lpips.vgg))),
    ("Alex", |q| q.lpips.map(|lpips| format!("{:.4}", lpips.alex))),
    ("depth median", |q| q.surface?.depth_error_percent.map(|error| format!("{:.3} %", error.median))),
    ("mean", |q| q.surface?.depth_error_percent.map(|error| format!("{:.3} %", error.mean))),
    ("normal median", |q| q.surface?.normal_error_deg.map(|error| format!("{:.2}°", error.median))),
    ("mean", |q| q.surface?.normal_error_deg.map(|error| format!("{:.2}°", error.mean))),
    ("depth-normal median", |q| {
        q.surface?.depth_normal_error_deg.map(|error| format!("{:.2}°", error.median))
    }),
    ("mean", |q| q.surface?.depth_normal_error_deg.map(|error| format!("{:.2}°", error.mean))),
    ("covered", |q| q.surface.map(|surface| format!("{:.2} %", 100.0 * surface.coverage))),
];

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::path::Path;

    use cosurf_city::{City, CitySettings};
    use cosurf_engine::init::{Form, splats_from_points};

    use super::*;

    /// Writes a small generated city into `folder`, with an untrained model made from its sparse points.
    fn untrained(folder: &Path) -> EvalOrder {
        let settings =
            CitySettings { extent_m: 40.0, views: 9, size_px: [64, 48], ..CitySettings::default() };
        let dataset = City::build(&settings).unwrap().write(folder, |_, _| ()).unwrap();
        let (points, extent) = (&dataset.points, dataset.extent());
        let splats = splats_from_points(points, extent, points.len(), 0, Form::Round);
        ply::write(&folder.join("model.ply"), &splats, &LocalFrame::WORLD).unwrap();
        EvalOrder {
            model: folder.into(),
            data: folder.into(),
            lpips: None,
            truth: None,
            eval_every: 4,
            max_size_px: Some(32),
            align: false,
            threads: 1,
        }
    }

    #[test]
    fn a_model_is_scored_on_held_out_views_and_the_datasets_own_truth() {
        let folder = tempfile::tempdir().unwrap();
        let order = untrained(folder.path());
        let report = evaluate_model(&order).unwrap();
        assert_eq!(report.views.len(), 3);
        let surface = report.mean.surface.unwrap();
        assert!((0.0..=1.0).contains(&surface.coverage) && surface.depth_error_percent.unwrap().median > 0.0);
        let text = table(&report);
        assert_eq!(text.lines().count(), 5, "{text}");
        assert!(text.contains("covered") && !text.contains("LPIPS") && text.contains("mean of 3"), "{text}");
        let json = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<EvalReport>(&json).unwrap(), report);
        // A true surface that is raised by 1 m gives other errors.
        let mut mesh = cosurf_scene::Mesh::read(&folder.path().join("gt/mesh.ply")).unwrap();
        mesh.positions.iter_mut().for_each(|position| position[2] += 1.0);
        let raised = folder.path().join("raised.ply");
        mesh.write_ply(&raised).unwrap();
        let other = evaluate_model(&EvalOrder { truth: Some(raised), ..order }).unwrap();
        assert_eq!(other.mean.psnr, report.mean.psnr);
        assert_ne!(other.mean.surface, report.mean.surface);
    }

    #[test]
    fn a_folder_without_a_model_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let error = ply::of_model(folder.path()).unwrap_err().to_string();
        assert!(
            error.contains(&folder.path().display().to_string()) && error.contains("global.ply"),
            "{error}"
        );
    }
}
