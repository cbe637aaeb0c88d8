//! Keys of a fleet in etcd, and their values.

use serde::{Deserialize, Serialize};

use palpate_refusal::{Reason, Refusal, Result};

/// Length limit of the name of a fleet or a node, bytes (its characters are ASCII).
const MAX_LETTERS: usize = 64;

/// Names of the keys of one fleet in etcd: `/palpate/FLEET/nodes/NODE` and `/palpate/FLEET/sessions/ID`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    root: String,
}

impl Keys {
    /// Creates the key names of the fleet `fleet`. Nothing is written to etcd.
    ///
    /// # Errors
    /// Refuses a name that [`check_name`] refuses, as a value of `cluster_name`.
    pub fn of(fleet: &str) -> Result<Self> {
        check_name("cluster_name", fleet)?;
        Ok(Keys { root: format!("/palpate/{fleet}/") })
    }

    /// Returns the prefix of the keys of all nodes, which ends with `/`.
    pub fn nodes(&self) -> String {
        format!("{}nodes/", self.root)
    }

    /// Returns the prefix of the keys of all sessions, which ends with `/`.
    pub fn sessions(&self) -> String {
        format!("{}sessions/", self.root)
    }

    /// Returns the key of the node `name`, which is not checked. It exists in etcd while the node's lease lasts; its
    /// value is a [`NodeValue`].
    pub fn node(&self, name: &str) -> String {
        self.nodes() + name
    }

    /// Returns the key of the session `id`, which is not checked. It exists in etcd until the session is deleted; its
    /// value is a [`SessionValue`].
    pub fn session(&self, id: &str) -> String {
        self.sessions() + id
    }
}

/// Checks the name of a fleet or a node: 1 to 64 ASCII letters, digits, `.`, `-`, `_` or `:`, the first a letter or
/// digit.
///
/// # Errors
/// Refuses any other name, as a value of `field` ([`Reason::OutOfRange`]).
pub fn check_name(field: &str, name: &str) -> Result<()> {
    let is_letter = |c: char| c.is_ascii_alphanumeric() || ".-_:".contains(c);
    let is_name = name.starts_with(|c: char| c.is_ascii_alphanumeric()) && name.chars().all(is_letter);
    if is_name && name.len() <= MAX_LETTERS {
        return Ok(());
    }
    let message = format!("must be 1 to {MAX_LETTERS} letters, digits, `.`, `-`, `_` or `:`, but is `{name}`");
    Err(Refusal::new(Reason::OutOfRange, field, message))
}

/// Value of a node's key: the node's own description, which it renews while it is present.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeValue {
    /// URL of the node for clients and other nodes.
    pub endpoint: String,
    /// Random ID of the node's folder of journals, where it is kept over restarts. It shows when two servers use one
    /// name.
    pub instance: String,
    /// Release of the node's program.
    pub version: String,
    /// [`palpate_session::journal::format::REPLAYS`] of that release: nodes with equal values replay with equal
    /// bits.
    pub replays: u32,
    /// Number of stepping threads.
    pub threads: u32,
    /// Measured part of the stepping threads' time, over all of them, that sessions use, 0 to 1.
    pub load: f64,
    /// Number of sessions that the node has.
    pub sessions: u32,
    /// Whether the node takes no new sessions; false if the value does not say.
    #[serde(default)]
    pub draining: bool,
}

/// Value of a session's key: its owner and standby. The revision at which the key was last written identifies the
/// ownership.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SessionValue {
    /// Name of the node that owns the session; empty if the owner has given it up.
    pub node: String,
    /// Name of the standby: the node that has every part of the journal that the owner calls durable, and may claim
    /// the session. Empty if there is none.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub standby: String,
}

/// Encodes the value of a key as JSON; empty if it can't be encoded, which does not happen to the values of this
/// module.
pub fn encode<T: Serialize>(value: &T) -> Vec<u8> {
    // Serialization of text and numbers can't fail.
    serde_json::to_vec(value).unwrap_or_default()
}

/// Decodes the JSON value of a key; `None` if it is no JSON or does not have the form of `T`. Unknown fields are
/// ignored.
pub fn decode<'v, T: Deserialize<'v>>(value: &'v [u8]) -> Option<T> {
    serde_json::from_slice(value).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_parts_of_keys_and_never_more() {
        for name in ["a", "node-1", "10.0.0.7:7117", "A_b.c"] {
            assert!(check_name("node", name).is_ok(), "{name}");
        }
        for name in ["", "a/b", "../a", "-a", "a b", "é", &"a".repeat(65)] {
            assert!(check_name("node", name).is_err(), "{name}");
        }
        let keys = Keys::of("ward").unwrap();
        assert_eq!(keys.node("n1"), "/palpate/ward/nodes/n1");
        assert_eq!(keys.session("00ff"), "/palpate/ward/sessions/00ff");
    }

    #[test]
    fn a_value_comes_back_and_foreign_bytes_are_none() {
        let value = SessionValue { node: "a".into(), standby: String::new() };
        assert_eq!(decode::<SessionValue>(&encode(&value)), Some(value));
        for foreign in [&b""[..], b"\xff", b"{}", b"[1]", b"{\"node\":1}"] {
            assert_eq!(decode::<SessionValue>(foreign), None);
        }
    }
}
