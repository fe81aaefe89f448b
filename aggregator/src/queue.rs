//! The queue of tasks for workers: a JetStream work queue of a NATS server. A task stays in the queue until a worker has
//! acknowledged it. It is delivered to another worker if one dies, that is, if nothing is heard of it for some time.
//!
//! What it knows nothing about: what a task is. It passes on a name and a folder.

mod address;

use std::time::Duration;

use async_nats::jetstream::ErrorCode;
use async_nats::jetstream::consumer::{AckPolicy, pull};
use async_nats::jetstream::context::{ConsumerInfoErrorKind, CreateStreamErrorKind};
use async_nats::jetstream::stream::{Config, LastRawMessageErrorKind, RetentionPolicy, Stream};
use async_nats::jetstream::{self, AckKind, Context, Message};
use futures_util::StreamExt;
use tokio::runtime::{Builder, Runtime};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

use address::{Address, shown};

/// Name of the stream on the server, and first part of all subjects.
const STREAM: &str = "cosurf-tiles";
/// A worker of which nothing is heard for so long is taken for dead.
const DEAD_AFTER: Duration = Duration::from_secs(10);
/// Interval at which a worker says that it is alive.
const ALIVE_EVERY: Duration = Duration::from_secs(3);
/// A worker waits so long for a task before it looks whether it shall end.
const WAIT: Duration = Duration::from_secs(1);
/// Pause before the stream is looked for again while another client is making it, and number of such pauses.
const MAKING: Duration = Duration::from_millis(50);
const MAKING_PAUSES: usize = 40;
/// A server that does not answer for so long is away.
const ANSWER_MAX: Duration = Duration::from_secs(5);

/// A connection to a queue. Several threads may use it.
#[derive(Debug)]
pub struct Queue {
    runtime: Runtime,
    context: Context,
    /// The address without user and password.
    url: String,
}

/// Why the queue cannot be used.
#[derive(Debug, thiserror::Error)]
#[error(
    "{url}: {cause}; check that a NATS server with JetStream runs there (nats-server -js), and that it knows the user \
     and the password of its address, nats://USER:PASSWORD@HOST:PORT"
)]
pub struct QueueError {
    url: String,
    cause: String,
}

/// A task that was delivered to this worker. It is delivered again, to any worker, unless it is finished.
#[derive(Debug)]
pub(crate) struct Delivered<'a> {
    queue: &'a Queue,
    message: Message,
    alive: JoinHandle<()>,
    /// Name of the task.
    pub(crate) task: String,
    /// The folder that it was queued with.
    pub(crate) folder: String,
    /// How often the task has been delivered, this time included.
    pub(crate) deliveries: u64,
}

impl Queue {
    /// Connects to a server, for example `nats://127.0.0.1:4222` or `nats://user:password@127.0.0.1:4222`. Fails if it is
    /// not there; a connection that is lost later is made again.
    pub fn open(url: &str) -> Result<Self, QueueError> {
        let queue = Self::connect(url)?;
        queue.answer(queue.stream())?;
        Ok(queue)
    }

    fn connect(url: &str) -> Result<Self, QueueError> {
        let fail = |cause: String| QueueError { url: shown(url), cause };
        let address = Address::parse(url).map_err(fail)?;
        // One thread of its own tells the server that the worker is alive while the worker computes.
        let runtime = Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.map_err(|cause| fail(cause.to_string()))?;
        let options = address.options().name("cosurf").connection_timeout(ANSWER_MAX);
        let connected = runtime.block_on(options.connect(address.server()));
        let client = connected.map_err(|cause| fail(cause.to_string()))?;
        let context = {
            let _inside = runtime.enter(); // the context starts a task of its own
            jetstream::new(client)
        };
        Ok(Self { runtime, context, url: shown(url) })
    }

    /// Queues a task for workers with devices of this class, unless it is in the queue already.
    ///
    /// A server that is killed forgets some removals of messages, or some messages, but not how far its workers were. It
    /// delivers no message up to there, although it has it. Such a message is queued again.
    pub(crate) fn send(&self, class: &str, task: &str, folder: &str) -> Result<(), QueueError> {
        let subject = format!("{}.{task}", subject(class));
        self.answer(async {
            let stream = self.stream().await?;
            let finished = finished(&stream, &consumer_name(class)).await?;
            let mut queued = match stream.get_last_raw_message_by_subject(&subject).await {
                Ok(message) => Some(message.sequence),
                Err(error) if error.kind() == LastRawMessageErrorKind::NoMessageFound => None,
                Err(error) => return Err(error.to_string()),
            };
            while queued.is_none_or(|sequence| sequence <= finished) {
                if let Some(sequence) = queued {
                    let _ = stream.delete_message(sequence).await; // a worker may have removed it
                }
                let sent = self.context.publish(subject.clone(), folder.to_owned().into()).await;
                let stored = sent.map_err(|error| error.to_string())?.await;
                queued = Some(stored.map_err(|error| error.to_string())?.sequence);
            }
            Ok(())
        })
    }

    /// The next task for workers with devices of this class. Waits a moment for one.
    pub(crate) fn take(&self, class: &str) -> Result<Option<Delivered<'_>>, QueueError> {
        let taken = self.answer(async {
            let name = consumer_name(class);
            let config = pull::Config {
                durable_name: Some(name.clone()),
                filter_subject: format!("{}.*", subject(class)),
                ack_policy: AckPolicy::Explicit,
                ack_wait: DEAD_AFTER,
                ..pull::Config::default()
            };
            let stream = self.stream().await?;
            let consumer = stream.get_or_create_consumer(&name, config).await;
            let consumer = consumer.map_err(|error| error.to_string())?;
            let batch = consumer.fetch().max_messages(1).expires(WAIT).messages().await;
            match batch.map_err(|error| error.to_string())?.next().await {
                Some(message) => message.map(Some).map_err(|error| error.to_string()),
                None => Ok(None),
            }
        })?;
        Ok(taken.map(|message| self.delivered(message)))
    }

    fn delivered(&self, message: Message) -> Delivered<'_> {
        let its = message.clone();
        let alive = self.runtime.spawn(async move {
            loop {
                sleep(ALIVE_EVERY).await;
                let _ = its.ack_with(AckKind::Progress).await; // without it, the task is delivered again
            }
        });
        let deliveries = message.info().map_or(1, |info| info.delivered.max(1) as u64);
        let task = message.subject.rsplit('.').next().unwrap_or_default().to_owned();
        let folder = String::from_utf8_lossy(&message.payload).into_owned();
        Delivered { queue: self, message, alive, task, folder, deliveries }
    }

    async fn stream(&self) -> Result<Stream, String> {
        let config = Config {
            name: STREAM.to_owned(),
            subjects: vec![format!("{STREAM}.>")],
            retention: RetentionPolicy::WorkQueue,
            ..Config::default()
        };
        let mut pauses = 0..MAKING_PAUSES;
        loop {
            match self.context.get_or_create_stream(config.clone()).await {
                Err(error) if is_being_made(&error.kind()) && pauses.next().is_some() => sleep(MAKING).await,
                made => return made.map_err(|error| error.to_string()),
            }
        }
    }

    /// Waits for the answer of the server, but not for ever.
    fn answer<T>(&self, asked: impl Future<Output = Result<T, String>>) -> Result<T, QueueError> {
        let fail = |cause| QueueError { url: self.url.clone(), cause };
        let in_time = async { timeout(ANSWER_MAX, asked).await };
        let answered = self.runtime.block_on(in_time);
        answered.map_err(|_| fail("no answer".to_owned()))?.map_err(fail)
    }
}

impl Delivered<'_> {
    /// Removes the task from the queue.
    pub(crate) fn finish(self) -> Result<(), QueueError> {
        self.queue.answer(async { self.message.double_ack().await.map_err(|error| error.to_string()) })
    }

    /// Returns the task to the queue. It is delivered again after `pause`.
    pub(crate) fn give_back(self, pause: Duration) -> Result<(), QueueError> {
        let kind = AckKind::Nak(Some(pause));
        self.queue.answer(async { self.message.ack_with(kind).await.map_err(|error| error.to_string()) })
    }
}

impl Drop for Delivered<'_> {
    fn drop(&mut self) {
        self.alive.abort();
    }
}

/// Whether another client may be making the stream at this moment: the server says that the subjects overlap. If it
/// keeps saying so, another program uses them.
fn is_being_made(failure: &CreateStreamErrorKind) -> bool {
    matches!(failure, CreateStreamErrorKind::JetStream(error) if error.error_code() == ErrorCode::STREAM_SUBJECT_OVERLAP)
}

/// The number of the message up to which all are finished; 0 before the first worker.
async fn finished(stream: &Stream, consumer: &str) -> Result<u64, String> {
    match stream.consumer_info(consumer).await {
        Ok(info) => Ok(info.ack_floor.stream_sequence),
        Err(error) if error.kind() == ConsumerInfoErrorKind::NotFound => Ok(0),
        Err(error) => Err(error.to_string()),
    }
}

/// The server's name for all workers with devices of this class.
fn consumer_name(class: &str) -> String {
    subject(class).replace('.', "-")
}

/// The subject of tasks for devices of this class. A subject has no spaces, and dots have a meaning.
fn subject(class: &str) -> String {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric();
    let class: String = class.chars().map(|letter| if is_plain(letter) { letter } else { '-' }).collect();
    format!("{STREAM}.{}", class.to_lowercase())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;
    use std::path::Path;
    use std::sync::Barrier;
    use std::thread;

    use cosurf_tests::nats::Nats;

    use super::*;

    /// The folder of the stream's messages in a server's folder.
    const MESSAGES: &str = "jetstream/$G/streams/cosurf-tiles/msgs";
    /// The server writes down what was finished within this time.
    const WRITTEN: Duration = Duration::from_secs(2);

    fn copy(from: &Path, to: &Path) {
        let _ = fs::remove_dir_all(to);
        fs::create_dir_all(to).unwrap();
        for file in fs::read_dir(from).unwrap() {
            let file = file.unwrap();
            fs::copy(file.path(), to.join(file.file_name())).unwrap();
        }
    }

    fn take(queue: &Queue) -> Delivered<'_> {
        let attempts = (0..20).filter_map(|_| queue.take("cpu").unwrap_or_default());
        attempts.into_iter().next().expect("the task is delivered within 20 seconds")
    }

    #[test]
    fn a_server_with_a_password_lets_only_its_user_in() {
        let folder = tempfile::tempdir().unwrap();
        let config = "authorization {\n  user: cosurf\n  password: \"a-long/password\"\n}\n";
        let Some(nats) = Nats::start_with(folder.path(), config) else { return };
        let server = nats.url().replace("nats://", "");
        let queue = Queue::open(&format!("nats://cosurf:a-long%2Fpassword@{server}")).unwrap();
        queue.send("cpu", "a", "folder").unwrap();
        assert_eq!(take(&queue).task, "a");
        for user in ["", "cosurf:another@"] {
            let error = Queue::open(&format!("nats://{user}{server}")).unwrap_err().to_string();
            assert!(error.contains("USER:PASSWORD") && error.starts_with(&nats.url()), "{error}");
            assert!(!error.contains("another"), "{error}");
        }
    }

    #[test]
    fn clients_may_open_a_new_queue_at_the_same_time() {
        for _ in 0..20 {
            let folder = tempfile::tempdir().unwrap();
            let Some(nats) = Nats::start(folder.path()) else { return };
            let clients: Vec<Queue> = (0..8).map(|_| Queue::connect(&nats.url()).unwrap()).collect();
            let together = Barrier::new(clients.len());
            let open = |client: &Queue| {
                together.wait();
                client.answer(client.stream()).map(drop)
            };
            thread::scope(|scope| {
                let opened: Vec<_> = clients.iter().map(|client| scope.spawn(|| open(client))).collect();
                opened.into_iter().for_each(|opened| opened.join().unwrap().unwrap());
            });
        }
    }

    #[test]
    fn a_task_is_delivered_although_the_server_forgot_that_it_was_finished_before() {
        let folder = tempfile::tempdir().unwrap();
        let (server, copied) = (folder.path().join("nats"), folder.path().join("messages"));
        let Some(mut nats) = Nats::start(&server) else { return };
        let queue = Queue::open(&nats.url()).unwrap();
        for task in ["a", "b"] {
            queue.send("cpu", task, "folder").unwrap();
        }
        copy(&server.join(MESSAGES), &copied);
        for task in ["a", "b"] {
            let delivered = take(&queue);
            assert_eq!((delivered.task.as_str(), delivered.folder.as_str()), (task, "folder"));
            delivered.finish().unwrap();
        }
        thread::sleep(WRITTEN);
        nats.kill();
        copy(&copied, &server.join(MESSAGES));
        nats.start_again();
        let again = || Queue::open(&nats.url()).and_then(|queue| queue.send("cpu", "b", "folder"));
        while again().is_err() {}
        assert_eq!(take(&queue).task, "b");
        again().unwrap(); // it is in the queue
        assert!(queue.take("cpu").unwrap().is_none(), "a task is queued once");
    }
}
