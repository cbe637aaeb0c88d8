//! The local model: the part of a sample that describes the tissue around the tool's place at that time.
//!
//! A client is ahead of every sample by the round trip, and knows its own path since then. So it starts from the
//! sample's state and computes the response of the tissue along that path ([`Touching`]). The force law gives the
//! pressure at the depth below the surface, minus damping. Tangentially, the disc sticks with the law's stiffness up
//! to the friction cone, and slides beyond. The error is that of the law over some millimetres, not that of a delay
//! of some milliseconds.

use std::collections::VecDeque;

use glam::{DMat3, DVec3};

use crate::force_law::{Law, Row};

/// State of contact between a tool and the tissue at one time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ContactState {
    /// The tool does not touch the tissue.
    Free,
    /// The tool touches the tissue and sticks to it.
    Sticking,
    /// The tool touches the tissue and slides, at the edge of the friction cone.
    Sliding,
    /// The tool holds the tissue, so it pulls as well as pushes.
    Holding,
}

/// Model of the tissue around a tool's place, as a sample contains it. Forces are those of the tissue on the tool;
/// vectors and matrices are in the tissue's frame. [`Touching::force_n`] computes the force: for a tool that holds the
/// tissue f₀ − K·(x − x₀) − B·(v − v₀), otherwise by the force law from p, n, κ and μ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalModel {
    /// Sequence number of the sample; it rises with each sample of a connection, maybe by more than 1.
    pub sequence: u64,
    /// Time of the tool's place by the client's clock, s.
    pub client_time_s: f64,
    /// Number of simulation steps that the server had done.
    pub step: u64,
    /// Place x₀ of the tool, m.
    pub place_m: DVec3,
    /// Velocity of the tool, m/s.
    pub velocity_m_per_s: DVec3,
    /// Force f₀ on the tool at x₀, N.
    pub force_n: DVec3,
    /// Stiffness K of the tissue, symmetric, N/m.
    pub stiffness_n_per_m: DMat3,
    /// Damping B of the tissue, symmetric, N·s/m.
    pub damping_n_s_per_m: DMat3,
    /// Point p on the surface under the tool, as the surface would be without the tool, m.
    pub surface_m: DVec3,
    /// Outward unit normal n at p.
    pub normal: DVec3,
    /// Curvature κ: change of the normal per metre along the surface, 1/m. It is symmetric, 0 for a plane, and 1/R
    /// for a sphere that is touched from outside.
    pub curvature_per_m: DMat3,
    /// Distance from x₀ within which K is valid, m ([`valid_m`]); it may be infinite. Only a tool that holds the
    /// tissue is rendered from K and B.
    pub valid_m: f64,
    /// Coefficient μ of Coulomb friction, 0 or more.
    pub friction: f64,
    /// State of contact between the tool and the tissue.
    pub contact_state: ContactState,
    /// Number of the force law by which p was computed; render this model with it.
    pub law: u32,
}

impl LocalModel {
    /// Returns whether a client can render it: every number is finite, `valid_m` and `friction` are not negative
    /// (`valid_m` may be infinite), and the normal has unit length within 0.001.
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

/// Returns the distance r within which a stiffness K is valid, m: r = √(2·max(f/10, `least_n`)/‖∂K/∂x‖), with f =
/// `force_n` the size of the force, N, and ‖∂K/∂x‖ = `change_n_per_m2` the change of K over a distance, N/m², which
/// counts as at least 10⁻⁹.
///
/// Over a distance r, the model's force is wrong by ½·‖∂K/∂x‖·r², the next term of its Taylor series. At r this error
/// is a tenth of the force, or `least_n` (N) if that is larger.
pub fn valid_m(force_n: f64, least_n: f64, change_n_per_m2: f64) -> f64 {
    (2.0 * (0.1 * force_n).max(least_n) / change_n_per_m2.max(1e-9)).sqrt()
}

/// Record of a tool's newest places with their times by the client's clock. It keeps 2048, which is 2 s at 1 kHz.
#[derive(Debug, Clone)]
pub struct Track {
    places: VecDeque<(f64, DVec3)>,
}

/// Number of places kept: two seconds at 1 kHz.
const KEPT: usize = 2048;

impl Default for Track {
    /// Creates an empty record. It reserves all the memory that it will use, because a tick must not allocate.
    fn default() -> Self {
        Track { places: VecDeque::with_capacity(KEPT) }
    }
}

impl Track {
    /// Appends `place_m`, m, at `time_s` by the client's clock, s, which must not be before the last one (not
    /// checked). Drops the oldest beyond 2048.
    pub fn push(&mut self, time_s: f64, place_m: DVec3) {
        if self.places.len() == KEPT {
            self.places.pop_front();
        }
        self.places.push_back((time_s, place_m));
    }

    /// Returns the places more than half a microsecond after `time_s` (client's clock, s), from the oldest to the
    /// newest, m. Empty if there are none.
    pub fn after(&self, time_s: f64) -> impl Iterator<Item = DVec3> {
        let from = self.places.partition_point(|place| !is_after(place.0, time_s));
        self.places.range(from..).map(|place| place.1)
    }

    /// Removes all places, and keeps the memory for them.
    pub fn clear(&mut self) {
        self.places.clear();
    }
}

/// Returns whether one time of the client is after another by more than half a microsecond: times are rounded to
/// nanoseconds on the wire.
pub(crate) fn is_after(time_s: f64, other_s: f64) -> bool {
    time_s > other_s + 5e-7
}

/// A client's usual tick, s.
const TICK_S: f64 = 1e-3;

/// State of a touch along a tool's path since a sample: tangential stretch of the tissue, sticking or sliding, and
/// place. It begins with a sample ([`Touching::at_sample`]) and is replaced at the next one; each of its functions
/// must get the same model, and the law that this model names.
///
/// A sample describes a tool 2 mm deep in a tissue of 400 N/m. Since then the client's tool has moved 1 mm deeper, so
/// its force is 1.2 N:
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
    /// Tangential displacement of the tissue under the disc from the place where it would not pull, m.
    stretch_m: DVec3,
    sliding: bool,
    /// Stretch at the time of the sample, m.
    begun_m: DVec3,
    /// The part of the sample's force that the law does not explain, N.
    rest_n: DVec3,
    place_m: DVec3,
}

/// Largest angle by which a curved surface turns along a path, as its tangent.
const MAX_TURN: f64 = 1.0;

impl Touching {
    /// Creates the state at the time of the sample `model`. The stretch s = −(f_t + B_t·v_t)/K_t explains the part f_t
    /// of the sample's force across the normal, with v_t the tool's velocity across it and K_t, B_t and D the law's
    /// stiffness, damping and drag across it at the depth d (D in place of B_t while it slides). It stays within the
    /// friction cone, |s| ≤ μ·F(d)/K_t. The law does not explain the rest r of the force, which is kept and added
    /// ([`Touching::force_n`]). For a tool that is free or holds the tissue, s and r are 0.
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
            // The rule of `move_to` decides, not the sample: otherwise the force would change with the first move.
            let ahead_m = touching.stretch_m + moved * TICK_S;
            touching.sliding = within(ahead_m, most_m) != ahead_m;
        }
        touching.rest_n = model.force_n - touching.force_n(model, law, model.velocity_m_per_s);
        touching
    }

    /// Returns the depth below the surface, m, and the normal at the disc's place on it.
    ///
    /// With x the tool's place, s the stretch and d the depth, the disc is at a = x − s + d·n(a), on the surface.
    /// Since the sample it has moved by g along the surface. There the normal is that of the sample plus κg, and the
    /// surface is ½·gᵀκg below the plane of the sample. Two iterations find a, with an error of third order in the
    /// angle.
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

    /// Returns the depth of the disc below the surface at the tool's present place, m (negative above it), and the
    /// law's values at that depth (those of depth 0 above it).
    pub fn at_law(&self, model: &LocalModel, law: &Law) -> (f64, Row) {
        let (depth_m, _) = self.under(model);
        (depth_m, law.at_depth(depth_m))
    }

    /// Moves the tool by Δx to `place_m` (m, in the tissue's frame): the stretch s becomes the part of s + Δx across
    /// the normal, shortened to μ·F(d)/K_t, with F and K_t the law's force and stiffness across at the depth d
    /// (Coulomb's law: the disc slides where its spring would pull with more than μ times the pressure). Above the
    /// surface, or where K_t is 0, the stretch becomes 0. The path counts: call it for each recorded place in turn.
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

    /// Returns the force of the tissue on the tool at its present place, if it moves at `velocity_m_per_s`, N.
    ///
    /// With the depth d, the normal n, the stretch s, the velocity v and its part v_t across n; F(d), K_t, B, B_t and
    /// D the law's values at that depth ([`Row`]); and r the rest of the sample's force:
    ///
    /// f = p·n + t + r,  p = max(0, F(d) − B·v·n), t = −K_t·s − B_t·v_t where the disc sticks,  t = −K_t·s where it
    /// slides, each shortened to μ·p; then −D·v_t as well where it slides.
    ///
    /// The part of f that points into the tissue is removed, and f is 0 above the surface. For a tool that holds the
    /// tissue, f = f₀ − K·Δx − B·Δv, with Δx and Δv the differences from the sample's place and velocity, and Δx
    /// shortened to [`LocalModel::valid_m`].
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

/// Returns the part of `vector` across the unit vector `normal`.
fn across(vector: DVec3, normal: DVec3) -> DVec3 {
    vector - vector.dot(normal) * normal
}

/// Returns `vector`, shortened to the length `most`.
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
