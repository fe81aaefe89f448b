//! Checks that the comment at the head of each file agrees with the list of passes.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use super::ALL;

/// Names of the files in a folder of this crate, without the ending `.wgsl`.
fn files_in(folder: &str) -> BTreeSet<String> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let entries = fs::read_dir(&folder).expect("the folder is there");
    entries
        .map(|entry| {
            let name = entry.expect("an entry").file_name().into_string().expect("a name in UTF-8");
            name.strip_suffix(".wgsl").expect("only WGSL lies here").to_owned()
        })
        .collect()
}

/// The parts that the comment at the head of a pass names.
fn parts_in_head(file: &str) -> Vec<&str> {
    let line = file.lines().find_map(|line| line.strip_prefix("// Parts: ")).expect("a line of parts");
    line.trim_end_matches('.').split(", ").collect()
}

#[test]
fn every_head_names_the_parts_of_its_pass() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for shader in ALL {
        let path = root.join("passes").join(shader.name).with_extension("wgsl");
        let file = fs::read_to_string(&path).expect("the pass is there");
        assert_eq!(parts_in_head(&file), shader.parts, "{}", path.display());
        assert!(shader.source.ends_with(&file), "{}", path.display());
    }
}

#[test]
fn every_file_is_used_and_every_name_is_a_file() {
    let names = |names: Vec<&str>| names.into_iter().map(str::to_owned).collect::<BTreeSet<_>>();
    assert_eq!(files_in("passes"), names(ALL.iter().map(|shader| shader.name).collect()));
    assert_eq!(files_in("parts"), names(ALL.iter().flat_map(|shader| shader.parts).copied().collect()));
}
