//! Receives the journals of sessions for which this server is the standby.

use std::sync::Arc;

use palpate_proto::pb;
use pb::mirror_request::Message;
use tokio::sync::mpsc;
use tonic::{Status, Streaming};

use super::Fleet;
use palpate_refusal::{Reason, Refusal};

type Tell = mpsc::Sender<Result<pb::MirrorResponse, Status>>;

impl Fleet {
    /// Receives the journals of a server until its stream ends. Confirms over `tell` what is on the disk.
    pub(in crate::server) async fn receive(self: Arc<Self>, mut inbound: Streaming<pb::MirrorRequest>, tell: Tell) {
        let stream = self.stand_by.new_stream();
        let why = self.receive_from(stream, &mut inbound, &tell).await;
        self.stand_by.stream_ended(stream);
        if let Err(status) = why {
            let _ = tell.send(Err(status)).await;
        }
    }

    async fn receive_from(
        self: &Arc<Self>,
        stream: u64,
        inbound: &mut Streaming<pb::MirrorRequest>,
        tell: &Tell,
    ) -> Result<(), Status> {
        let mut node = String::new();
        while let Some(pb::MirrorRequest { message }) = inbound.message().await? {
            match message {
                Some(Message::Open(open)) => {
                    node = open.node;
                    let mirrored = self.stand_by.stream_begins(&node, stream);
                    let _ = tell.send(Ok(pb::MirrorResponse { mirrored })).await;
                }
                _ if node.is_empty() => return Err(Refusal::new(Reason::OutOfTurn, "open", "must come first").into()),
                Some(Message::Parts(parts)) => {
                    let (fleet, from) = (self.clone(), node.clone());
                    let taken =
                        tokio::task::spawn_blocking(move || fleet.stand_by.take((&from, stream), &parts.parts)).await;
                    let mirrored = taken.map_err(|error| Status::internal(error.to_string()))??;
                    let _ = tell.send(Ok(pb::MirrorResponse { mirrored })).await;
                }
                Some(Message::End(end)) => {
                    self.stand_by.forget_from(&node, &end.session_id);
                    // A confirmation, by which the sender tells older reports from newer ones.
                    let forgotten = pb::Mirrored { session_id: end.session_id, run: 0, durable_bytes: 0 };
                    let _ = tell.send(Ok(pb::MirrorResponse { mirrored: vec![forgotten] })).await;
                }
                None => {}
            }
        }
        Ok(())
    }
}
