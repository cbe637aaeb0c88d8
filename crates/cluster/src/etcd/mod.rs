//! A client of etcd, as much of it as a fleet of servers needs: keys, transactions, leases, and changes as they come.
//!
//! **Members.** A call begins at the member that answered last and goes on to the others. A member that can't be reached, or
//! that knows of no leader, is passed over at once; one that does not answer after the time limit of an attempt. When all have
//! failed, another round begins after 0.25 s at most, until there was time for an attempt at each. So a call takes at most
//! `limit × (members + 2)`, and lasts over the election of another leader. Reads and transactions beyond 128 at a time wait for
//! those before them; leases and watches do not.
//!
//! **Once.** Reads, leases and watches may be done twice. A transaction is sent to another member only if the one before has
//! certainly not taken it; otherwise it ends in [`EtcdError::Unknown`], and its caller reads what has become of it.
//!
//! **Time.** A lease runs from when etcd grants it or keeps it alive, which is after the call began. Whoever relies on a lease
//! reads a monotonic clock before the call, and counts from there.

mod calls;
mod error;
mod lease;
mod login;
mod member;
mod options;
mod store;
mod watch;

use std::sync::Arc;
use std::time::Duration;

use palpate_proto::etcd::etcdserverpb::kv_client::KvClient;
use palpate_proto::etcd::etcdserverpb::lease_client::LeaseClient;
use palpate_proto::etcd::etcdserverpb::{
    LeaseGrantRequest, LeaseRevokeRequest, RangeRequest, RangeResponse, TxnRequest,
};
use tokio::sync::{Mutex, Semaphore};
use tokio::time::timeout;
use tonic::{Code, Response};

use calls::{MemberCall, MemberCalls, Repeat};
pub use error::root;
pub use error::{EtcdError, EtcdResult};
pub use lease::Lease;
use lease::LeaseKeepAlive;
pub use options::EtcdOptions;
pub use store::{Compare, KeyValue, Op, TransactionOutcome, Txn};
use store::{key_value, prefix_range, revision, signed};
pub use watch::{Watch, WatchError, WatchEvent};

/// Time limit of an attempt at one member, unless another is given.
pub const LIMIT: Duration = Duration::from_secs(1);

/// Keys of one answer to a list.
const PAGE: i64 = 1000;

/// Most keys of a list: a hundred thousand sessions have a few each.
const MAX_KEYS: usize = 1 << 20;

/// Largest answer that is taken.
const LARGEST_BYTES: usize = 64 << 20;

/// Reads and transactions under way at a time; others wait for these. More would not be done sooner, and all would be late.
const AT_A_TIME: usize = 128;

/// How often a list is begun anew because etcd dropped the revision that it was reading.
const LIST_ATTEMPTS: usize = 3;

/// A client of etcd. Clones share connections.
#[derive(Clone)]
pub struct Etcd {
    calls: Arc<MemberCalls>,
    pulse: Arc<Mutex<Option<LeaseKeepAlive>>>,
    turns: Arc<Semaphore>,
}

impl std::fmt::Debug for Etcd {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let endpoints: Vec<&str> = self.calls.members.iter().map(member::Member::url).collect();
        f.debug_struct("Etcd").field("endpoints", &endpoints).finish_non_exhaustive()
    }
}

impl Etcd {
    /// Returns a client with the time limit [`LIMIT`] for each attempt. Nothing is connected before the first call.
    ///
    /// # Errors
    /// Returns an error if the options are wrong or a file can't be read.
    pub fn open(options: &EtcdOptions) -> EtcdResult<Self> {
        Etcd::open_within(options, LIMIT)
    }

    /// Returns a client with a time limit for each attempt.
    ///
    /// # Errors
    /// As for [`Etcd::open`].
    pub fn open_within(options: &EtcdOptions, limit: Duration) -> EtcdResult<Self> {
        let calls = Arc::new(MemberCalls::new(options.clone(), limit)?);
        Ok(Etcd { calls, pulse: Arc::default(), turns: Arc::new(Semaphore::new(AT_A_TIME)) })
    }

    /// Returns the member at which the next call begins: the one that answered last.
    pub fn endpoint(&self) -> &str {
        self.calls.members[self.calls.preferred()].url()
    }

    /// Returns a key, and the revision of the store. No older than any write that has been answered before.
    ///
    /// # Errors
    /// Returns an error if no member can tell.
    pub async fn get(&self, key: &str) -> EtcdResult<(Option<KeyValue>, u64)> {
        let request = RangeRequest { key: key.into(), ..Default::default() };
        let response = self.range(&format!("read the key `{key}`"), request).await?;
        let revision = revision(response.header.as_ref());
        Ok((response.kvs.into_iter().next().and_then(key_value), revision))
    }

    /// Returns all keys that begin with `prefix`, in order, at one revision, and that revision. No older than any write
    /// that has been answered before. Keys that are no text are left out.
    ///
    /// # Errors
    /// Returns an error if no member can tell, or if there are more than 1,048,576.
    pub async fn list(&self, prefix: &str) -> EtcdResult<(Vec<KeyValue>, u64)> {
        let what = format!("list the keys `{prefix}…`");
        let mut attempts = 1..=LIST_ATTEMPTS;
        loop {
            attempts.next();
            match self.list_once(&what, prefix).await {
                Err(EtcdError::Refused(why)) if why.contains("compacted") && !attempts.is_empty() => {}
                listed => return listed,
            }
        }
    }

    async fn list_once(&self, what: &str, prefix: &str) -> EtcdResult<(Vec<KeyValue>, u64)> {
        let (key, range_end) = prefix_range(prefix);
        let mut request = RangeRequest { key, range_end, limit: PAGE, revision: 0 };
        let mut listed = Vec::new();
        loop {
            let page = self.range(what, request.clone()).await?;
            if request.revision == 0 {
                request.revision = signed(revision(page.header.as_ref()));
            }
            let last = page.kvs.last().map(|kv| kv.key.clone());
            listed.extend(page.kvs.into_iter().filter_map(key_value));
            let Some(last) = last.filter(|_| page.more) else {
                return Ok((listed, store::unsigned(request.revision)));
            };
            if listed.len() > MAX_KEYS {
                let why = format!("can't {what}: there are more than {MAX_KEYS}; give this fleet a prefix of its own");
                return Err(EtcdError::Refused(why));
            }
            // The next key that there could be.
            request.key = last;
            request.key.push(0);
        }
    }

    async fn range(&self, what: &str, request: RangeRequest) -> EtcdResult<RangeResponse> {
        let attempt = |way: MemberCall| {
            let request = way.request(request.clone());
            let mut client = KvClient::new(way.channel).max_decoding_message_size(LARGEST_BYTES);
            async move { client.range(request).await.map(Response::into_inner) }
        };
        let _turn = self.turns.acquire().await;
        let response = self.calls.call(what, Repeat::Freely, attempt).await?;
        self.calls.is_latest(response.header.as_ref());
        Ok(response)
    }

    /// Does a transaction.
    ///
    /// # Errors
    /// Returns [`EtcdError::Unknown`] if it may have been done although there is no answer: read its keys again. With every
    /// other error it was not done.
    pub async fn transact(&self, transaction: Txn) -> EtcdResult<TransactionOutcome> {
        let repeat = if transaction.only_reads() { Repeat::Freely } else { Repeat::Never };
        let request = TxnRequest::from(transaction);
        let attempt = |way: MemberCall| {
            let request = way.request(request.clone());
            let mut client = KvClient::new(way.channel).max_decoding_message_size(LARGEST_BYTES);
            async move { client.txn(request).await.map(Response::into_inner) }
        };
        let _turn = self.turns.acquire().await;
        let response = self.calls.call("do a transaction", repeat, attempt).await?;
        self.calls.is_latest(response.header.as_ref());
        Ok(response.into())
    }

    /// Makes a lease. One of which we have not heard, because the answer was lost, ends by itself.
    ///
    /// # Errors
    /// Returns an error if no member can, or if etcd refuses so long a time.
    pub async fn grant(&self, ttl_s: u64) -> EtcdResult<Lease> {
        let message = LeaseGrantRequest { ttl: signed(ttl_s), id: 0 };
        let attempt = |way: MemberCall| {
            let request = way.request(message);
            async move { LeaseClient::new(way.channel).lease_grant(request).await.map(Response::into_inner) }
        };
        let granted = self.calls.call("grant a lease", Repeat::Freely, attempt).await?;
        self.calls.is_latest(granted.header.as_ref());
        Ok(Lease { id: granted.id, ttl_s: store::unsigned(granted.ttl) })
    }

    /// Has a lease begin anew: the seconds that it lasts from now on, `None` if it has ended. Leases of one client wait for each
    /// other. An attempt over the open stream comes before those at each member.
    ///
    /// # Errors
    /// Returns an error if no member can. The lease may have begun anew all the same.
    pub async fn keep_alive(&self, lease: i64) -> EtcdResult<Option<u64>> {
        let mut kept = self.pulse.lock().await;
        // It is back only with an answer: who gives up waiting gives the stream up as well.
        if let Some(mut pulse) = kept.take() {
            let asked = timeout(self.calls.limit, pulse.ask(&self.calls, lease)).await;
            if let Ok(Ok(ttl_s)) = asked {
                *kept = Some(pulse);
                return Ok(ttl_s);
            }
            self.calls.pass_over(pulse.member);
            if asked.is_err() {
                self.calls.members[pulse.member].give_up(pulse.number).await;
            }
        }
        let attempt = |way: MemberCall| LeaseKeepAlive::open(way, &self.calls, lease);
        let (pulse, ttl_s) = self.calls.call("keep a lease alive", Repeat::Freely, attempt).await?;
        *kept = Some(pulse);
        Ok(ttl_s)
    }

    /// Ends a lease, and deletes its keys. It is no error if it has ended already.
    ///
    /// # Errors
    /// Returns an error if no member can.
    pub async fn revoke(&self, lease: i64) -> EtcdResult<()> {
        let attempt = |way: MemberCall| {
            let request = way.request(LeaseRevokeRequest { id: lease });
            async move {
                match LeaseClient::new(way.channel).lease_revoke(request).await {
                    Err(status) if status.code() != Code::NotFound => Err(status),
                    _ => Ok(()),
                }
            }
        };
        self.calls.call("revoke a lease", Repeat::Freely, attempt).await
    }

    /// Follows the keys that begin with `prefix`, from a revision on; 0 for what changes from when it is opened, which is in the
    /// first [`Watch::next`]. After a list, that is the revision after the list's.
    pub fn watch(&self, prefix: &str, from_revision: u64) -> Watch {
        Watch::new(self.calls.clone(), prefix, from_revision)
    }
}
