//! The force law of a stream with a device. It may become another: a better one, or that of another tissue.

use std::sync::{Arc, Mutex};

use palpate_haptics::Law;
use palpate_tissue::lock::lock;

/// The number of the law that a stream begins with, as its local models name it.
pub const FIRST: u32 = 0;

/// The law that the local models of a stream refer to, and its number in the stream. It is locked for a copy only.
#[derive(Debug)]
pub struct Laws(Mutex<(u32, Arc<Law>)>);

impl Laws {
    /// Creates the laws of a stream that begins with `first`.
    pub fn new(first: Arc<Law>) -> Self {
        Laws(Mutex::new((FIRST, first)))
    }

    /// Has all local models from the next sample on refer to `law`, whose number is `number`.
    pub fn change(&self, number: u32, law: Arc<Law>) {
        *lock(&self.0) = (number, law);
    }

    /// Returns the law that local models refer to from now on, and its number.
    pub fn newest(&self) -> (u32, Arc<Law>) {
        lock(&self.0).clone()
    }
}
