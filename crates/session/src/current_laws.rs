//! The force law of a stream with a device. It may be replaced by a more exact one, or by that of a changed tissue.

use std::sync::{Arc, Mutex};

use palpate_haptics::Law;
use palpate_tissue::lock::lock;

/// Number of the law with which a stream begins, as its local models name it.
pub const FIRST: u32 = 0;

/// The force law that the local models of a stream refer to now, and its number in the stream. It can be shared
/// between threads; it is locked only while it is copied or replaced.
#[derive(Debug)]
pub struct Laws(Mutex<(u32, Arc<Law>)>);

impl Laws {
    /// Creates the laws of a stream that begins with `first`, numbered [`FIRST`].
    pub fn new(first: Arc<Law>) -> Self {
        Laws(Mutex::new((FIRST, first)))
    }

    /// Makes all local models from the next sample on refer to `law`, whose number is `number`. A new law needs
    /// another number: a sampler notices the change by it.
    pub fn change(&self, number: u32, law: Arc<Law>) {
        *lock(&self.0) = (number, law);
    }

    /// Returns the number of the present law, which local models refer to, and the law.
    pub fn newest(&self) -> (u32, Arc<Law>) {
        lock(&self.0).clone()
    }
}
