//! Parses the output of the bench library divan: a tree of benches with their times. The line after a bench contains
//! its throughput, if any:
//!
//! ```text
//! passes              fastest       │ slowest       │ median        │ mean          │ samples │ iters
//! ├─ adam             295 µs        │ 1.161 ms      │ 362.2 µs      │ 384.9 µs      │ 100     │ 100
//! │                   169.4 Mitem/s │ 43.06 Mitem/s │ 138 Mitem/s   │ 129.8 Mitem/s │         │
//! ╰─ rasterize                      │               │               │               │         │
//!    ├─ Geometry     6.7 ms        │ …
//! ```

/// The fastest sample of a bench.
#[derive(Debug, PartialEq)]
pub(crate) struct Fastest {
    /// Name of the bench, then its argument if it has one, for example `rasterize, Geometry`.
    pub(crate) name: String,
    /// Milliseconds.
    pub(crate) ms: f64,
    /// Million items per second, if the bench counts items.
    pub(crate) million_per_s: Option<f64>,
}

/// The fastest sample of each bench in divan's output.
pub(crate) fn rows(output: &str) -> Vec<Fastest> {
    let mut rows: Vec<Fastest> = Vec::new();
    let mut group = String::new();
    for line in output.lines() {
        let rest = line.trim_start_matches(['│', '├', '╰', '─', ' ']);
        let branch = line[..line.len() - rest.len()].find(['├', '╰']);
        let Some((first, _)) = rest.split_once('│') else { continue };
        let words: Vec<&str> = first.split_whitespace().collect();
        match (branch, &words[..]) {
            (Some(_), [name]) => group = (*name).to_owned(),
            (Some(at), [name, figure, unit]) => {
                let name = if at == 0 { (*name).to_owned() } else { format!("{group}, {name}") };
                rows.extend(milliseconds(figure, unit).map(|ms| Fastest { name, ms, million_per_s: None }));
            }
            (None, [figure, unit]) => {
                if let Some(row) = rows.last_mut() {
                    row.million_per_s = millions(figure, unit);
                }
            }
            _ => {}
        }
    }
    rows
}

fn milliseconds(figure: &str, unit: &str) -> Option<f64> {
    divided(figure, unit, [("ns", 1e6), ("µs", 1e3), ("ms", 1.0), ("s", 1e-3)])
}

fn millions(figure: &str, unit: &str) -> Option<f64> {
    divided(figure, unit, [("item/s", 1e6), ("Kitem/s", 1e3), ("Mitem/s", 1.0), ("Gitem/s", 1e-3)])
}

/// Converts a figure to the unit whose divisor is 1. `None` if it is not a number, or `unit` is not in `divisors`.
fn divided(figure: &str, unit: &str, divisors: [(&str, f64); 4]) -> Option<f64> {
    let (_, divisor) = divisors.into_iter().find(|(name, _)| *name == unit)?;
    Some(figure.parse::<f64>().ok()? / divisor)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_times_and_throughputs_are_read() {
        let output = r"Timer precision: 20 ns
passes                 fastest       │ slowest       │ median        │ mean          │ samples │ iters
├─ adam                295.5 µs      │ 1.161 ms      │ 362.2 µs      │ 384.9 µs      │ 100     │ 100
│                      169.4 Mitem/s │ 43.06 Mitem/s │ 138 Mitem/s   │ 129.8 Mitem/s │         │
├─ rasterize                         │               │               │               │         │
│  ├─ Color            1.5 ms        │ 9 ms          │ 7 ms          │ 7 ms          │ 100     │ 100
│  │                   875.5 Kitem/s │ 20 Mitem/s    │ 25 Mitem/s    │ 25 Mitem/s    │         │
│  ╰─ Geometry         6.7 ms        │ 9 ms          │ 7 ms          │ 7 ms          │ 100     │ 100
│                      26 Mitem/s    │ 20 Mitem/s    │ 25 Mitem/s    │ 25 Mitem/s    │         │
╰─ step                              │               │               │               │         │
   ╰─ Color            1.5 s         │ 2 s           │ 1.7 s         │ 1.7 s         │ 100     │ 100
";
        let row = |name: &str, ms, million_per_s| Fastest { name: name.to_owned(), ms, million_per_s };
        assert_eq!(
            rows(output),
            [
                row("adam", 0.2955, Some(169.4)),
                row("rasterize, Color", 1.5, Some(0.8755)),
                row("rasterize, Geometry", 6.7, Some(26.0)),
                row("step, Color", 1500.0, None)
            ]
        );
    }
}
