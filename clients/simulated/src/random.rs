//! Random numbers that are equal on every machine.

/// A random number generator whose results are equal on every machine. Each method advances it.
pub struct Random(fastrand::Rng);

impl Random {
    /// Creates the generator number `stream` of a seed. Equal arguments give equal numbers; those of different streams
    /// are independent.
    pub fn new(seed: u64, stream: u64) -> Self {
        // The odd factor spreads neighbouring seeds and streams.
        Random(fastrand::Rng::with_seed((seed ^ stream.rotate_left(32)).wrapping_mul(0x9e37_79b9_7f4a_7c15)))
    }

    /// Returns a uniformly distributed number from `low` to below `high`.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.f64()
    }

    /// Returns a number of the normal distribution with mean 0 and standard deviation 1 (Box and Muller).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.between(0.0, 1.0)).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.between(0.0, 1.0)).cos()
    }

    /// Returns an element of a list, each with equal probability.
    ///
    /// # Panics
    /// If the list is empty.
    pub fn one_of<'t, T>(&mut self, list: &'t [T]) -> &'t T {
        &list[self.0.usize(..list.len())]
    }
}
