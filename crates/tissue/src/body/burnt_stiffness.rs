//! How much stiffer burns make springs: a function of the burns alone, so that nothing of it is saved.
//!
//! Heat coagulates tissue, which becomes stiffer. A burn b, from 0 to 1, multiplies the stiffness of a point by s = 1 + (S − 1)·b, with the scene's
//! factor S (`[cutting] burnt_stiffness_factor`). Each half of a spring of stiffness k is a spring of stiffness 2k, and is of the tissue at
//! its own end. Both are in series, 1/k′ = 1/(2k·s_a) + 1/(2k·s_b), so
//!
//! k′ = k·2·s_a·s_b/(s_a + s_b),
//!
//! which is S·k between points that have burnt through, and below 2k beside a burn, however large S is.
//!
//! **Levels.** b counts in [`LEVELS`] steps, so that the springs of a point change so many times in a burn, and not at each step.
//!
//! **The bound.** With L the matrix of the springs' stiffness, k′ ≤ S·k gives L′ ≼ S·L, whatever is burnt. The substep is that of S·L from
//! the beginning (`scheme::stability`).

use std::sync::Arc;

/// How many levels of stiffness a burn has above none.
pub(crate) const LEVELS: f64 = 16.0;

/// Returns the factor of the stiffness of a point with a burn, 0 to 1.
pub(crate) fn of_point(burnt_stiffness_factor: f64, burn: f64) -> f64 {
    1.0 + (burnt_stiffness_factor - 1.0) * ((LEVELS * burn).floor() / LEVELS)
}

/// The points that burns have made stiffer. Clones share the list.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct BurntStiffness {
    /// Their places in memory, ascending, and the factors of their stiffness, above 1.
    points: Arc<Vec<(u32, f64)>>,
}

impl BurntStiffness {
    /// Returns these points, which are given by ascending place, with their factors; those of 1 are left out.
    pub(crate) fn of(points: impl Iterator<Item = (u32, f64)>) -> Self {
        BurntStiffness { points: Arc::new(points.filter(|(_, factor)| *factor > 1.0).collect()) }
    }

    /// Returns the memory of this list for so many points, bytes.
    pub(crate) fn bytes(points: usize) -> u64 {
        (points * size_of::<(u32, f64)>()) as u64
    }

    /// Returns whether no point is stiffer than it was.
    #[inline]
    pub(crate) fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Returns the places of the stiffer points.
    pub(crate) fn places(&self) -> impl Iterator<Item = usize> {
        self.points.iter().map(|(place, _)| *place as usize)
    }

    /// Returns the factor of the stiffness of the point at a place.
    pub(crate) fn of_point(&self, place: usize) -> f64 {
        self.found(place).map_or(1.0, |at| self.points[at].1)
    }

    /// Returns the factor of the stiffness of a spring between two places; exactly 1 if neither is stiffer.
    #[inline]
    pub(crate) fn of_spring(&self, ends: [usize; 2]) -> f64 {
        if self.points.is_empty() {
            return 1.0;
        }
        let [a, b] = ends.map(|place| self.of_point(place));
        2.0 * a * b / (a + b)
    }

    /// Sets the factor of a point, above 1.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn set(&mut self, place: usize, factor: f64) {
        let found = self.found(place);
        let points = Arc::make_mut(&mut self.points);
        match found {
            Ok(at) => points[at].1 = factor,
            Err(at) => points.insert(at, (place as u32, factor)),
        }
    }

    /// Returns the places whose factor is another one in `other`, some of them twice.
    pub(crate) fn differences<'a>(&'a self, other: &'a Self) -> impl Iterator<Item = usize> + 'a {
        let is_same = Arc::ptr_eq(&self.points, &other.points);
        let both = self.places().chain(other.places()).take_while(move |_| !is_same);
        both.filter(|place| self.of_point(*place) != other.of_point(*place))
    }

    fn found(&self, place: usize) -> Result<usize, usize> {
        self.points.binary_search_by_key(&place, |(of, _)| *of as usize)
    }
}
