//! Nodes over a real broker, each on a thread, on the wall clock.
#![allow(clippy::unwrap_used, dead_code, missing_docs, unreachable_pub)]

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cosurf_link::{
    BrokerAddress, Identity, InboxLimits, MqttConfig, MqttTransport, Node, NodeEvent, Offer, Tls,
    UploadProgress, upload_blocking,
};
use cosurf_wire::ModelId;

/// An aggregator that keeps bodies in memory, and says what it hears.
pub struct Ground {
    pub bodies: Arc<Mutex<Vec<Vec<u8>>>>,
    pub retries: Arc<Mutex<Vec<String>>>,
    /// Models offered.
    pub heard: Arc<Mutex<Vec<ModelId>>>,
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Ground {
    pub fn start(broker: BrokerAddress, tls: Option<Tls>, identity: Identity) -> Self {
        let (bodies, retries) = (Arc::new(Mutex::new(Vec::new())), Arc::new(Mutex::new(Vec::new())));
        let heard = Arc::new(Mutex::new(Vec::new()));
        let is_over = Arc::new(AtomicBool::new(false));
        let (kept, told, over) = (Arc::clone(&bodies), Arc::clone(&retries), Arc::clone(&is_over));
        let offered = Arc::clone(&heard);
        let thread = std::thread::spawn(move || {
            let mut transport = MqttTransport::start(MqttConfig { broker, identity, tls });
            let mut node = Node::new(identity, InboxLimits::default(), &[]);
            let start = Instant::now();
            while !over.load(Ordering::Relaxed) {
                match node.step(&mut transport, || start.elapsed(), Duration::from_millis(50)) {
                    Some(NodeEvent::Store { header, body }) => {
                        kept.lock().unwrap().push(body.to_vec());
                        node.stored(header.into());
                    }
                    Some(NodeEvent::Disconnected { reason, .. }) => told.lock().unwrap().push(reason),
                    Some(NodeEvent::Receiving(header)) => offered.lock().unwrap().push(header.model),
                    _ => {}
                }
            }
        });
        Self { bodies, retries, heard, is_over, thread: Some(thread) }
    }
}

impl Drop for Ground {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

/// Uploads, telling how far it is.
pub fn upload(
    broker: BrokerAddress,
    tls: Option<Tls>,
    identity: Identity,
    offer: Offer,
    mut on_progress: impl FnMut(UploadProgress),
    mut on_retry: impl FnMut(u32, String),
) -> UploadProgress {
    let mut transport = MqttTransport::start(MqttConfig { broker, identity, tls });
    let mut node = Node::new(identity, InboxLimits::default(), &[]);
    let start = Instant::now();
    let done = upload_blocking(
        &mut node,
        &mut transport,
        offer,
        || start.elapsed(),
        |_, event| match event {
            NodeEvent::Progress(_, progress) => on_progress(progress),
            NodeEvent::Disconnected { attempt, reason } => on_retry(attempt, reason),
            _ => {}
        },
    );
    done.unwrap()
}
