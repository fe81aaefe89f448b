//! What a failed TLS connection means for the user.

use std::io::{self, ErrorKind};

use rumqttc::TlsError;
use rumqttc::v5::mqttbytes::Error as MqttError;
use rumqttc::v5::{ConnectionError, StateError};
use rustls::{AlertDescription, Error as RustlsError};

/// A broker without TLS closes the connection, or answers something else.
const NO_TLS: &str = "the broker does not speak TLS at this port: use mqtt://, or the broker's TLS port";

/// Why TLS failed and what helps; `None` if the error is another one.
pub(super) fn tls_fault(error: &ConnectionError) -> Option<String> {
    let cause = match error {
        ConnectionError::Tls(TlsError::Io(cause))
        | ConnectionError::Io(cause)
        | ConnectionError::MqttState(
            StateError::Io(cause) | StateError::Deserialization(MqttError::Io(cause)),
        ) => cause,
        _ => return None,
    };
    let is_handshake = matches!(error, ConnectionError::Tls(_));
    match (tls_error(cause), cause.kind()) {
        (Some(error), _) => meaning(error),
        (None, ErrorKind::ConnectionReset | ErrorKind::UnexpectedEof) if is_handshake => {
            Some(NO_TLS.to_owned())
        }
        _ => None,
    }
}

/// The TLS error inside an I/O error, if there is one.
fn tls_error(cause: &io::Error) -> Option<&RustlsError> {
    cause.get_ref()?.downcast_ref()
}

fn meaning(error: &RustlsError) -> Option<String> {
    use AlertDescription as Alert;
    let told = match error {
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
        _ => return None,
    };
    Some(told.to_owned())
}
