//! Errors of calls to etcd: whether the call was executed, and what to do about it.

use std::error::Error;

use tonic::{Code, ConnectError, Status};

/// Why a call to etcd was not executed, or may not have been. Each contains a message for people, with advice.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EtcdError {
    /// No member can be reached, or none knows of a leader. Nothing was read or written by a transaction; but a lease
    /// may have been granted, which ends by itself, renewed or ended. Try again.
    #[error("{0}")]
    Unreachable(String),
    /// etcd has refused, or the options are wrong: the same call would fail again. Nothing was done.
    #[error("{0}")]
    Refused(String),
    /// A transaction was sent and its answer was lost: it was executed, or was not, or will be soon. Read its keys
    /// again. If they don't show it, repeat it only with comparisons that can't hold if the first one was executed
    /// after all.
    #[error("{0}")]
    Unknown(String),
}

/// Result of a call to etcd.
pub type EtcdResult<T> = std::result::Result<T, EtcdError>;

/// What an error in an answer implies for the request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ErrorVerdict {
    /// Every member would refuse the request.
    Refused,
    /// The request was not executed here; another member may execute it.
    Elsewhere,
    /// The request was not executed because the token is not valid, or no longer.
    Stale,
    /// The request may have been executed.
    Lost,
}

/// Classifies an error. An error that is not known to be harmless is [`ErrorVerdict::Lost`].
pub(super) fn judge(status: &Status) -> ErrorVerdict {
    if is_of_transport(status) {
        let mut causes = std::iter::successors(status.source(), |&cause| cause.source());
        let unconnected = causes.any(<dyn Error>::is::<ConnectError>);
        return if unconnected { ErrorVerdict::Elsewhere } else { ErrorVerdict::Lost };
    }
    let says = |text: &str| status.message().contains(text);
    match status.code() {
        Code::Unauthenticated => ErrorVerdict::Stale,
        Code::Unknown | Code::InvalidArgument if says("revision of auth store is old") => ErrorVerdict::Stale,
        // "no leader" comes before anything is executed, because requests ask for a leader.
        Code::Unavailable if says("no leader") || says("not capable") || says("for learner") => ErrorVerdict::Elsewhere,
        Code::ResourceExhausted if says("too many requests") => ErrorVerdict::Elsewhere,
        Code::FailedPrecondition if says("not leader") => ErrorVerdict::Elsewhere,
        // tonic's own error for an answer that is too large.
        Code::OutOfRange if says("decoded message length") => ErrorVerdict::Lost,
        Code::InvalidArgument
        | Code::NotFound
        | Code::AlreadyExists
        | Code::PermissionDenied
        | Code::ResourceExhausted
        | Code::FailedPrecondition
        | Code::OutOfRange
        | Code::Unimplemented => ErrorVerdict::Refused,
        _ => ErrorVerdict::Lost,
    }
}

/// Returns whether the connection has failed, rather than etcd.
pub(super) fn is_of_transport(status: &Status) -> bool {
    status.source().is_some()
}

/// Returns the text of an error, without etcd's prefix.
pub(super) fn text(status: &Status) -> String {
    match status.source() {
        Some(source) => root(source),
        None => status.message().trim_start_matches("etcdserver: ").to_owned(),
    }
}

/// Returns the text of an error's innermost cause; its own text if it has no cause.
pub fn root(error: &(dyn Error + 'static)) -> String {
    std::iter::successors(Some(error), |&cause| cause.source()).last().map(ToString::to_string).unwrap_or_default()
}

/// Returns what to do about a refusal, from its text.
pub(super) fn advice(refusal: &str) -> &'static str {
    const ADVICE: [(&str, &str); 8] = [
        (
            "permission denied",
            "name a user of etcd who may use these keys (`etcdctl role grant-permission` grants them)",
        ),
        ("authentication failed", "check the user's name and the file of its password"),
        (
            "user name is empty",
            "name a user of etcd and the file of its password, or a certificate with the user's name",
        ),
        ("authentication is not enabled", "run `etcdctl auth enable`, or name no user"),
        ("invalid auth token", "name a user of etcd and the file of its password"),
        (
            "space exceeded",
            "compact and defragment etcd, disarm its alarm, or give it more space (--quota-backend-bytes)",
        ),
        ("lease not found", "the lease has ended: grant another"),
        ("unknown service", "check that this is the port for clients of an etcd, version 3.4 or later"),
    ];
    ADVICE.iter().find(|(says, _)| refusal.contains(says)).map_or("see the log of etcd", |(_, todo)| todo)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_may_have_been_done_is_never_sent_again() {
        for (code, message, verdict) in [
            (Code::Unavailable, "etcdserver: request timed out", ErrorVerdict::Lost),
            (Code::Unavailable, "etcdserver: server stopped", ErrorVerdict::Lost),
            (Code::Unavailable, "etcdserver: leader changed", ErrorVerdict::Lost),
            (Code::Unknown, "anything", ErrorVerdict::Lost),
            (Code::Cancelled, "", ErrorVerdict::Lost),
            (Code::OutOfRange, "Error, decoded message length too large", ErrorVerdict::Lost),
            (Code::Unavailable, "etcdserver: no leader", ErrorVerdict::Elsewhere),
            (Code::ResourceExhausted, "etcdserver: too many requests", ErrorVerdict::Elsewhere),
            (Code::ResourceExhausted, "etcdserver: mvcc: database space exceeded", ErrorVerdict::Refused),
            (Code::OutOfRange, "etcdserver: mvcc: required revision has been compacted", ErrorVerdict::Refused),
            (Code::Unauthenticated, "etcdserver: invalid auth token", ErrorVerdict::Stale),
        ] {
            assert_eq!(judge(&Status::new(code, message)), verdict, "{message}");
        }
    }

    #[test]
    fn only_a_connection_that_was_not_made_is_known_to_have_sent_nothing() {
        let broken = std::io::Error::other("reset");
        assert_eq!(judge(&Status::from_error(broken.into())), ErrorVerdict::Lost);
        let unmade = ConnectError(std::io::Error::other("refused").into());
        assert_eq!(judge(&Status::from_error(unmade.into())), ErrorVerdict::Elsewhere);
    }
}
