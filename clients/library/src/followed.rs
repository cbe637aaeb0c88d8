//! A session, wherever in its fleet it is: calls go to the server that has it, and streams are opened there again.

use std::sync::{Mutex, MutexGuard, PoisonError};

use palpate_proto::pb;
use palpate_refusal::Reason;
use palpate_refusal::status::elsewhere;
use tonic::Status;
use tonic_types::StatusExt;

use crate::Error;
use crate::connect::{Channel, Server};
use crate::fleet::{At, Trail};

/// How often a call goes on to another server, or to one that has the session again.
const MAX_MOVES: u32 = 8;

/// A session that is followed from server to server. A server of no fleet is called as any client does.
#[derive(Debug)]
pub struct Followed {
    session_id: String,
    place: Mutex<LastOwner>,
    /// Only one call at a time asks who has the session: others wait for what it finds.
    seeking: tokio::sync::Mutex<Trail>,
}

/// Who had the session at last.
#[derive(Debug, Clone)]
struct LastOwner {
    server: Server,
    channel: Channel,
    /// Counts the places.
    number: u64,
    /// The largest revision of an owner that was seen.
    revision: u64,
}

/// Returns whether the call may find the session at another server: it has moved, or its server is gone, or is about to
/// be.
pub fn is_away(status: &Status) -> bool {
    let is_broken = std::error::Error::source(status).is_some() || status.code() == tonic::Code::Unavailable;
    elsewhere(status).is_some() || is_broken
}

/// Whether the server ends in order.
fn is_ending(status: &Status) -> bool {
    status.get_details_error_info().is_some_and(|info| info.reason == Reason::ShuttingDown.as_str())
}

impl Followed {
    /// Creates a session that `server` has, or had at last, with a connection to it.
    pub fn new(server: Server, channel: Channel, session_id: String) -> Self {
        let place = LastOwner { server: server.clone(), channel, number: 0, revision: 0 };
        Followed { session_id, place: Mutex::new(place), seeking: Trail::new(server).into() }
    }

    /// Returns a session that `server` knows of, or has made: another of its fleet may have it.
    ///
    /// # Errors
    /// Returns the refusal of whoever has the session, or why nobody can be reached.
    pub async fn find(server: Server, channel: Channel, session_id: String) -> Result<(Self, pb::Session), Error> {
        let followed = Followed::new(server, channel, session_id);
        let session = followed.seek(None).await?;
        Ok((followed, session))
    }

    /// Returns the session's ID.
    pub fn session_id(&self) -> &str {
        &self.session_id
    }

    /// Returns the server that had the session at last.
    pub fn server(&self) -> Server {
        self.place().server.clone()
    }

    fn place(&self) -> MutexGuard<'_, LastOwner> {
        self.place.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns whether who says this revision still speaks for the session.
    pub fn is_current(&self, revision: u64) -> bool {
        let mut place = self.place();
        place.revision = place.revision.max(revision);
        revision == place.revision
    }

    /// Asks who has the session, after a refusal that says so, or none.
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

    /// Calls the server that has the session. Where the call finds that another has it, or that the server is gone, it is made again
    /// at the one that has the session then. A call whose answer was lost is made a second time, too.
    ///
    /// # Errors
    /// Returns the refusal of whoever has the session, or why nobody can be reached.
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
            // Unless another call has found it by now.
            if self.place().number == number {
                self.after(status).await?;
            }
        }
    }

    /// Finds who has the session after a call or a stream has ended with `status`. Then open it again, by [`Followed::call`].
    ///
    /// # Errors
    /// Returns `status` if it is for good; the refusal of whoever has the session, or why nobody can be reached.
    pub async fn after(&self, status: Status) -> Result<(), Error> {
        if !is_away(&status) {
            return Err(status.into());
        }
        match self.seek(Some(&status)).await {
            // Of no fleet: its own words say more.
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
