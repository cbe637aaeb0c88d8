//! How fast somebody may ask: a bucket that fills steadily, from which each asking takes. Time is an argument.

use crate::refusal::{Reason, Refusal, Result};

/// What may still be asked for at once, and how fast that comes back.
#[derive(Debug, Clone)]
pub(super) struct Bucket {
    per_s: f64,
    most: f64,
    left: f64,
    filled_ns: u64,
    /// Askings that were refused, less those that were not.
    refused: f64,
}

impl Bucket {
    /// A full one that holds `most`, and gets `per_s` a second.
    pub(super) fn new(per_s: f64, most: f64) -> Self {
        let most = most.max(1.0);
        Bucket { per_s, most, left: most, filled_ns: 0, refused: 0.0 }
    }

    /// Takes one, unless there is none; `what` is asked for too fast.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn take(&mut self, now_ns: u64, what: &str) -> Result<()> {
        let elapsed_s = now_ns.saturating_sub(self.filled_ns) as f64 * 1e-9;
        self.left = (self.left + elapsed_s * self.per_s).min(self.most);
        self.filled_ns = self.filled_ns.max(now_ns);
        if self.left < 1.0 {
            self.refused += 1.0;
            let Bucket { per_s, most, .. } = *self;
            let message = format!("{what} are more than {:.0} a minute, and {most:.0} at once", 60.0 * per_s);
            return Err(Refusal::new(Reason::RateLimited, "", message));
        }
        self.left -= 1.0;
        self.refused = (self.refused - 1.0).max(0.0);
        Ok(())
    }

    /// Whether it was asked so much too fast that even to refuse is too much: the excess is more than it holds.
    pub(super) fn is_abused(&self) -> bool {
        self.refused > self.most
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bucket_gives_what_it_holds_at_once_and_then_what_comes_in() {
        let mut bucket = Bucket::new(10.0, 5.0);
        let taken =
            |bucket: &mut Bucket, now_ns| (0..100).take_while(|_| bucket.take(now_ns, "things").is_ok()).count();
        assert_eq!(taken(&mut bucket, 1), 5);
        assert_eq!(taken(&mut bucket, 250_000_000), 2);
        // Time that goes back gives nothing; a long one no more than it holds.
        assert_eq!(taken(&mut bucket, 0), 0);
        assert_eq!(taken(&mut bucket, 1_000_000_000_000), 5);
        assert_eq!(bucket.take(1_000_000_000_000, "things").unwrap_err().reason, Reason::RateLimited);
        // Who asks on and on is told apart from who is a little too fast.
        assert!(!bucket.is_abused());
        (0..5).for_each(|_| assert!(bucket.take(1_000_000_000_000, "things").is_err()));
        assert!(bucket.is_abused());
        assert_eq!(taken(&mut bucket, 1_000_500_000_000), 5);
        assert!(!bucket.is_abused());
    }
}
