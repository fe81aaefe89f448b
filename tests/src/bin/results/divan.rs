//! The output of divan, a tree of benches with their times; the throughput is in the line after the time:
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
    /// Name, and argument if it has one.
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
        let Some((first, _)) = line.split_once(" │ ") else { continue };
        let branch = first.find(['├', '╰']);
        let words: Vec<&str> =
            first.split_whitespace().filter(|word| !word.starts_with(['├', '╰', '│'])).collect();
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
    let scale = match unit {
        "ns" => 1e-6,
        "µs" => 1e-3,
        "ms" => 1.0,
        "s" => 1e3,
        _ => return None,
    };
    Some(scale * figure.parse::<f64>().ok()?)
}

fn millions(figure: &str, unit: &str) -> Option<f64> {
    let scale = match unit {
        "item/s" => 1e-6,
        "Kitem/s" => 1e-3,
        "Mitem/s" => 1.0,
        "Gitem/s" => 1e3,
        _ => return None,
    };
    Some(scale * figure.parse::<f64>().ok()?)
}
