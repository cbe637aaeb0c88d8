//! Leases: the stream that keeps them alive, with one request and its answer at a time.

use palpate_proto::etcd::etcdserverpb::lease_client::LeaseClient;
use palpate_proto::etcd::etcdserverpb::{LeaseKeepAliveRequest, LeaseKeepAliveResponse};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming};

use super::calls::{MemberCall, MemberCalls};

/// A lease of etcd: keys that are written with it are deleted when it ends, because it was not renewed in time or was
/// revoked. Dropping this does not end it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lease {
    /// Number of the lease, for [`Op::Put`](super::Op::Put) and [`Etcd::keep_alive`](super::Etcd::keep_alive).
    pub id: i64,
    /// Seconds that the lease lasts after each renewal, as etcd granted: at least the requested time.
    pub ttl_s: u64,
}

/// An open keepalive stream. It is dropped as soon as an answer is late: that answer would be taken for the next
/// one.
pub(super) struct LeaseKeepAlive {
    pub(super) member: usize,
    /// Number of the connection.
    pub(super) number: u64,
    questions: mpsc::Sender<LeaseKeepAliveRequest>,
    answers: Streaming<LeaseKeepAliveResponse>,
}

impl LeaseKeepAlive {
    /// Opens a stream and renews `lease` with it. Returns the stream and the seconds that the lease lasts; `None`
    /// if it has ended.
    pub(super) async fn open(way: MemberCall, calls: &MemberCalls, lease: i64) -> Result<(Self, Option<u64>), Status> {
        let (questions, asked) = mpsc::channel(1);
        // etcd does not even confirm the stream before it has a request.
        questions.try_send(LeaseKeepAliveRequest { id: lease }).map_err(|_| ended())?;
        let request = way.request(ReceiverStream::new(asked));
        let answers = LeaseClient::new(way.channel).lease_keep_alive(request).await?.into_inner();
        let mut pulse = LeaseKeepAlive { member: way.member, number: way.number, questions, answers };
        let ttl_s = pulse.answer(calls, lease).await?;
        Ok((pulse, ttl_s))
    }

    /// Renews a lease. Returns the seconds that it lasts, or `None` if it has ended.
    pub(super) async fn ask(&mut self, calls: &MemberCalls, lease: i64) -> Result<Option<u64>, Status> {
        self.questions.try_send(LeaseKeepAliveRequest { id: lease }).map_err(|_| ended())?;
        self.answer(calls, lease).await
    }

    async fn answer(&mut self, calls: &MemberCalls, lease: i64) -> Result<Option<u64>, Status> {
        let answer = self.answers.message().await?.ok_or_else(ended)?;
        if answer.id != lease {
            return Err(Status::unavailable("answers for another lease"));
        }
        // A leader that was frozen while another was elected would renew leases that are no longer its own.
        if !calls.is_latest(answer.header.as_ref()) {
            return Err(Status::unavailable("has not heard of the present leader"));
        }
        Ok(u64::try_from(answer.ttl).ok().filter(|&ttl_s| ttl_s > 0))
    }
}

fn ended() -> Status {
    Status::unavailable("has ended the stream that keeps leases alive")
}
