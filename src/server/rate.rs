//! Rate limits by token buckets: a bucket fills steadily, and each request takes one token. Callers pass the time to
//! it.
//!
//! Commands above a stream's rate are refused one by one. When the excess is more than the bucket holds, so that
//! refusing costs too much as well, the stream ends with that reason. Other calls are counted per connection; the
//! refusal of one that arrives too early is delayed until the next would be allowed, which slows clients that retry
//! immediately.

use std::sync::Mutex;
use std::time::Duration;

use palpate_realtime::clock::now_ns;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::lock::lock;

/// A token bucket: one request takes one token.
#[derive(Debug, Clone)]
pub(super) struct Bucket {
    per_s: f64,
    most: f64,
    left: f64,
    filled_ns: u64,
    /// Refused requests minus those granted since; never below 0.
    refused: f64,
}

impl Bucket {
    /// Creates a full bucket that holds `most` tokens (at least 1) and gains `per_s` per second.
    pub(super) fn new(per_s: f64, most: f64) -> Self {
        let most = most.max(1.0);
        Bucket { per_s, most, left: most, filled_ns: 0, refused: 0.0 }
    }

    /// Takes a token. Returns an error if the bucket is empty; its message refers to the requests as `what`.
    pub(super) fn take(&mut self, now_ns: u64, what: &str) -> Result<()> {
        if !self.has_one(now_ns) {
            self.refused += 1.0;
            let Bucket { per_s, most, .. } = *self;
            let message = format!("{what} exceed {:.0} a minute, and {most:.0} at once", 60.0 * per_s);
            return Err(Refusal::new(Reason::RateLimited, "", message));
        }
        self.left -= 1.0;
        self.refused = (self.refused - 1.0).max(0.0);
        Ok(())
    }

    /// Returns the time until there is a token, at most a second; `None` if there is one.
    pub(super) fn time_to_one(&mut self, now_ns: u64) -> Option<Duration> {
        (!self.has_one(now_ns)).then(|| self.wait())
    }

    #[allow(clippy::cast_precision_loss)]
    fn has_one(&mut self, now_ns: u64) -> bool {
        let elapsed_s = now_ns.saturating_sub(self.filled_ns) as f64 * 1e-9;
        self.left = (self.left + elapsed_s * self.per_s).min(self.most);
        self.filled_ns = self.filled_ns.max(now_ns);
        self.left >= 1.0
    }

    /// Returns the time until the next request would be granted, at most a second.
    fn wait(&self) -> Duration {
        Duration::from_secs_f64(((1.0 - self.left) / self.per_s).clamp(0.0, 1.0))
    }

    /// Returns whether requests arrive so fast that even refusing them costs too much: the excess is more than the
    /// bucket holds.
    pub(super) fn is_abused(&self) -> bool {
        self.refused > self.most
    }
}

/// A bucket that all calls of a connection share. A refusal is delayed until the next call would be granted, which
/// slows a client that retries in a loop to the allowed rate.
#[derive(Debug)]
pub(super) struct RateLimiter {
    bucket: Mutex<Bucket>,
    what: &'static str,
}

impl RateLimiter {
    pub(super) fn new(per_s: f64, most: f64, what: &'static str) -> Self {
        RateLimiter { bucket: Mutex::new(Bucket::new(per_s, most)), what }
    }

    /// Counts a call. If it exceeds the rate, returns the refusal and the time by which to delay it.
    pub(super) fn pass(&self) -> std::result::Result<(), (Refusal, Duration)> {
        let mut bucket = lock(&self.bucket);
        bucket.take(now_ns(), self.what).map_err(|refusal| (refusal, bucket.wait()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_is_delayed_until_the_next_call_would_pass() {
        let limiter = RateLimiter::new(10.0, 3.0, "calls");
        (0..3).for_each(|_| limiter.pass().unwrap());
        let (refusal, wait) = limiter.pass().unwrap_err();
        assert_eq!(refusal.reason, Reason::RateLimited);
        assert!(wait <= Duration::from_millis(100), "{wait:?}");
        let slow = RateLimiter::new(0.01, 1.0, "calls");
        slow.pass().unwrap();
        assert_eq!(slow.pass().unwrap_err().1, Duration::from_secs(1));
    }

    #[test]
    fn a_bucket_gives_what_it_holds_at_once_and_then_what_comes_in() {
        let mut bucket = Bucket::new(10.0, 5.0);
        let taken =
            |bucket: &mut Bucket, now_ns| (0..100).take_while(|_| bucket.take(now_ns, "things").is_ok()).count();
        assert_eq!(taken(&mut bucket, 1), 5);
        assert_eq!(taken(&mut bucket, 250_000_000), 2);
        // Time that runs backwards gains nothing; a long time gains no more than the bucket holds.
        assert_eq!(taken(&mut bucket, 0), 0);
        assert_eq!(taken(&mut bucket, 1_000_000_000_000), 5);
        assert_eq!(bucket.take(1_000_000_000_000, "things").unwrap_err().reason, Reason::RateLimited);
        // A small excess is not abuse, a long one is.
        assert!(!bucket.is_abused());
        (0..5).for_each(|_| assert!(bucket.take(1_000_000_000_000, "things").is_err()));
        assert!(bucket.is_abused());
        assert_eq!(taken(&mut bucket, 1_000_500_000_000), 5);
        assert!(!bucket.is_abused());
    }
}
