//! X.509: the authority, its certificates and its list of revoked ones. All keys are ECDSA over P-256, which every TLS
//! library knows.

use std::time::Duration;

use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, DistinguishedName, DnType, Error,
    ExtendedKeyUsagePurpose, IsCa, Issuer, KeyIdMethod, KeyPair, KeyUsagePurpose, RevokedCertParams,
    SerialNumber, date_time_ymd,
};

use super::issued::Issued;

/// Name of the authority in its certificates.
const AUTHORITY_NAME: &str = "cosurf authority";
/// Days until the authority and its list of revoked certificates expire.
const AUTHORITY_DAYS: u32 = 3650;
/// Bytes of a serial number.
const SERIAL_BYTES: usize = 16;

/// The certificate authority of a site.
pub(super) struct Authority {
    issuer: Issuer<'static, KeyPair>,
}

/// What a certificate may be used for.
#[derive(Clone, Copy, Debug)]
pub(super) enum Role<'a> {
    /// A broker at one of these names and addresses.
    Server(&'a [String]),
    /// A participant.
    Client,
}

/// A new certificate with its key.
pub(super) struct Signed {
    pub(super) certificate_pem: String,
    pub(super) key_pem: String,
    /// Hexadecimal.
    pub(super) serial: String,
}

impl Authority {
    /// An authority with a new key.
    pub(super) fn new() -> Result<Self, Error> {
        Ok(Self::with(KeyPair::generate()?))
    }

    /// The authority with this secret key, in PEM.
    pub(super) fn from_key(pem: &str) -> Result<Self, Error> {
        Ok(Self::with(KeyPair::from_pem(pem)?))
    }

    fn with(key: KeyPair) -> Self {
        Self { issuer: Issuer::new(authority_params(), key) }
    }

    /// The secret key, in PEM.
    pub(super) fn key_pem(&self) -> String {
        self.issuer.key().serialize_pem()
    }

    /// The authority's own certificate, in PEM.
    pub(super) fn certificate(&self, now_s: u64) -> Result<String, Error> {
        let params = valid_for(authority_params(), now_s, AUTHORITY_DAYS);
        Ok(params.self_signed(self.issuer.key())?.pem())
    }

    /// Makes a certificate. `random` becomes its serial number.
    pub(super) fn sign(
        &self,
        name: &str,
        role: Role,
        random: &[u8; 32],
        now_s: u64,
        days: u32,
    ) -> Result<Signed, Error> {
        let (names, usage) = match role {
            Role::Server(names) => (names.to_vec(), ExtendedKeyUsagePurpose::ServerAuth),
            Role::Client => (Vec::new(), ExtendedKeyUsagePurpose::ClientAuth),
        };
        // Serial numbers are positive, so their first bit is not set.
        let mut serial = random[..SERIAL_BYTES].to_vec();
        serial[0] = serial[0] & 0x7f | 0x40;
        let mut params = valid_for(CertificateParams::new(names)?, now_s, days);
        params.distinguished_name = named(name);
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![usage];
        params.use_authority_key_identifier_extension = true;
        params.serial_number = Some(SerialNumber::from_slice(&serial));
        let key = KeyPair::generate()?;
        Ok(Signed {
            certificate_pem: params.signed_by(&key, &self.issuer)?.pem(),
            key_pem: key.serialize_pem(),
            serial: serial.iter().map(|byte| format!("{byte:02x}")).collect(),
        })
    }

    /// The list of revoked certificates, in PEM.
    pub(super) fn revoked(&self, issued: &Issued, now_s: u64) -> Result<String, Error> {
        let revoked = issued.all().filter_map(|record| {
            Some(RevokedCertParams {
                serial_number: SerialNumber::from_slice(&bytes(&record.serial)?),
                revocation_time: at(record.revoked_s?),
                reason_code: None,
                invalidity_date: None,
            })
        });
        let list = CertificateRevocationListParams {
            this_update: at(now_s),
            next_update: at(now_s + seconds(AUTHORITY_DAYS)),
            crl_number: SerialNumber::from(now_s),
            issuing_distribution_point: None,
            revoked_certs: revoked.collect(),
            key_identifier_method: KeyIdMethod::Sha256,
        };
        list.signed_by(&self.issuer)?.pem()
    }
}

fn authority_params() -> CertificateParams {
    let mut params = CertificateParams::default();
    params.distinguished_name = named(AUTHORITY_NAME);
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    params
}

fn named(name: &str) -> DistinguishedName {
    let mut distinguished = DistinguishedName::new();
    distinguished.push(DnType::CommonName, name);
    distinguished
}

/// A computer in the field may have no clock that runs while it is off, so certificates are valid from the past on.
fn valid_for(mut params: CertificateParams, now_s: u64, days: u32) -> CertificateParams {
    params.not_before = date_time_ymd(2000, 1, 1);
    params.not_after = at(now_s + seconds(days));
    params
}

fn seconds(days: u32) -> u64 {
    24 * 60 * 60 * u64::from(days)
}

fn at(seconds: u64) -> time::OffsetDateTime {
    date_time_ymd(1970, 1, 1) + Duration::from_secs(seconds)
}

/// The bytes of hexadecimal digits; `None` if they are something else.
fn bytes(digits: &str) -> Option<Vec<u8>> {
    let pairs = digits.as_bytes().chunks(2);
    pairs.map(|pair| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok()).collect()
}
