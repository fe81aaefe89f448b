//! Compares passwords with their hashes on a thread of its own, because each takes tens of milliseconds.

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread;

use argon2::Argon2;
use argon2::password_hash::PasswordVerifier;
use argon2::password_hash::phc::PasswordHash;
use cosurf_wire::DeviceId;

/// Limit on passwords that wait.
const JOBS_MAX: usize = 64;

/// A password to compare with a hash.
pub(in super::super) struct Job {
    /// The connection that waits for the answer.
    pub(in super::super) link: usize,
    pub(in super::super) user: DeviceId,
    pub(in super::super) password: String,
    pub(in super::super) hash: String,
}

/// The thread that compares passwords. It ends when this value is dropped.
pub(in super::super) struct Verifier {
    jobs: SyncSender<Job>,
    /// Fingerprints of passwords that were right, so that a device that comes back need not wait behind strangers who
    /// guess passwords. The key of the fingerprints is drawn at each start.
    right: BTreeMap<DeviceId, blake3::Hash>,
    key: [u8; 32],
}

impl Verifier {
    /// Starts the thread; `tell` gets each connection, its user and the fingerprint of its password if that was right.
    pub(in super::super) fn start(
        key: [u8; 32],
        tell: impl Fn(usize, DeviceId, Option<blake3::Hash>) + Send + 'static,
    ) -> Self {
        let (jobs, waiting) = sync_channel(JOBS_MAX);
        thread::spawn(move || verify(&key, &waiting, tell));
        Self { jobs, right: BTreeMap::new(), key }
    }

    /// Whether a password is known to be right.
    pub(in super::super) fn remembers(&self, user: &DeviceId, password: &str) -> bool {
        self.right.get(user) == Some(&blake3::keyed_hash(&self.key, password.as_bytes()))
    }

    /// Remembers a password that was right.
    pub(in super::super) fn remember(&mut self, user: DeviceId, fingerprint: blake3::Hash) {
        self.right.insert(user, fingerprint);
    }

    /// Hands a job to the thread; false if too many wait.
    pub(in super::super) fn ask(&self, job: Job) -> bool {
        !matches!(self.jobs.try_send(job), Err(TrySendError::Full(_) | TrySendError::Disconnected(_)))
    }
}

fn verify(key: &[u8; 32], jobs: &Receiver<Job>, tell: impl Fn(usize, DeviceId, Option<blake3::Hash>)) {
    while let Ok(Job { link, user, password, hash }) = jobs.recv() {
        let is_right = PasswordHash::new(&hash)
            .is_ok_and(|hash| Argon2::default().verify_password(password.as_bytes(), &hash).is_ok());
        tell(link, user, is_right.then(|| blake3::keyed_hash(key, password.as_bytes())));
    }
}
