//! Keys: ed25519 signatures of messages, and the world frame that all models must share.
//!
//! A participant with a secret key seals all its messages but chunks ([`cosurf_wire::seal`]); the header has the hash of
//! the body, so chunks need no signature. A receiver with a list of keys answers messages with silence that no listed key of
//! their sender has signed, as [`crate::guard`] tells. A receiver without a list believes every client of the broker.

use std::collections::BTreeMap;
use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::path::Path;

use cosurf_scene::{SceneError, files};
use cosurf_wire::{DeviceId, FrameId, Signature};
use ed25519_dalek::{Signer, SigningKey, VerifyingKey};

/// Maximum size of a list of keys in bytes.
const TRUSTED_BYTES_MAX: u64 = 1 << 20;
/// Maximum size of a secret key's file in bytes.
const KEY_BYTES_MAX: u64 = 1 << 10;

/// A participant's world frame, its secret key, and the keys that it trusts.
#[derive(Clone, Debug, Default)]
pub struct Credentials {
    /// World frame of this participant's models. Models in other frames are refused.
    pub frame: FrameId,
    /// Key that signs this participant's messages; `None` leaves them unsigned.
    pub key: Option<SecretKey>,
    /// Keys of the other side: of an aggregator's devices, or of a device's aggregators. `None` believes everybody.
    pub trusted: Option<Trusted>,
    /// Of a device: keys of the devices whose flights count. `None` believes everybody if `trusted` is `None` too, and
    /// nobody otherwise.
    pub fleet: Option<Trusted>,
}

/// Why a file that a setting names cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{setting}: {cause}")]
pub struct CredentialsError {
    /// The setting: `key`, `trusted` or `fleet`.
    pub setting: &'static str,
    /// What is wrong with its file.
    pub cause: SceneError,
}

impl Credentials {
    /// Reads the given files with the secret key and the lists of keys.
    pub fn load(
        frame: FrameId,
        key: Option<&Path>,
        trusted: Option<&Path>,
        fleet: Option<&Path>,
    ) -> Result<Self, CredentialsError> {
        let failed = |setting| move |cause| CredentialsError { setting, cause };
        Ok(Self {
            frame,
            key: key.map(SecretKey::read).transpose().map_err(failed("key"))?,
            trusted: trusted.map(Trusted::read).transpose().map_err(failed("trusted"))?,
            fleet: fleet.map(Trusted::read).transpose().map_err(failed("fleet"))?,
        })
    }
}

/// Why a message is not that of a listed key.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum KeyFault {
    #[error("no key of {0} is listed")]
    Unlisted(DeviceId),
    #[error("no listed key of {0} has signed it")]
    WrongKey(DeviceId),
    #[error("the key of {0} that has signed it is revoked")]
    Revoked(DeviceId),
}

/// A secret key for signing messages.
#[derive(Clone)]
pub struct SecretKey(SigningKey);

impl std::fmt::Debug for SecretKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "SecretKey of {}", hex(self.0.verifying_key().as_bytes()))
    }
}

impl SecretKey {
    /// Makes a key from 32 random bytes, which must come from a cryptographic random number generator.
    pub fn new(random: &[u8; 32]) -> Self {
        Self(SigningKey::from_bytes(random))
    }

    /// Reads a file written by [`Self::write_new`].
    pub fn read(path: &Path) -> Result<Self, SceneError> {
        let text = read_text(path, KEY_BYTES_MAX)?;
        let bytes = parse_hex(text.trim()).ok_or_else(|| {
            SceneError::malformed(path, "holds no secret key; make one with the command key")
        })?;
        Ok(Self::new(&bytes))
    }

    /// Writes the key to a new file that only the current user may read. An existing file is an error.
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
                SceneError::malformed(path, "already exists; a key is not overwritten, choose another name")
            }
            _ => SceneError::io(path, cause),
        })
    }

    /// The line with the public key of `device`. Receivers add it to their lists of keys.
    pub fn public_line(&self, device: &DeviceId) -> String {
        format!("{device} {}", hex(self.0.verifying_key().as_bytes()))
    }

    /// Signs the bytes of a statement.
    pub(crate) fn sign(&self, statement: [&[u8]; 4]) -> Signature {
        let signature = self.0.sign(&statement.concat());
        Signature { r: *signature.r_bytes(), s: *signature.s_bytes() }
    }
}

/// A list of trusted and revoked public keys.
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

    /// Parses a list of keys. A line `DEVICE KEY`, as the command `key` prints it, adds a key. A line
    /// `revoked DEVICE KEY` revokes a key. `#` starts a comment. A device may have several keys. An error
    /// message contains the number of the line.
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
            let key = key.ok_or_else(|| {
                wrong("this is not a public key; copy the line that the command key printed")
            })?;
            trusted.keys.entry(device).or_default().push(PublicKey { key, is_revoked });
        }
        Ok(trusted)
    }

    /// Checks that a key of `sender` has signed a statement, and that this key is not revoked.
    pub(crate) fn check(
        &self,
        sender: DeviceId,
        statement: [&[u8]; 4],
        Signature { r, s }: Signature,
    ) -> Result<(), KeyFault> {
        let keys = self.keys.get(&sender).ok_or(KeyFault::Unlisted(sender))?;
        let (statement, signature) = (statement.concat(), ed25519_dalek::Signature::from_components(r, s));
        let signer = keys.iter().find(|known| known.key.verify_strict(&statement, &signature).is_ok());
        match signer {
            None => Err(KeyFault::WrongKey(sender)),
            // A key that is listed twice is revoked if at least one of its lines says so.
            Some(signer) if keys.iter().any(|known| known.key == signer.key && known.is_revoked) => {
                Err(KeyFault::Revoked(sender))
            }
            Some(_) => Ok(()),
        }
    }
}

fn read_text(path: &Path, bytes_max: u64) -> Result<String, SceneError> {
    let failed = |cause| SceneError::io(path, cause);
    let mut file = files::open(path)?;
    let size = file.metadata().map_err(failed)?.len();
    if size > bytes_max {
        return Err(SceneError::malformed(path, "is too large for a file of keys; is it the right file?"));
    }
    let mut text = String::new();
    file.read_to_string(&mut text).map_err(failed)?;
    Ok(text)
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
