//! TLS of the broker, and the names in its clients' certificates.

use std::path::Path;
use std::sync::Arc;

use rustls::pki_types::pem::{self, PemObject};
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer};
use rustls::server::danger::ClientCertVerifier;
use rustls::server::{VerifierBuilderError, WebPkiClientVerifier};
use rustls::{RootCertStore, ServerConfig, ServerConnection};

use super::access::ServerTls;

/// Why the broker cannot use TLS.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BrokerTlsError {
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
    /// A certificate, its key or the list of revoked certificates is invalid.
    #[error("{path}: {cause}")]
    Invalid {
        /// The path of the file.
        path: String,
        /// The reason.
        cause: String,
    },
}

/// Reads the files. If `ca` is given, clients must have a certificate, unless `or_password`.
pub(super) fn read(files: &ServerTls, or_password: bool) -> Result<Arc<ServerConfig>, BrokerTlsError> {
    let key = PrivateKeyDer::from_pem_file(&files.key).map_err(file_error(&files.key, "a private key"))?;
    let chain = certificates(&files.cert)?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
        .with_safe_default_protocol_versions()
        .map_err(|cause| invalid(&files.cert, cause))?;
    let builder = match &files.ca {
        None => builder.with_no_client_auth(),
        Some(ca) => builder.with_client_cert_verifier(verifier(files, ca, or_password, provider)?),
    };
    let config = builder.with_single_cert(chain, key).map_err(|cause| invalid(&files.cert, cause))?;
    Ok(Arc::new(config))
}

fn verifier(
    files: &ServerTls,
    ca: &Path,
    or_password: bool,
    provider: Arc<rustls::crypto::CryptoProvider>,
) -> Result<Arc<dyn ClientCertVerifier>, BrokerTlsError> {
    let mut roots = RootCertStore::empty();
    for root in certificates(ca)? {
        roots.add(root).map_err(|cause| invalid(ca, cause))?;
    }
    let mut builder = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
    if let Some(revoked) = &files.revoked {
        let lists = CertificateRevocationListDer::pem_file_iter(revoked)
            .and_then(Iterator::collect::<Result<Vec<_>, _>>)
            .map_err(file_error(revoked, "a list of revoked certificates"))?;
        // As in Mosquitto, an expired list refuses everybody.
        builder = builder.with_crls(lists).enforce_revocation_expiration();
    }
    if or_password {
        builder = builder.allow_unauthenticated();
    }
    builder.build().map_err(|cause| match (&cause, &files.revoked) {
        (VerifierBuilderError::InvalidCrl(_), Some(revoked)) => {
            invalid(revoked, format!("{cause}; make it with a `crlnumber`, as OPERATING.md shows"))
        }
        _ => invalid(ca, cause),
    })
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, BrokerTlsError> {
    let wanted = file_error(path, "certificates");
    let found = CertificateDer::pem_file_iter(path).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let found =
        found.and_then(|found| if found.is_empty() { Err(pem::Error::NoItemsFound) } else { Ok(found) });
    found.map_err(wanted)
}

fn file_error(path: &Path, wanted: &'static str) -> impl FnOnce(pem::Error) -> BrokerTlsError {
    move |cause| BrokerTlsError::File { path: path.display().to_string(), wanted, cause }
}

fn invalid(path: &Path, cause: impl ToString) -> BrokerTlsError {
    BrokerTlsError::Invalid { path: path.display().to_string(), cause: cause.to_string() }
}

/// The common name in a client's certificate, which rustls has verified.
pub(super) fn client_name(connection: &ServerConnection) -> Option<String> {
    let certificate = connection.peer_certificates()?.first()?;
    let (_, parsed) = x509_parser::parse_x509_certificate(certificate).ok()?;
    let mut names = parsed.subject().iter_common_name();
    let name = names.next()?.as_str().ok()?.to_owned();
    // With two names it would not be clear which one the authority has checked.
    names.next().is_none().then_some(name)
}
