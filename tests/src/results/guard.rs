//! Finds figures that got worse.

use super::record::{Better, Column, Results, Tolerance};
use super::table::number;

/// Returns a sentence for each stored figure that the new results lack, or that is worse in the new results by more
/// than its tolerance. Figures without a tolerance are not compared. Figures that depend on the processor's speed are
/// compared only if both results were measured on the same model of processor, with as many cores.
pub fn worse(stored: &Results, new: &Results) -> Vec<String> {
    let mut found = Vec::new();
    for row in &stored.rows {
        for (column, before) in stored.columns.iter().zip(&row.values) {
            let (Some(before), Some(tolerance)) = (before, column.tolerance) else { continue };
            let is_same_machine = stored.processor == new.processor && stored.cores == new.cores;
            if column.per_processor && !is_same_machine {
                continue;
            }
            let what = format!("{}, {}: {}", stored.name, row.name, column.title());
            let after = new.figure(&row.name, &column.name);
            found.extend(match after {
                Some(after) if is_worse(column, tolerance, *before, after) => {
                    let [before, after] = [*before, after].map(|value| number(value, column.decimals + 1));
                    Some(format!("{what} is {after} instead of {before}, tolerance {}", text(tolerance)))
                }
                Some(_) => None,
                None => Some(format!("{what} is no longer measured")),
            });
        }
    }
    found
}

fn is_worse(column: &Column, tolerance: Tolerance, before: f64, after: f64) -> bool {
    let loss = match column.better {
        Better::Higher => before - after,
        Better::Lower => after - before,
        Better::Neither => return false,
    };
    let allowed = match tolerance {
        Tolerance::Absolute(allowed) => allowed,
        Tolerance::Relative(share) => share * before.abs(),
    };
    loss > allowed
}

fn text(tolerance: Tolerance) -> String {
    match tolerance {
        Tolerance::Absolute(allowed) => allowed.to_string(),
        Tolerance::Relative(share) => format!("{:.0} %", 100.0 * share),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::Row;

    fn results(processor: &str, psnr: Option<f64>, time_ms: f64) -> Results {
        Results {
            name: "bench".to_owned(),
            source: None,
            commit: "1234567".to_owned(),
            date: "2026-11-22".to_owned(),
            processor: processor.to_owned(),
            cores: 2,
            command: "bench".to_owned(),
            columns: vec![
                Column::new("PSNR", "dB", 2).guarded(Better::Higher, Tolerance::Absolute(0.2)),
                Column::speed("time", "ms", 1, Better::Lower),
                Column::splats(),
            ],
            rows: vec![Row {
                name: "case".to_owned(),
                values: vec![psnr, Some(time_ms), Some(psnr.unwrap_or(0.0))],
            }],
        }
    }

    #[test]
    fn only_what_is_worse_by_more_than_the_tolerance_is_found() {
        let stored = results("P", Some(30.0), 10.0);
        assert_eq!(worse(&stored, &results("P", Some(29.81), 11.4)), [""; 0], "within the tolerance");
        assert_eq!(worse(&stored, &results("P", Some(40.0), 1.0)), [""; 0], "better");
        assert_eq!(
            worse(&stored, &results("P", Some(29.7), 12.0)),
            [
                "bench, case: PSNR, dB is 29.700 instead of 30.000, tolerance 0.2",
                "bench, case: time, ms is 12.00 instead of 10.00, tolerance 15 %"
            ]
        );
        assert_eq!(worse(&stored, &results("Q", Some(30.0), 99.0)), [""; 0], "another processor");
        assert_eq!(
            worse(&stored, &results("P", None, 10.0)),
            ["bench, case: PSNR, dB is no longer measured"]
        );
    }
}
