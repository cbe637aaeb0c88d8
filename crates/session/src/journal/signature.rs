//! Signatures in a journal, which prove that it has not been changed: Ed25519, by the key of the server that wrote
//! it.
//!
//! A signature covers all messages before it in the file, with the times of their batches. So any addition,
//! omission or change before it is detected; if the file was cut off after a signature, its end is missing.

use std::sync::Arc;

use palpate_proto::journal as pb;
use prost::Message;
use ring::digest::{Context, SHA256};
use ring::signature::{ED25519, Ed25519KeyPair, KeyPair, UnparsedPublicKey};

use super::format::Topic;
use super::reader::JournalBatch;
use palpate_refusal::Result;

/// First bytes of the signed text: the key may sign other things too.
const PURPOSE: &[u8] = b"palpate journal 1\0";

/// First bytes of a public key in DER: its kind (RFC 8410).
const KIND: [u8; 12] = [0x30, 0x2a, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x03, 0x21, 0x00];

/// Public part of a server's Ed25519 key. It is displayed as 64 hexadecimal digits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PublicKey([u8; 32]);

impl PublicKey {
    /// Returns the key in a `SubjectPublicKeyInfo` (DER, RFC 8410); `None` if the bytes are not exactly an Ed25519
    /// key.
    pub fn of(der: &[u8]) -> Option<Self> {
        der.strip_prefix(&KIND).and_then(|bytes| bytes.try_into().ok()).map(PublicKey)
    }
}

impl std::fmt::Display for PublicKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// Private Ed25519 key of a server, which signs journals. `Debug` shows only its public part.
#[derive(Debug, Clone)]
pub struct Key(Arc<Ed25519KeyPair>);

impl Key {
    /// Returns the key in PKCS#8 (DER), with or without its public part; `None` if the bytes are not an Ed25519 key
    /// or the public part does not fit.
    pub fn of(der: &[u8]) -> Option<Self> {
        Some(Key(Arc::new(Ed25519KeyPair::from_pkcs8_maybe_unchecked(der).ok()?)))
    }

    /// Returns the public part of the key.
    pub fn public(&self) -> PublicKey {
        PublicKey(self.0.public_key().as_ref().try_into().unwrap_or_default())
    }
}

/// Digest of messages in their order.
#[derive(Clone)]
struct MessageDigest(Context);

impl MessageDigest {
    fn new() -> Self {
        MessageDigest(Context::new(&SHA256))
    }

    fn add(&mut self, topic: Topic, unix_ns: u64, bytes: &[u8]) {
        self.0.update(&topic.channel().to_le_bytes());
        self.0.update(&unix_ns.to_le_bytes());
        self.0.update(&(bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
    }

    /// Returns the text that is signed.
    fn text(&self) -> Vec<u8> {
        [PURPOSE, self.0.clone().finish().as_ref()].concat()
    }
}

/// Signer of a journal while it is written.
pub(super) struct Signer {
    key: Key,
    sum: MessageDigest,
    /// Whether there are messages after the last signature.
    is_behind: bool,
    /// Time of the last signature, ns since the Unix epoch.
    unix_ns: Option<u64>,
}

/// Least time between signatures, ns: a signature takes 96 bytes and some 20 µs.
const EVERY_NS: u64 = 1_000_000_000;

impl Signer {
    pub(super) fn new(key: Key) -> Self {
        Signer { key, sum: MessageDigest::new(), is_behind: false, unix_ns: None }
    }

    /// Adds a written message to the digest.
    pub(super) fn add(&mut self, topic: Topic, unix_ns: u64, bytes: &[u8]) {
        self.sum.add(topic, unix_ns, bytes);
        self.is_behind = true;
    }

    /// Returns the message with a signature of all messages so far, if one is due or if these are `all` that there
    /// will be.
    pub(super) fn sign(&mut self, unix_ns: u64, all: bool) -> Option<Vec<u8>> {
        let is_due = self.unix_ns.is_none_or(|last| unix_ns >= last.saturating_add(EVERY_NS));
        if !self.is_behind || !(is_due || all) {
            return None;
        }
        (self.unix_ns, self.is_behind) = (Some(unix_ns), false);
        let signature = self.key.0.sign(&self.sum.text()).as_ref().to_vec();
        let public_key = self.key.public().0.to_vec();
        Some(pb::Signature { public_key, signature }.encode_to_vec())
    }
}

impl std::fmt::Debug for Signer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Signer").field("key", &self.key).finish_non_exhaustive()
    }
}

/// Verifier of the signatures of a journal, batch by batch.
pub struct Signatures {
    key: PublicKey,
    sum: MessageDigest,
    /// The step up to which the last signed batch is complete, and the batch's number.
    signed: Option<(u64, u64)>,
    /// Number of messages after the last signature.
    behind: u64,
    ended: bool,
}

/// Signed extent of a journal, from its beginning.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Signed {
    /// The server with the key wrote every message up to this step, and none has been changed, added or left out
    /// since.
    pub until_step: u64,
    /// Number of messages after the last signature, which may have been written or changed without the key.
    pub unsigned: u64,
    /// Whether the journal's end is signed and nothing follows it, so that nothing was cut off.
    pub ended: bool,
}

impl Signatures {
    /// Creates a verifier of signatures by the server with this key, for one journal.
    pub fn of(key: PublicKey) -> Self {
        Signatures { key, sum: MessageDigest::new(), signed: None, behind: 0, ended: false }
    }

    /// Checks the next batch. Give every batch of the journal once, in order, from the first. A batch without a
    /// signature is accepted; [`Signatures::signed`] does not cover it until a later signature does.
    ///
    /// # Errors
    /// Refuses a signature that can't be decoded, one by another key, and one that does not match the messages before
    /// it, because a batch since the last signature was changed. Do not continue after that.
    pub fn check(&mut self, batch: &JournalBatch) -> Result<()> {
        let mut ends = false;
        for (topic, bytes) in batch.messages() {
            ends |= topic == Topic::End;
            if topic != Topic::Signatures {
                self.sum.add(topic, batch.unix_ns, bytes);
                self.behind += 1;
                continue;
            }
            let message =
                pb::Signature::decode(bytes).map_err(|e| batch.refuse(format!("a signature can't be read: {e}")))?;
            if message.public_key != self.key.0 {
                let by = <[u8; 32]>::try_from(message.public_key)
                    .map_or("no key".to_owned(), |by| PublicKey(by).to_string());
                return Err(batch.refuse(format!("is signed by another key, {by}")));
            }
            let key = UnparsedPublicKey::new(&ED25519, self.key.0);
            if key.verify(&self.sum.text(), &message.signature).is_err() {
                let since = self.signed.map_or(0, |signed| signed.1);
                let message = format!("its signature is of something else: batches {since} to here were changed");
                return Err(batch.refuse(message));
            }
            (self.signed, self.behind) = (Some((batch.until_step, batch.number)), 0);
            self.ended |= ends;
        }
        Ok(())
    }

    /// Returns the signed extent so far; `None` if no signature has been checked.
    pub fn signed(&self) -> Option<Signed> {
        let Signatures { behind, ended, .. } = *self;
        self.signed.map(|(until_step, _)| Signed { until_step, unsigned: behind, ended: ended && behind == 0 })
    }
}
