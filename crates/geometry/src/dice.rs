//! Pseudo-random numbers from a seed: equal on every machine and in every version.

/// A sequence of pseudo-random numbers (`SplitMix64`).
#[derive(Debug, Clone)]
pub struct Dice(u64);

impl Dice {
    /// Creates the sequence of a seed.
    pub fn new(seed: u64) -> Dice {
        Dice(seed)
    }

    /// Returns the next number, from 0 to 1.
    pub fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^= z >> 31;
        // 53 bits: every value is exact.
        (z >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Returns a number from `least` to `most`.
    pub fn within(&mut self, least: f64, most: f64) -> f64 {
        least + (most - least) * self.unit()
    }

    /// Returns a factor from 1 − `part` to 1 + `part`.
    pub fn factor(&mut self, part: f64) -> f64 {
        self.within(1.0 - part, 1.0 + part)
    }
}
