//! Limits the memory for reading a file to a multiple of its size, and has it paid for before it is allocated.

use super::{MULTIPLE, ROOM};
use crate::Problem;

/// Bytes that are paid in advance each time.
const STEP: usize = 1 << 18;

/// Counts the memory taken.
pub(super) struct MemoryAllowance<'a> {
    most: usize,
    taken: usize,
    paid: usize,
    /// Called with the total number of bytes to pay; returns `false` if that is refused.
    pay: &'a mut dyn FnMut(u64) -> bool,
}

impl<'a> MemoryAllowance<'a> {
    /// Creates the allowance for a file of this many bytes.
    pub(super) fn new(bytes: usize, pay: &'a mut dyn FnMut(u64) -> bool) -> Self {
        MemoryAllowance { most: bytes.saturating_mul(MULTIPLE).saturating_add(ROOM), taken: 0, paid: 0, pay }
    }

    /// Increases the allowance by another file of this many bytes.
    pub(super) fn add_file(&mut self, bytes: usize) {
        self.most = self.most.saturating_add(bytes.saturating_mul(MULTIPLE));
    }

    /// Increases the allowance by this many bytes, whatever the length of the file. The caller bounds them.
    pub(super) fn add_room(&mut self, bytes: usize) {
        self.most = self.most.saturating_add(bytes);
    }

    /// Takes memory. Refuses above the allowance, or if it is not paid.
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

    /// Returns how much memory is taken.
    pub(super) fn taken(&self) -> usize {
        self.taken
    }

    /// Gives memory back.
    pub(super) fn give_back(&mut self, bytes: usize) {
        self.taken = self.taken.saturating_sub(bytes);
    }

    /// Appends to a list, and takes the memory when it has to grow.
    pub(super) fn push<T>(&mut self, list: &mut Vec<T>, value: T) -> Result<(), Problem> {
        if list.len() == list.capacity() {
            self.take(list.capacity().max(4).saturating_mul(size_of::<T>()))?;
        }
        list.push(value);
        Ok(())
    }
}
