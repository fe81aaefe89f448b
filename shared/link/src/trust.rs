//! Who may send what: ed25519 signatures of what is announced, and the world frame that all must share.
//!
//! A signature binds device, number, hash of the body, sizes, kind, frame and site together
//! ([`ModelHeader::statement`]); chunks need none, for the hash holds them. With a list of keys a receiver
//! refuses who is not in it, who is revoked, and a number below one that it has stored of the same device.
//! Without one it takes models from anybody whom the broker lets in. Answers ([`cosurf_wire::Want`] and its
//! like) are not signed: a broker's access list keeps every device to its own branch.

use std::collections::BTreeMap;
use std::fs;
use std::io::{ErrorKind, Write};
use std::path::Path;

use cosurf_scene::SceneError;
use cosurf_wire::message::MAX_STATEMENT_BYTES;
use cosurf_wire::{DeviceId, FrameId, ModelHeader, ModelId, RefusalReason, Signature, SiteId};
use ed25519_dalek::{Signer, SigningKey, VerifyingKey};

/// Longest list of keys that is read.
const TRUSTED_BYTES_MAX: u64 = 1 << 20;
/// Longest file of a secret key.
const KEY_BYTES_MAX: u64 = 1 << 10;

/// What a participant signs with, and whom it believes.
#[derive(Clone, Debug, Default)]
pub struct Credentials {
    /// The world frame of its models.
    pub frame: FrameId,
    /// What it signs with, if it signs.
    pub key: Option<SecretKey>,
    /// Whom it believes; everybody where there is no list.
    pub trusted: Option<Trusted>,
}

impl Credentials {
    /// Reads the files that are named.
    pub fn load(frame: FrameId, key: Option<&Path>, trusted: Option<&Path>) -> Result<Self, SceneError> {
        let key = key.map(SecretKey::read).transpose()?;
        let trusted = trusted.map(Trusted::read).transpose()?;
        Ok(Self { frame, key, trusted })
    }

    /// Why a model is refused, if it is: `newest` is the greatest number stored of its device.
    pub(crate) fn check(
        &self,
        site: &SiteId,
        header: &ModelHeader,
        newest: Option<ModelId>,
    ) -> Result<(), RefusalReason> {
        if header.frame != self.frame {
            return Err(RefusalReason::WrongFrame);
        }
        let Some(trusted) = &self.trusted else { return Ok(()) };
        trusted.check(site, header)?;
        if newest.is_some_and(|newest| header.model < newest) {
            return Err(RefusalReason::Replayed);
        }
        Ok(())
    }
}

/// What a participant signs with.
#[derive(Clone)]
pub struct SecretKey(SigningKey);

impl std::fmt::Debug for SecretKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "SecretKey of {}", hex(self.0.verifying_key().as_bytes()))
    }
}

impl SecretKey {
    /// The key of 32 bytes that nobody can guess.
    pub fn new(random: &[u8; 32]) -> Self {
        Self(SigningKey::from_bytes(random))
    }

    /// Reads what [`Self::write_new`] wrote.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        let text = read_text(path, KEY_BYTES_MAX)?;
        let bytes = parse_hex(text.trim()).ok_or_else(|| {
            SceneError::malformed(path, "holds no secret key; write one with the command key")
        })?;
        Ok(Self::new(&bytes))
    }

    /// Writes the key into a new file that only its owner may read. A file that is there stays.
    pub fn write_new(&self, path: &Path) -> Result<(), SceneError> {
        let mut options = fs::OpenOptions::new();
        options.write(true).create_new(true);
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
        let written = options.open(path).and_then(|mut file| {
            writeln!(file, "{}", hex(self.0.as_bytes()))?;
            file.sync_all()
        });
        written.map_err(|cause| match cause.kind() {
            ErrorKind::AlreadyExists => {
                SceneError::malformed(path, "is there already; a key is not overwritten, choose another name")
            }
            _ => SceneError::io(path, cause),
        })
    }

    /// The line for the lists of those who shall believe `device`.
    pub fn public_line(&self, device: &DeviceId) -> String {
        format!("{device} {}", hex(self.0.verifying_key().as_bytes()))
    }

    /// Signs an announcement.
    pub fn sign(&self, site: &SiteId, header: &mut ModelHeader) {
        let mut buffer = [0; MAX_STATEMENT_BYTES];
        let signature = self.0.sign(header.statement(site, &mut buffer));
        header.signature = Some(Signature { r: *signature.r_bytes(), s: *signature.s_bytes() });
    }
}

/// A list of keys.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Trusted {
    keys: BTreeMap<DeviceId, Vec<PublicKey>>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct PublicKey {
    key: VerifyingKey,
    is_revoked: bool,
}

impl Trusted {
    /// Reads a list from a file.
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        let text = read_text(path, TRUSTED_BYTES_MAX)?;
        Self::parse(&text).map_err(|reason| SceneError::malformed(path, reason))
    }

    /// Reads a list: a line `DEVICE KEY` for each key, as the command `key` prints it, `revoked DEVICE KEY` for
    /// one that counts no more, and comments after `#`. A device may have several keys. The error names the
    /// line.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut trusted = Self::default();
        for (i, line) in text.lines().enumerate() {
            let wrong = |what: &str| format!("line {}: {what}", i + 1);
            let line = line.split('#').next().unwrap_or_default();
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            let (is_revoked, device, key) = match words[..] {
                [] => continue,
                [device, key] => (false, device, key),
                ["revoked", device, key] => (true, device, key),
                _ => return Err(wrong("write DEVICE KEY, or revoked DEVICE KEY")),
            };
            let device = DeviceId::new(device).map_err(|error| wrong(&error.to_string()))?;
            let key = parse_hex(key).and_then(|bytes| VerifyingKey::from_bytes(&bytes).ok());
            let key =
                key.ok_or_else(|| wrong("no public key; copy the line that the command key printed"))?;
            trusted.keys.entry(device).or_default().push(PublicKey { key, is_revoked });
        }
        Ok(trusted)
    }

    fn check(&self, site: &SiteId, header: &ModelHeader) -> Result<(), RefusalReason> {
        let keys = self.keys.get(&header.device).ok_or(RefusalReason::UnknownDevice)?;
        let Signature { r, s } = header.signature.ok_or(RefusalReason::BadSignature)?;
        let signature = ed25519_dalek::Signature::from_components(r, s);
        let mut buffer = [0; MAX_STATEMENT_BYTES];
        let statement = header.statement(site, &mut buffer);
        let signer = keys.iter().find(|known| known.key.verify_strict(statement, &signature).is_ok());
        match signer {
            None => Err(RefusalReason::BadSignature),
            // A key that stands in the list twice is revoked if it is once.
            Some(signer) if keys.iter().any(|known| known.key == signer.key && known.is_revoked) => {
                Err(RefusalReason::Revoked)
            }
            Some(_) => Ok(()),
        }
    }
}

fn read_text(path: &Path, bytes_max: u64) -> Result<String, SceneError> {
    let size = fs::metadata(path).map_err(|cause| SceneError::io(path, cause))?.len();
    if size > bytes_max {
        return Err(SceneError::malformed(path, "is too long for keys; name the right file"));
    }
    fs::read_to_string(path).map_err(|cause| SceneError::io(path, cause))
}

fn hex(bytes: &[u8; 32]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn parse_hex(text: &str) -> Option<[u8; 32]> {
    let digits: &[u8; 64] = text.as_bytes().try_into().ok()?;
    let mut bytes = [0; 32];
    for (byte, pair) in bytes.iter_mut().zip(digits.as_chunks::<2>().0) {
        let digit = |c: u8| char::from(c).to_digit(16);
        *byte = (digit(pair[0])? * 16 + digit(pair[1])?) as u8;
    }
    Some(bytes)
}
