//! The messages that a haptic stream sends to its client: samples, laws, rejections.

use std::collections::VecDeque;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use palpate_proto::pb;
use tonic::Status;

use super::event::StreamEvent;
use crate::server::datagrams::DatagramChannel;
use crate::server::force_law::Updates;
use crate::server::recovered::Notices;
use crate::server::session_instruments::JoinedInstruments;
use palpate_realtime::StreamGuard;
use palpate_realtime::clock::now_ns;
use palpate_realtime::queue::Reader;
use palpate_refusal::Reason;
use palpate_session::sample_selection::PacedSample;
use palpate_session::wire;

/// Longest interval between samples on the stream while they go by datagram, ns.
const HEARTBEAT_NS: u64 = 1_000_000_000;

/// The sources of a haptic stream's messages. Samples go by datagram while those arrive.
pub(super) struct ResponseStream {
    updates: Option<Updates>,
    events: Reader<StreamEvent>,
    samples: Reader<PacedSample>,
    notices: Notices,
    channel: Arc<DatagramChannel>,
    instruments: JoinedInstruments,
    /// When the last sample was sent on the stream, ns.
    streamed_ns: u64,
    /// The messages before the next sample, and that sample.
    ready: VecDeque<pb::touch_response::Message>,
    /// Number of answers that were dropped because the client was too slow.
    dropped_answers: u64,
    guard: StreamGuard,
}

impl ResponseStream {
    pub(super) fn new(
        updates: Option<Updates>,
        events: Reader<StreamEvent>,
        samples: Reader<PacedSample>,
        notices: Notices,
        guard: StreamGuard,
        channel: Arc<DatagramChannel>,
        instruments: JoinedInstruments,
    ) -> Self {
        ResponseStream {
            updates,
            events,
            samples,
            notices,
            channel,
            instruments,
            streamed_ns: 0,
            ready: VecDeque::new(),
            dropped_answers: 0,
            guard,
        }
    }

    /// Polls for the next message of the stream; `None` at its end.
    pub(super) fn poll(
        &mut self,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<pb::touch_response::Message, Status>>> {
        use pb::touch_response::Message;
        loop {
            if let Some(message) = self.ready.pop_front() {
                return Poll::Ready(Some(Ok(message)));
            }
            if let Some(updates) = &mut self.updates
                && let Poll::Ready(told) = updates.poll(context)
            {
                match told {
                    Some(update) => return Poll::Ready(Some(Ok(Message::ForceLaw(update)))),
                    None => self.updates = None,
                }
            }
            if let Poll::Ready(event) = self.events.poll_pop(context) {
                return Poll::Ready(match event {
                    Ok((StreamEvent::Rejected(rejection), dropped_answers)) => {
                        self.dropped_answers = dropped_answers;
                        Some(Ok(Message::Rejection(pb::Rejection { dropped_answers, ..rejection })))
                    }
                    Ok((StreamEvent::Renewed { client_time_ns, arrival_ns, datagrams }, _)) => {
                        let server_hold_ns = now_ns().saturating_sub(arrival_ns);
                        Some(Ok(Message::Renewed(pb::Renewed { client_time_ns, server_hold_ns, datagrams })))
                    }
                    Ok((StreamEvent::TissueChanged(step), _)) => Some(Ok(Message::ForceLaw(pb::ForceLawUpdate {
                        tissue_step: Some(step),
                        reason: Reason::NotAvailable.as_str().to_owned(),
                        message: "an instrument has no force law".to_owned(),
                        ..Default::default()
                    }))),
                    Ok((StreamEvent::Failed(status), _)) => Some(Err(status)),
                    Ok((StreamEvent::Finished, _)) => None,
                    Err(refusal) => Some(Err(refusal.into())),
                });
            }
            let (paced, dropped) = match ready!(self.samples.poll_pop(context)) {
                Ok(popped) => popped,
                Err(refusal) => return Poll::Ready(Some(Err(refusal.into()))),
            };
            self.updates.iter().for_each(|updates| updates.follow(&paced.sample));
            let dropped_answers = self.dropped_answers;
            let told = |rejection| Message::Rejection(pb::Rejection { dropped_answers, ..rejection });
            self.ready.extend(self.notices.of(&paced.sample).into_iter().map(told));
            let mut sample = wire::sample::sample(&paced, self.guard.shape(), dropped, now_ns());
            let overloads = self.instruments.add_to(&mut sample, &paced.sample);
            self.ready.extend(overloads.into_iter().map(Message::JawOverload));
            // The stream has a heartbeat of its own, which shows a client that it still works.
            let (now, by_datagram) = (now_ns(), self.channel.send(&sample));
            if !by_datagram || now.saturating_sub(self.streamed_ns) >= HEARTBEAT_NS {
                self.streamed_ns = now;
                self.ready.push_back(Message::Sample(sample));
            }
        }
    }
}
