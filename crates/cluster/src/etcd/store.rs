//! Keys, values and transactions, as callers have them and as etcd has them.

use palpate_proto::etcd::etcdserverpb::compare::{CompareResult, CompareTarget, TargetUnion};
use palpate_proto::etcd::etcdserverpb::request_op::Request;
use palpate_proto::etcd::etcdserverpb::response_op::Response;
use palpate_proto::etcd::etcdserverpb::{
    self as rpc, DeleteRangeRequest, PutRequest, RangeRequest, RequestOp, ResponseHeader, TxnRequest, TxnResponse,
};
use palpate_proto::etcd::mvccpb;

/// A key and what is at it. Revisions count the changes of the whole store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyValue {
    /// The key.
    pub key: String,
    /// What is at it.
    pub value: Vec<u8>,
    /// The revision at which the key was made, since it was last deleted.
    pub create_revision: u64,
    /// The revision at which it was last written.
    pub mod_revision: u64,
    /// The lease at whose end it is deleted; 0 for none.
    pub lease: i64,
}

/// A condition of a transaction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Compare {
    /// There is no such key.
    Absent(String),
    /// There is such a key.
    Present(String),
    /// The key was last written at this revision.
    ModRevision(String, u64),
}

/// An operation of a transaction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Op {
    /// Writes a key.
    Put {
        /// The key.
        key: String,
        /// What is at it from now on.
        value: Vec<u8>,
        /// The lease at whose end it is deleted. Without one it stays, also if it had one before.
        lease: Option<i64>,
    },
    /// Deletes a key, if there is one.
    Delete(String),
    /// Reads a key.
    Get(String),
}

/// A transaction: all of `then` if all of `if_all` holds, else all of `otherwise`, at one revision. etcd refuses one with more
/// than 128 operations, or that writes a key twice.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Txn {
    /// What has to hold.
    pub if_all: Vec<Compare>,
    /// What is done if it holds.
    pub then: Vec<Op>,
    /// What is done otherwise.
    pub otherwise: Vec<Op>,
}

/// What came of a transaction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TransactionOutcome {
    /// Whether the conditions held.
    pub succeeded: bool,
    /// The revision of the store after it: of what it wrote, if it wrote.
    pub revision: u64,
    /// What each [`Op::Get`] of the operations that were done has read, in their order.
    pub got: Vec<Option<KeyValue>>,
}

impl Txn {
    /// Whether it writes nothing, whatever holds.
    pub(super) fn only_reads(&self) -> bool {
        self.then.iter().chain(&self.otherwise).all(|op| matches!(op, Op::Get(_)))
    }
}

impl From<Txn> for TxnRequest {
    fn from(txn: Txn) -> Self {
        let ops = |ops: Vec<Op>| ops.into_iter().map(RequestOp::from).collect();
        TxnRequest {
            compare: txn.if_all.into_iter().map(rpc::Compare::from).collect(),
            success: ops(txn.then),
            failure: ops(txn.otherwise),
        }
    }
}

impl From<Compare> for rpc::Compare {
    fn from(compare: Compare) -> Self {
        let created = (CompareTarget::Create, TargetUnion::CreateRevision(0));
        let (key, result, (target, union)) = match compare {
            Compare::Absent(key) => (key, CompareResult::Equal, created),
            Compare::Present(key) => (key, CompareResult::Greater, created),
            Compare::ModRevision(key, revision) => {
                (key, CompareResult::Equal, (CompareTarget::Mod, TargetUnion::ModRevision(signed(revision))))
            }
        };
        rpc::Compare { result: result.into(), target: target.into(), key: key.into_bytes(), target_union: Some(union) }
    }
}

impl From<Op> for RequestOp {
    fn from(op: Op) -> Self {
        let request = match op {
            Op::Put { key, value, lease } => {
                Request::RequestPut(PutRequest { key: key.into_bytes(), value, lease: lease.unwrap_or(0) })
            }
            Op::Delete(key) => {
                Request::RequestDeleteRange(DeleteRangeRequest { key: key.into_bytes(), range_end: Vec::new() })
            }
            Op::Get(key) => Request::RequestRange(RangeRequest { key: key.into_bytes(), ..Default::default() }),
        };
        RequestOp { request: Some(request) }
    }
}

impl From<TxnResponse> for TransactionOutcome {
    fn from(response: TxnResponse) -> Self {
        let got = response.responses.into_iter().filter_map(|one| match one.response {
            Some(Response::ResponseRange(range)) => Some(range.kvs.into_iter().next().and_then(key_value)),
            _ => None,
        });
        let got = got.collect();
        TransactionOutcome { succeeded: response.succeeded, revision: revision(response.header.as_ref()), got }
    }
}

/// `None` if the key is no text: it is none of ours.
pub(super) fn key_value(raw: mvccpb::KeyValue) -> Option<KeyValue> {
    Some(KeyValue {
        key: String::from_utf8(raw.key).ok()?,
        value: raw.value,
        create_revision: unsigned(raw.create_revision),
        mod_revision: unsigned(raw.mod_revision),
        lease: raw.lease,
    })
}

/// The store's revision when an answer was made.
pub(super) fn revision(header: Option<&ResponseHeader>) -> u64 {
    header.map_or(0, |header| unsigned(header.revision))
}

/// The first key beyond those that begin with `prefix`, as etcd wants it: the keys from `prefix` up to it begin so. An empty
/// prefix is that of all keys.
pub(super) fn prefix_range(prefix: &str) -> (Vec<u8>, Vec<u8>) {
    if prefix.is_empty() {
        return (vec![0], vec![0]);
    }
    let mut end = prefix.as_bytes().to_vec();
    // No byte of UTF-8 is the largest one.
    if let Some(last) = end.last_mut() {
        *last = last.saturating_add(1);
    }
    (prefix.as_bytes().to_vec(), end)
}

/// etcd's revisions have a sign that they don't use.
pub(super) fn unsigned(revision: i64) -> u64 {
    u64::try_from(revision).unwrap_or(0)
}

/// A revision as etcd has it.
pub(super) fn signed(revision: u64) -> i64 {
    i64::try_from(revision).unwrap_or(i64::MAX)
}
