//! Numbers by place, of which clones share what has not changed since.

use std::sync::Arc;

/// The places of a page. A change copies a page that a clone shares.
const PAGE: usize = 256;

/// The number of a place that has none.
const NONE: u32 = u32::MAX;

/// A number for some of the places of a tissue. Its memory, and what a change of a clone copies, grow with the places that have numbers.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct PlaceNumbers {
    pages: Vec<Option<Arc<[u32; PAGE]>>>,
}

impl PlaceNumbers {
    /// Returns the number of a place; `None` if it has none.
    #[inline]
    pub(crate) fn get(&self, place: usize) -> Option<usize> {
        let page = self.pages.get(place / PAGE)?.as_ref()?;
        let number = page[place % PAGE];
        (number != NONE).then_some(number as usize)
    }

    /// Gives a place a number, below 2³² − 1.
    pub(crate) fn set(&mut self, place: usize, number: u32) {
        let page = place / PAGE;
        if self.pages.len() <= page {
            self.pages.resize(page + 1, None);
        }
        Arc::make_mut(self.pages[page].get_or_insert_with(|| Arc::new([NONE; PAGE])))[place % PAGE] = number;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_keeps_its_number_whatever_clones_get() {
        let mut numbers = PlaceNumbers::default();
        assert_eq!(numbers.get(1000), None);
        for place in [0, 255, 256, 70_000] {
            numbers.set(place, 2 * place as u32);
        }
        let before = numbers.clone();
        numbers.set(256, 7);
        numbers.set(257, 8);
        let of = |numbers: &PlaceNumbers| [0, 255, 256, 257, 258, 70_000, 70_001].map(|place| numbers.get(place));
        assert_eq!(of(&before), [Some(0), Some(510), Some(512), None, None, Some(140_000), None]);
        assert_eq!(of(&numbers), [Some(0), Some(510), Some(7), Some(8), None, Some(140_000), None]);
    }
}
