//! The rendering law: a thousand times a second, it computes a force from the newest local model and the tool's own
//! path.
//!
//! When a newer model arrives, the force would jump by the error of the old one. That difference is kept as a bias and
//! decays with [`BIAS_S`], so the hand feels a smooth change, not a knock.

use glam::DVec3;

use super::envelope::{Envelope, State, Wanted};
use super::law::Law;
use super::local::{LocalModel, Touching, Track};
use crate::sheet::Standing;

/// Time constant with which the error of the last model decays, s.
pub const BIAS_S: f64 = 0.02;

/// One tool's renderer.
#[derive(Debug, Clone)]
pub struct Renderer {
    law: Law,
    /// The newest model, and the touch that follows from it.
    newest: Option<(LocalModel, Touching)>,
    /// A newer model that has arrived since.
    arrived: Option<LocalModel>,
    arrived_s: Option<f64>,
    bias_n: DVec3,
    biased_s: f64,
    track: Track,
    before: Option<(f64, DVec3)>,
    velocity_m_per_s: DVec3,
    refused: u64,
    /// The limits between the law and the device.
    pub envelope: Envelope,
}

impl Renderer {
    /// A renderer for a tissue with `law`, which must be sound, behind `envelope`.
    pub fn new(law: Law, envelope: Envelope) -> Self {
        Renderer {
            law,
            newest: None,
            arrived: None,
            arrived_s: None,
            bias_n: DVec3::ZERO,
            biased_s: 0.0,
            track: Track::default(),
            before: None,
            velocity_m_per_s: DVec3::ZERO,
            refused: 0,
            envelope,
        }
    }

    /// Restarts with another server, whose models start from the beginning. The envelope keeps its state.
    pub fn begin(&mut self, law: Law) {
        (self.law, self.newest, self.arrived, self.arrived_s) = (law, None, None, None);
    }

    /// The number of models refused: out of order, or not finite.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Whether forces are rendered.
    pub fn state(&self) -> State {
        self.envelope.state()
    }

    /// The time of the newest model by the client's clock, s.
    pub fn model_time_s(&self) -> Option<f64> {
        self.newest.as_ref().map(|newest| newest.0.client_time_s)
    }

    /// Takes a model that has just arrived. It takes effect at the next tick.
    pub fn receive(&mut self, model: LocalModel, now_s: f64) {
        let newest = self.arrived.as_ref().or(self.newest.as_ref().map(|newest| &newest.0));
        let late = newest.is_some_and(|newest| model.sequence <= newest.sequence);
        if late || !model.is_sound() {
            self.refused += 1;
            return;
        }
        (self.arrived, self.arrived_s) = (Some(model), Some(now_s));
    }

    /// Switches to a model that has arrived: repeats the tool's path since, and keeps the difference from the last
    /// model.
    fn adopt(&mut self, model: LocalModel, now_s: f64) {
        let before_n = self.newest.is_some().then(|| self.wanted_n(now_s));
        let mut touching = Touching::at_sample(&model, &self.law);
        for place_m in self.track.after(model.client_time_s) {
            touching.move_to(&model, &self.law, place_m);
        }
        self.newest = Some((model, touching));
        (self.biased_s, self.bias_n) = (now_s, DVec3::ZERO);
        if let Some(before_n) = before_n {
            self.bias_n = before_n - self.wanted_n(now_s);
        }
    }

    /// The force that the law asks for, before the envelope, N.
    fn wanted_n(&self, now_s: f64) -> DVec3 {
        let Some((model, touching)) = &self.newest else { return DVec3::ZERO };
        let force_n = touching.force_n(model, &self.law, self.velocity_m_per_s)
            + self.bias_n * ((self.biased_s - now_s) / BIAS_S).exp();
        if model.standing == Standing::Holding {
            return force_n;
        }
        force_n - force_n.dot(model.normal).min(0.0) * model.normal
    }

    /// The force to render until the next tick, for a tool at `place_m` now, N.
    pub fn tick(&mut self, now_s: f64, place_m: DVec3) -> DVec3 {
        let known = place_m.is_finite() && now_s.is_finite();
        if let Some((then_s, from_m)) = self.before.filter(|_| known)
            && now_s > then_s
        {
            self.velocity_m_per_s = (place_m - from_m) / (now_s - then_s);
        }
        if known {
            self.before = Some((now_s, place_m));
            self.track.push(now_s, place_m);
            if let Some((model, touching)) = &mut self.newest {
                touching.move_to(model, &self.law, place_m);
            }
            if let Some(model) = self.arrived.take() {
                self.adopt(model, now_s);
            }
        }
        let force_n = self.wanted_n(now_s);
        // Before the first model nothing is stale.
        let age_s = self.arrived_s.map_or(0.0, |arrived_s| now_s - arrived_s);
        let wanted = Wanted { now_s, place_m, velocity_m_per_s: self.velocity_m_per_s, force_n, age_s };
        self.envelope.render(&wanted)
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::super::device::UNDECLARED;
    use super::*;

    /// Of a tool at rest at `place_m`, on a surface at `height_m` with a spring of 400 N/m.
    fn model(sequence: u64, time_s: f64, place_m: DVec3, height_m: f64) -> LocalModel {
        LocalModel {
            sequence,
            client_time_s: time_s,
            step: sequence,
            place_m,
            velocity_m_per_s: DVec3::ZERO,
            force_n: 400.0 * (height_m - place_m.z) * DVec3::Z,
            stiffness_n_per_m: DMat3::IDENTITY,
            damping_n_s_per_m: DMat3::IDENTITY,
            surface_m: height_m * DVec3::Z,
            normal: DVec3::Z,
            valid_m: 0.01,
            friction: 0.2,
            standing: Standing::Sticking,
        }
    }

    fn renderer() -> Renderer {
        Renderer::new(Law::linear(400.0, 0.5), Envelope::new(UNDECLARED, DVec3::ZERO))
    }

    #[test]
    fn a_moving_hand_feels_the_spring_where_it_is_and_the_damping_of_its_speed() {
        let mut renderer = renderer();
        let place_m = |tick: u32| -DVec3::Z * (0.002 + 1e-4 * f64::from(tick));
        renderer.receive(model(1, 0.0, place_m(0), 0.0), 0.0);
        for tick in 0..30 {
            let now_s = f64::from(tick) * 1e-3;
            renderer.tick(now_s, place_m(tick));
            // 0.1 m/s from the second tick on.
            let damping_n = if tick == 0 { 0.0 } else { 0.05 };
            let expected_n = 0.8 + 0.04 * f64::from(tick) + damping_n;
            let wanted_n = renderer.wanted_n(now_s);
            assert!((wanted_n - expected_n * DVec3::Z).length() < 1e-9, "{tick}: {wanted_n}");
        }
    }

    #[test]
    fn a_newer_model_changes_the_force_without_a_jump() {
        let (mut renderer, place_m) = (renderer(), -0.004 * DVec3::Z);
        renderer.receive(model(1, 0.0, place_m, 0.0), 0.0);
        renderer.tick(0.0, place_m);
        assert!((renderer.wanted_n(0.0).z - 1.6).abs() < 1e-12);
        // The surface was told a millimetre too high: 1.6 N instead of 1.2.
        renderer.receive(model(2, 0.001, place_m, -0.001), 0.001);
        renderer.tick(0.001, place_m);
        for (later_s, expected_n) in [(0.0, 1.6), (BIAS_S, 1.2 + 0.4 / std::f64::consts::E), (1.0, 1.2)] {
            let wanted_n = renderer.wanted_n(0.001 + later_s);
            assert!((wanted_n - expected_n * DVec3::Z).length() < 1e-9, "{later_s} s: {wanted_n}");
        }
    }
}
