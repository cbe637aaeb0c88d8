//! The rules by which a session has one owner at a time: the transactions sent to etcd, and how long a node may
//! act. This module has no I/O and no clock, so a simulation of the fleet uses the rules of the server.
//!
//! **Why there is one owner.** A node's key is under its lease. etcd ends a lease no earlier than its time to live
//! after it received the newest keepalive, so no earlier than that after the node *sent* it. The node acts only
//! until [`fence_ns`], which is before that. Other nodes claim a session only in a transaction that finds the
//! owner's key gone and the session's key as they have read it. When a node's lease has ended and the node comes
//! back, it acts for a session only after a transaction that finds the session's key as this node left it. So of a
//! claim and a return, one fails.

use super::etcd::{Compare, Op, Txn};
use super::key::{Keys, SessionValue, encode};

/// Fraction of the lease's time to live by which a node stops early, 0 to 1. It covers the difference in rate between
/// two machines' clocks, and a step or a message that has begun.
pub const MARGIN: f64 = 0.1;

/// Returns the time until which a node may step its sessions and answer for them, ns of the clock of `sent_ns`. The
/// node sent a keepalive at `sent_ns`, and etcd granted `ttl_s` seconds from when it received that. The limit is
/// `sent_ns` + (1 − [`MARGIN`])·`ttl_s`, so 0.9 of the time to live.
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::cast_sign_loss)]
pub fn fence_ns(sent_ns: u64, ttl_s: u64) -> u64 {
    sent_ns + ((1.0 - MARGIN) * ttl_s as f64 * 1e9) as u64
}

fn put(key: String, value: &SessionValue) -> Op {
    Op::Put { key, value: encode(value), lease: None }
}

/// Returns the transaction that makes `node` the owner of a new session `id`, without a standby. Its conditions fail
/// if a session has this ID, or the node's lease has ended.
pub fn create(keys: &Keys, id: &str, node: &str) -> Txn {
    let key = keys.session(id);
    Txn {
        if_all: vec![Compare::Absent(key.clone()), Compare::Present(keys.node(node))],
        then: vec![put(key, &SessionValue { node: node.to_owned(), standby: String::new() })],
        otherwise: vec![],
    }
}

/// Returns the transaction by which `node` confirms that it still owns the session `id`, with the standby `standby`
/// (empty for none). `revision` is that of the key as `node` left it. It writes the key, so the ownership has a new
/// revision. Its conditions fail if the key has changed since, for example because another node has claimed the
/// session, or if the node's lease has ended.
pub fn keep(keys: &Keys, id: &str, revision: u64, node: &str, standby: &str) -> Txn {
    let key = keys.session(id);
    Txn {
        if_all: vec![Compare::ModRevision(key.clone(), revision), Compare::Present(keys.node(node))],
        then: vec![put(key, &SessionValue { node: node.to_owned(), standby: standby.to_owned() })],
        otherwise: vec![],
    }
}

/// Returns the transaction by which the standby `node` makes itself the owner of a session whose owner is gone,
/// without a standby. `seen` is the key's value at `revision`. Its conditions fail if the owner is present, the key
/// has changed since, or the lease of `node` has ended. It does not check that `node` is the standby ([`may_claim`]).
pub fn claim(keys: &Keys, id: &str, (seen, revision): (&SessionValue, u64), node: &str) -> Txn {
    let key = keys.session(id);
    let mut if_all = vec![Compare::ModRevision(key.clone(), revision), Compare::Present(keys.node(node))];
    if !seen.node.is_empty() {
        if_all.push(Compare::Absent(keys.node(&seen.node)));
    }
    let value = SessionValue { node: node.to_owned(), standby: String::new() };
    Txn { if_all, then: vec![put(key, &value)], otherwise: vec![] }
}

/// Returns whether `node` may try a [`claim`]: `seen` names it as the standby and not as the owner, and the owner has
/// given the session up or is absent. `is_there` tells whether the node of a name is present.
pub fn may_claim(seen: &SessionValue, node: &str, is_there: impl Fn(&str) -> bool) -> bool {
    seen.standby == node && seen.node != node && (seen.node.is_empty() || !is_there(&seen.node))
}

/// Returns the transaction by which the owner `from`, at `revision` of the session's key, makes `to` the owner,
/// without a standby. `from` must already have stopped stepping the session and answering for it. Its conditions fail
/// if the key has changed or either node's lease has ended.
pub fn hand_over(keys: &Keys, id: &str, revision: u64, [from, to]: [&str; 2]) -> Txn {
    let key = keys.session(id);
    Txn {
        if_all: vec![
            Compare::ModRevision(key.clone(), revision),
            Compare::Present(keys.node(from)),
            Compare::Present(keys.node(to)),
        ],
        then: vec![put(key, &SessionValue { node: to.to_owned(), standby: String::new() })],
        otherwise: vec![],
    }
}

/// Returns the transaction by which the owner at `revision` of the session's key gives the session up: the owner has
/// kept nothing of it, and `standby` may claim it (empty for none). Its condition fails if the key has changed; the
/// owner's lease need not last.
pub fn give_up(keys: &Keys, id: &str, revision: u64, standby: &str) -> Txn {
    let key = keys.session(id);
    Txn {
        if_all: vec![Compare::ModRevision(key.clone(), revision)],
        then: vec![put(key, &SessionValue { node: String::new(), standby: standby.to_owned() })],
        otherwise: vec![],
    }
}

/// Returns the transaction by which the owner at `revision` deletes the session's key. Its condition fails if the key
/// has changed or is gone.
pub fn delete(keys: &Keys, id: &str, revision: u64) -> Txn {
    let key = keys.session(id);
    Txn { if_all: vec![Compare::ModRevision(key.clone(), revision)], then: vec![Op::Delete(key)], otherwise: vec![] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_stops_before_its_lease_can_have_ended() {
        assert_eq!(fence_ns(1_000, 3), 1_000 + 2_700_000_000);
    }

    #[test]
    fn only_the_standby_of_an_owner_that_is_gone_may_claim() {
        let value = |node: &str, standby: &str| SessionValue { node: node.into(), standby: standby.into() };
        let is_there = |node: &str| node == "a";
        for (seen, may) in [
            (value("b", "me"), true),
            (value("", "me"), true),
            (value("a", "me"), false),
            (value("b", "c"), false),
            (value("b", ""), false),
            (value("me", "me"), false),
        ] {
            assert_eq!(may_claim(&seen, "me", is_there), may, "{seen:?}");
        }
    }
}
