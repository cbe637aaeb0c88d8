//! The memory that reading a file takes: within a multiple of its bytes, and paid for before it is allocated.

use super::{MULTIPLE, ROOM};
use crate::Problem;

/// More is paid for in steps of so many bytes.
const STEP: usize = 1 << 18;

/// Counts what is taken.
pub(super) struct MemoryAllowance<'a> {
    most: usize,
    taken: usize,
    paid: usize,
    /// Pays for so many bytes in all; `false` if it can't.
    pay: &'a mut dyn FnMut(u64) -> bool,
}

impl<'a> MemoryAllowance<'a> {
    /// For a file of so many bytes.
    pub(super) fn new(bytes: usize, pay: &'a mut dyn FnMut(u64) -> bool) -> Self {
        MemoryAllowance { most: bytes.saturating_mul(MULTIPLE).saturating_add(ROOM), taken: 0, paid: 0, pay }
    }

    /// Another file of so many bytes belongs to it.
    pub(super) fn add_file(&mut self, bytes: usize) {
        self.most = self.most.saturating_add(bytes.saturating_mul(MULTIPLE));
    }

    /// Takes so many bytes.
    pub(super) fn take(&mut self, bytes: usize) -> Result<(), Problem> {
        let sum = self.taken.saturating_add(bytes);
        if sum > self.most {
            return Err(Problem::TooLarge { what: "bytes in memory for a file of its size", limit: self.most });
        }
        if sum > self.paid {
            let paid = sum.saturating_add(STEP);
            if !(self.pay)(paid as u64) {
                return Err(Problem::TooLarge { what: "bytes in memory", limit: self.paid });
            }
            self.paid = paid;
        }
        self.taken = sum;
        Ok(())
    }

    /// So many bytes are free again.
    pub(super) fn give_back(&mut self, bytes: usize) {
        self.taken = self.taken.saturating_sub(bytes);
    }

    /// Appends to a list, with what that takes when it has to grow.
    pub(super) fn push<T>(&mut self, list: &mut Vec<T>, value: T) -> Result<(), Problem> {
        if list.len() == list.capacity() {
            self.take(list.capacity().max(4).saturating_mul(size_of::<T>()))?;
        }
        list.push(value);
        Ok(())
    }
}
