//! The local model: the content of a sample about the tissue around the tool's place at that time.
//!
//! A client is ahead of every sample by the round trip, and knows its own path since. So it starts from the sample's
//! state and repeats the response of the tissue along that path ([`Touching`]): the depth below the surface gives the
//! pressure by the force law, less damping; tangentially, the disc sticks with the law's stiffness up to the friction
//! cone, and slides beyond. The error is that of the law along some millimetres, not that of some milliseconds.

use std::collections::VecDeque;

use glam::{DMat3, DVec3};

use crate::force_law::{Law, Row};

/// The state of contact between a tool and the tissue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ContactState {
    /// Not touching.
    Free,
    /// Touching, and not sliding.
    Sticking,
    /// Touching, at the edge of the friction cone.
    Sliding,
    /// Holding.
    Holding,
}

/// The content of a sample. Forces are those on the tool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalModel {
    /// Sequence number; each sample has a higher one.
    pub sequence: u64,
    /// Client time of the tool's place, s.
    pub client_time_s: f64,
    /// Steps done.
    pub step: u64,
    /// x0: place of the tool, m.
    pub place_m: DVec3,
    /// Velocity of the tool, m/s.
    pub velocity_m_per_s: DVec3,
    /// f0: the force there, N.
    pub force_n: DVec3,
    /// K: symmetric, N/m.
    pub stiffness_n_per_m: DMat3,
    /// B: symmetric, N·s/m.
    pub damping_n_s_per_m: DMat3,
    /// p: a place on the surface under the tool as it would be without the tool, m.
    pub surface_m: DVec3,
    /// n: the outward normal there.
    pub normal: DVec3,
    /// κ: how the normal changes per metre along the surface, 1/m; symmetric, 0 of a plane, 1/R of a sphere that is touched
    /// from outside.
    pub curvature_per_m: DMat3,
    /// The distance from x0 within which K is valid, m.
    pub valid_m: f64,
    /// μ.
    pub friction: f64,
    /// The state of contact between the tool and the tissue.
    pub contact_state: ContactState,
    /// The number of the force law that goes with this model: p is placed by it.
    pub law: u32,
}

impl LocalModel {
    /// Returns whether every number is finite and the normal has unit length.
    pub fn is_sound(&self) -> bool {
        let vectors = [self.place_m, self.velocity_m_per_s, self.force_n, self.surface_m];
        vectors.iter().all(|v| v.is_finite())
            && self.stiffness_n_per_m.is_finite()
            && self.damping_n_s_per_m.is_finite()
            && self.curvature_per_m.is_finite()
            && self.valid_m >= 0.0
            && self.friction >= 0.0
            && self.friction.is_finite()
            && self.client_time_s.is_finite()
            && (self.normal.length() - 1.0).abs() < 1e-3
    }
}

/// Returns the distance within which K is valid: where half its change along the path is a tenth of the force, or of
/// `least_n` if that is larger. `change` is ‖∂K/∂x‖, N/m².
///
/// Over a way r the force of the model is off by ½·‖∂K/∂x‖·r², the next term of its Taylor series. So
/// r = √(2·max(f/10, `least_n`)/‖∂K/∂x‖).
pub fn valid_m(force_n: f64, least_n: f64, change_n_per_m2: f64) -> f64 {
    (2.0 * (0.1 * force_n).max(least_n) / change_n_per_m2.max(1e-9)).sqrt()
}

/// The newest places of a tool, by the client's own clock.
#[derive(Debug, Clone)]
pub struct Track {
    places: VecDeque<(f64, DVec3)>,
}

/// Number of places kept: two seconds at 1 kHz.
const KEPT: usize = 2048;

impl Default for Track {
    /// An empty one, with room for all that it will keep: a tick must not ask for memory.
    fn default() -> Self {
        Track { places: VecDeque::with_capacity(KEPT) }
    }
}

impl Track {
    /// Adds the newest place.
    pub fn push(&mut self, time_s: f64, place_m: DVec3) {
        if self.places.len() == KEPT {
            self.places.pop_front();
        }
        self.places.push_back((time_s, place_m));
    }

    /// Returns all places after a time, in order.
    pub fn after(&self, time_s: f64) -> impl Iterator<Item = DVec3> {
        let from = self.places.partition_point(|place| !is_after(place.0, time_s));
        self.places.range(from..).map(|place| place.1)
    }

    /// Removes all places.
    pub fn clear(&mut self) {
        self.places.clear();
    }
}

/// Whether one time of the client is after another, with half a microsecond of tolerance: times return from the wire in whole
/// nanoseconds.
pub(crate) fn is_after(time_s: f64, other_s: f64) -> bool {
    time_s > other_s + 5e-7
}

/// A client's usual tick, s.
const TICK_S: f64 = 1e-3;

/// The state of a touch along a tool's path.
///
/// A sample tells of a tool 2 mm deep in a tissue of 400 N/m. Since then the client's tool has gone 1 mm deeper, so it feels 1.2 N:
///
/// ```
/// use glam::{DMat3, DVec3};
/// use palpate_haptics::{ContactState, Law, LocalModel, Touching};
///
/// let law = Law::linear(400.0, 0.5);
/// let model = LocalModel {
///     sequence: 1,
///     client_time_s: 0.0,
///     step: 1,
///     place_m: DVec3::new(0.0, 0.0, -0.002),
///     velocity_m_per_s: DVec3::ZERO,
///     force_n: 0.8 * DVec3::Z,
///     stiffness_n_per_m: 400.0 * DMat3::IDENTITY,
///     damping_n_s_per_m: 0.5 * DMat3::IDENTITY,
///     surface_m: DVec3::ZERO,
///     normal: DVec3::Z,
///     curvature_per_m: DMat3::ZERO,
///     valid_m: 0.01,
///     friction: 0.2,
///     contact_state: ContactState::Sticking,
///     law: 0,
/// };
/// assert!(model.is_sound());
/// let mut touching = Touching::at_sample(&model, &law);
/// touching.move_to(&model, &law, DVec3::new(0.0, 0.0, -0.003));
/// let force_n = touching.force_n(&model, &law, DVec3::ZERO);
/// assert!((force_n - 1.2 * DVec3::Z).length() < 1e-9, "{force_n} N");
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Touching {
    /// How far the tissue under the disc is displaced tangentially from where it would not pull, m.
    stretch_m: DVec3,
    sliding: bool,
    /// Stretch when the sample was taken, m.
    begun_m: DVec3,
    /// The part of the sample's force that the law does not explain, N.
    rest_n: DVec3,
    place_m: DVec3,
}

/// The surface turns by no more than this along a way for which it is curved: tan of the angle.
const MAX_TURN: f64 = 1.0;

impl Touching {
    /// Returns the state when the sample was taken: the stretch s = −(f_t + B_t·v_t)/K_t that explains what of the sample's
    /// force is across the surface (D in place of B_t while it slides), within the friction cone, |s| ≤ μ·F(d)/K_t; and the rest r
    /// of the force, which the law does not explain ([`Touching::force_n`]).
    pub fn at_sample(model: &LocalModel, law: &Law) -> Self {
        let mut touching = Touching {
            stretch_m: DVec3::ZERO,
            sliding: false,
            begun_m: DVec3::ZERO,
            rest_n: DVec3::ZERO,
            place_m: model.place_m,
        };
        if matches!(model.contact_state, ContactState::Free | ContactState::Holding) {
            return touching;
        }
        touching.sliding = model.contact_state == ContactState::Sliding;
        let row = law.at_depth(touching.under(model).0);
        let moved = across(model.velocity_m_per_s, model.normal);
        let mut drawn_n = across(model.force_n, model.normal);
        drawn_n += if touching.sliding { row.drag_n_s_per_m } else { row.across_n_s_per_m } * moved;
        if row.across_n_per_m > 0.0 {
            let most_m = model.friction * row.force_n / row.across_n_per_m;
            touching.stretch_m = within(-drawn_n / row.across_n_per_m, most_m);
            touching.begun_m = touching.stretch_m;
            // By the rule of `move_to`, not by the sample: otherwise the force would change with the first move.
            let ahead_m = touching.stretch_m + moved * TICK_S;
            touching.sliding = within(ahead_m, most_m) != ahead_m;
        }
        touching.rest_n = model.force_n - touching.force_n(model, law, model.velocity_m_per_s);
        touching
    }

    /// Depth below the surface, and the normal where the disc is on it.
    ///
    /// With x the tool's place, s the stretch and d the depth, the disc is at a = x − s + d·n(a), on the surface. From
    /// where it was when the sample was taken it has gone a way g along the surface; there the normal is that of the sample
    /// plus κg, and the surface ½·gᵀκg below the plane of the sample. Two rounds find a: what they leave is of third order in
    /// the angle.
    fn under(&self, model: &LocalModel) -> (f64, DVec3) {
        let above_m = self.place_m - model.surface_m;
        let plane = (-above_m.dot(model.normal), model.normal);
        if model.curvature_per_m == DMat3::ZERO {
            return plane;
        }
        let (mut depth_m, mut normal) = plane;
        let moved_m = self.place_m - model.place_m - (self.stretch_m - self.begun_m);
        for _ in 0..2 {
            let gone_m = across(moved_m + depth_m * normal, model.normal);
            let turn = within(across(model.curvature_per_m * gone_m, model.normal), MAX_TURN);
            normal = (model.normal + turn).normalize();
            let height_m = (above_m - self.stretch_m).dot(model.normal) + 0.5 * gone_m.dot(turn);
            depth_m = -height_m / normal.dot(model.normal);
        }
        (depth_m, normal)
    }

    /// Returns the depth of the disc, m, and the law there.
    pub fn at_law(&self, model: &LocalModel, law: &Law) -> (f64, Row) {
        let (depth_m, _) = self.under(model);
        (depth_m, law.at_depth(depth_m))
    }

    /// Advances to the tool's next place, Δx away: s becomes what of s + Δx is across the surface, shortened to μ·F(d)/K_t
    /// (Coulomb's law: the disc slides where its spring would pull with more than μ times the pressure).
    pub fn move_to(&mut self, model: &LocalModel, law: &Law, place_m: DVec3) {
        let moved_m = place_m - self.place_m;
        self.place_m = place_m;
        let (depth_m, normal) = self.under(model);
        let row = law.at_depth(depth_m);
        if depth_m <= 0.0 || row.across_n_per_m <= 0.0 {
            (self.stretch_m, self.sliding) = (DVec3::ZERO, false);
            return;
        }
        let most_m = model.friction * row.force_n / row.across_n_per_m;
        let stretch_m = across(self.stretch_m + moved_m, normal);
        self.stretch_m = within(stretch_m, most_m);
        self.sliding = self.stretch_m != stretch_m;
    }

    /// Returns the force on the tool at its present place, N.
    ///
    /// With d the depth, n the normal, s the stretch, v the velocity and v_t what of it is across n; F(d), K_t, B, B_t and D the
    /// law at that depth ([`Row`]); and r the rest of the sample's force:
    ///
    /// f = p·n + t + r,  p = max(0, F(d) − B·v·n),
    /// t = −K_t·s − B_t·v_t where the disc sticks,  t = −K_t·s where it slides, each shortened to μ·p; then −D·v_t as well where
    /// it slides.
    ///
    /// What of f points into the tissue is left out. A tool that holds the tissue feels f₀ − K·Δx − B·Δv, with Δx and Δv the
    /// differences from the sample's place and velocity, and Δx shortened to [`LocalModel::valid_m`].
    pub fn force_n(&self, model: &LocalModel, law: &Law, velocity_m_per_s: DVec3) -> DVec3 {
        if model.contact_state == ContactState::Holding {
            let away_m = within(self.place_m - model.place_m, model.valid_m);
            let faster = velocity_m_per_s - model.velocity_m_per_s;
            return model.force_n - model.stiffness_n_per_m * away_m - model.damping_n_s_per_m * faster;
        }
        let (depth_m, normal) = self.under(model);
        if depth_m <= 0.0 {
            return DVec3::ZERO;
        }
        let row = law.at_depth(depth_m);
        let pressure_n = (row.force_n - row.damping_n_s_per_m * velocity_m_per_s.dot(normal)).max(0.0);
        let across_m_per_s = across(velocity_m_per_s, normal);
        let mut across_n = -row.across_n_per_m * self.stretch_m;
        if !self.sliding {
            across_n -= row.across_n_s_per_m * across_m_per_s;
        }
        across_n = within(across_n, model.friction * pressure_n);
        if self.sliding {
            across_n -= row.drag_n_s_per_m * across_m_per_s;
        }
        let force_n = pressure_n * normal + across_n + self.rest_n;
        // A touch never pulls.
        force_n - force_n.dot(normal).min(0.0) * normal
    }
}

/// What of `vector` is across the unit vector `normal`.
fn across(vector: DVec3, normal: DVec3) -> DVec3 {
    vector - vector.dot(normal) * normal
}

/// `vector`, shortened to the length `most`.
fn within(vector: DVec3, most: f64) -> DVec3 {
    let length = vector.length();
    if length <= most { vector } else { vector * (most / length) }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    const NORMAL: DVec3 = DVec3::new(0.6, 0.0, 0.8);
    /// A direction in the surface.
    const ALONG: DVec3 = DVec3::new(-0.8, 0.0, 0.6);

    /// 400 N/m and 0.5 N·s/m along the normal; across it 300 N/m and 2 N·s/m of a disc that sticks.
    fn law() -> Law {
        let row = |depth_m: f64| Row {
            force_n: 400.0 * depth_m,
            stiffness_n_per_m: 400.0,
            across_n_per_m: 300.0,
            damping_n_s_per_m: 0.5,
            across_n_s_per_m: 2.0,
            drag_n_s_per_m: 1.0,
        };
        Law { step_m: 0.1, rows: vec![row(0.0), row(0.1)], is_coarse: false }
    }

    /// A disc at rest, 4 mm deep, so pressed with 1.6 N, and drawn back along the surface with `drawn_n`.
    fn model(drawn_n: f64) -> LocalModel {
        LocalModel {
            law: 0,
            sequence: 1,
            client_time_s: 0.0,
            step: 1,
            place_m: -0.004 * NORMAL,
            velocity_m_per_s: DVec3::ZERO,
            force_n: 1.6 * NORMAL - drawn_n * ALONG,
            stiffness_n_per_m: DMat3::IDENTITY,
            damping_n_s_per_m: DMat3::IDENTITY,
            surface_m: DVec3::ZERO,
            normal: NORMAL,
            curvature_per_m: DMat3::ZERO,
            valid_m: 0.01,
            friction: 0.2,
            contact_state: ContactState::Sticking,
        }
    }

    #[test]
    fn a_disc_that_sticks_goes_on_from_the_samples_stretch_up_to_the_cone_of_friction() {
        let (law, model) = (law(), model(0.2));
        let mut touching = Touching::at_sample(&model, &law);
        // Where it is, it feels the sample's force; a way of 0.1 mm stretches by 0.03 N; the cone is at 0.2·1.6 N.
        for (way_m, drawn_n) in [(0.0, 0.2), (1e-4, 0.23), (-1e-4, 0.17), (0.0, 0.2), (0.01, 0.32), (0.02, 0.32)] {
            touching.move_to(&model, &law, model.place_m + way_m * ALONG);
            let force_n = touching.force_n(&model, &law, DVec3::ZERO);
            assert!((force_n - (1.6 * NORMAL - drawn_n * ALONG)).length() < 1e-12, "{way_m} m: {force_n}");
        }
        // Back from there the stretch gets less at once.
        touching.move_to(&model, &law, model.place_m + (0.02 - 1e-4) * ALONG);
        let force_n = touching.force_n(&model, &law, DVec3::ZERO);
        assert!((force_n.dot(ALONG) + 0.29).abs() < 1e-12, "{force_n}");
    }

    #[test]
    fn on_a_sphere_the_force_stays_radial_and_the_depth_is_that_below_the_sphere() {
        const RADIUS_M: f64 = 0.04;
        let law = law();
        let model = LocalModel {
            surface_m: DVec3::ZERO,
            curvature_per_m: DMat3::IDENTITY * (1.0 / RADIUS_M),
            contact_state: ContactState::Free,
            friction: 0.0,
            ..model(0.0)
        };
        let middle_m = -RADIUS_M * NORMAL;
        for angle in [0.0, 0.05, -0.1, 0.2] {
            let out = DQuat::from_axis_angle(NORMAL.cross(ALONG), angle) * NORMAL;
            let mut touching = Touching::at_sample(&model, &law);
            touching.move_to(&model, &law, middle_m + (RADIUS_M - 0.003) * out);
            let force_n = touching.force_n(&model, &law, DVec3::ZERO);
            // Of a plane it would be 20 % at 0.1, and in another direction.
            let error = (force_n - 1.2 * out).length() / 1.2;
            assert!(error < 1e-9 + 4.0 * angle.abs().powi(3), "{angle}: {error}");
        }
    }

    #[test]
    fn a_curvature_that_makes_no_sense_does_no_harm() {
        let law = law();
        for curvature in [1e300, -1e9, 1e-300] {
            let model = LocalModel { curvature_per_m: DMat3::IDENTITY * curvature, ..model(0.1) };
            assert!(model.is_sound());
            let mut touching = Touching::at_sample(&model, &law);
            for way_m in [1e-6, 0.01, 1.0] {
                touching.move_to(&model, &law, model.place_m + way_m * ALONG);
                assert!(touching.force_n(&model, &law, ALONG).is_finite(), "{curvature} {way_m}");
            }
        }
    }

    #[test]
    fn damping_acts_along_the_movement_and_across_never_beyond_the_cone() {
        let (law, model) = (law(), model(0.0));
        let touching = Touching::at_sample(&model, &law);
        let inward_n = touching.force_n(&model, &law, -0.1 * NORMAL);
        assert!((inward_n - 1.65 * NORMAL).length() < 1e-12, "{inward_n}");
        let slow_n = touching.force_n(&model, &law, 0.1 * ALONG);
        assert!((slow_n - (1.6 * NORMAL - 0.2 * ALONG)).length() < 1e-12, "{slow_n}");
        let fast_n = touching.force_n(&model, &law, 1.0 * ALONG);
        assert!((fast_n - (1.6 * NORMAL - 0.32 * ALONG)).length() < 1e-12, "{fast_n}");
    }
}
