//! The keys of a site, in a folder: a certificate authority, a certificate and a signing key for each participant, and
//! the list of what was revoked. With them, only the site's own participants can connect to its broker, and what they
//! send is signed.
//!
//! What it knows nothing about: the broker and the programs that use the files.

mod certificate;
mod issued;

use std::fs;
use std::io::{self, Write};
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use cosurf_link::SecretKey;
use cosurf_scene::{SceneError, atomic, files};
use cosurf_wire::DeviceId;

use certificate::{Authority, Role, Signed};
use issued::{Issued, Record};

/// The authority's secret key. Who has it can let anyone in.
const AUTHORITY_KEY: &str = "authority.key";
const AUTHORITY: &str = "ca.pem";
const REVOKED: &str = "revoked.pem";
const TRUSTED: &str = "trusted.txt";
const FLEET: &str = "fleet.txt";
/// Folder with the broker's files, named as in `shared/docs/mosquitto.conf`.
const BROKER: &str = "broker";
/// Folder with the folders of revoked participants.
const REVOKED_FOLDERS: &str = "revoked";
/// Names that a participant cannot have, because the folder uses them.
const RESERVED: [&str; 2] = [BROKER, REVOKED_FOLDERS];

/// Why keys were not made or revoked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PkiError {
    /// A file cannot be read or written.
    #[error(transparent)]
    File(#[from] SceneError),
    /// A certificate or a key cannot be made or read.
    #[error("{path}: {cause}")]
    Certificate {
        /// The file of the certificate or key.
        path: String,
        /// The cause.
        cause: rcgen::Error,
    },
    /// The system gives no random numbers.
    #[error("the system gives no random numbers: {0}")]
    NoRandom(getrandom::Error),
    /// The broker has no certificate yet, and no name for one is given.
    #[error("name the broker's computer, as its clients will: --host 192.168.1.10")]
    NoHost,
    /// The participant has keys already.
    #[error("{0} has keys already; to make new ones, add --revoke {0}")]
    HasKeys(DeviceId),
    /// The participant has no keys.
    #[error("{0} has no keys that could be revoked; those with keys: {1}")]
    HasNone(DeviceId, String),
    /// The broker's certificate cannot be revoked.
    #[error(
        "the broker's certificate cannot be revoked: drones trust every certificate of their `ca.pem`. `--host` makes a \
         new one; if its key was stolen, make all keys anew in another folder"
    )]
    NotRevocable,
    /// The name is needed for something else.
    #[error("{0} cannot be the name of a participant: the folder has a folder of this name")]
    Reserved(DeviceId),
}

/// What to make or revoke.
#[derive(Clone, Debug)]
pub struct Wish {
    /// Names and addresses of the broker's computer. If there are any, the broker gets a new certificate.
    pub hosts: Vec<String>,
    /// Name of the aggregator. It gets keys if it has none.
    pub aggregator: DeviceId,
    /// Devices that get keys.
    pub devices: Vec<DeviceId>,
    /// Participants whose keys are revoked, before new ones are made.
    pub revoked: Vec<DeviceId>,
    /// Days until new certificates expire, 1 to 3,650.
    pub days: u32,
}

/// What was done, for the user.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Done {
    /// Folders with new files.
    pub made: Vec<PathBuf>,
    /// Participants whose keys were revoked.
    pub revoked: Vec<DeviceId>,
}

/// The keys of a site.
pub struct Pki {
    folder: PathBuf,
    authority: Authority,
    issued: Issued,
    now_s: u64,
}

impl Pki {
    /// Opens the folder, and makes the authority if it is new.
    pub fn open(folder: &Path) -> Result<Self, PkiError> {
        files::create_folder(folder)?;
        let now_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
        let (key, certificate) = (folder.join(AUTHORITY_KEY), folder.join(AUTHORITY));
        let authority = match read(&key)? {
            Some(text) => Authority::from_key(&text),
            None => Authority::new(),
        };
        let authority = authority.map_err(|cause| failed(&key, cause))?;
        if !key.exists() {
            write_secret(&key, &authority.key_pem())?;
        }
        if !certificate.exists() {
            let made = authority.certificate(now_s).map_err(|cause| failed(&certificate, cause))?;
            write(&certificate, &made)?;
        }
        Ok(Self { folder: folder.to_owned(), authority, issued: Issued::read(folder)?, now_s })
    }

    /// Makes and revokes what is wished. The list of revoked certificates is always made anew.
    pub fn fulfil(mut self, wish: &Wish) -> Result<Done, PkiError> {
        self.check(wish)?;
        let mut done = Done::default();
        for name in &wish.revoked {
            self.revoke(name)?;
            done.revoked.push(*name);
        }
        if !wish.hosts.is_empty() {
            done.made.push(self.make_broker(&wish.hosts, wish.days)?);
        }
        let aggregator = (!self.has_keys(&wish.aggregator)).then_some(&wish.aggregator);
        for name in aggregator.into_iter().chain(&wish.devices) {
            done.made.push(self.make_participant(name, wish.days)?);
        }
        self.publish(&wish.aggregator)?;
        Ok(done)
    }

    /// Refuses the whole wish before anything is changed.
    fn check(&self, wish: &Wish) -> Result<(), PkiError> {
        if wish.hosts.is_empty() && !self.folder.join(BROKER).exists() {
            return Err(PkiError::NoHost);
        }
        let names = wish.devices.iter().chain([&wish.aggregator]);
        let is_reserved = |name: &&DeviceId| RESERVED.contains(&name.as_str());
        if let Some(name) = names.into_iter().find(is_reserved) {
            return Err(PkiError::Reserved(*name));
        }
        if wish.revoked.iter().any(|name| is_reserved(&name)) {
            return Err(PkiError::NotRevocable);
        }
        for name in &wish.revoked {
            if !self.has_keys(name) {
                let names: Vec<&str> = self.issued.valid().map(|record| record.name.as_str()).collect();
                return Err(PkiError::HasNone(*name, names.join(", ")));
            }
        }
        for (i, name) in wish.devices.iter().enumerate() {
            let has_keys = self.has_keys(name) && !wish.revoked.contains(name);
            if has_keys || *name == wish.aggregator || wish.devices[..i].contains(name) {
                return Err(PkiError::HasKeys(*name));
            }
        }
        Ok(())
    }

    fn has_keys(&self, name: &DeviceId) -> bool {
        self.folder.join(name.as_str()).exists()
    }

    fn revoke(&mut self, name: &DeviceId) -> Result<(), PkiError> {
        self.issued.revoke(name.as_str(), self.now_s);
        self.issued.write(&self.folder)?;
        let away = self.folder.join(REVOKED_FOLDERS);
        files::create_folder(&away)?;
        let serial = self.issued.last_serial(name.as_str()).unwrap_or_default();
        let away = away.join(format!("{name}-{serial}"));
        fs::rename(self.folder.join(name.as_str()), &away)
            .map_err(|cause| SceneError::io(&away, cause).into())
    }

    fn make_broker(&self, hosts: &[String], days: u32) -> Result<PathBuf, PkiError> {
        let folder = self.folder.join(BROKER);
        files::create_folder(&folder)?;
        let local = ["localhost".to_owned(), "127.0.0.1".to_owned()];
        let mut hosts = [hosts, &local].concat();
        hosts.dedup();
        // Certificates have addresses in their shortest form.
        for host in &mut hosts {
            if let Ok(address) = host.parse::<IpAddr>() {
                *host = address.to_string();
            }
        }
        let made = self.sign(&hosts[0], Role::Server(&hosts), days, &folder.join("server.pem"))?;
        replace_secret(&folder.join("server.key"), &made.key_pem)?;
        write(&folder.join("server.pem"), &made.certificate_pem)?;
        Ok(folder)
    }

    /// The participant is noted before its files appear, so that whatever can be used can be revoked.
    fn make_participant(&mut self, name: &DeviceId, days: u32) -> Result<PathBuf, PkiError> {
        let (folder, partial) = (self.folder.join(name.as_str()), self.folder.join(format!(".{name}")));
        match fs::remove_dir_all(&partial) {
            Err(cause) if cause.kind() != io::ErrorKind::NotFound => {
                return Err(SceneError::io(&partial, cause).into());
            }
            _ => fs::create_dir(&partial).map_err(|cause| SceneError::io(&partial, cause))?,
        }
        let made = self.sign(name.as_str(), Role::Client, days, &folder.join("tls.pem"))?;
        write_secret(&partial.join("tls.key"), &made.key_pem)?;
        write(&partial.join("tls.pem"), &made.certificate_pem)?;
        write(&partial.join(AUTHORITY), &self.authority_pem()?)?;
        let key = SecretKey::new(&random()?);
        key.write_new(&partial.join("sign.key"))?;
        self.issued.add(Record {
            name: name.to_string(),
            serial: made.serial,
            key: key.public_line(name),
            made_s: self.now_s,
            revoked_s: None,
        });
        self.issued.write(&self.folder)?;
        fs::rename(&partial, &folder).map_err(|cause| SceneError::io(&folder, cause))?;
        Ok(folder)
    }

    fn sign(&self, name: &str, role: Role, days: u32, path: &Path) -> Result<Signed, PkiError> {
        let serial: [u8; 32] = random()?;
        self.authority.sign(name, role, &serial, self.now_s, days).map_err(|cause| failed(path, cause))
    }

    fn authority_pem(&self) -> Result<String, PkiError> {
        let path = self.folder.join(AUTHORITY);
        Ok(fs::read_to_string(&path).map_err(|cause| SceneError::io(&path, cause))?)
    }

    /// Writes the lists that all participants need: what is revoked, and whose signatures to trust. Devices trust the
    /// aggregator, and the flights of the whole fleet; the aggregator trusts the devices.
    fn publish(&self, aggregator: &DeviceId) -> Result<(), PkiError> {
        let path = self.folder.join(REVOKED);
        let revoked =
            self.authority.revoked(&self.issued, self.now_s).map_err(|cause| failed(&path, cause))?;
        write(&path, &revoked)?;
        let broker = self.folder.join(BROKER);
        write(&broker.join(REVOKED), &revoked)?;
        write(&broker.join(AUTHORITY), &self.authority_pem()?)?;
        let is_aggregator = |name: &str| name == aggregator.as_str();
        let devices = self.issued.all().filter(|record| !is_aggregator(&record.name));
        let fleet: String = devices.map(Record::trust_line).collect();
        for record in self.issued.valid() {
            let others = |other: &&Record| is_aggregator(&other.name) != is_aggregator(&record.name);
            let lines: String = self.issued.all().filter(others).map(Record::trust_line).collect();
            write(&self.folder.join(&record.name).join(TRUSTED), &lines)?;
            if !is_aggregator(&record.name) {
                write(&self.folder.join(&record.name).join(FLEET), &fleet)?;
            }
        }
        Ok(())
    }
}

fn failed(path: &Path, cause: rcgen::Error) -> PkiError {
    PkiError::Certificate { path: path.display().to_string(), cause }
}

fn random() -> Result<[u8; 32], PkiError> {
    let mut bytes = [0; 32];
    getrandom::fill(&mut bytes).map_err(PkiError::NoRandom)?;
    Ok(bytes)
}

/// The text of a file; `None` if it does not exist.
fn read(path: &Path) -> Result<Option<String>, SceneError> {
    match fs::read_to_string(path) {
        Ok(text) => Ok(Some(text)),
        Err(cause) if cause.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(cause) => Err(SceneError::io(path, cause)),
    }
}

fn write(path: &Path, text: &str) -> Result<(), SceneError> {
    atomic::write_bytes(path, text.as_bytes())
}

/// Writes a new file that only the current user may read.
fn write_secret(path: &Path, text: &str) -> Result<(), SceneError> {
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let written = options.open(path).and_then(|mut file| {
        file.write_all(text.as_bytes())?;
        file.sync_all()
    });
    written.map_err(|cause| SceneError::io(path, cause))
}

/// Writes a file that only the current user may read, in place of an older one.
fn replace_secret(path: &Path, text: &str) -> Result<(), SceneError> {
    match fs::remove_file(path) {
        Err(cause) if cause.kind() != io::ErrorKind::NotFound => Err(SceneError::io(path, cause)),
        _ => write_secret(path, text),
    }
}

#[cfg(test)]
mod tests;
