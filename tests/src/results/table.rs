//! Formats results as Markdown tables.

use super::record::{Column, Results, Row};

impl Results {
    /// The table, and below it a line that tells how the figures were measured.
    pub fn to_markdown(&self) -> String {
        let rows: String = self.rows.iter().map(|row| row_line(&self.columns, row)).collect();
        format!("{}{rows}\n{}\n", head(&self.columns), self.caption())
    }

    fn caption(&self) -> String {
        let Self { source, commit, date, processor, cores, command, .. } = self;
        let source = source.as_ref().map_or(String::new(), |source| format!(" Source: {source}."));
        let cores = if *cores == 1 { "1 core".to_owned() } else { format!("{cores} cores") };
        format!("`{command}`: {date}, commit {commit}, {cores} of {processor}.{source}")
    }
}

/// The first two lines of a table.
pub(crate) fn head(columns: &[Column]) -> String {
    let titles: String = columns.iter().map(|column| format!(" {} |", column.title())).collect();
    format!("| |{titles}\n|---|{}\n", "---:|".repeat(columns.len()))
}

/// A row as a line of the table, with dashes for figures that were not measured.
pub(crate) fn row_line(columns: &[Column], row: &Row) -> String {
    let cell = |(column, value): (&Column, &Option<f64>)| match value {
        Some(value) => format!(" {} |", number(*value, column.decimals)),
        None => " – |".to_owned(),
    };
    let cells: String = columns.iter().zip(&row.values).map(cell).collect();
    format!("| {} |{cells}\n", row.name)
}

/// Formats a number with `decimals` digits after the point; zero has no sign. From 10,000 on, commas separate the thousands.
pub(crate) fn number(value: f64, decimals: usize) -> String {
    let mut text = format!("{value:.decimals$}");
    if text.trim_start_matches(['-', '0', '.']).is_empty() {
        text.retain(|sign| sign != '-');
    }
    let (whole, fraction) =
        text.split_once('.').map_or((text.as_str(), ""), |(whole, fraction)| (whole, fraction));
    let digits = whole.trim_start_matches('-');
    if digits.len() < 5 {
        return text;
    }
    let groups: Vec<&str> =
        digits.as_bytes().rchunks(3).rev().filter_map(|group| str::from_utf8(group).ok()).collect();
    let sign = if whole.starts_with('-') { "-" } else { "" };
    let point = if fraction.is_empty() { "" } else { "." };
    format!("{sign}{}{point}{fraction}", groups.join(","))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_readable() {
        assert_eq!(number(23.456, 2), "23.46");
        assert_eq!(number(9999.0, 0), "9999");
        assert_eq!(number(-0.004, 2), "0.00");
        assert_eq!(number(-0.006, 2), "-0.01");
        assert_eq!(number(138_677.0, 0), "138,677");
        assert_eq!(number(-1_234_567.25, 1), "-1,234,567.2");
    }

    #[test]
    fn a_row_has_a_cell_for_each_column() {
        let columns = [Column::psnr("PSNR"), Column::splats()];
        let row = Row { name: "a".to_owned(), values: vec![Some(20.0), None] };
        assert_eq!(head(&columns), "| | PSNR, dB | splats |\n|---|---:|---:|\n");
        assert_eq!(row_line(&columns, &row), "| a | 20.00 | – |\n");
    }
}
