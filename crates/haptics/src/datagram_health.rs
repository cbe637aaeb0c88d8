//! Checks whether datagrams get through. Each end numbers its datagrams and acknowledges the newest one that it
//! received. While an end's datagrams are acknowledged, it sends its messages as datagrams; otherwise it uses the
//! reliable stream beside them.
//!
//! A network that blocks datagrams, or passes them in one direction only, is therefore not an error. The ends keep
//! trying ([`DatagramHealth::is_silent`]), and use datagrams again as soon as they are acknowledged.

/// Longest time since the last new acknowledgement for which datagrams are used, s. It is twice the time after which
/// an end holds its last value, so a burst of losses does not cause a switch to the stream.
pub const CONFIRMED_S: f64 = 0.1;

/// Longest time between two datagrams of one end, s. An end that has nothing to send for this long sends one anyway
/// ([`DatagramHealth::is_silent`]).
pub const LIFE_S: f64 = 0.04;

/// One end's record of the datagrams of one connection, in both directions. It decides whether this end uses datagrams
/// or the stream: the stream at first, datagrams once one of its own has been acknowledged.
///
/// All times of its functions are by this end's clock, s.
#[derive(Debug, Clone, Default)]
pub struct DatagramHealth {
    sent: u64,
    sent_s: Option<f64>,
    came: u64,
    newest: u64,
    confirmed: u64,
    confirmed_s: Option<f64>,
    carries: bool,
    fell_back: u64,
}

/// Counts of one end's datagrams since its [`DatagramHealth`] was created.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Carried {
    /// Number of datagrams sent.
    pub sent: u64,
    /// Number of datagrams received, repeated ones included.
    pub came: u64,
    /// Number of switches from datagrams to the stream because datagrams were no longer acknowledged.
    pub fell_back: u64,
}

impl DatagramHealth {
    /// Counts a datagram that is sent at `now_s`. Returns its number, from 1, and the number of the other end's
    /// newest datagram, which it acknowledges (0 before the first).
    pub fn send(&mut self, now_s: f64) -> (u64, u64) {
        self.sent += 1;
        self.sent_s = Some(now_s);
        (self.sent, self.newest)
    }

    /// Records that the other end's datagram `number` arrived at `now_s`, which acknowledges this end's datagram
    /// `acknowledges` (0 for none). Only a number above all acknowledged before is a new acknowledgement; one that
    /// this end never sent confirms nothing.
    pub fn arrive(&mut self, number: u64, acknowledges: u64, now_s: f64) {
        self.came += 1;
        self.newest = self.newest.max(number);
        // A datagram that was not sent cannot have been received.
        if (self.confirmed + 1..=self.sent).contains(&acknowledges) {
            self.confirmed = acknowledges;
            self.confirmed_s = Some(now_s);
        }
    }

    /// Returns whether a message at `now_s` goes as a datagram: whether a new acknowledgement arrived in the last
    /// [`CONFIRMED_S`]; false before the first. If it was true at the last call and is false now, this counts as a
    /// switch to the stream ([`Carried::fell_back`]).
    pub fn update(&mut self, now_s: f64) -> bool {
        let carries = self.confirmed_s.is_some_and(|confirmed_s| now_s - confirmed_s <= CONFIRMED_S);
        if self.carries && !carries {
            self.fell_back += 1;
        }
        self.carries = carries;
        carries
    }

    /// Returns whether a datagram is due at `now_s` because this end has sent none for [`LIFE_S`]; true before the
    /// first.
    pub fn is_silent(&self, now_s: f64) -> bool {
        self.sent_s.is_none_or(|sent_s| now_s - sent_s >= LIFE_S - 1e-9)
    }

    /// Returns the counts so far.
    pub fn carried(&self) -> Carried {
        Carried { sent: self.sent, came: self.came, fell_back: self.fell_back }
    }
}

/// Record of which of the 64 consecutive numbers up to the newest received one were received; empty at first. A pose
/// is sent several times but must count once.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReceiveWindow {
    newest: u64,
    /// Bit k: `newest − k` was received.
    bits: u64,
}

impl ReceiveWindow {
    /// Records `number`. Returns true if it is the first, above the newest, or at most 63 below the newest and not
    /// received before. Returns false, and changes nothing, for a repeated number and for one that is 64 or more below
    /// the newest, even if it was never received.
    pub fn take(&mut self, number: u64) -> bool {
        if self.bits == 0 || number > self.newest {
            let ahead = if self.bits == 0 { 64 } else { number - self.newest };
            self.bits = if ahead < 64 { self.bits << ahead } else { 0 } | 1;
            self.newest = number;
            return true;
        }
        let bit = 1_u64.checked_shl(u32::try_from(self.newest - number).unwrap_or(64)).unwrap_or(0);
        let is_new = bit != 0 && self.bits & bit == 0;
        self.bits |= bit;
        is_new
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Simulates two ends that send each other a datagram every `every_ms`, with a delay of 25 ms. `passes` decides
    /// whether one gets through, by its sender and the time, ms. Returns whether each end uses datagrams, one entry
    /// per millisecond.
    fn play(every_ms: u32, passes: impl Fn(usize, u32) -> bool) -> [Vec<bool>; 2] {
        let (mut ends, mut carries) =
            ([DatagramHealth::default(), DatagramHealth::default()], [Vec::new(), Vec::new()]);
        let mut under_way: Vec<(u32, usize, (u64, u64))> = Vec::new();
        for now_ms in 0..3000_u32 {
            let now_s = f64::from(now_ms) * 1e-3;
            under_way.retain(|(due_ms, to, (number, acknowledges))| {
                if *due_ms == now_ms {
                    ends[*to].arrive(*number, *acknowledges, now_s);
                }
                *due_ms > now_ms
            });
            for from in 0..2 {
                if now_ms % every_ms == 0 || ends[from].is_silent(now_s) {
                    let datagram = ends[from].send(now_s);
                    if passes(from, now_ms) {
                        under_way.push((now_ms + 25, 1 - from, datagram));
                    }
                }
                carries[from].push(ends[from].update(now_s));
            }
        }
        carries
    }

    #[test]
    fn datagrams_carry_once_both_ways_are_confirmed() {
        for carries in play(10, |_, _| true) {
            assert!(carries[..50].iter().all(|carries| !carries) && carries[90..].iter().all(|carries| *carries));
        }
    }

    #[test]
    fn scattered_losses_change_nothing_and_a_way_that_is_cut_does_for_both_until_it_is_mended() {
        // Every second one and every third one passes.
        for carries in play(10, |from, now_ms| now_ms / 10 % (2 + from as u32) == 0) {
            assert!(carries[150..].iter().all(|carries| *carries));
        }
        // One direction is blocked for a second. Both ends notice, each because its datagrams are not acknowledged.
        for carries in play(10, |from, now_ms| from == 1 || !(1000..2000).contains(&now_ms)) {
            assert!(carries[100..1000].iter().all(|carries| *carries));
            assert!(carries[1160..2000].iter().all(|carries| !carries));
            assert!(carries[2150..].iter().all(|carries| *carries));
        }
        // Blocked datagrams are never used.
        for carries in play(10, |_, _| false) {
            assert!(carries.iter().all(|carries| !carries));
        }
    }

    #[test]
    fn nobody_confirms_what_was_not_sent() {
        let mut end = DatagramHealth::default();
        end.arrive(1, 7, 0.0);
        assert!(!end.update(0.0));
        assert_eq!(end.send(0.0), (1, 1));
        end.arrive(2, 1, 0.01);
        assert!(end.update(0.1) && !end.update(0.2));
        assert_eq!(end.carried(), Carried { sent: 1, came: 2, fell_back: 1 });
    }

    #[test]
    fn a_number_counts_once_also_when_it_was_overtaken() {
        let mut seen = ReceiveWindow::default();
        let taken: Vec<bool> = [5, 5, 3, 3, 6, 4, 80, 17, 16, 79, 79, 0].map(|number| seen.take(number)).into();
        assert_eq!(taken, [true, false, true, false, true, true, true, true, false, true, false, false]);
        let mut seen = ReceiveWindow::default();
        assert!(seen.take(0) && !seen.take(0) && seen.take(u64::MAX) && !seen.take(u64::MAX) && !seen.take(1));
    }
}
