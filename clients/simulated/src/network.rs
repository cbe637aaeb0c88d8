//! A simulated network: decides whether and when a message arrives. Time is an argument: virtual in `link`, real in
//! `proxy`.
//!
//! **A stream** (TCP): nothing is lost and messages stay in order, but a lost packet delays all later ones until it has been
//! retransmitted: arrival = max(arrival of the message before, sent + delay + jitter + (RTT … RTO if lost)).
//!
//! **Datagrams**: a lost message stays lost, and messages overtake each other: arrival = sent + delay + jitter.
//!
//! Losses are independent, or come in bursts (Gilbert 1960): a state in which everything is lost, left with
//! probability 1/length at each message. An outage loses everything that is sent during it; a stream sends it again
//! afterwards.
//!
//! **A link of limited rate** comes before all that. A message waits in its queue for those sent before. A datagram
//! that finds the queue full is dropped (the tail of the queue, as in most routers). A stream's sender holds back
//! what does not fit, so it is only late, until the buffers of its computer are full; then messages are dropped, as a
//! server drops samples.

use std::collections::VecDeque;

use crate::random::Random;

/// How messages travel. Parsed from `stream` or `datagram`; other texts are refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Transport {
    /// A gRPC stream over TCP: a lost packet delays all later ones.
    #[default]
    Stream,
    /// Datagrams over UDP: a lost packet is lost alone.
    Datagram,
}

impl Transport {
    /// Returns its name in options, `stream` or `datagram`.
    pub fn name(self) -> &'static str {
        match self {
            Transport::Stream => "stream",
            Transport::Datagram => "datagram",
        }
    }
}

impl std::str::FromStr for Transport {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let found = [Transport::Stream, Transport::Datagram].into_iter().find(|transport| transport.name() == name);
        found.ok_or_else(|| "must be stream or datagram".to_owned())
    }
}

/// The conditions of a network. The default delays and loses nothing. No value is checked.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Conditions {
    /// How messages travel.
    pub transport: Transport,
    /// Round-trip time without jitter, s.
    pub round_trip_s: f64,
    /// Standard deviation of the delay each way, s: normally distributed, but no message arrives before it has left
    /// the link.
    pub jitter_s: f64,
    /// Fraction of the messages that are lost, 0 to below 1; a stream delivers them later instead.
    pub loss: f64,
    /// Mean number of messages lost in succession; up to 1, each is lost independently.
    pub burst: f64,
    /// Duration of the outage that begins at a random moment of each second, s; 0: none.
    pub outage_s: f64,
    /// Rate of the link in each direction, bit/s; 0: unlimited.
    pub rate_bit_per_s: f64,
    /// Longest time that a datagram waits for a link of limited rate, s; one that would wait longer is dropped. A
    /// stream has a buffer of 1 MiB instead.
    pub queue_s: f64,
}

/// Capacity of a stream's buffers (of the sockets at both ends, and the window of HTTP/2), bits.
const STREAM_BITS: f64 = 8.0 * 1024.0 * 1024.0;

/// A link of limited rate, with its queue.
struct Link {
    rate_bit_per_s: f64,
    longest_s: f64,
    /// When everything that waits will have been sent, s.
    free_s: f64,
}

impl Link {
    fn new(conditions: &Conditions) -> Self {
        let rate_bit_per_s = conditions.rate_bit_per_s;
        let longest_s = match conditions.transport {
            Transport::Datagram => conditions.queue_s,
            Transport::Stream => STREAM_BITS / rate_bit_per_s,
        };
        Link { rate_bit_per_s, longest_s, free_s: 0.0 }
    }

    /// Returns when a message has passed the link, s; `None` if it is dropped.
    fn pass(&mut self, now_s: f64, bytes: u64) -> Option<f64> {
        if self.rate_bit_per_s <= 0.0 {
            return Some(now_s);
        }
        let begins_s = self.free_s.max(now_s);
        if begins_s - now_s > self.longest_s {
            return None;
        }
        self.free_s = begins_s + 8.0 * bytes as f64 / self.rate_bit_per_s;
        Some(self.free_s)
    }
}

/// Least retransmission timeout of TCP, s (RFC 6298 requires 1 s, Linux uses 200 ms).
const MIN_RTO_S: f64 = 0.2;

/// Random stalls of equal length: one begins at a random moment of each second.
pub struct Stalls {
    stall_s: f64,
    random: Random,
    begin_s: f64,
}

impl Stalls {
    /// Creates stalls of `stall_s` each, s, the first within the second after `from_s`; with 0 there are none.
    pub fn new(stall_s: f64, from_s: f64, mut random: Random) -> Self {
        let begin_s = from_s + random.between(0.0, 1.0);
        Stalls { stall_s, random, begin_s }
    }

    /// Returns the end of the stall that lasts at `now_s`, s; `None` if there is none. Times must not decrease from
    /// call to call.
    pub fn at(&mut self, now_s: f64) -> Option<f64> {
        while now_s >= self.begin_s + self.stall_s {
            self.begin_s = self.begin_s.ceil() + self.random.between(0.0, 1.0);
        }
        (self.stall_s > 0.0 && now_s >= self.begin_s).then_some(self.begin_s + self.stall_s)
    }
}

/// The outages of a network, at equal times for both directions: each computes its own from the same seed.
pub struct Outages {
    stalls: Stalls,
    ended_s: f64,
}

impl Outages {
    /// Creates the outages of a seed, of [`Conditions::outage_s`] each, the first within the second after `from_s`.
    pub fn new(conditions: &Conditions, seed: u64, from_s: f64) -> Self {
        let stalls = Stalls::new(conditions.outage_s, from_s, Random::new(seed, 5));
        Outages { stalls, ended_s: f64::NEG_INFINITY }
    }

    /// Returns whether the network has outages.
    pub fn are_any(&self) -> bool {
        self.stalls.stall_s > 0.0
    }

    /// Returns the end of the outage at `now_s`, s; `None` if there is none.
    fn at(&mut self, now_s: f64) -> Option<f64> {
        self.stalls.at(now_s)
    }

    /// Returns the time since the end of the last outage that a call fell into, s; 0 during one, infinite before the
    /// first. Times must not decrease from call to call.
    pub fn since_s(&mut self, now_s: f64) -> f64 {
        if let Some(end_s) = self.at(now_s) {
            self.ended_s = end_s;
        }
        (now_s - self.ended_s).max(0.0)
    }
}

/// One direction of a simulated connection, with the messages in it.
///
/// A message takes half of the round trip of 100 ms:
///
/// ```
/// use palpate_simulated::network::{Conditions, Direction};
///
/// let conditions = Conditions { round_trip_s: 0.1, ..Conditions::default() };
/// let (seed, direction) = (1, 0);
/// let mut up = Direction::new(conditions, seed, direction, 0.0);
/// up.send(0.000, 200, "a command of 200 bytes");
/// assert_eq!(up.next_s(), Some(0.05));
/// assert_eq!(up.receive(0.049), None);
/// assert_eq!(up.receive(0.050), Some("a command of 200 bytes"));
/// ```
pub struct Direction<T> {
    conditions: Conditions,
    random: Random,
    link: Link,
    outages: Outages,
    is_bursting: bool,
    /// Messages under way, sorted by arrival, s.
    under_way: VecDeque<(f64, T)>,
    last_s: f64,
    sent: u64,
    overflowed: u64,
}

impl<T> Direction<T> {
    /// Creates one direction of the network with this seed. `direction` is its number, other than 5: each has random
    /// numbers of its own. All directions of a seed have their outages at equal times, the first within the second
    /// after `from_s`.
    pub fn new(conditions: Conditions, seed: u64, direction: u64, from_s: f64) -> Self {
        Direction {
            conditions,
            random: Random::new(seed, direction),
            link: Link::new(&conditions),
            outages: Outages::new(&conditions, seed, from_s),
            is_bursting: false,
            under_way: VecDeque::new(),
            last_s: f64::NEG_INFINITY,
            sent: 0,
            overflowed: 0,
        }
    }

    fn is_lost(&mut self) -> bool {
        let Conditions { loss, burst, .. } = self.conditions;
        if loss <= 0.0 {
            return false;
        }
        let dice = self.random.between(0.0, 1.0);
        if burst <= 1.0 {
            return dice < loss;
        }
        let (begins, ends) = (loss / (burst * (1.0 - loss).max(1e-9)), 1.0 / burst);
        self.is_bursting = if self.is_bursting { dice >= ends } else { dice < begins };
        self.is_bursting
    }

    /// Sends a message at `now_s`, which must not decrease from call to call; decides at once whether and when it
    /// arrives. `bytes` is its length on the link, which only counts if the rate is limited.
    pub fn send(&mut self, now_s: f64, bytes: u64, message: T) {
        let Conditions { transport, round_trip_s, jitter_s, .. } = self.conditions;
        self.sent += 1;
        let Some(left_s) = self.link.pass(now_s, bytes) else {
            self.overflowed += 1;
            return;
        };
        let mut arrives_s = left_s + round_trip_s / 2.0;
        if jitter_s > 0.0 {
            arrives_s = (arrives_s + jitter_s * self.random.normal()).max(left_s);
        }
        let (is_lost, outage) = (self.is_lost(), self.outages.at(now_s));
        match transport {
            Transport::Datagram if is_lost || outage.is_some() => return,
            Transport::Datagram => {}
            Transport::Stream => {
                if is_lost {
                    arrives_s += self.random.between(round_trip_s, (2.0 * round_trip_s).max(MIN_RTO_S));
                }
                // The retransmission after the outage may have to wait for another timeout.
                let again_s = outage.map_or(now_s, |end_s| end_s + self.random.between(0.0, MIN_RTO_S));
                arrives_s = (arrives_s + again_s - now_s).max(self.last_s);
                self.last_s = arrives_s;
            }
        }
        let at = self.under_way.partition_point(|entry| entry.0 <= arrives_s);
        self.under_way.insert(at, (arrives_s, message));
    }

    /// Removes and returns the message that arrives first, if it has arrived by `now_s`; `None` otherwise.
    pub fn receive(&mut self, now_s: f64) -> Option<T> {
        // A nanosecond more allows for rounding: times are sums of milliseconds.
        if self.under_way.front()?.0 > now_s + 1e-9 {
            return None;
        }
        self.under_way.pop_front().map(|entry| entry.1)
    }

    /// Returns when the next message arrives, s; `None` if none is under way. It may have arrived already.
    pub fn next_s(&self) -> Option<f64> {
        self.under_way.front().map(|entry| entry.0)
    }

    /// Returns the number of messages that were neither lost nor received yet.
    pub fn under_way(&self) -> usize {
        self.under_way.len()
    }

    /// Returns the number of messages sent so far, including lost and dropped ones.
    pub fn sent(&self) -> u64 {
        self.sent
    }

    /// Returns the number of messages dropped so far because the queue of the link, or the buffers of a stream, were
    /// full.
    pub fn overflowed(&self) -> u64 {
        self.overflowed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arrivals(conditions: Conditions) -> Vec<u32> {
        let mut direction = Direction::new(conditions, 1, 1, 0.0);
        (0..20_000).for_each(|number| direction.send(f64::from(number) * 1e-3, 125, number));
        std::iter::from_fn(|| direction.receive(1e9)).collect()
    }

    #[test]
    fn datagrams_are_lost_as_often_and_in_runs_as_long_as_is_asked_for() {
        for burst in [1.0, 5.0] {
            let conditions = Conditions { transport: Transport::Datagram, loss: 0.05, burst, ..Conditions::default() };
            let arrived = arrivals(conditions);
            let gaps: Vec<u32> = arrived.windows(2).map(|pair| pair[1] - pair[0] - 1).filter(|gap| *gap > 0).collect();
            let share = f64::from(gaps.iter().sum::<u32>()) / 20_000.0;
            let mean = f64::from(gaps.iter().sum::<u32>()) / gaps.len() as f64;
            assert!((0.04..0.06).contains(&share), "{burst}: {share} lost");
            assert!((0.85 * burst..1.15 * burst.max(1.05)).contains(&mean), "{burst}: {mean} in a row");
        }
    }

    #[test]
    fn datagrams_overtake_each_other_and_a_stream_loses_nothing() {
        let conditions = Conditions { jitter_s: 0.01, loss: 0.01, outage_s: 0.1, ..Conditions::default() };
        let arrived = arrivals(conditions);
        assert!(arrived.len() == 20_000 && arrived.is_sorted());
        let arrived = arrivals(Conditions { transport: Transport::Datagram, ..conditions });
        assert!(!arrived.is_sorted());
        // A tenth of the time nothing gets through, and a hundredth of the rest is lost.
        assert!((17_000..18_600).contains(&arrived.len()), "{}", arrived.len());
    }

    #[test]
    fn a_link_passes_no_more_than_its_rate_and_a_datagram_waits_no_longer_than_its_queue() {
        // 1000 messages of 1000 bits per second, of datagrams and of a stream. Messages that still wait at the end
        // arrive too: 50 ms of datagrams, and the 1 MiB of a stream.
        let all = [20_000, 20_000];
        for (rate_bit_per_s, longest_s, arrive) in [(2e6, 0.0, all), (1e6, 0.0, all), (5e5, 0.05, [10_025, 18_389])] {
            let conditions = Conditions { rate_bit_per_s, queue_s: 0.05, ..Conditions::default() };
            for transport in [Transport::Datagram, Transport::Stream] {
                let mut direction = Direction::new(Conditions { transport, ..conditions }, 1, 1, 0.0);
                let (mut waited_s, mut arrived) = (0.0_f64, 0);
                for number in 0..1_000_000_u32 {
                    let now_s = f64::from(number) * 1e-3;
                    if number < 20_000 {
                        direction.send(now_s, 125, now_s);
                    }
                    while let Some(sent_s) = direction.receive(now_s) {
                        (waited_s, arrived) = (waited_s.max(now_s - sent_s), arrived + 1);
                    }
                }
                let is_datagram = transport == Transport::Datagram;
                let expected = arrive[usize::from(!is_datagram)];
                assert!(u32::abs_diff(arrived, expected) <= 2, "{transport:?}, {rate_bit_per_s}: {arrived} arrived");
                assert_eq!(u64::from(20_000 - arrived), direction.overflowed());
                // Its own time on the link, and the tick.
                let most_s = longest_s + 0.004;
                assert!(!is_datagram || waited_s <= most_s, "{rate_bit_per_s}: {waited_s} s");
            }
        }
    }
}
