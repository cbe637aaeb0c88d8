//! The haptic stream: commands to tools, and samples of what they feel.

use palpate_proto::pb;
use pb::haptic_service_client::HapticServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio_stream::{Stream, StreamExt};
use tonic::{Status, Streaming};

use crate::connect::Channel;

/// A haptic stream that a server has opened: commands go to tools that it leases, samples of these come back. It ends
/// when this is dropped; the server then releases its tools.
#[derive(Debug)]
pub struct Touch {
    opened: pb::TouchOpened,
    inbound: Streaming<pb::TouchResponse>,
}

impl Touch {
    /// Opens a stream and waits for the server's `opened`. Sends `open`, then `messages` as they are produced; when
    /// they end, so does the stream. The server may take some time to compute a force law: set a time limit around
    /// this call.
    ///
    /// ```no_run
    /// use palpate_client::{Channel, Touch};
    /// use palpate_proto::pb;
    /// use pb::touch_request::Message;
    /// use tokio_stream::wrappers::ReceiverStream;
    ///
    /// # async fn example(channel: Channel, open: pb::TouchOpen, command: pb::Command) -> Result<(), tonic::Status> {
    /// let (say, messages) = tokio::sync::mpsc::channel(64);
    /// let mut touch = Touch::open(channel, open, ReceiverStream::new(messages)).await?;
    /// // The receiver lives as long as the stream.
    /// let _ = say.send(Message::Command(command)).await;
    /// while let Some(message) = touch.next().await? {
    ///     println!("{message:?}");
    /// }
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// Returns the server's refusal, or how the connection broke; `INTERNAL` if the server ends the stream or sends
    /// something else before `opened`.
    pub async fn open<S>(channel: Channel, open: pb::TouchOpen, messages: S) -> Result<Self, Status>
    where
        S: Stream<Item = Say> + Send + 'static,
    {
        let outbound = tokio_stream::once(Say::Open(open)).chain(messages);
        let outbound = outbound.map(|message| pb::TouchRequest { message: Some(message) });
        let mut inbound = HapticServiceClient::new(channel).touch(outbound).await?.into_inner();
        // The first message answers `open`, or is an error.
        match inbound.message().await?.and_then(|response| response.message) {
            Some(Heard::Opened(opened)) => Ok(Touch { opened, inbound }),
            _ => Err(Status::internal("the server did not open the stream")),
        }
    }

    /// Returns the server's answer to `open`: the force law, the next step, warnings.
    pub fn opened(&self) -> &pb::TouchOpened {
        &self.opened
    }

    /// Waits for the next message of the server and returns it; `None` after the server has ended the stream without
    /// an error. Dropping the future loses no message.
    ///
    /// # Errors
    /// Returns why the server ended the stream, or how the connection broke.
    pub async fn next(&mut self) -> Result<Option<Heard>, Status> {
        while let Some(response) = self.inbound.message().await? {
            // A newer server may send messages that this client does not know.
            if response.message.is_some() {
                return Ok(response.message);
            }
        }
        Ok(None)
    }
}
