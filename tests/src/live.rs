//! Nodes that are connected to a real broker and run in real time.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cosurf_link::{
    BrokerAddress, Identity, InboxLimits, MqttConfig, MqttTransport, Node, NodeEvent, Offer, Tls,
    UploadProgress, last_will, upload_blocking,
};
use cosurf_wire::ModelId;

/// A receiver of models on a thread of its own. It keeps their bodies in memory, and stops when it is dropped.
pub struct Ground {
    /// Bodies that have arrived completely.
    pub bodies: Arc<Mutex<Vec<Vec<u8>>>>,
    /// Numbers of the models whose upload has started.
    pub announced: Arc<Mutex<Vec<ModelId>>>,
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Ground {
    /// Connects to a broker and starts to receive.
    pub fn start(broker: BrokerAddress, tls: Option<Tls>, identity: Identity) -> Self {
        let bodies: Arc<Mutex<Vec<Vec<u8>>>> = Arc::default();
        let announced: Arc<Mutex<Vec<ModelId>>> = Arc::default();
        let is_over = Arc::new(AtomicBool::new(false));
        let (kept, heard, over) = (Arc::clone(&bodies), Arc::clone(&announced), Arc::clone(&is_over));
        let thread = std::thread::spawn(move || {
            let mut transport = connect(broker, tls, identity);
            let mut node = Node::new(identity, InboxLimits::default(), &[]);
            let start = Instant::now();
            while !over.load(Ordering::Relaxed) {
                match node.step(&mut transport, || start.elapsed(), Duration::from_millis(50)) {
                    Some(NodeEvent::Store { header, body }) => {
                        kept.lock().unwrap().push(body.to_vec());
                        node.stored(header.into());
                    }
                    Some(NodeEvent::Receiving(header)) => heard.lock().unwrap().push(header.model),
                    _ => {}
                }
            }
        });
        Self { bodies, announced, is_over, thread: Some(thread) }
    }
}

impl Drop for Ground {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

/// Starts to connect to a broker.
fn connect(broker: BrokerAddress, tls: Option<Tls>, identity: Identity) -> MqttTransport {
    let will = Some(last_will(&identity, None));
    MqttTransport::start(MqttConfig { broker, identity, will, tls, login: None })
}

/// Uploads a model, waits until a receiver acknowledges it, and returns the final progress. Panics if the upload
/// fails. `on_retry` gets the reason of each lost connection.
pub fn upload(
    broker: BrokerAddress,
    tls: Option<Tls>,
    identity: Identity,
    offer: Offer,
    mut on_progress: impl FnMut(UploadProgress),
    mut on_retry: impl FnMut(String),
) -> UploadProgress {
    let mut transport = connect(broker, tls, identity);
    let mut node = Node::new(identity, InboxLimits::default(), &[]);
    let start = Instant::now();
    let done = upload_blocking(
        &mut node,
        &mut transport,
        offer,
        || start.elapsed(),
        |_, event| match event {
            NodeEvent::Progress(_, progress) => on_progress(progress),
            NodeEvent::Disconnected { reason, .. } => on_retry(reason),
            _ => {}
        },
    );
    done.unwrap()
}
