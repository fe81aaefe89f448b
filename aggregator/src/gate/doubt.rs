//! Why models are kept out of merges.

/// Why a model is kept out of a merge.
#[derive(Clone, Debug, PartialEq)]
pub enum Doubt {
    /// The model has no splats.
    Empty,
    /// The model has the same splats and cameras as the one with this index.
    Copy(usize),
    /// The model has splats with coefficients of colour as large as this.
    Glaring(f64),
    /// This share of the model's splats, 0..=1, lies where none of its own cameras looks.
    Unseen(f64),
    /// This share of the pictures of the model's own cameras, 0..=1, shows mostly no surface.
    Void(f64),
    /// The model contradicts the models with these indices.
    Contradicts(Vec<usize>),
    /// The model's error on ground that it shares with others is this many times as large as theirs.
    FarWorse(f64),
    /// The model has no cameras, and its frame is not vouched for.
    Blind,
    /// The model shares no ground with the others, and its frame is not vouched for.
    Unverified,
}

impl Doubt {
    /// The reason as a sentence without its subject. `names` has the name of every model.
    pub(crate) fn reason<N: AsRef<str>>(&self, names: &[N]) -> String {
        match self {
            Self::Empty => "has no splats".into(),
            Self::Copy(original) => format!("is a copy of the model of {}", names[*original].as_ref()),
            Self::Glaring(largest) => {
                format!("has splats of impossible colours (a coefficient of {largest:.0}; trained ones stay below 10)")
            }
            Self::Unseen(share) => {
                format!("has {:.0} % of its splats where none of its cameras looks", 100.0 * share)
            }
            Self::Void(share) => {
                format!("shows no ground in {:.0} % of the pictures of its own cameras", 100.0 * share)
            }
            Self::FarWorse(times) => {
                format!("shows shared ground far worse than the others ({times:.0} times their error)")
            }
            Self::Blind => {
                "has no cameras, so it cannot be compared with the others; if all models use one frame, name it (`frame`) \
                 or pass --same-frame"
                    .into()
            }
            Self::Unverified => {
                "shares no ground with the others, so its frame cannot be checked; if all models use one frame, name it \
                 (`frame`) or pass --same-frame"
                    .into()
            }
            Self::Contradicts(others) => {
                let names: Vec<&str> = others.iter().map(|other| names[*other].as_ref()).collect();
                format!("contradicts {} (different ground, place, scale or brightness)", names.join(", "))
            }
        }
    }
}
