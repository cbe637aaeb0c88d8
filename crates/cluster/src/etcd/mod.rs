//! A client of etcd with what a fleet of servers needs: keys, transactions, leases and watches.
//!
//! **Members.** A call begins at the member that answered last and continues with the others. A member that can't
//! be reached, or that knows of no leader, is skipped at once; a member that does not answer is skipped after the
//! time limit of an attempt. When all have failed, another round begins after at most 0.25 s, until there was time
//! for one attempt at each member. So a call takes at most `limit × (members + 2)`, and survives the election of
//! another leader. At most 128 reads and transactions run at a time; further ones wait. Leases and watches do not
//! wait.
//!
//! **Once.** Reads, leases and watches may be repeated. A transaction is sent to another member only if the
//! previous one has certainly not executed it; otherwise it ends in [`EtcdError::Unknown`], and its caller reads
//! the keys to find out.
//!
//! **Time.** A lease runs from when etcd grants it or keeps it alive, which is after the call began. A caller that
//! relies on a lease reads a monotonic clock before the call, and counts from there.

mod calls;
mod error;
mod lease;
mod login;
mod member;
mod options;
mod store;
mod watch;

use std::future::Future;
use std::pin::Pin;
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

/// Default time limit of an attempt at one member: 1 s. A call may make several attempts.
pub const LIMIT: Duration = Duration::from_secs(1);

/// A call under way, which does nothing until it is polled. Dropping it cancels the call, which etcd may execute
/// nevertheless. It is boxed so that it is compiled here, once, and not in every crate that makes calls.
pub type Answer<'a, T> = Pin<Box<dyn Future<Output = EtcdResult<T>> + Send + 'a>>;

/// Keys per answer to a list.
const PAGE: i64 = 1000;

/// Limit of keys in a list: enough for a hundred thousand sessions with a few keys each.
const MAX_KEYS: usize = 1 << 20;

/// Size limit of an answer, bytes.
const LARGEST_BYTES: usize = 64 << 20;

/// Limit of concurrent reads and transactions; further ones wait. More would not finish sooner, and would delay
/// each other.
const AT_A_TIME: usize = 128;

/// Attempts at a list, if etcd compacts the revision that it reads.
const LIST_ATTEMPTS: usize = 3;

/// Client of one etcd cluster. Clones share the connections, the keepalive stream and the limit of 128 concurrent
/// reads and transactions. Its calls need a Tokio runtime.
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
    /// Creates a client with the time limit [`LIMIT`] (1 s) for each attempt at a member. It connects at the first
    /// call.
    ///
    /// # Errors
    /// Returns [`EtcdError::Refused`] if an endpoint is invalid or there are not 1 to 16, if options contradict each
    /// other ([`EtcdOptions`]), if a password would be sent in the clear, or if a file can't be read.
    pub fn open(options: &EtcdOptions) -> EtcdResult<Self> {
        Etcd::open_within(options, LIMIT)
    }

    /// Creates a client with the time limit `limit` for each attempt at a member. It connects at the first call.
    ///
    /// # Errors
    /// Returns [`EtcdError::Refused`] if an endpoint is invalid or there are not 1 to 16, if options contradict each
    /// other ([`EtcdOptions`]), if a password would be sent in the clear, or if a file can't be read.
    pub fn open_within(options: &EtcdOptions, limit: Duration) -> EtcdResult<Self> {
        let calls = Arc::new(MemberCalls::new(options.clone(), limit)?);
        Ok(Etcd { calls, pulse: Arc::default(), turns: Arc::new(Semaphore::new(AT_A_TIME)) })
    }

    /// Returns the address of the member at which the next call begins: the one that answered last, or the next one
    /// after it failed; a random one before the first call.
    pub fn endpoint(&self) -> &str {
        self.calls.members[self.calls.preferred()].url()
    }

    /// Reads a key. Returns its value, or `None` if it does not exist or is not UTF-8, and the store's revision. The
    /// read is linearizable: it sees every write that was answered before.
    ///
    /// # Errors
    /// - [`EtcdError::Unreachable`]: no member can answer in time.
    /// - [`EtcdError::Refused`]: etcd refuses, for example because the user may not do this.
    pub fn get<'a>(&'a self, key: &'a str) -> Answer<'a, (Option<KeyValue>, u64)> {
        Box::pin(async move {
            let request = RangeRequest { key: key.into(), ..Default::default() };
            let response = self.range(&format!("read the key `{key}`"), request).await?;
            let revision = revision(response.header.as_ref());
            Ok((response.kvs.into_iter().next().and_then(key_value), revision))
        })
    }

    /// Reads all keys that begin with `prefix`, by ascending key and at one revision. Returns them and that revision.
    /// The read sees every write that was answered before. Keys that are not UTF-8 are left out; an empty prefix
    /// means all keys.
    ///
    /// # Errors
    /// - [`EtcdError::Unreachable`]: no member can answer in time.
    /// - [`EtcdError::Refused`]: etcd refuses, has compacted the revision at three attempts, or has more than
    ///   1,048,576 such keys.
    pub fn list<'a>(&'a self, prefix: &'a str) -> Answer<'a, (Vec<KeyValue>, u64)> {
        Box::pin(async move {
            let what = format!("list the keys `{prefix}…`");
            let mut attempts = 1..=LIST_ATTEMPTS;
            loop {
                attempts.next();
                match self.list_once(&what, prefix).await {
                    Err(EtcdError::Refused(why)) if why.contains("compacted") && !attempts.is_empty() => {}
                    listed => return listed,
                }
            }
        })
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
            // The smallest key after `last`.
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

    /// Executes a transaction and returns its outcome. Conditions that do not hold are no error
    /// ([`TransactionOutcome::succeeded`]).
    ///
    /// # Errors
    /// - [`EtcdError::Unknown`]: the transaction may have been executed although there is no answer: read its keys
    ///   again. It does not occur if the transaction only reads.
    /// - [`EtcdError::Unreachable`]: no member can answer in time. Nothing was written.
    /// - [`EtcdError::Refused`]: etcd refuses, for example more than 128 operations or a lease that has ended.
    ///   Nothing was written.
    pub fn transact(&self, transaction: Txn) -> Answer<'_, TransactionOutcome> {
        Box::pin(async move {
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
        })
    }

    /// Creates a lease of at least `ttl_s` seconds, which runs from when etcd grants it. If the answer is lost, the
    /// unused lease ends by itself.
    ///
    /// # Errors
    /// - [`EtcdError::Unreachable`]: no member can answer in time.
    /// - [`EtcdError::Refused`]: etcd refuses, for example a time to live that long.
    pub fn grant(&self, ttl_s: u64) -> Answer<'_, Lease> {
        Box::pin(async move {
            let message = LeaseGrantRequest { ttl: signed(ttl_s), id: 0 };
            let attempt = |way: MemberCall| {
                let request = way.request(message);
                async move { LeaseClient::new(way.channel).lease_grant(request).await.map(Response::into_inner) }
            };
            let granted = self.calls.call("grant a lease", Repeat::Freely, attempt).await?;
            self.calls.is_latest(granted.header.as_ref());
            Ok(Lease { id: granted.id, ttl_s: store::unsigned(granted.ttl) })
        })
    }

    /// Renews the lease with the number `lease` ([`Lease::id`]). Returns the seconds that it lasts from then on, or
    /// `None` if it has ended. Leases of one client are renewed one after the other. The open stream is tried first,
    /// then each member.
    ///
    /// # Errors
    /// - [`EtcdError::Unreachable`]: no member can answer in time. The lease may have been renewed nevertheless.
    /// - [`EtcdError::Refused`]: etcd refuses, for example because the user may not do this.
    pub fn keep_alive(&self, lease: i64) -> Answer<'_, Option<u64>> {
        Box::pin(async move {
            let mut kept = self.pulse.lock().await;
            // It is put back only with an answer: a caller that is cancelled drops the stream as well.
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
        })
    }

    /// Ends the lease with the number `lease`, and deletes its keys. A lease that has already ended is no error.
    ///
    /// # Errors
    /// - [`EtcdError::Unreachable`]: no member can answer in time. The lease may have ended nevertheless.
    /// - [`EtcdError::Refused`]: etcd refuses, for example because the user may not do this.
    pub fn revoke(&self, lease: i64) -> Answer<'_, ()> {
        Box::pin(async move {
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
        })
    }

    /// Returns a watch of the keys that begin with `prefix`, from revision `from_revision` on; 0 stands for the
    /// changes after the watch is opened, which happens in the first [`Watch::next`]. After a list, pass the revision
    /// after the list's. This makes no call.
    pub fn watch(&self, prefix: &str, from_revision: u64) -> Watch {
        Watch::new(self.calls.clone(), prefix, from_revision)
    }
}
