//! The bytes to and from a broker: by TCP, with or without TLS, with or without WebSocket frames around them.

use std::future::{Future, ready};
use std::io;

use bytes::Bytes;
use futures_util::{SinkExt, StreamExt, future};
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::http::HeaderValue;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{self, Message};
use tokio_tungstenite::{WebSocketStream, client_async_with_config};
use tokio_util::io::{CopyToBytes, SinkWriter, StreamReader};

use super::address::BrokerAddress;
use super::fault::Fault;
use super::tls::Tls;

/// Largest WebSocket message that the client accepts, in bytes. Brokers put one or a few packets into one.
const FRAME_BYTES_MAX: usize = 256 << 10;
/// The name of MQTT among the protocols over WebSocket (MQTT 5.0, section 6).
const PROTOCOL: &str = "mqtt";

/// Bytes in both directions.
pub(super) trait Stream: AsyncRead + AsyncWrite + Send + Unpin {}

impl<S: AsyncRead + AsyncWrite + Send + Unpin> Stream for S {}

/// Connects to a broker, up to where MQTT begins.
pub(super) async fn open(broker: &BrokerAddress, tls: Option<&Tls>) -> Result<Box<dyn Stream>, Fault> {
    let tcp = TcpStream::connect((broker.host.as_str(), broker.port)).await.map_err(Fault::Lost)?;
    // Only costs time if it fails.
    let _ = tcp.set_nodelay(true);
    let stream: Box<dyn Stream> = match tls {
        None => Box::new(tcp),
        Some(tls) => Box::new(secure(broker, tls, tcp).await.map_err(Fault::Tls)?),
    };
    match &broker.web_path {
        None => Ok(stream),
        Some(path) => framed(broker, path, stream).await.map_err(|error| Fault::WebSocket(Box::new(error))),
    }
}

async fn secure(broker: &BrokerAddress, tls: &Tls, tcp: TcpStream) -> io::Result<impl Stream + use<>> {
    let name = ServerName::try_from(broker.host.clone()).map_err(io::Error::other)?;
    TlsConnector::from(tls.0.clone()).connect(name, tcp).await
}

/// Greets the WebSocket server. In what follows, packets may begin and end anywhere in the frames.
async fn framed(
    broker: &BrokerAddress,
    path: &str,
    stream: Box<dyn Stream>,
) -> Result<Box<dyn Stream>, tungstenite::Error> {
    let scheme = if broker.is_tls { "wss" } else { "ws" };
    let mut request = format!("{scheme}://{}{path}", broker.authority()).into_client_request()?;
    request.headers_mut().insert("sec-websocket-protocol", HeaderValue::from_static(PROTOCOL));
    let config = WebSocketConfig::default()
        .max_message_size(Some(FRAME_BYTES_MAX))
        .max_frame_size(Some(FRAME_BYTES_MAX))
        .read_buffer_size(16 << 10);
    let (socket, _) = client_async_with_config(request, stream, Some(config)).await?;
    Ok(Box::new(bytes_of(socket)))
}

/// A WebSocket as bytes in both directions.
fn bytes_of(socket: WebSocketStream<Box<dyn Stream>>) -> impl Stream {
    let (sink, stream) = socket.split();
    let read =
        stream.take_while(|message| ready(!matches!(message, Ok(Message::Close(_))))).filter_map(payload);
    let write = sink.with(|bytes: Bytes| future::ok(Message::Binary(bytes))).sink_map_err(io_error);
    tokio::io::join(StreamReader::new(read), SinkWriter::new(CopyToBytes::new(write)))
}

/// The bytes of a message; `None` if it has none for MQTT.
fn payload(
    message: Result<Message, tungstenite::Error>,
) -> impl Future<Output = Option<io::Result<Bytes>>> + Unpin {
    ready(match message {
        Ok(Message::Binary(bytes)) => Some(Ok(bytes)),
        // MQTT is carried in binary frames alone.
        Ok(Message::Text(_)) => Some(Err(io::ErrorKind::InvalidData.into())),
        Ok(_) => None,
        Err(error) => Some(Err(io_error(error))),
    })
}

fn io_error(error: tungstenite::Error) -> io::Error {
    match error {
        tungstenite::Error::Io(error) => error,
        error => io::Error::other(error),
    }
}
