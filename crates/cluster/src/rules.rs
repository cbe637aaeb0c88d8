//! The rules by which a session has one owner at a time: what is asked of etcd, and until when a node may act. No I/O and no clock
//! here, so that a simulation of the fleet uses the very rules that the server does.
//!
//! **Why there is one owner.** A node's key is under its lease. etcd lets a lease end no earlier than its time to live after it got
//! the newest keepalive, so no earlier than that after the node *sent* it. The node acts only until [`fence_ns`], which is before
//! that. Others claim a session only in a transaction that finds the owner's key gone, and the session's key as they have read it.
//! When a node's lease has ended and it comes back, it acts for a session only after a transaction that finds the session's key as
//! this node left it. So of a claim and a return, one fails.

use super::etcd::{Compare, Op, Txn};
use super::key::{Keys, SessionValue, encode};

/// The part of the time to live by which a node stops early: clocks of two machines may differ by that much in their rates, and a
/// step or a message that has begun ends within it.
pub const MARGIN: f64 = 0.1;

/// Returns until when a node may step and speak for its sessions, by its own clock: it sent a keepalive at `sent_ns`,
/// and etcd has granted `ttl_s` from when it got that.
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::cast_sign_loss)]
pub fn fence_ns(sent_ns: u64, ttl_s: u64) -> u64 {
    sent_ns + ((1.0 - MARGIN) * ttl_s as f64 * 1e9) as u64
}

fn put(key: String, value: &SessionValue) -> Op {
    Op::Put { key, value: encode(value), lease: None }
}

/// Makes `node` the owner of a new session. Fails if there is one of that ID, or the node's lease has ended.
pub fn create(keys: &Keys, id: &str, node: &str) -> Txn {
    let key = keys.session(id);
    Txn {
        if_all: vec![Compare::Absent(key.clone()), Compare::Present(keys.node(node))],
        then: vec![put(key, &SessionValue { node: node.to_owned(), standby: String::new() })],
        otherwise: vec![],
    }
}

/// Returns the transaction by which `node`, which owned the session at `revision`, says that it still does, and which node stands by. Fails if
/// another has claimed it.
pub fn keep(keys: &Keys, id: &str, revision: u64, node: &str, standby: &str) -> Txn {
    let key = keys.session(id);
    Txn {
        if_all: vec![Compare::ModRevision(key.clone(), revision), Compare::Present(keys.node(node))],
        then: vec![put(key, &SessionValue { node: node.to_owned(), standby: standby.to_owned() })],
        otherwise: vec![],
    }
}

/// Returns the transaction by which `node`, which stands by, makes itself the owner of a session whose owner is gone. `seen` was read at
/// `revision`. Fails if the owner is there, or anybody has changed the key since.
pub fn claim(keys: &Keys, id: &str, (seen, revision): (&SessionValue, u64), node: &str) -> Txn {
    let key = keys.session(id);
    let mut if_all = vec![Compare::ModRevision(key.clone(), revision), Compare::Present(keys.node(node))];
    if !seen.node.is_empty() {
        if_all.push(Compare::Absent(keys.node(&seen.node)));
    }
    let value = SessionValue { node: node.to_owned(), standby: String::new() };
    Txn { if_all, then: vec![put(key, &value)], otherwise: vec![] }
}

/// Returns whether `node` may try a [`claim`], by what it has read.
pub fn may_claim(seen: &SessionValue, node: &str, is_there: impl Fn(&str) -> bool) -> bool {
    seen.standby == node && seen.node != node && (seen.node.is_empty() || !is_there(&seen.node))
}

/// Returns the transaction by which the owner at `revision` makes another node the owner. It has stopped stepping and speaking for the session
/// before.
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

/// Returns the transaction by which the owner at `revision` gives the session up: it has nothing of it any more, and who stands by may claim it.
pub fn give_up(keys: &Keys, id: &str, revision: u64, standby: &str) -> Txn {
    let key = keys.session(id);
    Txn {
        if_all: vec![Compare::ModRevision(key.clone(), revision)],
        then: vec![put(key, &SessionValue { node: String::new(), standby: standby.to_owned() })],
        otherwise: vec![],
    }
}

/// Returns the transaction by which the owner at `revision` deletes the session.
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
