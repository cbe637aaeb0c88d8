//! The severed and the burnt springs of a sheet as its sweep reads them: factors of their stiffness, 0 for a severed one, for rows with such springs
//! only, and the anchors that are left.

use crate::body::severed::NO_ANCHOR;
use crate::kernel::field::{Field, Layout};
use crate::kernel::real::Real;

/// The springs that begin at a point, in the order of their factors: to the right, down, down and to the right, and from the
/// point on the right down to the point below; then the bending springs to the right and down.
pub(crate) const RIGHT: usize = 0;
pub(crate) const DOWN: usize = 1;
pub(crate) const DIAGONAL: usize = 2;
pub(crate) const COUNTER_DIAGONAL: usize = 3;
pub(crate) const TWO_RIGHT: usize = 4;
pub(crate) const TWO_DOWN: usize = 5;

/// Number of springs that begin at a point.
const SPRINGS: usize = 6;

/// The factors of a sheet's springs.
#[derive(Debug)]
pub(crate) struct SheetCuts<T> {
    stride: usize,
    /// For each row with cuts or burns the factors of its springs, [`SPRINGS`] rows of the layout. Empty if no row has any.
    rows: Vec<Option<Box<Field<T>>>>,
    /// The extra K″/m of each point divided by the reference value, a plane of the layout. `None` if no anchor spring is severed.
    anchors: Option<Field<T>>,
}

impl<T: Real> SheetCuts<T> {
    /// Returns the factors of a whole sheet.
    pub(crate) fn none(layout: &Layout) -> Self {
        SheetCuts { stride: layout.stride, rows: Vec::new(), anchors: None }
    }

    /// Returns whether no row has cuts.
    pub(crate) fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Returns the factors of row `i`; null if it has no cuts.
    #[inline(always)]
    pub(crate) fn row(&self, i: usize) -> *const T {
        match self.rows.get(i) {
            Some(Some(factors)) => factors.as_ptr(),
            _ => std::ptr::null(),
        }
    }

    /// Returns the extra K″/m of each point divided by the reference value; null if no anchor spring is severed.
    #[inline(always)]
    pub(crate) fn anchors(&self) -> *const T {
        self.anchors.as_ref().map_or(std::ptr::null(), |anchors| anchors.as_ptr())
    }

    /// Severs or restores the anchor spring of a point.
    pub(crate) fn set_anchor(&mut self, layout: &Layout, [i, j]: [usize; 2], is_severed: bool) {
        let anchors = self.anchors.get_or_insert_with(|| Field::of_length(layout.plane));
        anchors[i * self.stride + j] = T::of(if is_severed { NO_ANCHOR } else { 0.0 });
    }

    /// Forgets that anchor springs were severed, once all are whole again.
    pub(crate) fn forget_anchors(&mut self) {
        self.anchors = None;
    }

    /// Sets the factor of the spring that joins the point [i, j] to the one `di` rows and `dj` columns on.
    pub(crate) fn set(&mut self, layout: &Layout, [i, j]: [usize; 2], [di, dj]: [isize; 2], factor: f64) {
        // From its upper end, or its left one, on.
        let (i, j, [di, dj]) = if di < 0 || di == 0 && dj < 0 {
            (i.wrapping_add_signed(di), j.wrapping_add_signed(dj), [-di, -dj])
        } else {
            (i, j, [di, dj])
        };
        let (spring, j) = match [di, dj] {
            [0, 1] => (RIGHT, j),
            [1, 0] => (DOWN, j),
            [1, 1] => (DIAGONAL, j),
            [1, -1] => (COUNTER_DIAGONAL, j - 1),
            [0, 2] => (TWO_RIGHT, j),
            _ => (TWO_DOWN, j),
        };
        if self.rows.is_empty() {
            self.rows.resize_with(layout.rows, || None);
        }
        let stride = self.stride;
        let factors = self.rows[i].get_or_insert_with(|| {
            let mut factors = Field::of_length(SPRINGS * stride);
            factors.fill(T::of(1.0));
            Box::new(factors)
        });
        factors[spring * stride + j] = T::of(factor);
    }
}
