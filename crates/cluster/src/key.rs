//! The keys of a fleet in etcd, and their values.

use serde::{Deserialize, Serialize};

use palpate_refusal::{Reason, Refusal, Result};

/// Longest name of a fleet or a node.
const MAX_LETTERS: usize = 64;

/// Where the keys of a fleet are: `/palpate/FLEET/nodes/NODE` and `/palpate/FLEET/sessions/ID`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Keys {
    root: String,
}

impl Keys {
    /// Creates the keys of the fleet of that name.
    ///
    /// # Errors
    /// Refuses a name that is none.
    pub fn of(fleet: &str) -> Result<Self> {
        check_name("cluster_name", fleet)?;
        Ok(Keys { root: format!("/palpate/{fleet}/") })
    }

    /// Returns what the keys of all nodes begin with.
    pub fn nodes(&self) -> String {
        format!("{}nodes/", self.root)
    }

    /// Returns what the keys of all sessions begin with.
    pub fn sessions(&self) -> String {
        format!("{}sessions/", self.root)
    }

    /// Returns the key of a node, which is there while its lease is.
    pub fn node(&self, name: &str) -> String {
        self.nodes() + name
    }

    /// Returns the key of a session, which is there until the session is deleted.
    pub fn session(&self, id: &str) -> String {
        self.sessions() + id
    }
}

/// Checks the name of a fleet or a node: letters, digits, and `.`, `-`, `_`, `:` between them.
///
/// # Errors
/// Refuses any other name.
pub fn check_name(field: &str, name: &str) -> Result<()> {
    let is_letter = |c: char| c.is_ascii_alphanumeric() || ".-_:".contains(c);
    let is_name = name.starts_with(|c: char| c.is_ascii_alphanumeric()) && name.chars().all(is_letter);
    if is_name && name.len() <= MAX_LETTERS {
        return Ok(());
    }
    let message = format!("must be 1 to {MAX_LETTERS} letters, digits, `.`, `-`, `_` or `:`, but is `{name}`");
    Err(Refusal::new(Reason::OutOfRange, field, message))
}

/// A node, as it says itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NodeValue {
    /// URL for clients and for other nodes.
    pub endpoint: String,
    /// Random, and kept in the node's folder of journals: two servers must not have one name.
    pub instance: String,
    /// Its release.
    pub version: String,
    /// [`palpate_session::journal::format::REPLAYS`] of its release.
    pub replays: u32,
    /// Stepping threads.
    pub threads: u32,
    /// What its sessions take of these, 0 to 1, measured.
    pub load: f64,
    /// Its sessions.
    pub sessions: u32,
    /// It takes no new sessions.
    #[serde(default)]
    pub draining: bool,
}

/// Who owns a session. The revision of the key is that of the ownership.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SessionValue {
    /// The owner; empty if the owner has given it up.
    pub node: String,
    /// Who has all of its journal that the owner calls durable, and may claim it; empty if none.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub standby: String,
}

/// Returns the value of a key as JSON.
pub fn encode<T: Serialize>(value: &T) -> Vec<u8> {
    // Maps of text and numbers can always be written.
    serde_json::to_vec(value).unwrap_or_default()
}

/// Returns the value of a key; `None` if it is not one of ours.
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
