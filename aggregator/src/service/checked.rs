//! JSON files whose last field is a hash of what comes before it, so that no changed bit goes unnoticed. Files of older
//! versions have no such field, and are read as they are.

use std::path::Path;

use cosurf_scene::{SceneError, atomic, files};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// What comes before the hash, which is in hexadecimal digits.
const BEFORE: &str = ",\n  \"blake3\": \"";
/// What comes after it.
const AFTER: &str = "\"\n}";

/// Writes a value with fields as such a file.
pub(super) fn write(path: &Path, value: &impl Serialize) -> Result<(), SceneError> {
    let text = serde_json::to_string_pretty(value)
        .map_err(|error| SceneError::malformed(path, error.to_string()))?;
    let content = text.strip_suffix("\n}").unwrap_or(&text);
    let hash = blake3::hash(content.as_bytes()).to_hex();
    atomic::write_bytes(path, format!("{content}{BEFORE}{hash}{AFTER}").as_bytes())
}

/// Reads such a file.
pub(super) fn read<T: DeserializeOwned>(path: &Path) -> Result<T, SceneError> {
    let malformed = |what: String| SceneError::malformed(path, what);
    let text = String::from_utf8(files::read(path)?).map_err(|error| malformed(error.to_string()))?;
    let checked = text.strip_suffix(AFTER).and_then(|text| text.rsplit_once(BEFORE));
    if checked.is_some_and(|(content, hash)| blake3::hash(content.as_bytes()).to_hex().as_str() != hash) {
        return Err(malformed("its hash does not match".to_owned()));
    }
    serde_json::from_str(&text).map_err(|error| malformed(error.to_string()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::collections::BTreeMap;
    use std::fs;

    use super::*;

    #[test]
    fn every_changed_bit_is_noticed_and_files_without_a_hash_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        let value = BTreeMap::from([("device".to_owned(), "drone-1"), ("text".to_owned(), "a \"b\"")]);
        let read = || read::<BTreeMap<String, String>>(&path);
        write(&path, &value).unwrap();
        assert_eq!(read().unwrap()["device"], "drone-1");
        let whole = fs::read(&path).unwrap();
        let hash_at = whole.len() - AFTER.len() - 64 - BEFORE.len();
        for place in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[place] ^= 1;
            fs::write(&path, &damaged).unwrap();
            // Damage to the field's name leaves a file without a hash, whose content is as it was.
            let is_harmless = place >= hash_at && read().is_ok_and(|its| its["device"] == "drone-1");
            assert!(read().is_err() || is_harmless, "byte {place}");
        }
        fs::write(&path, "{\"device\": \"drone-2\"}").unwrap();
        assert_eq!(read().unwrap()["device"], "drone-2");
    }
}
