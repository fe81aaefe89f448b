//! Collects the figures of a running bench.

use std::path::PathBuf;

use super::record::{Column, Results, Row};
use super::{machine, store, table};

/// Collects the rows of a bench and prints each; [`finish`](Self::finish) writes them as JSON.
#[derive(Debug)]
pub struct Measurement(Results);

impl Measurement {
    /// Begins a bench and prints the head of its table.
    pub fn start(name: &str, columns: &[Column]) -> Self {
        print!("{}", table::head(columns));
        let words: Vec<String> = std::env::args().skip(1).filter(|word| word != "--bench").collect();
        Self(Results {
            name: name.to_owned(),
            source: None,
            commit: machine::commit(),
            date: machine::today(),
            processor: machine::processor(),
            cores: machine::cores(),
            command: [name].into_iter().chain(words.iter().map(String::as_str)).collect::<Vec<_>>().join(" "),
            columns: columns.to_vec(),
            rows: Vec::new(),
        })
    }

    /// Adds and prints a row. Figures that are not finite count as not measured.
    pub fn row(&mut self, name: &str, values: &[Option<f64>]) {
        assert_eq!(values.len(), self.0.columns.len(), "a figure for each column");
        let values = values.iter().map(|value| value.filter(|value| value.is_finite())).collect();
        let row = Row { name: name.to_owned(), values };
        print!("{}", table::row_line(&self.0.columns, &row));
        self.0.rows.push(row);
    }

    /// Writes the results to the folder that `RESULTS_FOLDER` names, or to `target/results`. Returns them.
    pub fn finish(self) -> std::io::Result<Results> {
        let folder = std::env::var_os("RESULTS_FOLDER")
            .map_or_else(|| machine::root().join("target/results"), PathBuf::from);
        store::write(&folder, &self.0)?;
        Ok(self.0)
    }
}
