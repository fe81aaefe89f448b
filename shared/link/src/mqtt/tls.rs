//! TLS (rustls with ring): the broker proves its identity with a certificate, and the device too if it has one.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, pem};
use rustls::{ClientConfig, RootCertStore};
use serde::{Deserialize, Serialize};

/// The files of a TLS client, all in PEM.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsFiles {
    /// Certificates of the trusted authorities.
    pub ca: PathBuf,
    /// The client's certificate, followed by the intermediate certificates up to the trusted authority. Absent if the
    /// broker asks for a password instead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cert: Option<PathBuf>,
    /// The private key of `cert`; absent without it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key: Option<PathBuf>,
}

use super::address::BrokerAddress;

/// Why TLS cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TlsError {
    /// A file is missing or has the wrong content.
    #[error("{path}: {cause}; it must hold {wanted} in PEM")]
    File {
        /// The file's path.
        path: String,
        /// The expected content.
        wanted: &'static str,
        /// The underlying error.
        cause: pem::Error,
    },
    /// Certificate and key do not match, or a certificate is invalid.
    #[error("certificate {cert}: {cause}")]
    Pair {
        /// The certificate's path.
        cert: String,
        /// The underlying error.
        cause: rustls::Error,
    },
    /// The address requires TLS and no certificates are given, or certificates are given for an address
    /// without TLS.
    #[error(
        "a broker at mqtts:// or wss:// needs tls = {{ ca, cert, key }}, and one at mqtt:// or ws:// must not have it"
    )]
    OneWithoutOther,
    /// Only one of certificate and key is given.
    #[error("write both cert and key, or neither of them if the broker asks for a password")]
    CertOrKey,
}

/// A client's certificate and key, and the root certificates that it trusts.
#[derive(Clone, Debug)]
pub struct Tls(pub(super) Arc<ClientConfig>);

impl Tls {
    /// Reads the certificates and the key.
    pub fn read(files: &TlsFiles) -> Result<Self, TlsError> {
        let mut roots = RootCertStore::empty();
        for root in certificates(&files.ca)? {
            roots.add(root).map_err(|cause| pair_error(&files.ca, cause))?;
        }
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let builder = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|cause| pair_error(&files.ca, cause))?
            .with_root_certificates(roots);
        let config = match (&files.cert, &files.key) {
            (Some(cert), Some(key)) => {
                let secret = PrivateKeyDer::from_pem_file(key)
                    .map_err(|cause| file_error(key, "a private key", cause))?;
                builder
                    .with_client_auth_cert(certificates(cert)?, secret)
                    .map_err(|cause| pair_error(cert, cause))?
            }
            (None, None) => builder.with_no_client_auth(),
            _ => return Err(TlsError::CertOrKey),
        };
        Ok(Self(Arc::new(config)))
    }

    /// Reads the certificates and the key if the address requires TLS. With an address without TLS, `files`
    /// must be `None`.
    pub fn for_broker(broker: &BrokerAddress, files: Option<&TlsFiles>) -> Result<Option<Self>, TlsError> {
        match (broker.is_tls, files) {
            (true, Some(files)) => Self::read(files).map(Some),
            (false, None) => Ok(None),
            _ => Err(TlsError::OneWithoutOther),
        }
    }
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    match read {
        Ok(found) if found.is_empty() => Err(file_error(path, "certificates", pem::Error::NoItemsFound)),
        Ok(found) => Ok(found),
        Err(cause) => Err(file_error(path, "certificates", cause)),
    }
}

fn file_error(path: &Path, wanted: &'static str, cause: pem::Error) -> TlsError {
    TlsError::File { path: path.display().to_string(), wanted, cause }
}

fn pair_error(cert: &Path, cause: rustls::Error) -> TlsError {
    TlsError::Pair { cert: cert.display().to_string(), cause }
}
