//! The schema of all stored results.

use serde::{Deserialize, Serialize};

/// The results of one bench: a table of figures, and how they were measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Results {
    /// Name of the bench; also the name of the file, without `.json`.
    pub name: String,
    /// Where the figures were taken from, if no run of `results` measured them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// Commit that was measured; ends with `+` if the sources differed from it.
    pub commit: String,
    /// Day of the measurement, for example `2026-11-22`.
    pub date: String,
    /// Model of the processor.
    pub processor: String,
    /// Number of cores that the bench could use.
    pub cores: usize,
    /// The measuring command, with placeholders such as `DATA` for folders.
    pub command: String,
    /// The figures that each row has.
    pub columns: Vec<Column>,
    /// The cases that were measured.
    pub rows: Vec<Row>,
}

/// One kind of figure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Column {
    /// Name of the figure.
    pub name: String,
    /// Unit of the figure; empty for ratios and counts.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub unit: String,
    /// Digits after the point in tables.
    pub decimals: usize,
    /// Which direction is an improvement.
    pub better: Better,
    /// How much worse a new figure may be than the stored one; without a tolerance the two are not compared.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tolerance: Option<Tolerance>,
    /// Whether the figure depends on the processor's speed. If so, it is compared only with figures that were
    /// measured on the same model of processor.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub per_processor: bool,
}

/// Which direction of a figure is an improvement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Better {
    /// Larger figures are better.
    Higher,
    /// Smaller figures are better.
    Lower,
    /// Neither direction is better: the figure only describes the case.
    Neither,
}

/// How much worse a figure may be before it is reported.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Tolerance {
    /// In the unit of the figure.
    Absolute(f64),
    /// As a share of the stored figure.
    Relative(f64),
}

/// One case and its figures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Row {
    /// Name of the case, unique in its table.
    pub name: String,
    /// A figure for each column; `None` if it was not measured.
    pub values: Vec<Option<f64>>,
}

impl Results {
    /// The figure in the row and the column with these names; `None` if there is no such row or column, or if the
    /// figure was not measured.
    pub fn figure(&self, row: &str, column: &str) -> Option<f64> {
        let row = self.rows.iter().find(|candidate| candidate.name == row)?;
        let place = self.columns.iter().position(|candidate| candidate.name == column)?;
        row.values[place]
    }
}

impl Column {
    /// A figure of which neither direction is better. New figures are not compared with stored ones.
    pub fn new(name: &str, unit: &str, decimals: usize) -> Self {
        let (name, unit) = (name.to_owned(), unit.to_owned());
        Self { name, unit, decimals, better: Better::Neither, tolerance: None, per_processor: false }
    }

    /// Sets which direction is better, and how much worse a new figure may be than the stored one.
    pub fn guarded(self, better: Better, tolerance: Tolerance) -> Self {
        Self { better, tolerance: Some(tolerance), ..self }
    }

    /// A time or a rate, which depends on the processor's speed. Differences up to 15 % count as noise.
    pub fn speed(name: &str, unit: &str, decimals: usize, better: Better) -> Self {
        let guarded = Self::new(name, unit, decimals).guarded(better, Tolerance::Relative(0.15));
        Self { per_processor: true, ..guarded }
    }

    /// PSNR. The tolerance is wide, because the seed of a training changes the PSNR by some tenths of a decibel.
    pub fn psnr(name: &str) -> Self {
        Self::new(name, "dB", 2).guarded(Better::Higher, Tolerance::Absolute(0.3))
    }

    /// SSIM.
    pub fn ssim() -> Self {
        Self::new("SSIM", "", 3).guarded(Better::Higher, Tolerance::Absolute(0.01))
    }

    /// F-score of a mesh.
    pub fn f_score() -> Self {
        Self::new("F-score", "", 3).guarded(Better::Higher, Tolerance::Absolute(0.02))
    }

    /// An error of depths or normals. Differences up to a tenth count as noise.
    pub fn error(name: &str, unit: &str, decimals: usize) -> Self {
        Self::new(name, unit, decimals).guarded(Better::Lower, Tolerance::Relative(0.1))
    }

    /// Peak resident memory in MiB.
    pub fn memory() -> Self {
        Self::new("peak memory", "MiB", 0).guarded(Better::Lower, Tolerance::Relative(0.1))
    }

    /// A number of splats.
    pub fn splats() -> Self {
        Self::new("splats", "", 0)
    }

    /// The name of the figure and its unit, as in the head of a table.
    pub fn title(&self) -> String {
        if self.unit.is_empty() { self.name.clone() } else { format!("{}, {}", self.name, self.unit) }
    }
}
