//! Reads the keys that sign journals and check their signatures from PEM.

use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{PrivatePkcs8KeyDer, SubjectPublicKeyInfoDer};

use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::journal::signature::{Key, PublicKey};

fn refuse(why: &str) -> Refusal {
    Refusal::new(Reason::Unreadable, "", why)
}

/// Returns a refusal of a key that is not Ed25519.
fn other_kind() -> Refusal {
    refuse("is a key of another kind: signatures of journals are Ed25519")
}

/// Parses a private key in PEM (`PRIVATE KEY`, PKCS#8).
///
/// # Errors
/// Refuses any other text, and a key that is not Ed25519. The message does not quote the text.
pub fn private(text: &str) -> Result<Key> {
    let key = PrivatePkcs8KeyDer::from_pem_slice(text.as_bytes())
        .map_err(|_| refuse("has no private key in PEM (-----BEGIN PRIVATE KEY-----)"))?;
    Key::of(key.secret_pkcs8_der()).ok_or_else(other_kind)
}

/// Parses a public key in PEM (`PUBLIC KEY`).
///
/// # Errors
/// Refuses any other text, and a key that is not Ed25519.
pub fn public(text: &str) -> Result<PublicKey> {
    let key = SubjectPublicKeyInfoDer::from_pem_slice(text.as_bytes())
        .map_err(|_| refuse("has no public key in PEM (-----BEGIN PUBLIC KEY-----)"))?;
    PublicKey::of(key.as_ref()).ok_or_else(other_kind)
}
