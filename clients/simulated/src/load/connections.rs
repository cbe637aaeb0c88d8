//! Connections that the clients of a load share.

use std::collections::BTreeMap;

use palpate_client::{Channel, Error, Server};

use super::plan::LoadPlan;

/// Purpose of a connection. Frames have their own connections: on a shared one, they would delay samples.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum ConnectionPurpose {
    Call,
    Touch,
    View,
}

/// Connections, each shared by a limited number of streams.
pub(crate) struct Connections {
    max_streams: u32,
    /// The newest connection and its number of streams, by whether it is for frames and by the server.
    newest: BTreeMap<(bool, String), (Channel, u32)>,
}

impl Connections {
    pub(crate) fn new(plan: &LoadPlan) -> Self {
        Connections { max_streams: plan.clients_per_connection, newest: BTreeMap::new() }
    }

    /// Returns a connection to a server with room for the stream of a client or viewer; a call needs no room.
    pub(crate) async fn to(&mut self, server: &Server, purpose: ConnectionPurpose) -> Result<Channel, Error> {
        let streams = u32::from(purpose != ConnectionPurpose::Call);
        let key = (purpose == ConnectionPurpose::View, server.url().to_owned());
        if let Some((channel, streams_so_far)) = self.newest.get_mut(&key)
            && *streams_so_far + streams <= self.max_streams
        {
            *streams_so_far += streams;
            return Ok(channel.clone());
        }
        let channel = server.connect().await?;
        self.newest.insert(key, (channel.clone(), streams));
        Ok(channel)
    }
}
