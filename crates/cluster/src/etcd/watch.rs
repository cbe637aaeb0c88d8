//! Watches: changes of keys as they happen, each once and in order, even when a member fails.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use palpate_proto::etcd::etcdserverpb::watch_client::WatchClient;
use palpate_proto::etcd::etcdserverpb::watch_request::RequestUnion;
use palpate_proto::etcd::etcdserverpb::{WatchCreateRequest, WatchProgressRequest, WatchRequest, WatchResponse};
use palpate_proto::etcd::mvccpb;
use palpate_proto::etcd::mvccpb::event::EventType;
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Status, Streaming};

use super::calls::{MemberCall, MemberCalls, Repeat};
use super::error::{EtcdError, text};
use super::member::BACK_OFF;
use super::store::{KeyValue, key_value, prefix_range, revision, signed, unsigned};

/// Size limit of a message, bytes: etcd splits larger ones at about 2 MB.
const LARGEST_BYTES: usize = 16 << 20;

/// Watch number in answers that belong to no watch.
const NO_WATCH: i64 = -1;

/// A change of a key, as [`Watch::next`] returns it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum WatchEvent {
    /// The key was written, at its `mod_revision`.
    Put(KeyValue),
    /// The key was deleted, or its lease has ended.
    Delete {
        /// The key.
        key: String,
        /// Revision of the deletion.
        revision: u64,
    },
}

/// Why a watch has ended for good. Failures of connections do not end it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WatchError {
    /// etcd no longer has the changes since the last one seen: list the keys, and watch from the revision after
    /// that list's.
    #[error("etcd no longer has the changes since revision {since}: list the keys again")]
    Compacted {
        /// The first revision that was missed.
        since: u64,
    },
    /// etcd refuses the watch, and would refuse it again.
    #[error("{0}")]
    Refused(String),
}

/// Changes of the keys that begin with a prefix, each once and in order. It works only while a [`Watch::next`] is
/// polled, and reads no more from etcd than fits the connection's window. It has a connection of its own, so its
/// backlog delays nothing else; dropping it closes that.
pub struct Watch {
    calls: Arc<MemberCalls>,
    /// Index of the member at which it was last open; `usize::MAX` before the first.
    member: Arc<AtomicUsize>,
    /// Future of the next batch. A caller that is cancelled leaves it here for the next call, so nothing is lost.
    next: Pin<Box<dyn Future<Output = (Following, WatchEvents)> + Send>>,
}

type WatchEvents = Result<Vec<WatchEvent>, WatchError>;

impl std::fmt::Debug for Watch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Watch").field("endpoint", &self.endpoint()).finish_non_exhaustive()
    }
}

impl Watch {
    pub(super) fn new(calls: Arc<MemberCalls>, prefix: &str, from: u64) -> Self {
        let member = Arc::new(AtomicUsize::new(usize::MAX));
        let place = WatchPosition { from, seen: 0 };
        let prefix = prefix.to_owned();
        let following =
            Following { calls: calls.clone(), member: member.clone(), prefix, place, open: None, ended: None };
        Watch { calls, member, next: Box::pin(following.next()) }
    }

    /// Waits for the next changes and returns them by ascending revision, at least one. Keys that are not UTF-8 are
    /// left out. The changes of one transaction come together, unless they exceed about a megabyte. You may cancel
    /// the call at any time: nothing is lost.
    ///
    /// It waits while etcd can't be reached; a renewal of a lease reports that sooner.
    ///
    /// # Errors
    /// Returns [`WatchError::Compacted`] if etcd no longer has the changes since the last ones, or
    /// [`WatchError::Refused`]; then every further call returns the same error.
    pub async fn next(&mut self) -> Result<Vec<WatchEvent>, WatchError> {
        let (following, batch) = self.next.as_mut().await;
        self.next = Box::pin(following.next());
        batch
    }

    /// Returns the address of the member at which the watch is or was last open; `None` before it was first opened.
    pub fn endpoint(&self) -> Option<&str> {
        self.calls.members.get(self.member.load(Ordering::Relaxed)).map(super::member::Member::url)
    }
}

/// Position of a watch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct WatchPosition {
    /// First revision that is not wholly seen; 0 before a watch of new changes was opened.
    from: u64,
    /// Number of events of that revision that were seen.
    seen: usize,
}

impl WatchPosition {
    /// Returns the position after events of these revisions. More events of the last revision follow if `parted`.
    fn after(self, revisions: impl Iterator<Item = u64>, parted: bool) -> WatchPosition {
        let mut place = self;
        for revision in revisions {
            let seen = if revision == place.from { place.seen + 1 } else { 1 };
            place = WatchPosition { from: revision, seen };
        }
        if parted { place } else { WatchPosition { from: place.from + 1, seen: 0 } }
    }
}

/// State of a watch, which each future of [`Watch::next`] owns and hands back.
struct Following {
    calls: Arc<MemberCalls>,
    member: Arc<AtomicUsize>,
    prefix: String,
    place: WatchPosition,
    open: Option<WatchStream>,
    ended: Option<WatchError>,
}

/// An open stream.
struct WatchStream {
    member: usize,
    questions: mpsc::Sender<WatchRequest>,
    answers: Streaming<WatchResponse>,
    /// Whether a request for progress is unanswered.
    asked: bool,
    /// Number of events of the first revision that were seen before the connection broke, and are skipped.
    again: usize,
}

/// Why a stream has ended.
enum Break {
    Ended(WatchError),
    Broken,
}

impl Following {
    async fn next(mut self) -> (Self, WatchEvents) {
        loop {
            if let Some(ended) = &self.ended {
                let ended = ended.clone();
                return (self, Err(ended));
            }
            let Some(open) = &mut self.open else {
                match self.open().await {
                    Ok(open) => {
                        self.member.store(open.member, Ordering::Relaxed);
                        self.open = Some(open);
                    }
                    Err(EtcdError::Refused(why)) => self.ended = Some(WatchError::Refused(why)),
                    Err(EtcdError::Unreachable(_) | EtcdError::Unknown(_)) => sleep(BACK_OFF).await,
                }
                continue;
            };
            match open.receive(&mut self.place, self.calls.limit).await {
                Ok(events) if events.is_empty() => {}
                Ok(events) => return (self, Ok(events)),
                Err(end) => {
                    self.calls.pass_over(open.member);
                    self.open = None;
                    if let Break::Ended(why) = end {
                        self.ended = Some(why);
                    }
                }
            }
        }
    }

    /// Opens the watch at a member, from its position on.
    async fn open(&mut self) -> Result<WatchStream, EtcdError> {
        let (key, range_end) = prefix_range(&self.prefix);
        let create = WatchCreateRequest {
            key,
            range_end,
            start_revision: signed(self.place.from),
            progress_notify: true,
            fragment: true,
        };
        let what = format!("watch the keys `{}…`", self.prefix);
        let calls = &self.calls;
        let attempt = |way: MemberCall| {
            let create = create.clone();
            async move {
                let channel = calls.members[way.member].connect().await.map_err(Status::unavailable)?;
                opened(way, channel, create).await
            }
        };
        let (mut open, now) = calls.call(&what, Repeat::Freely, attempt).await?;
        if self.place.from == 0 {
            self.place.from = now + 1;
        }
        open.again = self.place.seen;
        Ok(open)
    }
}

/// Opens a stream. Returns it and the store's revision at which etcd has accepted the watch.
async fn opened(way: MemberCall, channel: Channel, create: WatchCreateRequest) -> Result<(WatchStream, u64), Status> {
    let (questions, asked) = mpsc::channel(2);
    let create = WatchRequest { request_union: Some(RequestUnion::CreateRequest(create)) };
    questions.try_send(create).map_err(|_| ended())?;
    let mut client = WatchClient::new(channel).max_decoding_message_size(LARGEST_BYTES);
    let mut answers = client.watch(way.request(ReceiverStream::new(asked))).await?.into_inner();
    let first = answers.message().await?.ok_or_else(ended)?;
    if !first.created {
        return Err(Status::unavailable("has not opened the watch"));
    }
    if first.canceled && first.compact_revision == 0 {
        // etcd also reports an invalid token in this way.
        return Err(Status::unauthenticated(first.cancel_reason));
    }
    let open = WatchStream { member: way.member, questions, answers, asked: false, again: 0 };
    Ok((open, revision(first.header.as_ref())))
}

impl WatchStream {
    /// Waits up to `limit` for etcd's next message. Returns its events, none if it reports no change, and moves
    /// `place` beyond them.
    async fn receive(
        &mut self,
        place: &mut WatchPosition,
        limit: std::time::Duration,
    ) -> Result<Vec<WatchEvent>, Break> {
        let Ok(answer) = timeout(limit, self.answers.message()).await else {
            // A member that works answers this at once.
            let progress = WatchRequest { request_union: Some(RequestUnion::ProgressRequest(WatchProgressRequest {})) };
            let silent = std::mem::replace(&mut self.asked, true) || self.questions.try_send(progress).is_err();
            return if silent { Err(Break::Broken) } else { Ok(Vec::new()) };
        };
        let answer = match answer {
            Ok(Some(answer)) => answer,
            Ok(None) => return Err(Break::Broken),
            Err(status) => {
                tracing::debug!("a watch of etcd broke: {}", text(&status));
                return Err(Break::Broken);
            }
        };
        self.asked = false;
        if answer.compact_revision > 0 {
            return Err(Break::Ended(WatchError::Compacted { since: place.from }));
        }
        if answer.canceled {
            return Err(Break::Broken);
        }
        // Answers to our requests do not show which changes have been sent: before etcd 3.4.25 they may overtake
        // changes.
        if answer.watch_id == NO_WATCH || answer.created {
            return Ok(Vec::new());
        }
        if answer.events.is_empty() {
            let next = revision(answer.header.as_ref()) + 1;
            if next > place.from {
                *place = WatchPosition { from: next, seen: 0 };
            }
            return Ok(Vec::new());
        }
        let first = *place;
        let mut events = answer.events;
        events.retain(|event| {
            let revision = written(event);
            let seen = revision == first.from && self.again > 0;
            self.again -= usize::from(seen);
            revision >= first.from && !seen
        });
        if events.is_empty() {
            return Ok(Vec::new());
        }
        *place = place.after(events.iter().map(written), answer.fragment);
        Ok(events.into_iter().filter_map(watch_event).collect())
    }
}

/// Returns the revision of an event.
fn written(event: &mvccpb::Event) -> u64 {
    event.kv.as_ref().map_or(0, |kv| unsigned(kv.mod_revision))
}

/// Converts an event. `None` if the key is not UTF-8: such a key belongs to another program.
fn watch_event(event: mvccpb::Event) -> Option<WatchEvent> {
    let deleted = event.r#type() == EventType::Delete;
    let kv = key_value(event.kv?)?;
    Some(if deleted { WatchEvent::Delete { key: kv.key, revision: kv.mod_revision } } else { WatchEvent::Put(kv) })
}

fn ended() -> Status {
    Status::unavailable("has ended the watch")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_place_is_within_a_revision_while_parts_of_it_come() {
        let place = WatchPosition { from: 7, seen: 0 };
        assert_eq!(place.after([7, 9].into_iter(), false), WatchPosition { from: 10, seen: 0 });
        let within = place.after([8, 9, 9].into_iter(), true);
        assert_eq!(within, WatchPosition { from: 9, seen: 2 });
        assert_eq!(within.after([9].into_iter(), true), WatchPosition { from: 9, seen: 3 });
        assert_eq!(within.after([9, 9, 11].into_iter(), false), WatchPosition { from: 12, seen: 0 });
    }
}
