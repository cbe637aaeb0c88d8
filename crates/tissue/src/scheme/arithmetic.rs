//! The arithmetic of a scheme: how it advances one component of a block of points.

use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;

/// Largest number of fields that any scheme keeps besides u and d.
pub(crate) const MAX_KEPT: usize = 5;

/// Pure arithmetic on u (here `x`), d, the springs' force `n` and the values that a scheme keeps from earlier
/// substeps.
pub(crate) trait Arithmetic<T: Real> {
    /// Number of fields that the scheme keeps besides u and d.
    const KEPT: usize;
    /// How many of these fields, counted from the last, a sweep writes.
    const WRITTEN: usize;
    /// Number of force fields that it takes, 1 or 2.
    const FORCES: usize;

    /// Whether `advance` itself cuts values of u and d below [`Real::MIN_MAGNITUDE`] to 0.
    const CUTS: bool = false;

    /// Whether a part of the springs' force relaxes: [`Arithmetic::relaxing`].
    const RELAXES: bool = false;

    /// Returns the force of the branches during the last increment: the mean of its beginning and its end.
    #[inline(always)]
    fn relaxing<V: Vector<Real = T>>(&self, n: V, _kept: &[V; MAX_KEPT]) -> V {
        n.splat(T::default())
    }

    /// Returns u and d after the (sub)step and updates `kept`. `force` is the tools' force in the scheme's
    /// units; a single field is passed twice.
    fn advance<V: Vector<Real = T>>(&self, x: V, d: V, n: V, kept: &mut [V; MAX_KEPT], force: Option<[V; 2]>)
    -> (V, V);

    /// Returns the displacement along which the tools' force (the last of its fields) did work, given u and d
    /// before and after.
    fn travel<V: Vector<Real = T>>(&self, before: [V; 2], after: [V; 2]) -> V;

    /// Returns the present displacement and velocity × substep. `force` is that of the tools, in the springs'
    /// units.
    fn observe<V: Vector<Real = T>>(&self, x: V, d: V, n: V, kept: &[V; MAX_KEPT], force: Option<V>) -> (V, V);

    /// Returns the square of velocity × substep, in the form that the scheme's own conserved energy uses, if it
    /// has one.
    fn conserved_speed_squared<V: Vector<Real = T>>(
        &self,
        x: V,
        d: V,
        n: V,
        kept: &[V; MAX_KEPT],
        force: Option<V>,
    ) -> V {
        let (_, w) = self.observe(x, d, n, kept, force);
        w.mul(w)
    }
}
