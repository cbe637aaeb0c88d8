//! A certification authority for tests.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

use rcgen::{BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, SanType};
use tonic::transport::{Certificate, ClientTlsConfig};

/// A certification authority and what it signs.
pub struct Authority {
    pub issuer: Issuer<'static, KeyPair>,
    /// Its own certificate.
    pub pem: String,
}

impl Authority {
    pub fn new() -> Self {
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().unwrap();
        let pem = params.self_signed(&key).unwrap().pem();
        Authority { issuer: Issuer::new(params, key), pem }
    }

    /// Certificate and key of a server at 127.0.0.1, or of a client of that name.
    pub fn sign(&self, client: Option<&str>) -> (String, String) {
        let mut params = CertificateParams::default();
        let (name, purpose) = match client {
            Some(name) => (SanType::DnsName(name.try_into().unwrap()), ExtendedKeyUsagePurpose::ClientAuth),
            None => (SanType::IpAddress([127, 0, 0, 1].into()), ExtendedKeyUsagePurpose::ServerAuth),
        };
        params.subject_alt_names.push(name);
        params.extended_key_usages.push(purpose);
        let key = KeyPair::generate().unwrap();
        (params.signed_by(&key, &self.issuer).unwrap().pem(), key.serialize_pem())
    }

    /// Certificate and key of a server of a fleet at 127.0.0.1, which shows others that name.
    pub fn sign_node(&self, name: &str) -> (String, String) {
        let mut params = CertificateParams::default();
        params.subject_alt_names =
            vec![SanType::IpAddress([127, 0, 0, 1].into()), SanType::DnsName(name.try_into().unwrap())];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        let key = KeyPair::generate().unwrap();
        (params.signed_by(&key, &self.issuer).unwrap().pem(), key.serialize_pem())
    }

    /// Trusts what it signs.
    pub fn trust(&self) -> ClientTlsConfig {
        ClientTlsConfig::new().ca_certificate(Certificate::from_pem(&self.pem))
    }
}
