//! Datagrams for a client that can't open a haptic stream: poses of the tools of a lease, and samples.

use std::future::poll_fn;
use std::sync::Arc;

use palpate_proto::pb;
use prost::Message;
use tracing::{Instrument, debug, info};

use super::event::StreamEvent;
use super::lease_controller::LeaseController;
use super::response_stream::ResponseStream;
use super::stream::KeepaliveTimer;
use super::tools::lease_id;
use crate::server::datagrams::{Arrival, DatagramChannel, GOOD, not_available};
use crate::server::recovered::Notices;
use crate::server::services::Services;
use crate::server::session_instruments::Instruments;
use palpate_realtime::StreamKind;
use palpate_realtime::queue::{Writer, queue};
use palpate_refusal::{Refusal, Result};
use palpate_session::budget::Account;
use palpate_session::wire;

/// A datagram session that was offered for a lease.
struct LeaseSession {
    controller: LeaseController,
    responses: ResponseStream,
    channel: Arc<DatagramChannel>,
    arrival: Option<Arrival>,
    events: Writer<StreamEvent>,
}

/// Offers a datagram session for the tools of a lease, and serves it in a task of its own.
pub(super) async fn offer(
    services: &Services,
    request: &pb::OpenDatagramsRequest,
    account: &Account,
) -> Result<pb::DatagramOffer> {
    let handle = services.seat("OpenDatagrams", &request.session_id).await?.handle;
    let lease = lease_id(&request.lease_id)?;
    let (every, deadband) = (request.sample_every_steps, request.deadband.as_ref());
    let (tools, step) = handle.at_intake(|intake, now| {
        intake.renew(lease, now)?;
        Ok::<_, Refusal>((intake.tools_of(lease).collect::<Vec<u32>>(), intake.next_step()))
    })?;
    let mut sampling = wire::sample::sampling(every, Some(tools.clone()), deadband, request.heartbeat_s, false)?;
    let guard = handle.open_stream("OpenDatagrams", StreamKind::HoldsTools, account)?;
    let (offer, arrival) = services.datagrams.offer()?.ok_or_else(not_available)?;
    let (limits, traffic) = (&services.config.limits, services.traffic.clone());
    // Tools of AcquireTool are led one by one: they are in no instrument.
    let instruments = Instruments::default();
    let controller =
        LeaseController::new(handle.clone(), lease, &tools, None, true, limits, traffic, instruments.clone());
    let channel = Arc::new(DatagramChannel::new(controller.pace()));
    sampling.wanted = Some(channel.wanted());
    let (events, heard) = queue(limits.queued_samples);
    let cut = guard.cut().clone();
    let samples = handle.samples(sampling, Some(account));
    let notices = Notices::new(tools, step);
    let instruments = services.instruments.join(&handle.id, instruments, false);
    let responses = ResponseStream::new(None, heard, samples, notices, guard, channel.clone(), instruments);
    let session = LeaseSession { controller, responses, channel, arrival: Some(arrival), events };
    let serving = async move {
        tokio::select! {
            why = session.serve() => debug!("datagrams of a lease ended: {why}"),
            () = cut.cancelled() => info!("datagrams of a lease were cut"),
        }
    };
    tokio::spawn(serving.in_current_span());
    Ok(offer)
}

impl LeaseSession {
    /// Serves until the lease or the session ends; returns the reason.
    async fn serve(self) -> String {
        let LeaseSession { mut controller, mut responses, channel, mut arrival, events } = self;
        // Until the session arrives, it counts as a stream of the simulated session.
        let Ok(Some(connection)) = tokio::time::timeout(GOOD, channel.arrive(&mut arrival)).await else {
            return "nobody took the ticket".to_owned();
        };
        let telling = async {
            let mut stream = match connection.open_uni().await {
                Ok(opening) => opening.await.map_err(|error| error.to_string())?,
                Err(error) => return Err(error.to_string()),
            };
            loop {
                let message = match poll_fn(|context| responses.poll(context)).await {
                    Some(Ok(message)) => pb::TouchResponse { message: Some(message) },
                    Some(Err(status)) => return Err(status.message().to_owned()),
                    None => return Ok(()),
                };
                let mut bytes = Vec::with_capacity(4 + message.encoded_len());
                bytes.extend(u32::try_from(message.encoded_len()).unwrap_or(u32::MAX).to_le_bytes());
                message.encode(&mut bytes).map_err(|error| error.to_string())?;
                stream.write_all(&bytes).await.map_err(|error| error.to_string())?;
            }
        };
        let mut life = KeepaliveTimer::of(true);
        let (handle, lease) = (controller.handle.clone(), controller.lease);
        let listening = async {
            loop {
                tokio::select! {
                    datagram = channel.next(&mut arrival) => {
                        if let Err(refusal) = controller.datagram(datagram, &events) {
                            return refusal.to_string();
                        }
                    }
                    () = life.tick() => {
                        channel.stay_alive();
                        if handle.at_intake(|intake, _| intake.tools_of(lease).next().is_none()) {
                            return "the lease is over".to_owned();
                        }
                    }
                }
            }
        };
        tokio::select! {
            told = telling => told.err().unwrap_or_default(),
            why = listening => why,
            closed = connection.closed() => closed.to_string(),
        }
    }
}
