//! Checks where stored results come from: `results` measured them, and at a commit that can be checked out.

use super::record::Results;

/// The only results that may name a source, because `results` cannot measure them: figures of another program, and of a
/// graphics card beside which nothing can be built.
const MEASURED_ELSEWHERE: [&str; 3] = ["opensplat", "card", "card_passes"];

/// The faults of stored results, a sentence for each. `has_commit` tells whether the history contains a commit; `None`
/// if the history is not available.
pub(super) fn faults(results: &Results, has_commit: impl Fn(&str) -> Option<bool>) -> Vec<String> {
    let Results { name, source, commit, .. } = results;
    let source = source.as_ref().filter(|_| !MEASURED_ELSEWHERE.contains(&name.as_str()));
    let copied = source.map(|source| format!("the results `{name}` are copied from {source}; measure them"));
    let commit = commit_fault(commit, has_commit);
    let measured =
        commit.map(|fault| format!("the results `{name}` were measured at {fault}; measure them again"));
    copied.into_iter().chain(measured).collect()
}

/// What is wrong with a commit; `None` if nothing is, or if the history is not available.
fn commit_fault(commit: &str, has_commit: impl Fn(&str) -> Option<bool>) -> Option<String> {
    if commit == "unknown" || commit.ends_with('+') {
        return Some(format!("`{commit}`, which is not a commit"));
    }
    (has_commit(commit) == Some(false)).then(|| format!("`{commit}`, which the history lacks"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn faults_of(name: &str, source: Option<&str>, commit: &str) -> Vec<String> {
        let (name, source, commit) = (name.to_owned(), source.map(str::to_owned), commit.to_owned());
        faults(&Results { name, source, commit, ..Results::default() }, |commit| Some(commit == "1234567"))
    }

    #[test]
    fn only_results_from_elsewhere_may_have_a_source() {
        assert_eq!(faults_of("opensplat", Some("README"), "1234567"), [""; 0]);
        assert_eq!(faults_of("short", None, "1234567"), [""; 0]);
        let copied = "the results `short` are copied from README; measure them";
        assert_eq!(faults_of("short", Some("README"), "1234567"), [copied]);
    }

    #[test]
    fn commits_that_cannot_be_checked_out_are_found() {
        for commit in ["1234567+", "unknown", "7654321"] {
            let faults = faults_of("short", None, commit);
            assert!(faults.len() == 1 && faults[0].contains(commit), "{commit}: {faults:?}");
        }
        let results = |commit: &str| Results { commit: commit.to_owned(), ..Results::default() };
        assert_eq!(faults(&results("7654321"), |_| None), [""; 0], "without a history");
        assert_eq!(faults(&results("7654321+"), |_| None).len(), 1, "without a history");
    }
}
