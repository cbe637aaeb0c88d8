//! Datagrams for a client that can't open a haptic stream: poses of the tools of a lease, and samples.

use std::future::poll_fn;
use std::sync::Arc;

use palpate_proto::pb;
use prost::Message;
use tracing::{Instrument, debug, info};

use super::event::Event;
use super::holder::Holder;
use super::outlet::Outlet;
use super::stream::Life;
use super::tools::lease_id;
use crate::budget::Account;
use crate::pace::StreamKind;
use crate::pace::queue::{Writer, queue};
use crate::refusal::{Refusal, Result};
use crate::server::datagrams::{Arrival, GOOD, Way, not_available};
use crate::server::recovered::Notices;
use crate::server::services::Services;
use crate::wire;

/// A session that was offered for a lease.
struct LeaseSession {
    holder: Holder,
    outlet: Outlet,
    way: Arc<Way>,
    arrival: Option<Arrival>,
    events: Writer<Event>,
}

/// Offers datagrams for the tools of a lease.
pub(super) async fn offer(
    services: &Services,
    request: &pb::OpenDatagramsRequest,
    account: &Account,
) -> Result<pb::DatagramOffer> {
    let live = services.session(&request.session_id).await?;
    let lease = lease_id(&request.lease_id)?;
    let (every, deadband) = (request.sample_every_steps, request.deadband.as_ref());
    let (tools, step) = live.at_intake(|intake, now| {
        intake.renew(lease, now)?;
        Ok::<_, Refusal>((intake.tools_of(lease).collect::<Vec<u32>>(), intake.next_step()))
    })?;
    let mut sampling = wire::sample::sampling(every, Some(tools.clone()), deadband, request.heartbeat_s, false)?;
    let guard = live.open_stream("OpenDatagrams", StreamKind::HoldsTools, account)?;
    let (offer, arrival) = services.datagrams.offer()?.ok_or_else(not_available)?;
    let (limits, traffic) = (&services.config.limits, services.traffic.clone());
    let holder = Holder::new(live.clone(), lease, &tools, None, true, limits, traffic);
    let way = Arc::new(Way::new(holder.pace()));
    sampling.wanted = Some(way.wanted());
    let (events, heard) = queue(limits.queued_samples);
    let cut = guard.cut().clone();
    let samples = live.samples(sampling, Some(account));
    let outlet = Outlet::new(None, heard, samples, Notices::new(tools, step), guard, way.clone());
    let session = LeaseSession { holder, outlet, way, arrival: Some(arrival), events };
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
    /// Serves until the lease or the session ends; says why it did.
    async fn serve(self) -> String {
        let LeaseSession { mut holder, mut outlet, way, mut arrival, events } = self;
        // Until then it has a place among the streams of the session.
        let Ok(Some(connection)) = tokio::time::timeout(GOOD, way.arrive(&mut arrival)).await else {
            return "nobody took the ticket".to_owned();
        };
        let telling = async {
            let mut stream = match connection.open_uni().await {
                Ok(opening) => opening.await.map_err(|error| error.to_string())?,
                Err(error) => return Err(error.to_string()),
            };
            loop {
                let message = match poll_fn(|context| outlet.poll(context)).await {
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
        let mut life = Life::of(true);
        let (live, lease) = (holder.live.clone(), holder.lease);
        let listening = async {
            loop {
                tokio::select! {
                    datagram = way.next(&mut arrival) => {
                        if let Err(refusal) = holder.datagram(datagram, &events) {
                            return refusal.to_string();
                        }
                    }
                    () = life.tick() => {
                        way.stay_alive();
                        if live.at_intake(|intake, _| intake.tools_of(lease).next().is_none()) {
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
