//! Tickets for datagram sessions: 128 random bits, each valid for one session, within ten seconds.

use std::collections::HashMap;
use std::time::Duration;

use tokio::sync::oneshot;
use wtransport::Connection;

use palpate_realtime::ids::random_bits;
use palpate_refusal::Result;

/// The future session that presents a ticket.
pub(in crate::server) type Arrival = oneshot::Receiver<Connection>;

/// Time for which a ticket is valid.
pub(in crate::server) const GOOD: Duration = Duration::from_secs(10);
const GOOD_NS: u64 = 1_000_000_000 * GOOD.as_secs();

/// Maximum number of outstanding tickets; each belongs to a stream or a call.
const MAX_TICKETS: usize = 4096;

/// The outstanding tickets.
#[derive(Debug, Default)]
pub(super) struct Tickets(HashMap<[u8; 16], Ticket>);

#[derive(Debug)]
struct Ticket {
    given_ns: u64,
    whose: oneshot::Sender<Connection>,
}

impl Tickets {
    /// Creates a ticket. Returns it and the future session that presents it; `None` if too many are outstanding.
    pub(super) fn give(&mut self, now_ns: u64) -> Result<Option<([u8; 16], Arrival)>> {
        if self.0.len() >= MAX_TICKETS {
            self.0.retain(|_, ticket| ticket.is_good(now_ns));
        }
        if self.0.len() >= MAX_TICKETS {
            return Ok(None);
        }
        let number = random_bits()?.to_be_bytes();
        let (whose, arrival) = oneshot::channel();
        self.0.insert(number, Ticket { given_ns: now_ns, whose });
        Ok(Some((number, arrival)))
    }

    /// Takes the ticket out of a path, `/touch/` and 32 hexadecimal digits. Returns where to send its session; `None`
    /// if there is no valid ticket.
    pub(super) fn take(&mut self, path: &str, now_ns: u64) -> Option<oneshot::Sender<Connection>> {
        let digits = path.strip_prefix("/touch/").filter(|digits| digits.len() == 32 && digits.is_ascii())?;
        let number = u128::from_str_radix(digits, 16).ok()?.to_be_bytes();
        self.0.remove(&number).filter(|ticket| ticket.is_good(now_ns)).map(|ticket| ticket.whose)
    }
}

impl Ticket {
    fn is_good(&self, now_ns: u64) -> bool {
        now_ns.saturating_sub(self.given_ns) <= GOOD_NS && !self.whose.is_closed()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(number: [u8; 16]) -> String {
        format!("/touch/{:032x}", u128::from_be_bytes(number))
    }

    #[test]
    fn a_ticket_is_good_once_for_ten_seconds_and_as_long_as_its_stream_is_there() {
        let mut tickets = Tickets::default();
        let (number, arrival) = tickets.give(0).unwrap().unwrap();
        for wrong in ["", "/touch/", "/touch/1", "/touch/+0000000000000000000000000000001", &path([7; 16])] {
            assert!(tickets.take(wrong, 1).is_none(), "{wrong}");
        }
        assert!(tickets.take(&path(number), GOOD_NS).is_some());
        assert!(tickets.take(&path(number), GOOD_NS).is_none(), "once");
        let (number, old) = tickets.give(0).unwrap().unwrap();
        assert!(tickets.take(&path(number), GOOD_NS + 1).is_none(), "too old");
        let (number, gone) = tickets.give(0).unwrap().unwrap();
        drop((arrival, old, gone));
        assert!(tickets.take(&path(number), 1).is_none(), "its stream has ended");
    }

    #[test]
    fn tickets_are_bounded_and_make_room_as_they_lapse() {
        let mut tickets = Tickets::default();
        let kept: Vec<_> = std::iter::from_fn(|| tickets.give(0).unwrap()).collect();
        assert_eq!(kept.len(), MAX_TICKETS);
        assert!(tickets.give(GOOD_NS).unwrap().is_none());
        assert!(tickets.give(GOOD_NS + 1).unwrap().is_some());
        assert_eq!(tickets.0.len(), 1);
    }
}
