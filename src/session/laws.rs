//! The force laws of a stream with a device: the one that it began with, and perhaps a better one later.

use std::sync::{Arc, OnceLock};

use palpate_touch::Law;

/// The number of the law that a stream begins with, as its local models name it.
pub const FIRST: u32 = 0;
/// The number of the better law.
pub const BETTER: u32 = 1;

/// The laws of a stream. Who samples reads it without waiting; who computes a better law adds that.
#[derive(Debug, PartialEq)]
pub struct Laws {
    first: Arc<Law>,
    better: OnceLock<Arc<Law>>,
}

impl Laws {
    /// Of a stream that begins with `first`.
    pub fn new(first: Arc<Law>) -> Self {
        Laws { first, better: OnceLock::new() }
    }

    /// The law that the stream began with.
    pub fn first(&self) -> &Law {
        &self.first
    }

    /// Has all local models from the next sample on refer to `law`. Only the first call counts: there is one better law.
    pub fn improve(&self, law: Arc<Law>) {
        let _ = self.better.set(law);
    }

    /// The law that local models refer to from now on, and its number.
    pub fn newest(&self) -> (u32, &Arc<Law>) {
        self.better.get().map_or((FIRST, &self.first), |better| (BETTER, better))
    }
}
