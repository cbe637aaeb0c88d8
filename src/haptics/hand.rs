//! Simulated hands: a mass that holds the device, drawn by a spring to where its owner wants it. What a simulated hand
//! feels says how a loop behaves, not how it feels to people.

use glam::DVec3;

/// m·ẍ = k(target − x) − b·ẋ + force of the device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hand {
    /// Any name.
    pub name: &'static str,
    /// Of hand and device, kg.
    pub mass_kg: f64,
    /// N·s/m.
    pub damping_n_s_per_m: f64,
    /// N/m.
    pub stiffness_n_per_m: f64,
}

const fn hand(name: &'static str, mass_kg: f64, damping_n_s_per_m: f64, stiffness_n_per_m: f64) -> Hand {
    Hand { name, mass_kg, damping_n_s_per_m, stiffness_n_per_m }
}

/// From a loose grip to a firm one; `none` is a device that nobody holds.
pub const HANDS: [Hand; 4] = [
    hand("light", 0.1, 2.0, 100.0),
    hand("medium", 0.15, 5.5, 300.0),
    hand("firm", 0.3, 10.0, 800.0),
    hand("none", 0.05, 0.3, 0.0),
];

/// The string of a device that nobody holds, N/m, and the most that it pulls with, N.
const STRING_N_PER_M: f64 = 60.0;
const STRING_N: f64 = 0.5;

/// Where a hand is.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Held {
    /// m.
    pub place_m: DVec3,
    /// m/s.
    pub velocity_m_per_s: DVec3,
}

impl Hand {
    /// By its name.
    pub fn named(name: &str) -> Option<Self> {
        HANDS.iter().find(|hand| hand.name == name).copied()
    }

    /// What leads a device that nobody holds to its target: a string, N. Hands need none.
    pub fn string_n(&self, target_m: DVec3, place_m: DVec3) -> DVec3 {
        if self.stiffness_n_per_m > 0.0 {
            return DVec3::ZERO;
        }
        (STRING_N_PER_M * (target_m - place_m)).clamp_length_max(STRING_N)
    }

    /// After `time_s` under a constant force, with a target that moves straight from `from_m` to `to_m`: exact but for
    /// the target's part, which is that of its mean.
    pub fn advance(&self, held: Held, from_m: DVec3, to_m: DVec3, force_n: DVec3, time_s: f64) -> Held {
        const PARTS: u32 = 4;
        let part_s = time_s / f64::from(PARTS);
        (0..PARTS).fold(held, |held, part| {
            let target_m = from_m.lerp(to_m, (f64::from(part) + 0.5) / f64::from(PARTS));
            self.coast(held, target_m, force_n, part_s)
        })
    }

    /// The exact solution for a target that rests.
    fn coast(&self, held: Held, target_m: DVec3, force_n: DVec3, t: f64) -> Held {
        let (m, b, k) = (self.mass_kg, self.damping_n_s_per_m, self.stiffness_n_per_m);
        let rate = b / (2.0 * m);
        let Held { place_m: x, velocity_m_per_s: v } = held;
        if k == 0.0 {
            // Nothing draws it: the speed goes to force/b.
            let (last, decay) = (force_n / b, (-b / m * t).exp());
            let place_m = x + last * t + (v - last) * (1.0 - decay) * (m / b);
            return Held { place_m, velocity_m_per_s: last + (v - last) * decay };
        }
        let rest_m = target_m + force_n / k;
        let square = k / m - rate * rate;
        let omega = square.abs().sqrt();
        // cos and sin/ω of the vibration, or their hyperbolic kin.
        let (c, s) = if omega * t < 1e-9 {
            (1.0, t)
        } else if square > 0.0 {
            ((omega * t).cos(), (omega * t).sin() / omega)
        } else {
            ((omega * t).cosh(), (omega * t).sinh() / omega)
        };
        let decay = (-rate * t).exp();
        let away = x - rest_m;
        let place_m = rest_m + decay * (away * c + (v + rate * away) * s);
        let velocity_m_per_s = decay * (v * c - (rate * v + (k / m) * away) * s);
        Held { place_m, velocity_m_per_s }
    }

    /// The delay in the loop with a spring of `stiffness` at which it stops being stable, s; infinite if it never does:
    /// the least t with m·s² + b·s + k + K·e^{−s·t} = 0 on the imaginary axis. A held sample counts as half a period.
    pub fn critical_delay_s(&self, stiffness_n_per_m: f64) -> f64 {
        let (m, b, k, stiffness) = (self.mass_kg, self.damping_n_s_per_m, self.stiffness_n_per_m, stiffness_n_per_m);
        let sum = 2.0 * m * k - b * b;
        let inner = sum * sum - 4.0 * m * m * (k * k - stiffness * stiffness);
        if inner < 0.0 {
            return f64::INFINITY;
        }
        [1.0, -1.0]
            .iter()
            .map(|sign| (sum + sign * inner.sqrt()) / (2.0 * m * m))
            .filter(|square| *square > 0.0)
            .map(|square| {
                let omega = square.sqrt();
                (-f64::atan2(-b * omega, m * square - k)).rem_euclid(std::f64::consts::TAU) / omega
            })
            .fold(f64::INFINITY, f64::min)
    }
}
