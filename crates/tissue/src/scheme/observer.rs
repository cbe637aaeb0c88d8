//! Reads displacement and velocity from a scheme's state, with the scheme chosen at run time.
//!
//! Steps are compiled once for each scheme. Surveys are rare: they use an [`Observer`], and are compiled once
//! for all schemes.

use super::arithmetic::{Arithmetic, MAX_KEPT};
use super::family::Family;
use super::{Multistep, Rk4, Scheme, TwoStep};
use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;

/// The arithmetic of any scheme in one number format, without compensation: observing needs none.
pub(crate) enum Observer<T: Real> {
    TwoStep(<TwoStep<0> as Family>::Plain<T>),
    LongTwoStep(<TwoStep<2> as Family>::Plain<T>),
    RelaxingTwoStep(<TwoStep<5> as Family>::Plain<T>),
    Exponential2(<Multistep<2> as Family>::Plain<T>),
    Exponential3(<Multistep<3> as Family>::Plain<T>),
    Exponential4(<Multistep<4> as Family>::Plain<T>),
    Rk4(<Rk4 as Family>::Plain<T>),
}

/// Compiles an expression for the arithmetic of each scheme, and runs that of `$observer`.
macro_rules! with {
    ($observer:expr, |$arithmetic:ident| $body:expr) => {
        match $observer {
            Observer::TwoStep($arithmetic) => $body,
            Observer::LongTwoStep($arithmetic) => $body,
            Observer::RelaxingTwoStep($arithmetic) => $body,
            Observer::Exponential2($arithmetic) => $body,
            Observer::Exponential3($arithmetic) => $body,
            Observer::Exponential4($arithmetic) => $body,
            Observer::Rk4($arithmetic) => $body,
        }
    };
}

/// Returns [`Arithmetic::KEPT`] of an arithmetic.
fn kept_of<T: Real, C: Arithmetic<T>>(_: &C) -> usize {
    C::KEPT
}

impl<T: Real> Observer<T> {
    /// Returns the observer of a scheme.
    pub(crate) fn of(scheme: &Scheme) -> Self {
        match scheme {
            Scheme::TwoStep(family) => Observer::TwoStep(family.plain(0)),
            Scheme::LongTwoStep(family) => Observer::LongTwoStep(family.plain(0)),
            Scheme::RelaxingTwoStep(family) => Observer::RelaxingTwoStep(family.plain(0)),
            Scheme::Exponential2(family) => Observer::Exponential2(family.plain(0)),
            Scheme::Exponential3(family) => Observer::Exponential3(family.plain(0)),
            Scheme::Exponential4(family) => Observer::Exponential4(family.plain(0)),
            Scheme::Rk4(family) => Observer::Rk4(family.plain(0)),
        }
    }

    /// Returns how many fields the scheme keeps besides u and d.
    pub(crate) fn kept(&self) -> usize {
        with!(self, |arithmetic| kept_of(arithmetic))
    }

    /// Returns the force of the branches during the last increment ([`Arithmetic::relaxing`]); `None` without branches.
    #[inline(always)]
    pub(crate) fn relaxing<V: Vector<Real = T>>(&self, n: V, kept: &[V; MAX_KEPT]) -> Option<V> {
        if let Observer::RelaxingTwoStep(arithmetic) = self { Some(arithmetic.relaxing(n, kept)) } else { None }
    }

    /// Returns u, w and the square of w in the form of the scheme's conserved energy ([`Arithmetic::observe`],
    /// [`Arithmetic::conserved_speed_squared`]).
    #[inline(always)]
    pub(crate) fn observe<V: Vector<Real = T>>(
        &self,
        x: V,
        d: V,
        n: V,
        kept: &[V; MAX_KEPT],
        force: Option<V>,
    ) -> [V; 3] {
        with!(self, |arithmetic| {
            let (u, w) = arithmetic.observe(x, d, n, kept, force);
            [u, w, arithmetic.conserved_speed_squared(x, d, n, kept, force)]
        })
    }
}
