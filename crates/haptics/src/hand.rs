//! Simulated hands: a mass that holds the device and is pulled to a target by a spring. The results show how a
//! control loop behaves, not how it feels to people.

use glam::DVec3;

/// Model of a hand that holds a device: m·ẍ = k·(target − x) − b·ẋ + F, with x the place of hand and device, F the
/// force of the device on the hand, and m, b and k the fields below.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hand {
    /// Name by which [`Hand::named`] finds it, in lower case.
    pub name: &'static str,
    /// Mass m of hand and device, kg; above 0.
    pub mass_kg: f64,
    /// Damping b, N·s/m; above 0.
    pub damping_n_s_per_m: f64,
    /// Stiffness k of the spring that pulls it to the target, N/m; 0 for a device that nobody holds.
    pub stiffness_n_per_m: f64,
}

const fn hand(name: &'static str, mass_kg: f64, damping_n_s_per_m: f64, stiffness_n_per_m: f64) -> Hand {
    Hand { name, mass_kg, damping_n_s_per_m, stiffness_n_per_m }
}

/// Known hands, from a loose grip to a firm one: `light`, `medium`, `firm`. The last, `none`, is a device that nobody
/// holds.
pub const HANDS: [Hand; 4] = [
    hand("light", 0.1, 2.0, 100.0),
    hand("medium", 0.15, 5.5, 300.0),
    hand("firm", 0.3, 10.0, 800.0),
    hand("none", 0.05, 0.3, 0.0),
];

/// Stiffness, N/m, and largest force, N, of the string that pulls a device that nobody holds.
const STRING_N_PER_M: f64 = 60.0;
const STRING_N: f64 = 0.5;

/// Place and velocity of a hand and its device at one time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct HandState {
    /// Place, m.
    pub place_m: DVec3,
    /// Velocity, m/s.
    pub velocity_m_per_s: DVec3,
}

impl Hand {
    /// Returns the hand of [`HANDS`] whose name is `name` exactly, in lower case; `None` if there is none.
    pub fn named(name: &str) -> Option<Self> {
        HANDS.iter().find(|hand| hand.name == name).copied()
    }

    /// Returns the force of the string that pulls a device that nobody holds from `place_m` to `target_m`, N: 60 N/m
    /// times the way, shortened to 0.5 N. For a hand (`stiffness_n_per_m` > 0) it is 0. The caller adds it to the
    /// force that it gives to [`Hand::advance`].
    pub fn string_n(&self, target_m: DVec3, place_m: DVec3) -> DVec3 {
        if self.stiffness_n_per_m > 0.0 {
            return DVec3::ZERO;
        }
        (STRING_N_PER_M * (target_m - place_m)).clamp_length_max(STRING_N)
    }

    /// Returns the state `time_s` after the state `held`, under the constant force F = `force_n` on the hand, N, with
    /// a target that moves straight from `from_m` to `to_m`, m. It is exact except that the target counts as constant
    /// in each quarter of the time, at its mean.
    ///
    /// With γ = b/2m, ω² = k/m − γ², the place of rest x_r = target + F/k, x₀ and v₀ the place and velocity of `held`,
    /// and a = x₀ − x_r:
    ///
    /// x(t) = x_r + e^{−γt}·(a·cos ωt + (v₀ + γ·a)·sin(ωt)/ω),
    /// v(t) = e^{−γt}·(v₀·cos ωt − (γ·v₀ + (k/m)·a)·sin(ωt)/ω),
    ///
    /// with hyperbolic functions of |ω| where ω² < 0. Without a spring, v(t) = F/b + (v₀ − F/b)·e^{−bt/m}.
    pub fn advance(&self, held: HandState, from_m: DVec3, to_m: DVec3, force_n: DVec3, time_s: f64) -> HandState {
        const PARTS: u32 = 4;
        let part_s = time_s / f64::from(PARTS);
        (0..PARTS).fold(held, |held, part| {
            let target_m = from_m.lerp(to_m, (f64::from(part) + 0.5) / f64::from(PARTS));
            self.coast(held, target_m, force_n, part_s)
        })
    }

    /// The exact solution for a target at rest.
    fn coast(&self, held: HandState, target_m: DVec3, force_n: DVec3, t: f64) -> HandState {
        let (m, b, k) = (self.mass_kg, self.damping_n_s_per_m, self.stiffness_n_per_m);
        let rate = b / (2.0 * m);
        let HandState { place_m: x, velocity_m_per_s: v } = held;
        if k == 0.0 {
            // Without a spring, the speed tends to force/b.
            let (last, decay) = (force_n / b, (-b / m * t).exp());
            let place_m = x + last * t + (v - last) * (1.0 - decay) * (m / b);
            return HandState { place_m, velocity_m_per_s: last + (v - last) * decay };
        }
        let rest_m = target_m + force_n / k;
        let square = k / m - rate * rate;
        let omega = square.abs().sqrt();
        // cos and sin/ω of the vibration, or the hyperbolic functions.
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
        HandState { place_m, velocity_m_per_s }
    }

    /// Returns the delay at which the loop of the hand and a rendered spring of `stiffness_n_per_m` = K (N/m) becomes
    /// unstable, s; infinite if it never does. It is the smallest t for which m·s² + b·s + k + K·e^{−s·t} = 0 has a
    /// root s on the imaginary axis. A sample that is held for a period adds a delay of half a period.
    ///
    /// With s = iω both sides of K·e^{−iωt} = mω² − k − ibω have the same size, so (mω² − k)² + b²ω² = K²:
    ///
    /// ω² = [(2mk − b²) ± √((2mk − b²)² − 4m²·(k² − K²))]/2m²,
    ///
    /// and the same angle: ω·t = −arg(mω² − k − ibω), from 0 to 2π.
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A hand so firm and damped that it does not oscillate.
    const CREEPING: Hand = hand("creeping", 0.1, 20.0, 300.0);

    /// Integrates the equation of motion to fourth order, in steps so short that their error does not matter.
    fn integrated(hand: &Hand, held: HandState, from_m: DVec3, to_m: DVec3, force_n: DVec3, time_s: f64) -> HandState {
        const STEPS: u32 = 2000;
        let dt = time_s / f64::from(STEPS);
        let slope = |[x, v]: [DVec3; 2], part: f64| {
            let pull_n = hand.stiffness_n_per_m * (from_m.lerp(to_m, part) - x) - hand.damping_n_s_per_m * v;
            [v, (pull_n + force_n) / hand.mass_kg]
        };
        let along = |[x, v]: [DVec3; 2], [dx, dv]: [DVec3; 2], t: f64| [x + t * dx, v + t * dv];
        let [place_m, velocity_m_per_s] = (0..STEPS).fold([held.place_m, held.velocity_m_per_s], |y, step| {
            let part = |share: f64| (f64::from(step) + share) / f64::from(STEPS);
            let k1 = slope(y, part(0.0));
            let k2 = slope(along(y, k1, 0.5 * dt), part(0.5));
            let k3 = slope(along(y, k2, 0.5 * dt), part(0.5));
            let k4 = slope(along(y, k3, dt), part(1.0));
            [0, 1].map(|c: usize| y[c] + dt / 6.0 * (k1[c] + 2.0 * k2[c] + 2.0 * k3[c] + k4[c]))
        });
        HandState { place_m, velocity_m_per_s }
    }

    #[test]
    fn a_hand_obeys_its_equation() {
        let held = HandState { place_m: DVec3::new(0.01, -0.02, 0.003), velocity_m_per_s: DVec3::new(-0.1, 0.05, 0.2) };
        let (force_n, target_m) = (DVec3::new(0.4, -0.3, 1.1), DVec3::new(0.02, 0.01, -0.015));
        for hand in HANDS.into_iter().chain([CREEPING]) {
            for time_s in [0.001, 0.02, 0.3] {
                let truth = integrated(&hand, held, target_m, target_m, force_n, time_s);
                let found = hand.advance(held, target_m, target_m, force_n, time_s);
                let way_m = truth.place_m.distance(held.place_m);
                assert!(found.place_m.distance(truth.place_m) < 1e-8 * way_m, "{} {time_s}: {found:?}", hand.name);
                let speeds = [found, truth].map(|held| held.velocity_m_per_s);
                assert!(speeds[0].distance(speeds[1]) < 1e-7, "{} {time_s}: {speeds:?}", hand.name);
            }
            // A moving target counts by its mean over a quarter of the time.
            let to_m = target_m + DVec3::new(3e-4, 0.0, 0.0);
            let truth = integrated(&hand, held, target_m, to_m, force_n, 0.001);
            let found = hand.advance(held, target_m, to_m, force_n, 0.001);
            let speeds = [found, truth].map(|held| held.velocity_m_per_s);
            assert!(found.place_m.distance(truth.place_m) < 1e-8, "{}: {found:?} {truth:?}", hand.name);
            assert!(speeds[0].distance(speeds[1]) < 2e-5, "{}: {speeds:?}", hand.name);
        }
    }

    #[test]
    fn a_hand_comes_to_rest_where_its_spring_bears_the_force() {
        for hand in HANDS.into_iter().filter(|hand| hand.stiffness_n_per_m > 0.0) {
            let (target_m, force_n) = (DVec3::new(0.0, 0.01, 0.02), DVec3::new(0.0, 0.0, 1.0));
            let end =
                (0..200).fold(HandState::default(), |held, _| hand.advance(held, target_m, target_m, force_n, 0.05));
            assert!(end.place_m.distance(target_m + force_n / hand.stiffness_n_per_m) < 1e-12);
            assert_eq!(hand.string_n(target_m, DVec3::ZERO), DVec3::ZERO);
        }
        // A device that is not held is pulled by a string with half a newton.
        let nobody = Hand::named("none").unwrap_or(CREEPING);
        assert_eq!(nobody.string_n(DVec3::new(0.001, 0.0, 0.0), DVec3::ZERO), DVec3::new(0.06, 0.0, 0.0));
        assert!((nobody.string_n(DVec3::ONE, DVec3::ZERO).length() - 0.5).abs() < 1e-12);
        assert_eq!(Hand::named("nobody"), None);
    }

    /// m·s² + b·s + k + K·e^(−s·t) at s = iω.
    fn characteristic(hand: &Hand, stiffness: f64, delay_s: f64, omega: f64) -> f64 {
        let real = hand.stiffness_n_per_m - hand.mass_kg * omega * omega + stiffness * (omega * delay_s).cos();
        let imaginary = hand.damping_n_s_per_m * omega - stiffness * (omega * delay_s).sin();
        real.hypot(imaginary)
    }

    #[test]
    fn the_critical_delay_is_the_least_with_a_vibration_that_lasts() {
        for hand in HANDS {
            for stiffness in [20.0, 150.0, 400.0, 1500.0] {
                let delay_s = hand.critical_delay_s(stiffness);
                let least = |delay_s: f64| {
                    let omegas = (1..200_000).map(|n| 2e-3 * f64::from(n));
                    omegas.map(|omega| characteristic(&hand, stiffness, delay_s, omega)).fold(f64::INFINITY, f64::min)
                };
                if delay_s.is_finite() {
                    assert!(least(delay_s) < 0.1, "{} {stiffness}: {delay_s}", hand.name);
                    for part in [0.5, 0.8, 0.95] {
                        assert!(least(part * delay_s) > 0.1, "{} {stiffness}: {part}", hand.name);
                    }
                } else {
                    assert!(least(0.02) > 0.0 && stiffness < hand.stiffness_n_per_m, "{} {stiffness}", hand.name);
                }
            }
        }
    }
}
