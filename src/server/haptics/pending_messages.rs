//! Messages that a client sends before its haptic stream is open.

use std::collections::VecDeque;

use palpate_proto::pb;
use tonic::{Status, Streaming};

/// Messages that a client sends before its stream is open, which may take as long as a force law does. They are read
/// from the transport, which cuts connections whose small messages nobody reads.
#[derive(Default)]
pub(super) struct PendingMessages {
    said: VecDeque<Result<Option<pb::TouchRequest>, Status>>,
    /// Number of commands dropped in favour of newer ones; and tool and sequence number of the newest of these.
    pub(super) refused: usize,
    pub(super) dropped: VecDeque<(u32, u64)>,
}

impl PendingMessages {
    /// Waits for `opening`, and keeps the newest `most` messages that arrive in the meantime.
    pub(super) async fn gather<T>(
        &mut self,
        opening: impl Future<Output = T>,
        inbound: &mut Streaming<pb::TouchRequest>,
        most: usize,
    ) -> T {
        use pb::touch_request::Message;
        let mut opening = std::pin::pin!(opening);
        loop {
            // After the end, or a message that is not expected now, nothing more is read.
            let goes_on = self.said.back().is_none_or(|said| {
                let message = said.as_ref().ok().and_then(|said| said.as_ref()?.message.as_ref());
                matches!(message, Some(Message::Command(_) | Message::Renew(_)))
            });
            tokio::select! {
                opened = &mut opening => return opened,
                message = inbound.message(), if goes_on => self.said.push_back(message),
            }
            if self.said.len() > most
                && let Some(Ok(Some(pb::TouchRequest { message: Some(Message::Command(old)) }))) = self.said.pop_front()
            {
                self.refused += 1;
                self.dropped.push_back((old.tool, old.sequence.unwrap_or_default()));
                if self.dropped.len() > most {
                    self.dropped.pop_front();
                }
            }
        }
    }

    /// Returns the next message, first of those kept.
    pub(super) async fn next(
        &mut self,
        inbound: &mut Streaming<pb::TouchRequest>,
    ) -> Result<Option<pb::TouchRequest>, Status> {
        match self.said.pop_front() {
            Some(said) => said,
            None => inbound.message().await,
        }
    }
}
