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

/// Parses the first private key in a text in PEM (`PRIVATE KEY`, PKCS#8), for signing journals.
///
/// # Errors
/// Refuses a text without such a key, and a key that is not Ed25519. The message does not quote the text.
pub fn private(text: &str) -> Result<Key> {
    let key = PrivatePkcs8KeyDer::from_pem_slice(text.as_bytes())
        .map_err(|_| refuse("has no private key in PEM (-----BEGIN PRIVATE KEY-----)"))?;
    Key::of(key.secret_pkcs8_der()).ok_or_else(other_kind)
}

/// Parses the first public key in a text in PEM (`PUBLIC KEY`), for checking the signatures of journals.
///
/// # Errors
/// Refuses a text without such a key, and a key that is not Ed25519.
pub fn public(text: &str) -> Result<PublicKey> {
    let key = SubjectPublicKeyInfoDer::from_pem_slice(text.as_bytes())
        .map_err(|_| refuse("has no public key in PEM (-----BEGIN PUBLIC KEY-----)"))?;
    PublicKey::of(key.as_ref()).ok_or_else(other_kind)
}
