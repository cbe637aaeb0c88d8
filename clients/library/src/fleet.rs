//! Finds the server of a fleet that has a session, and directs calls to it.
//!
//! A server that does not have a session names the one that does (`ELSEWHERE`), or refuses temporarily while another
//! takes the session over (`FENCED`). A server without a fleet does neither: everything here then costs at most one
//! more call.

use std::time::Duration;

use palpate_proto::pb;
use palpate_refusal::Reason;
use palpate_refusal::status::elsewhere;
use pb::session_service_client::SessionServiceClient;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tonic::Status;
use tonic_types::StatusExt;

use crate::Error;
use crate::connect::{Channel, Server};

/// The answer to a call, and the server of the fleet that gave it, for further calls.
#[derive(Debug, Clone)]
pub struct At<T> {
    /// The server that answered.
    pub server: Server,
    /// The open connection to that server.
    pub channel: Channel,
    /// What the call returned.
    pub answer: T,
}

/// Interval between calls to a server while no server of the fleet has the session.
pub(crate) const AGAIN: Duration = Duration::from_millis(250);

/// Maximum number of servers that are asked for one session.
const MAX_SERVERS: usize = 16;

/// Maximum number of redirections of one call.
const MAX_HOPS: u32 = 8;

/// Returns whether a server of a fleet refused temporarily (`FENCED`): another server is about to have the session, or
/// this one has lost contact with the fleet. An equal call may succeed later.
pub fn is_fenced(status: &Status) -> bool {
    status.get_details_error_info().is_some_and(|info| info.reason == Reason::Fenced.as_str())
}

/// Connects to a fleet and finds the server that has the session with the ID `session_id`. Returns it with the
/// session's status. `server` may be any server of the fleet. Waits while another server takes the session over, at
/// most half a second longer than the time limit for connecting ([`Server::within`]).
///
/// # Errors
/// Returns [`Error::Call`] with the refusal of a server that knows what became of the session (such as `NOT_FOUND`),
/// or with the last temporary refusal; [`Error::Connection`] if no server can be reached in time; and
/// [`Error::Argument`] if the credentials can't be used at the server that has it.
pub async fn locate(server: &Server, session_id: &str) -> Result<At<pb::Session>, Error> {
    Trail::new(server.clone()).seek(session_id).await
}

/// Connects to `server` and calls `call` with the connection. If a refusal names the server that has the session,
/// connects to that and repeats the call there, at most 8 times. While the session is being taken over, repeats the
/// call every quarter of a second, at most for the time limit for connecting ([`Server::within`]). A call whose
/// connection breaks is not repeated.
///
/// ```no_run
/// use palpate_client::watch::Samples;
/// use palpate_client::{Error, Server, fleet};
/// use palpate_proto::pb;
///
/// # async fn example(server: &Server, request: pb::WatchSamplesRequest) -> Result<(), Error> {
/// let mut samples = fleet::follow(server, |channel| Samples::open(channel, request.clone())).await?.answer;
/// println!("{:?}", samples.next().await?);
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// Returns [`Error::Call`] with any other refusal, with how the connection broke, or with the last refusal when the
/// limits above are reached; [`Error::Connection`] if a server can't be reached; and [`Error::Argument`] if the
/// credentials can't be used at the named server.
pub async fn follow<T, F>(server: &Server, call: impl Fn(Channel) -> F) -> Result<At<T>, Error>
where
    F: Future<Output = Result<T, Status>>,
{
    follow_from(server, server.connect().await?, call).await
}

/// Calls `call` like [`follow`], but first over `channel`, an open connection to `server`.
///
/// # Errors
/// Returns the errors of [`follow`].
pub async fn follow_from<T, F>(server: &Server, channel: Channel, call: impl Fn(Channel) -> F) -> Result<At<T>, Error>
where
    F: Future<Output = Result<T, Status>>,
{
    let (mut server, mut channel, mut hops) = (server.clone(), channel, 0);
    let until = Instant::now() + server.patience();
    loop {
        let status = match call(channel.clone()).await {
            Ok(answer) => return Ok(At { server, channel, answer }),
            Err(status) => status,
        };
        match elsewhere(&status) {
            Some(endpoint) if hops < MAX_HOPS => {
                hops += 1;
                server = server.at(&endpoint)?;
                channel = server.connect().await?;
            }
            None if is_fenced(&status) && Instant::now() < until => tokio::time::sleep(AGAIN).await,
            _ => return Err(status.into()),
        }
    }
}

/// Returns the server that has the session `created`, which a call to `server` has just returned: a fleet may have
/// created it on another server. Does not connect. Outside a fleet, returns `server`.
///
/// # Errors
/// Returns [`Error::Argument`] if the credentials can't be used at the other server ([`Server::at`]).
pub fn home(server: &Server, created: &pb::Session) -> Result<Server, Error> {
    match &created.ownership {
        Some(ownership) if ownership.endpoint.trim_end_matches('/') != server.url() => server.at(&ownership.endpoint),
        _ => Ok(server.clone()),
    }
}

/// The servers to ask for a session.
#[derive(Debug)]
pub(crate) struct Trail {
    /// The first server, whose URL the program has.
    first: Server,
    /// The server that last had the session, or was named as having it.
    server: Server,
    /// URLs of other servers.
    others: Vec<String>,
    /// The largest ownership revision seen.
    revision: u64,
    /// Whether the fleet answers, but no server has the session yet.
    is_awaited: bool,
    /// Lease of the newest stream: after a move its tool is still in the tissue, and the next server continues this
    /// lease. Empty if it can't be continued.
    pub(crate) lease_id: String,
    /// Number of the newest command. It increases across all streams: a continued lease ignores commands with smaller
    /// ones.
    pub(crate) sequence: u64,
}

impl Trail {
    pub(crate) fn new(server: Server) -> Self {
        Trail {
            first: server.clone(),
            server,
            others: Vec::new(),
            revision: 0,
            is_awaited: false,
            lease_id: String::new(),
            sequence: 0,
        }
    }

    /// Returns the server to ask first.
    pub(crate) fn server(&self) -> &Server {
        &self.server
    }

    /// Returns whether, when [`Trail::seek`] last failed, the fleet answered but no server had the session yet.
    pub(crate) fn is_awaited(&self) -> bool {
        self.is_awaited
    }

    /// Sets the server that was named as having the session.
    ///
    /// # Errors
    /// Returns an error if the credentials can't be used there.
    pub(crate) fn go(&mut self, endpoint: &str) -> Result<(), Error> {
        let next = self.server.at(endpoint)?;
        let before = std::mem::replace(&mut self.server, next).url().to_owned();
        self.others.retain(|url| *url != before);
        self.others.insert(0, before);
        self.others.truncate(MAX_SERVERS);
        Ok(())
    }

    /// Returns whether the owner with this revision is not outdated, and records the largest revision seen.
    pub(crate) fn is_current(&mut self, revision: u64) -> bool {
        let is_current = revision >= self.revision;
        self.revision = self.revision.max(revision);
        is_current
    }

    /// Finds the server that has the session. Asks servers one after another: the next one when the current can't be
    /// reached, refuses temporarily, or is silent for a quarter of a second, and a server that is named as the owner
    /// at once. Repeats the question to those that do not have the session.
    ///
    /// Returns any other refusal at once; returns the last answer when no server can be reached, or the time limit
    /// for connecting has passed.
    /// may take to connect.
    pub(crate) async fn seek(&mut self, session_id: &str) -> Result<At<pb::Session>, Error> {
        self.is_awaited = false;
        let mut round = Round::new(session_id, self.server.clone(), self.first.clone());
        round.rest = self.others.clone();
        round.rest.push(self.first.url().to_owned());
        let over = tokio::time::sleep(self.first.patience() + 2 * AGAIN);
        tokio::pin!(over);
        loop {
            let (server, answer) = tokio::select! {
                () = &mut over => return Err(round.last.unwrap_or_else(silent)),
                Some(told) = round.answers.recv() => told,
                () = tokio::time::sleep_until(round.turn), if !round.rest.is_empty() => {
                    round.ask_next();
                    continue;
                }
            };
            let error = match answer {
                Ok((_, session)) if session.ownership.as_ref().is_some_and(|own| own.revision < self.revision) => {
                    Error::Connection(format!("{}: it does not serve the session any more", server.url()))
                }
                Ok((channel, session)) => {
                    self.learn(server.clone(), session.ownership.as_ref());
                    return Ok(At { server, channel, answer: session });
                }
                Err(error) => error,
            };
            match &error {
                Error::Call(status) => match elsewhere(status) {
                    Some(endpoint) => {
                        self.is_awaited = true;
                        let next = server.at(&endpoint)?;
                        let why = format!("the server at {endpoint} has the session, but can't be reached");
                        round.last = Some(Error::Connection(why));
                        round.ask(next);
                    }
                    None if is_fenced(status) => {
                        self.is_awaited = true;
                        round.last = Some(error);
                        round.ask_next();
                    }
                    None if is_broken(status) => round.fail(&server, error, self.is_awaited),
                    // A server that answers this knows the session's fate.
                    None => {
                        self.server = server;
                        return Err(error);
                    }
                },
                Error::Argument(_) => return Err(error),
                _ => round.fail(&server, error, self.is_awaited),
            }
            if !self.is_awaited && round.is_lost() {
                return Err(round.last.unwrap_or_else(silent));
            }
        }
    }

    fn learn(&mut self, server: Server, ownership: Option<&pb::Ownership>) {
        self.server = server;
        (self.others, self.revision) = match ownership {
            Some(ownership) => {
                let others = ownership.others.iter().take(MAX_SERVERS).cloned().collect();
                (others, ownership.revision)
            }
            None => (Vec::new(), 0),
        };
    }
}

fn silent() -> Error {
    Error::Connection("no server answers".to_owned())
}

/// Returns whether a call did not reach the server, or its answer did not arrive.
fn is_broken(status: &Status) -> bool {
    std::error::Error::source(status).is_some() || status.code() == tonic::Code::Unavailable
}

/// The answer of a server.
type ServerMetadata = (Server, Result<(Channel, pb::Session), Error>);

/// The servers that are being asked for a session.
struct Round {
    session_id: String,
    /// The server whose credentials are used for all.
    first: Server,
    /// URLs of the servers not asked yet.
    rest: Vec<String>,
    /// URLs of the servers being asked, and whether they can't be reached.
    asked: Vec<(String, bool)>,
    asking: JoinSet<()>,
    tell: mpsc::Sender<ServerMetadata>,
    answers: mpsc::Receiver<ServerMetadata>,
    /// When the next one is asked.
    turn: Instant,
    last: Option<Error>,
}

impl Round {
    fn new(session_id: &str, server: Server, first: Server) -> Self {
        let (tell, answers) = mpsc::channel(MAX_SERVERS);
        let mut round = Round {
            session_id: session_id.to_owned(),
            first,
            rest: Vec::new(),
            asked: Vec::new(),
            asking: JoinSet::new(),
            tell,
            answers,
            turn: Instant::now(),
            last: None,
        };
        round.ask(server);
        round
    }

    /// Starts to ask a server repeatedly, unless it is being asked already.
    fn ask(&mut self, server: Server) {
        if self.asked.len() >= MAX_SERVERS || self.asked.iter().any(|(url, _)| url == server.url()) {
            return;
        }
        self.asked.push((server.url().to_owned(), false));
        self.turn = Instant::now() + AGAIN;
        self.asking.spawn(ask(server, self.session_id.clone(), self.tell.clone()));
    }

    fn ask_next(&mut self) {
        let before = self.asked.len();
        while !self.rest.is_empty() && self.asked.len() == before {
            let next = self.rest.remove(0);
            // Servers for which the credentials can't be used are skipped.
            if let Ok(next) = self.first.at(&next) {
                self.ask(next);
            }
        }
    }

    /// Records that a server can't be reached, and asks the next. An answer of the fleet is kept as the last error.
    fn fail(&mut self, server: &Server, error: Error, has_answer: bool) {
        if !has_answer {
            self.last = Some(error);
        }
        self.asked.iter_mut().filter(|(url, _)| url == server.url()).for_each(|(_, is_lost)| *is_lost = true);
        self.ask_next();
    }

    /// Returns whether no server can be reached.
    fn is_lost(&self) -> bool {
        self.rest.is_empty() && self.asked.iter().all(|(_, is_lost)| *is_lost)
    }
}

/// Asks a server for a session until the answers are no longer received.
async fn ask(server: Server, session_id: String, tell: mpsc::Sender<ServerMetadata>) {
    let mut channel = None;
    loop {
        let request = pb::GetSessionRequest { session_id: session_id.clone() };
        let asking = async {
            let open = match channel.take() {
                Some(open) => open,
                None => server.connect().await?,
            };
            let answer = SessionServiceClient::new(open.clone()).get_session(request).await;
            channel =
                answer.as_ref().is_err_and(|status| !is_broken(status) || is_fenced(status)).then(|| open.clone());
            let session = answer?.into_inner().session;
            let session = session.ok_or_else(|| Error::Connection("the server sent no session".to_owned()))?;
            Ok((open, session))
        };
        let asked = tokio::time::timeout(server.patience() + AGAIN, asking).await;
        let late = |_| Err(Error::Connection(format!("{} is silent", server.url())));
        if tell.send((server.clone(), asked.unwrap_or_else(late))).await.is_err() {
            return;
        }
        tokio::time::sleep(AGAIN).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Credentials;

    fn server(url: &str) -> Server {
        Server::new(url, &Credentials::default()).unwrap()
    }

    #[test]
    fn a_smaller_revision_does_not_speak_for_the_session() {
        let mut trail = Trail::new(server("http://127.0.0.1:1"));
        let seen = [3, 3, 5, 4, 5].map(|revision| trail.is_current(revision));
        assert_eq!(seen, [true, true, true, false, true]);
        // A server without a fleet has no revisions.
        trail.learn(server("http://127.0.0.1:1"), None);
        assert!(trail.is_current(0));
    }

    #[test]
    fn whoever_had_the_session_is_asked_after_who_is_said_to_have_it() {
        let mut trail = Trail::new(server("http://127.0.0.1:1"));
        let others = ["http://127.0.0.1:3/", "http://127.0.0.1:4"].map(str::to_owned).to_vec();
        let ownership = pb::Ownership { revision: 7, others, ..Default::default() };
        trail.learn(server("http://127.0.0.1:2"), Some(&ownership));
        trail.go("http://127.0.0.1:4").unwrap();
        assert_eq!(trail.server().url(), "http://127.0.0.1:4");
        assert_eq!(trail.others[0], "http://127.0.0.1:2");
        assert!(!trail.is_current(6));
        assert!(trail.go("ftp://127.0.0.1").is_err());
        assert_eq!(trail.server().url(), "http://127.0.0.1:4");
    }

    #[test]
    fn a_session_is_where_its_creator_says() {
        let near = server("http://127.0.0.1:1");
        let made_at = |endpoint: &str| {
            let ownership = pb::Ownership { endpoint: endpoint.to_owned(), ..Default::default() };
            let created = pb::Session { ownership: Some(ownership), ..Default::default() };
            home(&near, &created).unwrap().url().to_owned()
        };
        assert_eq!(home(&near, &pb::Session::default()).unwrap().url(), near.url());
        assert_eq!(made_at("http://127.0.0.1:1/"), near.url());
        assert_eq!(made_at("http://127.0.0.1:2"), "http://127.0.0.1:2");
    }
}
