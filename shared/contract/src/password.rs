//! Passwords for brokers. They are in a file or in the environment, so that configuration files and command lines hold
//! none.

use std::path::Path;
use std::{env, fs, io};

/// The environment variable with the password.
const VARIABLE: &str = "COSURF_PASSWORD";

/// Why there is no password.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PasswordError {
    /// The file cannot be read.
    #[error("password_file: {path}: {cause}")]
    File {
        /// The file's path.
        path: String,
        /// The operating system's error.
        cause: io::Error,
    },
    /// The file's first line is empty.
    #[error("password_file: {path}: write the password on the first line")]
    Empty {
        /// The file's path.
        path: String,
    },
}

/// The password for a broker: the first line of `file`, or else the environment variable `COSURF_PASSWORD`. `None` if
/// there is neither.
pub fn read_password(file: Option<&Path>) -> Result<Option<String>, PasswordError> {
    let Some(file) = file else { return Ok(env::var(VARIABLE).ok().filter(|password| !password.is_empty())) };
    let path = file.display().to_string();
    let text = fs::read_to_string(file).map_err(|cause| PasswordError::File { path: path.clone(), cause })?;
    match text.lines().next().map(str::trim_end) {
        None | Some("") => Err(PasswordError::Empty { path }),
        Some(password) => Ok(Some(password.to_owned())),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_password_is_the_first_line_of_its_file() {
        let path = env::temp_dir().join(format!("cosurf-password-{}", std::process::id()));
        let missing = read_password(Some(&path)).unwrap_err().to_string();
        assert!(missing.starts_with("password_file: ") && missing.contains("cosurf-password"), "{missing}");
        for (text, password) in
            [("secret words\r\nmore\n", Some("secret words")), ("\nsecret", None), ("", None)]
        {
            fs::write(&path, text).unwrap();
            let read = read_password(Some(&path)).ok().flatten();
            assert_eq!(read.as_deref(), password, "{text:?}");
        }
        fs::remove_file(&path).unwrap();
    }
}
