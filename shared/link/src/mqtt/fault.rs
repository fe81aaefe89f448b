//! Why a connection to a broker failed, and what helps.

use std::io::{self, ErrorKind};

use rumqttc::v5::mqttbytes::v5::{ConnectReturnCode, DisconnectReasonCode, PubAckReason};
use rustls::{AlertDescription, CertificateError, Error as RustlsError};
use tokio_tungstenite::tungstenite;

/// A broker without TLS closes the connection, or answers something else.
const NO_TLS: &str = "the broker does not speak TLS at this port: use mqtt://, or the broker's TLS port";

/// Why a connection ended or could not be made.
#[derive(Debug, thiserror::Error)]
pub(super) enum Fault {
    /// The connection could not be made, or broke.
    #[error("{}", lost(.0))]
    Lost(#[source] io::Error),
    /// TLS could not be agreed on.
    #[error("{}", no_tls(.0))]
    Tls(#[source] io::Error),
    /// The greeting of WebSocket failed.
    #[error("{}", no_websocket(.0))]
    WebSocket(#[source] Box<tungstenite::Error>),
    /// The broker does not answer.
    #[error("no answer: check the address, and that a broker listens there")]
    NoAnswer,
    /// The other side closed a connection without TLS before it had answered.
    #[error(
        "the broker closed the connection without an answer: if it speaks TLS at this port, use mqtts://"
    )]
    HungUp,
    /// The first answer is not that of an MQTT broker.
    #[error("what answers is no MQTT broker: use the port of one; if it speaks TLS there, use mqtts://")]
    NoBroker,
    /// The broker refuses the client.
    #[error("{}", refused(*.0))]
    Refused(ConnectReturnCode),
    /// The broker refuses subscriptions.
    #[error(
        "subscriptions refused: give this participant access to its topics; its name must be that of its certificate or \
         user"
    )]
    Subscriptions,
    /// The broker sent something that is not MQTT 5, or more than the client accepts.
    #[error("the broker sent a packet that is not allowed: {0:?}")]
    Packet(DisconnectReasonCode),
    /// The broker said farewell.
    #[error("{}", closed(*.0))]
    Closed(DisconnectReasonCode),
    /// Connection after connection is lost at once.
    #[error(
        "connection lost {times} times in a row just after it was made: the line breaks, or another program uses the \
         same name; give each its own"
    )]
    LostAtOnce {
        /// How often.
        times: u32,
    },
    /// Messages are not acknowledged.
    #[error("no acknowledgement; connecting again")]
    NoAcknowledgement,
    /// Nothing arrives any more.
    #[error("no reply to a ping")]
    NoReply,
}

impl Fault {
    /// What the fault means after so many connections that were lost just after they were made. A broker that ends the older
    /// one of two connections of one name may not say so.
    pub(super) fn after_breaks(self, times: u32) -> Self {
        match &self {
            Self::Lost(error) if is_closed(error) => Self::LostAtOnce { times },
            _ => self,
        }
    }

    /// What the fault means before the broker has answered.
    pub(super) fn before_answer(self, is_tls: bool) -> Self {
        match &self {
            Self::Lost(error) if !is_tls && is_closed(error) => Self::HungUp,
            Self::Packet(_) => Self::NoBroker,
            _ => self,
        }
    }
}

fn is_closed(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::UnexpectedEof | ErrorKind::ConnectionReset | ErrorKind::BrokenPipe)
}

/// Why the broker does not take a message under `topic`; `None` if it does.
pub(super) fn denial(reason: PubAckReason, topic: &str) -> Option<String> {
    match reason {
        PubAckReason::Success | PubAckReason::NoMatchingSubscribers => None,
        PubAckReason::NotAuthorized => Some(format!(
            "messages under {topic} are refused: give this participant access to its topics; its name must be that of \
                 its certificate or user"
        )),
        PubAckReason::QuotaExceeded => Some(format!(
            "a message under {topic} is refused because the broker has no room: raise its memory, or find the client \
             that publishes so much"
        )),
        other => Some(format!("a message under {topic} is refused: {other:?}")),
    }
}

/// The kind of the messages under a topic: its level after site and device.
pub(super) fn kind_of(topic: &str) -> String {
    topic.split('/').nth(4).unwrap_or_default().to_owned()
}

fn lost(error: &io::Error) -> String {
    match (tls_error(error).and_then(meaning), error.kind()) {
        (Some(told), _) => told.to_owned(),
        (None, ErrorKind::ConnectionRefused) => {
            "connection refused: check the address, and that the broker runs".to_owned()
        }
        (None, _) if is_closed(error) => "connection lost".to_owned(),
        _ => format!("{error}: check the address, and the network"),
    }
}

fn no_tls(error: &io::Error) -> String {
    match (tls_error(error), error.kind()) {
        (Some(cause), _) => meaning(cause).map_or_else(|| format!("TLS: {error}"), str::to_owned),
        (None, ErrorKind::ConnectionReset | ErrorKind::UnexpectedEof) => NO_TLS.to_owned(),
        _ => format!("TLS: {error}"),
    }
}

fn no_websocket(error: &tungstenite::Error) -> String {
    match error {
        tungstenite::Error::Io(error) if tls_error(error).is_some() => lost(error),
        tungstenite::Error::Http(response) => format!(
            "the broker answers {} instead of WebSocket: name the path of its WebSocket listener",
            response.status()
        ),
        error => {
            format!("the broker does not speak WebSocket at this port: use mqtt:// or mqtts:// ({error})")
        }
    }
}

fn refused(code: ConnectReturnCode) -> String {
    match code {
        ConnectReturnCode::NotAuthorized | ConnectReturnCode::BadUserNamePassword => {
            "the broker does not accept this name and password: check them".to_owned()
        }
        code => format!("connection refused: {code:?}"),
    }
}

fn closed(code: DisconnectReasonCode) -> String {
    match code {
        DisconnectReasonCode::SessionTakenOver => {
            "another program connected under the same name: give every device its own name".to_owned()
        }
        code => format!("connection closed by the broker: {code:?}"),
    }
}

/// The TLS error inside an I/O error, if there is one.
fn tls_error(cause: &io::Error) -> Option<&RustlsError> {
    cause.get_ref()?.downcast_ref()
}

fn meaning(error: &RustlsError) -> Option<&'static str> {
    use AlertDescription as Alert;
    Some(match error {
        RustlsError::AlertReceived(Alert::CertificateRevoked) => {
            "the broker says that this certificate is revoked: get a new one"
        }
        RustlsError::AlertReceived(Alert::CertificateExpired) => {
            "the broker says that this certificate has expired: get a new one, and check both clocks"
        }
        RustlsError::AlertReceived(
            Alert::UnknownCA | Alert::BadCertificate | Alert::CertificateUnknown | Alert::DecryptError,
        ) => "the broker does not accept this certificate: it must come from the broker's own authority",
        RustlsError::AlertReceived(Alert::CertificateRequired | Alert::NoCertificate) => {
            "the broker asks for a certificate: name it with tls = { ca, cert, key }"
        }
        RustlsError::InvalidMessage(_) => NO_TLS,
        RustlsError::InvalidCertificate(CertificateError::UnknownIssuer | CertificateError::BadSignature) => {
            "TLS: the broker's certificate does not come from this authority: name the broker's own as `ca`"
        }
        RustlsError::InvalidCertificate(
            CertificateError::Expired | CertificateError::ExpiredContext { .. },
        ) => "TLS: the broker's certificate has expired: give it a new one, and check both clocks",
        _ => return None,
    })
}
