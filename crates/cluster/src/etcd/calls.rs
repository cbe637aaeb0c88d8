//! One call at any member that answers: which members are tried, for how long, and which are skipped for a while.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use palpate_proto::etcd::etcdserverpb::ResponseHeader;
use tokio::time::{Instant, sleep, timeout};
use tonic::metadata::MetadataValue;
use tonic::transport::Channel;
use tonic::{Request, Status};

use super::error::{ErrorVerdict, EtcdError, EtcdResult, advice, is_of_transport, judge, text};
use super::login::{Login, Token};
use super::member::{BACK_OFF, Member};
use super::options::EtcdOptions;

/// First wait between two rounds of attempts; it doubles up to [`BACK_OFF`].
const FIRST_WAIT: Duration = Duration::from_millis(25);

/// All members, and the state that calls share.
pub(super) struct MemberCalls {
    pub(super) members: Vec<Member>,
    /// Time limit of an attempt.
    pub(super) limit: Duration,
    login: Login,
    /// Index of the member that answered last.
    preferred: AtomicUsize,
    /// The latest raft term in any answer so far.
    term: AtomicU64,
}

/// One attempt at a member: the connection and token that it uses.
pub(super) struct MemberCall {
    pub(super) member: usize,
    /// Number of the connection.
    pub(super) number: u64,
    pub(super) channel: Channel,
    token: Option<Token>,
}

impl MemberCall {
    /// Returns a request that has our token and that a member without a leader refuses.
    pub(super) fn request<M>(&self, message: M) -> Request<M> {
        let mut request = Request::new(message);
        request.metadata_mut().insert("hasleader", MetadataValue::from_static("true"));
        if let Some(token) = &self.token {
            request.metadata_mut().insert("token", token.value.clone());
        }
        request
    }
}

/// Whether a call may be executed twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Repeat {
    /// Twice has the same effect as once.
    Freely,
    /// Repeat only if it was certainly not executed.
    Never,
}

/// Result of an attempt at one member.
enum Attempt<T> {
    Done(T),
    Refused(String),
    NotDone(String),
    Lost(String),
}

impl MemberCalls {
    pub(super) fn new(options: EtcdOptions, limit: Duration) -> EtcdResult<Self> {
        let uris = options.checked()?;
        let options = Arc::new(options);
        // Clients begin at a random member, to spread their load.
        let mut random = [0; 4];
        let first = getrandom::fill(&mut random).map_or(0, |()| u32::from_le_bytes(random) as usize % uris.len());
        let members = uris.into_iter().map(|uri| Member::new(uri, options.clone(), limit)).collect();
        let (preferred, term) = (AtomicUsize::new(first), AtomicU64::new(0));
        Ok(MemberCalls { members, limit, login: Login::new(options), preferred, term })
    }

    /// Returns the index of the member that answered last.
    pub(super) fn preferred(&self) -> usize {
        self.preferred.load(Ordering::Relaxed)
    }

    /// Makes calls begin at the member after `member`, unless they already begin at another.
    pub(super) fn pass_over(&self, member: usize) {
        let next = (member + 1) % self.members.len();
        let _ = self.preferred.compare_exchange(member, next, Ordering::Relaxed, Ordering::Relaxed);
    }

    /// Keeps the raft term of an answer if it is the latest. Returns whether it is: an older term comes from a
    /// member that has not yet heard of the present leader.
    pub(super) fn is_latest(&self, header: Option<&ResponseHeader>) -> bool {
        let term = header.map_or(0, |header| header.raft_term);
        self.term.fetch_max(term, Ordering::Relaxed) <= term
    }

    /// Executes a call at the first member that can. New attempts begin until all members together have had the
    /// time of one attempt each; an attempt under way may still finish.
    pub(super) async fn call<T, F, A>(&self, what: &str, repeat: Repeat, attempt: F) -> EtcdResult<T>
    where
        F: Fn(MemberCall) -> A,
        A: Future<Output = std::result::Result<T, Status>>,
    {
        let count = self.members.len();
        let end = Instant::now() + self.limit * u32::try_from(count).unwrap_or(1);
        let mut reasons = BTreeMap::new();
        let mut wait = FIRST_WAIT;
        loop {
            let first = self.preferred();
            for member in (first..first + count).map(|index| index % count) {
                let url = self.members[member].url();
                match self.attempt(member, &attempt).await {
                    Attempt::Done(answer) => {
                        self.preferred.store(member, Ordering::Relaxed);
                        return Ok(answer);
                    }
                    Attempt::Refused(why) => {
                        let todo = advice(&why);
                        return Err(EtcdError::Refused(format!("etcd at {url} refuses to {what}: {why}; {todo}")));
                    }
                    Attempt::Lost(why) if repeat == Repeat::Never => {
                        self.pass_over(member);
                        let todo = "read its keys again before you repeat it";
                        let why = format!("etcd at {url} may or may not have done this: {what}: {why}; {todo}");
                        return Err(EtcdError::Unknown(why));
                    }
                    Attempt::NotDone(why) | Attempt::Lost(why) => {
                        self.pass_over(member);
                        reasons.insert(url, why);
                    }
                }
                if Instant::now() >= end {
                    break;
                }
            }
            if Instant::now() + wait >= end {
                let reasons: Vec<String> = reasons.iter().map(|(url, why)| format!("{url}: {why}")).collect();
                let todo =
                    "check that most members run, that they reach each other, and that this machine reaches them";
                let why = format!("no member of etcd can {what} ({}); {todo}", reasons.join("; "));
                return Err(EtcdError::Unreachable(why));
            }
            sleep(wait).await;
            wait = (2 * wait).min(BACK_OFF);
        }
    }

    async fn attempt<T, F, A>(&self, index: usize, attempt: &F) -> Attempt<T>
    where
        F: Fn(MemberCall) -> A,
        A: Future<Output = std::result::Result<T, Status>>,
    {
        let member = &self.members[index];
        let (number, channel) = match member.line().await {
            Ok(line) => line,
            Err(why) => return Attempt::NotDone(why),
        };
        let mut stale = None;
        loop {
            let token = match timeout(self.limit, self.login.token(&channel, stale)).await {
                Ok(Ok(token)) => token,
                Ok(Err(status)) if judge(&status) == ErrorVerdict::Refused => return Attempt::Refused(text(&status)),
                Ok(Err(status)) => {
                    if is_of_transport(&status) {
                        member.give_up(number).await;
                    }
                    return Attempt::NotDone(text(&status));
                }
                Err(_) => {
                    member.give_up(number).await;
                    return Attempt::NotDone(member.silent());
                }
            };
            let used = token.as_ref().map(|token| token.number);
            let way = MemberCall { member: index, number, channel: channel.clone(), token };
            let status = match timeout(self.limit, attempt(way)).await {
                Ok(Ok(answer)) => return Attempt::Done(answer),
                Ok(Err(status)) => status,
                Err(_) => {
                    member.give_up(number).await;
                    return Attempt::Lost(member.silent());
                }
            };
            if is_of_transport(&status) {
                member.give_up(number).await;
            }
            match judge(&status) {
                // Once: a refusal of a new token is final.
                ErrorVerdict::Stale if used.is_some() && stale.is_none() => stale = used,
                ErrorVerdict::Stale | ErrorVerdict::Refused => return Attempt::Refused(text(&status)),
                ErrorVerdict::Elsewhere => return Attempt::NotDone(text(&status)),
                ErrorVerdict::Lost => return Attempt::Lost(text(&status)),
            }
        }
    }
}
