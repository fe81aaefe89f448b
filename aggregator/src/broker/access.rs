//! Who may connect, and who may publish and read what.

mod verifier;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use argon2::Argon2;
use argon2::password_hash::PasswordHasher;
use argon2::password_hash::phc::PasswordHash;
use cosurf_wire::{DeviceId, SiteId};
use rumqttc::v5::mqttbytes::v5::Login;

use super::client::User;
use super::topics::{covers, matches};

pub(super) use verifier::{Job, Verifier};

/// Topics that a user may write: `%s` stands for the site, `%u` for the user's name. The same as in `cosurf.acl`.
const WRITES: [&str; 5] = [
    "gs/v1/%s/%u/state",
    "gs/v1/%s/%u/status",
    "gs/v1/%s/%u/flight",
    "gs/v1/%s/%u/up/#",
    "gs/v1/%s/%u/global/+",
];
/// Topics that a user may read.
const READS: [&str; 3] = ["gs/v1/%s/%u/dn/#", "gs/v1/%s/global/#", "gs/v1/%s/+/flight"];
/// Largest file of users, bytes.
const FILE_BYTES_MAX: u64 = 4 << 20;
/// Longest password, bytes.
pub(super) const PASSWORD_BYTES_MAX: usize = 1024;

/// Why a file of users cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum UsersError {
    /// The file cannot be read.
    #[error("{path}: {cause}")]
    Io {
        /// The file's path.
        path: String,
        /// The operating system's error.
        cause: std::io::Error,
    },
    /// A line is not what the command `password` prints.
    #[error("{path}, line {line}: write the line that `cosurf-aggregator password NAME` prints")]
    Line {
        /// The file's path.
        path: String,
        /// Number of the line, from 1.
        line: usize,
    },
    /// The password is empty or too long.
    #[error("give a password of 1 to {PASSWORD_BYTES_MAX} bytes")]
    Password,
}

/// The passwords of users, as hashes.
#[derive(Clone, Debug, Default)]
pub struct Users(BTreeMap<DeviceId, String>);

impl Users {
    /// The names of the users.
    pub fn names(&self) -> impl Iterator<Item = DeviceId> {
        self.0.keys().copied()
    }

    /// Reads a file with a line for each user, as [`user_line`] makes it. Empty lines and lines that begin with `#` do
    /// not count.
    pub fn read(path: &Path) -> Result<Self, UsersError> {
        let name = path.display().to_string();
        let io = |cause| UsersError::Io { path: name.clone(), cause };
        if fs::metadata(path).map_err(io)?.len() > FILE_BYTES_MAX {
            return Err(io(std::io::Error::other(format!("larger than {FILE_BYTES_MAX} bytes"))));
        }
        let text = fs::read_to_string(path).map_err(io)?;
        let lines = text.lines().map(str::trim).enumerate();
        let lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
        let users = lines.map(|(number, line)| {
            read_line(line).ok_or_else(|| UsersError::Line { path: name.clone(), line: number + 1 })
        });
        users.collect::<Result<_, _>>().map(Self)
    }
}

fn read_line(line: &str) -> Option<(DeviceId, String)> {
    let (user, hash) = line.split_once(':')?;
    PasswordHash::new(hash).ok()?;
    Some((DeviceId::new(user).ok()?, hash.to_owned()))
}

/// The line of a user in the file of users: the name, and the Argon2id hash of the password with its `salt`.
pub fn user_line(user: &DeviceId, password: &str, salt: [u8; 16]) -> Result<String, UsersError> {
    if password.is_empty() || password.len() > PASSWORD_BYTES_MAX {
        return Err(UsersError::Password);
    }
    let hashed = Argon2::default().hash_password_with_salt(password.as_bytes(), &salt);
    hashed.map(|hash| format!("{user}:{hash}")).map_err(|_| UsersError::Password)
}

/// What a broker asks of its clients.
#[derive(Debug)]
pub(super) struct Access {
    /// The passwords that are accepted; `None` if no password is asked for.
    pub(super) users: Option<Users>,
    /// Whether a certificate is accepted: its common name is the user.
    pub(super) takes_certificates: bool,
    /// The site whose topics users may use; `None` for those of all sites.
    pub(super) site: Option<SiteId>,
    /// The password of the parts of this program.
    pub(super) house_password: String,
}

/// Answer to a client that wants to connect.
#[derive(Debug)]
pub(super) enum Verdict {
    Accept(User),
    Refuse,
    /// The password must be compared with this hash, which takes a while.
    Verify {
        user: DeviceId,
        password: String,
        hash: String,
    },
}

impl Access {
    /// Whether strangers may connect.
    pub(super) fn is_open(&self) -> bool {
        self.users.is_none() && !self.takes_certificates
    }

    /// Judges a client at the door for parts of this program.
    pub(super) fn judge_house(&self, login: Option<&Login>) -> Verdict {
        let is_right = login.is_some_and(|login| {
            blake3::hash(login.password.as_bytes()) == blake3::hash(self.house_password.as_bytes())
        });
        if is_right { Verdict::Accept(User::House) } else { Verdict::Refuse }
    }

    /// Judges a client from outside by its password or the common name of its certificate.
    pub(super) fn judge(&self, login: Option<Login>, certificate: Option<&str>) -> Verdict {
        if self.is_open() {
            return Verdict::Accept(User::Stranger);
        }
        if let Some(name) = certificate.filter(|_| self.takes_certificates) {
            let is_same = login.is_none_or(|login| login.username == name);
            let user = DeviceId::new(name).ok().filter(|_| is_same);
            return user.map_or(Verdict::Refuse, |user| Verdict::Accept(User::Named(user.as_str().into())));
        }
        let found = login.and_then(|login| {
            let user = DeviceId::new(&login.username).ok()?;
            let hash = self.users.as_ref()?.0.get(&user)?.clone();
            (login.password.len() <= PASSWORD_BYTES_MAX).then_some((user, login.password, hash))
        });
        found.map_or(Verdict::Refuse, |(user, password, hash)| Verdict::Verify { user, password, hash })
    }

    pub(super) fn may_publish(&self, user: &User, topic: &str) -> bool {
        self.allows(user, &WRITES, |pattern| matches(topic, pattern))
    }

    pub(super) fn may_subscribe(&self, user: &User, filter: &str) -> bool {
        self.allows(user, &READS, |pattern| covers(pattern, filter))
    }

    fn allows(&self, user: &User, patterns: &[&str], is_match: impl Fn(&str) -> bool) -> bool {
        let User::Named(name) = user else { return true };
        let site = self.site.as_ref().map_or("+", SiteId::as_str);
        patterns.iter().any(|pattern| is_match(&pattern.replace("%s", site).replace("%u", name)))
    }
}

/// Files of the TLS of a built-in broker, all in PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerTls {
    /// The broker's certificate, followed by intermediate certificates.
    pub cert: PathBuf,
    /// The private key of `cert`.
    pub key: PathBuf,
    /// Certificates of the authorities whose clients may connect; absent to ask clients for no certificate.
    pub ca: Option<PathBuf>,
    /// List of revoked certificates.
    pub revoked: Option<PathBuf>,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The rules for Mosquitto and those of this broker are the same.
    #[test]
    fn the_access_list_for_mosquitto_has_the_same_topics() {
        let list = include_str!("../../../shared/docs/cosurf.acl");
        let patterns = |word: &str| -> Vec<String> {
            let start = format!("pattern {word} ");
            let lines = list.lines().filter_map(|line| line.strip_prefix(&start));
            lines.map(|topic| topic.replace("/quarry/", "/%s/")).collect()
        };
        assert_eq!(patterns("write"), WRITES);
        assert_eq!(patterns("read"), READS);
    }
}
