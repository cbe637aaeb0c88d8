//! A session that is followed through its fleet: calls go to the server that has it, and streams are reopened there.

use std::sync::{Mutex, MutexGuard, PoisonError};

use palpate_proto::pb;
use palpate_refusal::Reason;
use palpate_refusal::status::elsewhere;
use tonic::Status;
use tonic_types::StatusExt;

use crate::Error;
use crate::connect::{Channel, Server};
use crate::fleet::{At, Trail};

/// Maximum number of times that one call is repeated at another server, or at a server that has the session again.
const MAX_MOVES: u32 = 8;

/// A session that is followed from server to server of its fleet: it keeps a connection to the one that last had it.
/// With a server outside a fleet, calls simply go to that one. Any number of tasks may use it at once.
#[derive(Debug)]
pub struct Followed {
    session_id: String,
    place: Mutex<LastOwner>,
    /// Only one call at a time searches for the server that has the session: others wait for its result.
    seeking: tokio::sync::Mutex<Trail>,
}

/// The server that last had the session.
#[derive(Debug, Clone)]
struct LastOwner {
    server: Server,
    channel: Channel,
    /// Number of servers found so far.
    number: u64,
    /// The largest ownership revision seen.
    revision: u64,
}

/// Returns whether a call that ended with `status` may find the session at another server: the refusal names one or is
/// temporary, the connection broke, or the server is not available or about to end.
pub fn is_away(status: &Status) -> bool {
    let is_broken = std::error::Error::source(status).is_some() || status.code() == tonic::Code::Unavailable;
    elsewhere(status).is_some() || is_broken
}

/// Returns whether the server is shutting down in an orderly way.
fn is_ending(status: &Status) -> bool {
    status.get_details_error_info().is_some_and(|info| info.reason == Reason::ShuttingDown.as_str())
}

impl Followed {
    /// Creates a followed session from its ID, the server that has it or last had it, and an open connection to that
    /// server. Calls nothing: the session need not exist.
    pub fn new(server: Server, channel: Channel, session_id: String) -> Self {
        let place = LastOwner { server: server.clone(), channel, number: 0, revision: 0 };
        Followed { session_id, place: Mutex::new(place), seeking: Trail::new(server).into() }
    }

    /// Finds a session that `server` knows or has created: another server of its fleet may have it. Returns it with
    /// its status. `channel` is an open connection to `server`. Waits like [`crate::fleet::locate`].
    ///
    /// # Errors
    /// Returns the errors of [`crate::fleet::locate`].
    pub async fn find(server: Server, channel: Channel, session_id: String) -> Result<(Self, pb::Session), Error> {
        let followed = Followed::new(server, channel, session_id);
        let session = followed.seek(None).await?;
        Ok((followed, session))
    }

    /// Returns the session's ID.
    pub fn session_id(&self) -> &str {
        &self.session_id
    }

    /// Returns the server that last had the session, as far as this has found out.
    pub fn server(&self) -> Server {
        self.place().server.clone()
    }

    fn place(&self) -> MutexGuard<'_, LastOwner> {
        self.place.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns whether no newer ownership revision than `revision` was seen so far, and remembers it if it is newer.
    /// Ignore messages of a stream for whose revision this returns false: their server no longer has the session.
    pub fn is_current(&self, revision: u64) -> bool {
        let mut place = self.place();
        place.revision = place.revision.max(revision);
        revision == place.revision
    }

    /// Finds the server that has the session, starting with the one that `refused` names, if any. Returns the
    /// session.
    async fn seek(&self, refused: Option<&Status>) -> Result<pb::Session, Error> {
        let mut trail = self.seeking.lock().await;
        if let Some(endpoint) = refused.and_then(elsewhere) {
            trail.go(&endpoint)?;
        }
        let At { server, channel, answer } = trail.seek(&self.session_id).await?;
        let revision = answer.ownership.as_ref().map_or(0, |ownership| ownership.revision);
        let mut place = self.place();
        *place = LastOwner { server, channel, number: place.number + 1, revision: place.revision.max(revision) };
        Ok(answer)
    }

    /// Calls `call` with a connection to the server that has the session. If that has moved or its server is gone
    /// ([`is_away`]), repeats the call at the server that has it then, at most 8 times. A call whose answer was lost
    /// is repeated too, so it may take effect twice. Sets no time limit for the call itself.
    ///
    /// # Errors
    /// Returns [`Error::Call`] with a refusal that no other server would change, or with that of the ninth attempt;
    /// otherwise the errors of [`Followed::after`].
    pub async fn call<T, F>(&self, call: impl Fn(Channel) -> F) -> Result<T, Error>
    where
        F: Future<Output = Result<T, Status>>,
    {
        let mut moves = 0;
        loop {
            let LastOwner { channel, number, .. } = self.place().clone();
            let status = match call(channel).await {
                Ok(answer) => return Ok(answer),
                Err(status) => status,
            };
            moves += 1;
            if !is_away(&status) || moves > MAX_MOVES {
                return Err(status.into());
            }
            // Unless another call has found it in the meantime.
            if self.place().number == number {
                self.after(status).await?;
            }
        }
    }

    /// Finds the server that has the session after a call or a stream has ended with `status`. Waits like
    /// [`crate::fleet::locate`]. Then open the stream again, by [`Followed::call`].
    ///
    /// # Errors
    /// Returns `status` if no other server would change it ([`is_away`]), and if its server is shutting down and no
    /// other can be reached; otherwise the errors of [`crate::fleet::locate`].
    pub async fn after(&self, status: Status) -> Result<(), Error> {
        if !is_away(&status) {
            return Err(status.into());
        }
        match self.seek(Some(&status)).await {
            // A server outside a fleet: its own message explains more.
            Err(Error::Connection(_)) if is_ending(&status) => Err(status.into()),
            sought => sought.map(drop),
        }
    }
}

#[cfg(test)]
mod tests {
    use palpate_refusal::Refusal;

    use super::*;

    #[test]
    fn a_session_may_be_elsewhere_after_what_tells_of_a_move_or_of_a_server_that_is_gone() {
        let refused = |reason| {
            Status::from(Refusal { place: Some("http://127.0.0.1:2".to_owned()), ..Refusal::new(reason, "", "") })
        };
        assert!(
            [Reason::Elsewhere, Reason::Fenced, Reason::ShuttingDown].iter().all(|reason| is_away(&refused(*reason)))
        );
        assert!(is_away(&Status::unavailable("the connection broke")));
        for reason in [Reason::UnknownSession, Reason::SessionDeleted, Reason::NotHolder] {
            assert!(!is_away(&refused(reason)), "{reason:?}");
        }
        assert!(!is_away(&Status::internal("a fault")));
    }
}
