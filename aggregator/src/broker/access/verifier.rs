//! Compares passwords with their hashes on a thread of its own, because each takes tens of milliseconds.
//!
//! Who guesses passwords must not keep others waiting: the addresses have their turns one after the other, those from
//! which a right password came before the others. If too many passwords wait, the address with the most loses its newest.

mod line;

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;

use argon2::Argon2;
use argon2::password_hash::PasswordVerifier;
use argon2::password_hash::phc::PasswordHash;
use cosurf_wire::DeviceId;

use line::Line;

/// Limit on the addresses that are remembered because a right password came from them.
const ADDRESSES_MAX: usize = 4096;

/// A password to compare with a hash.
pub(in super::super) struct Job {
    /// The connection that waits for the answer.
    pub(in super::super) link: usize,
    /// The address of the client.
    pub(in super::super) address: IpAddr,
    pub(in super::super) user: DeviceId,
    pub(in super::super) password: String,
    pub(in super::super) hash: String,
}

/// What waits for the thread.
#[derive(Default)]
struct Waiting {
    line: Line<Job>,
    is_over: bool,
}

/// The passwords that wait, and what wakes the thread.
type Shared = Arc<(Mutex<Waiting>, Condvar)>;

/// The thread that compares passwords. It ends when this value is dropped.
pub(in super::super) struct Verifier {
    shared: Shared,
    /// Fingerprints of passwords that were right, so that a device that comes back need not wait. The key of the
    /// fingerprints is drawn at each start.
    right: BTreeMap<DeviceId, blake3::Hash>,
    /// Addresses from which right passwords came.
    trusted: BTreeSet<IpAddr>,
    key: [u8; 32],
}

impl Verifier {
    /// Starts the thread; `tell` gets each connection, its user and the fingerprint of its password if that was right.
    pub(in super::super) fn start(
        key: [u8; 32],
        tell: impl Fn(usize, DeviceId, Option<blake3::Hash>) + Send + 'static,
    ) -> Self {
        let shared = Shared::default();
        let waiting = Arc::clone(&shared);
        thread::spawn(move || verify(&key, &waiting, tell));
        Self { shared, right: BTreeMap::new(), trusted: BTreeSet::new(), key }
    }

    /// Whether a password is known to be right.
    pub(in super::super) fn remembers(&self, user: &DeviceId, password: &str) -> bool {
        self.right.get(user) == Some(&blake3::keyed_hash(&self.key, password.as_bytes()))
    }

    /// Remembers a password that was right, and the address that it came from.
    pub(in super::super) fn remember(
        &mut self,
        user: DeviceId,
        fingerprint: blake3::Hash,
        address: Option<IpAddr>,
    ) {
        self.right.insert(user, fingerprint);
        if self.trusted.len() < ADDRESSES_MAX {
            self.trusted.extend(address);
        }
    }

    /// Hands a job to the thread. Returns the connection whose password is not compared because too many wait.
    pub(in super::super) fn ask(&self, job: Job) -> Option<usize> {
        let (address, is_first) = (job.address, self.trusted.contains(&job.address));
        let lost = lock(&self.shared).line.join(address, is_first, job);
        self.shared.1.notify_one();
        lost.map(|job| job.link)
    }
}

impl Drop for Verifier {
    fn drop(&mut self) {
        lock(&self.shared).is_over = true;
        self.shared.1.notify_one();
    }
}

/// A panic of another thread leaves the line as it was.
fn lock(shared: &Shared) -> MutexGuard<'_, Waiting> {
    shared.0.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits for a job; `None` if there will be no more.
fn next(shared: &Shared) -> Option<Job> {
    let mut waiting = lock(shared);
    loop {
        if waiting.is_over {
            return None;
        }
        if let Some(job) = waiting.line.next() {
            return Some(job);
        }
        waiting = shared.1.wait(waiting).unwrap_or_else(PoisonError::into_inner);
    }
}

fn verify(key: &[u8; 32], shared: &Shared, tell: impl Fn(usize, DeviceId, Option<blake3::Hash>)) {
    while let Some(Job { link, user, password, hash, .. }) = next(shared) {
        let is_right = PasswordHash::new(&hash)
            .is_ok_and(|hash| Argon2::default().verify_password(password.as_bytes(), &hash).is_ok());
        tell(link, user, is_right.then(|| blake3::keyed_hash(key, password.as_bytes())));
    }
}
