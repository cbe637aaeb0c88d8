//! Keys, values and transactions, in the form of this client and in etcd's.

use palpate_proto::etcd::etcdserverpb::compare::{CompareResult, CompareTarget, TargetUnion};
use palpate_proto::etcd::etcdserverpb::request_op::Request;
use palpate_proto::etcd::etcdserverpb::response_op::Response;
use palpate_proto::etcd::etcdserverpb::{
    self as rpc, DeleteRangeRequest, PutRequest, RangeRequest, RequestOp, ResponseHeader, TxnRequest, TxnResponse,
};
use palpate_proto::etcd::mvccpb;

/// A key, its value and its history, as etcd has it at one revision. A revision counts the changes of the whole
/// store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyValue {
    /// The key.
    pub key: String,
    /// The value of the key.
    pub value: Vec<u8>,
    /// Revision at which the key was created, after its last deletion.
    pub create_revision: u64,
    /// Revision at which the key was last written.
    pub mod_revision: u64,
    /// Lease at whose end the key is deleted; 0 for none.
    pub lease: i64,
}

/// A condition of a transaction, which holds or not when etcd executes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Compare {
    /// The key does not exist.
    Absent(String),
    /// The key exists.
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
        /// The new value.
        value: Vec<u8>,
        /// Lease at whose end the key is deleted. `None` detaches the key from any lease, so it stays.
        lease: Option<i64>,
    },
    /// Deletes a key, if it exists.
    Delete(String),
    /// Reads a key.
    Get(String),
}

/// A transaction: executes all of `then` if all of `if_all` hold, else all of `otherwise`, at one revision. etcd
/// refuses more than 128 operations, and two writes of one key.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Txn {
    /// Conditions; without any, `then` is executed.
    pub if_all: Vec<Compare>,
    /// Operations if all conditions hold, in order; may be empty.
    pub then: Vec<Op>,
    /// Operations if a condition does not hold, in order; may be empty.
    pub otherwise: Vec<Op>,
}

/// Outcome of a transaction that etcd has executed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TransactionOutcome {
    /// Whether all conditions held, so that `then` was executed, and not `otherwise`.
    pub succeeded: bool,
    /// Revision of the store after the transaction, which is that of its writes if it wrote.
    pub revision: u64,
    /// Results of the executed [`Op::Get`]s, in their order; `None` for a key that does not exist or is not UTF-8.
    pub got: Vec<Option<KeyValue>>,
}

impl Txn {
    /// Returns whether it writes nothing in either case.
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

/// Converts etcd's form. `None` if the key is not UTF-8: such a key belongs to another program.
pub(super) fn key_value(raw: mvccpb::KeyValue) -> Option<KeyValue> {
    Some(KeyValue {
        key: String::from_utf8(raw.key).ok()?,
        value: raw.value,
        create_revision: unsigned(raw.create_revision),
        mod_revision: unsigned(raw.mod_revision),
        lease: raw.lease,
    })
}

/// Returns the store's revision when an answer was made; 0 without a header.
pub(super) fn revision(header: Option<&ResponseHeader>) -> u64 {
    header.map_or(0, |header| unsigned(header.revision))
}

/// Returns the range of keys that begin with `prefix`, as etcd expects it: `prefix` itself and the first key
/// beyond. An empty prefix covers all keys.
pub(super) fn prefix_range(prefix: &str) -> (Vec<u8>, Vec<u8>) {
    if prefix.is_empty() {
        return (vec![0], vec![0]);
    }
    let mut end = prefix.as_bytes().to_vec();
    // No byte of UTF-8 has the largest value, so this can't overflow.
    if let Some(last) = end.last_mut() {
        *last = last.saturating_add(1);
    }
    (prefix.as_bytes().to_vec(), end)
}

/// Converts etcd's signed revision, which is never negative.
pub(super) fn unsigned(revision: i64) -> u64 {
    u64::try_from(revision).unwrap_or(0)
}

/// Converts a revision to etcd's signed form.
pub(super) fn signed(revision: u64) -> i64 {
    i64::try_from(revision).unwrap_or(i64::MAX)
}
