//! The force law of a tissue: its force, stiffness and damping over the depth of a disc that is pressed straight in
//! quasi-statically. The server sends it once and ahead, so that a client knows how the force will rise.
//!
//! The stiffness at one place does not determine the force a millimetre deeper, because tissue hardens: with 50 ms of
//! delay, a hand at 50 mm/s is 2.5 mm beyond the last sample. A polynomial through past samples extrapolates badly
//! there. The tissue's own law, which the server computes from its model, is accurate.

use std::f64::consts::PI;

use crate::tip::TipShape;

/// Stiffness of a flat rigid disc of radius a on a half-space, 2·a·E/(1 − ν²), divided by that of an even pressure, whose mean
/// depth is 16·p·a·(1 − ν²)/(3π·E) (Johnson, Contact Mechanics, sections 3.4 and 3.6).
const RIGID_TO_EVEN: f64 = 32.0 / (3.0 * PI * PI);

/// Values of a force law at one depth: force, stiffness and damping. "Along" and "across" refer to the outward normal
/// of the surface; a disc sticks or slides as [`crate::Touching`] decides.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Row {
    /// Outward force of the tissue on the disc, N.
    pub force_n: f64,
    /// Stiffness along the normal, the derivative of the force by the depth, N/m.
    pub stiffness_n_per_m: f64,
    /// Stiffness across the normal for a disc that sticks, N/m.
    pub across_n_per_m: f64,
    /// Damping along the normal, N·s/m.
    pub damping_n_s_per_m: f64,
    /// Damping across the normal for a disc that sticks, N·s/m.
    pub across_n_s_per_m: f64,
    /// Damping across the normal for a disc that slides, N·s/m.
    pub drag_n_s_per_m: f64,
}

/// Force law of a tissue: force, stiffness and damping over depth, as a table with equal steps of depth from 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Law {
    /// Depth between two rows, m; above 0.
    pub step_m: f64,
    /// Values at depths 0, `step_m`, 2·`step_m`, …; at least two rows in a sound law ([`Law::is_sound`]).
    pub rows: Vec<Row>,
    /// Whether it was composed from coarser sheets because the tissue's own law takes too long to compute. It is then
    /// within a tenth of that law.
    pub is_coarse: bool,
}

impl Law {
    /// Returns the law of a linear spring and damper, K·d + B·v at a depth d and a speed v inwards, with K =
    /// `stiffness_n_per_m` and B = `damping_n_s_per_m` both along and across the normal. A disc that slides has no
    /// drag. It has two rows, at 0 and 0.1 m, and is linear beyond as well.
    pub fn linear(stiffness_n_per_m: f64, damping_n_s_per_m: f64) -> Self {
        let step_m = 0.1;
        let row = |force_n: f64| Row {
            force_n,
            stiffness_n_per_m,
            across_n_per_m: stiffness_n_per_m,
            damping_n_s_per_m,
            across_n_s_per_m: damping_n_s_per_m,
            drag_n_s_per_m: 0.0,
        };
        Law { step_m, rows: vec![row(0.0), row(stiffness_n_per_m * step_m)], is_coarse: false }
    }

    /// Returns the law of a tip of `radius_m` (m), if this is the law of a disc of that radius with an even pressure, on a linear
    /// tissue whose modulus E/(1 − ν²) near the tip is `plane_modulus_pa`, Pa.
    ///
    /// On a half-space a flat rigid disc is [`RIGID_TO_EVEN`] as stiff (Boussinesq). A sphere of radius R that goes x into a
    /// half-space touches what is within √(R·x), up to its half, and its stiffness is that of a rigid disc of this radius (Hertz):
    /// g(x) = 2·E/(1 − ν²)·√(R·x). A tissue that is held nearby yields less by s·F, whatever the size of the tip, with s from the
    /// law of the disc: so a sphere that is d deep has x = d + s·F(x), and the stiffness g/(1 − s·g). Stiffness and damping across
    /// the normal, damping and drag change in the proportion of g.
    pub fn of_tip(self, shape: TipShape, radius_m: f64, plane_modulus_pa: f64) -> Self {
        let disc_n_per_m = RIGID_TO_EVEN * self.at_depth(0.0).stiffness_n_per_m;
        let whole_n_per_m = 2.0 * plane_modulus_pa * radius_m;
        if !shape.is_rigid() || disc_n_per_m <= 0.0 || whole_n_per_m <= 0.0 {
            return self;
        }
        let spared_m_per_n = whole_n_per_m.recip() - disc_n_per_m.recip();
        // Force and stiffness on a half-space.
        let of_half_space = |into_m: f64| {
            let touching = (into_m.min(radius_m) / radius_m).sqrt();
            let force_n = 2.0 / 3.0 * touching * whole_n_per_m * into_m.min(radius_m);
            (force_n + whole_n_per_m * (into_m - radius_m).max(0.0), touching)
        };
        let of_sphere = |depth_m: f64| {
            let most_m = depth_m * (disc_n_per_m / whole_n_per_m).max(1.0);
            let (mut low_m, mut high_m) = (0.0, most_m);
            for _ in 0..60 {
                let into_m = 0.5 * (low_m + high_m);
                let is_deeper = into_m - spared_m_per_n * of_half_space(into_m).0 > depth_m;
                if is_deeper { high_m = into_m } else { low_m = into_m }
            }
            let (force_n, touching) = of_half_space(0.5 * (low_m + high_m));
            let stiffness_n_per_m = touching * whole_n_per_m;
            (force_n, stiffness_n_per_m / (1.0 - spared_m_per_n * stiffness_n_per_m), touching)
        };
        let of_row = |(number, row): (usize, &Row)| {
            let (force_n, stiffness_n_per_m, touching) = match shape {
                TipShape::Sphere => of_sphere(number as f64 * self.step_m),
                TipShape::RigidDisc | TipShape::Disc | TipShape::Blade => {
                    (RIGID_TO_EVEN * row.force_n, RIGID_TO_EVEN * row.stiffness_n_per_m, 1.0)
                }
            };
            let part = RIGID_TO_EVEN * touching;
            Row {
                force_n,
                stiffness_n_per_m,
                across_n_per_m: part * row.across_n_per_m,
                damping_n_s_per_m: part * row.damping_n_s_per_m,
                across_n_s_per_m: part * row.across_n_s_per_m,
                drag_n_s_per_m: part * row.drag_n_s_per_m,
            }
        };
        let rows = self.rows.iter().enumerate().map(of_row).collect();
        Law { rows, ..self }
    }

    /// Returns whether a client can use it: it has at least two rows and a positive step, all values are finite and
    /// not negative, and the force never falls with depth.
    pub fn is_sound(&self) -> bool {
        let finite = |row: &Row| {
            [row.force_n, row.stiffness_n_per_m, row.across_n_per_m, row.damping_n_s_per_m, row.across_n_s_per_m]
                .iter()
                .chain([&row.drag_n_s_per_m])
                .all(|value| value.is_finite() && *value >= 0.0)
        };
        self.rows.len() >= 2
            && self.step_m > 0.0
            && self.step_m.is_finite()
            && self.rows.iter().all(finite)
            && self.rows.windows(2).all(|pair| pair[1].force_n >= pair[0].force_n)
    }

    /// Returns the values at `depth_m`, m. The force is cubic between rows, with the rows' stiffness as slopes, and a
    /// straight line beyond the last row. A negative depth counts as 0. Panics if the law has no row.
    ///
    /// With F₀ and F₁ the forces of two rows a step h apart, k₀ and k₁ their stiffness, Δ = F₁ − F₀ and t from 0 to 1
    /// between them, the force is the cubic of Hermite:
    ///
    /// F(t) = F₀ + t·Δ + t·(1 − t)·[(1 − t)·(h·k₀ − Δ) + t·(Δ − h·k₁)],  k = F′(t)/h.
    ///
    /// All other values are linear between rows and constant beyond the last. Beyond the last row, at depth D,
    /// F = F(D) + k(D)·(d − D).
    pub fn at_depth(&self, depth_m: f64) -> Row {
        let last = self.rows.len() - 1;
        let place = (depth_m / self.step_m).max(0.0);
        if place >= last as f64 {
            let row = self.rows[last];
            let beyond_m = depth_m - last as f64 * self.step_m;
            return Row { force_n: row.force_n + row.stiffness_n_per_m * beyond_m, ..row };
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let below = place as usize;
        let t = place - below as f64;
        let (a, b) = (self.rows[below], self.rows[below + 1]);
        let mix = |a: f64, b: f64| a + t * (b - a);
        let rise = b.force_n - a.force_n;
        let (sa, sb) = (a.stiffness_n_per_m * self.step_m - rise, rise - b.stiffness_n_per_m * self.step_m);
        let bend = t * (1.0 - t);
        Row {
            force_n: a.force_n + t * rise + bend * ((1.0 - t) * sa + t * sb),
            stiffness_n_per_m: (rise + (1.0 - 2.0 * t) * ((1.0 - t) * sa + t * sb) + bend * (sb - sa)) / self.step_m,
            across_n_per_m: mix(a.across_n_per_m, b.across_n_per_m),
            damping_n_s_per_m: mix(a.damping_n_s_per_m, b.damping_n_s_per_m),
            across_n_s_per_m: mix(a.across_n_s_per_m, b.across_n_s_per_m),
            drag_n_s_per_m: mix(a.drag_n_s_per_m, b.drag_n_s_per_m),
        }
    }

    /// Returns the depth at which the force is `force_n` (N), m: by bisection between the two rows around it; beyond
    /// the last row, at depth D, it is D + (`force_n` − F(D))/k(D), with F and k the law's force and stiffness, which
    /// is very large if k(D) is 0. Returns 0 if `force_n` is not positive. The law must be sound ([`Law::is_sound`]).
    pub fn depth_of(&self, force_n: f64) -> f64 {
        if force_n <= 0.0 {
            return 0.0;
        }
        let last = self.rows.len() - 1;
        let above = self.rows.partition_point(|row| row.force_n < force_n);
        if above > last {
            let row = self.rows[last];
            return last as f64 * self.step_m + (force_n - row.force_n) / row.stiffness_n_per_m.max(f64::MIN_POSITIVE);
        }
        let (mut low, mut high) = ((above.max(1) - 1) as f64 * self.step_m, above.max(1) as f64 * self.step_m);
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            if self.at_depth(middle).force_n < force_n { low = middle } else { high = middle }
        }
        0.5 * (low + high)
    }

    /// Returns the depth of the last row, m: (number of rows − 1)·`step_m`.
    pub fn reach_m(&self) -> f64 {
        (self.rows.len() - 1) as f64 * self.step_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a law that hardens, with rows 0.5 mm apart. All its values differ.
    fn hardening() -> Law {
        let rows = (0..5).map(|row| {
            let x = f64::from(row);
            Row {
                force_n: 0.1 * x + 0.02 * x * x,
                stiffness_n_per_m: (0.1 + 0.04 * x) / 5e-4,
                across_n_per_m: 50.0 + 3.0 * x,
                damping_n_s_per_m: 0.5 + 0.1 * x,
                across_n_s_per_m: 0.3 + 0.07 * x,
                drag_n_s_per_m: 0.2 + 0.01 * x * x,
            }
        });
        Law { step_m: 5e-4, rows: rows.collect(), is_coarse: false }
    }

    #[test]
    fn on_a_linear_tissue_rigid_tips_have_the_laws_of_boussinesq_and_hertz() {
        let (radius_m, modulus_pa) = (0.004_f64, 9e3);
        let whole_n_per_m: f64 = 2.0 * modulus_pa * radius_m;
        let near = |a: f64, b: f64| (a - b).abs() < 1e-12 + 1e-9 * b.abs();
        // A half-space, a thin tissue on a firm table, and one that yields.
        for spared_m_per_n in [0.0, 0.4 / whole_n_per_m, -0.3 / whole_n_per_m] {
            let disc_n_per_m = (whole_n_per_m.recip() - spared_m_per_n).recip();
            let even = Law::linear(disc_n_per_m * 3.0 * PI * PI / 32.0, 0.5);
            let even =
                Law { step_m: 1e-3, rows: (0..9).map(|row| even.at_depth(1e-3 * f64::from(row))).collect(), ..even };
            assert_eq!(even.clone().of_tip(TipShape::Disc, radius_m, modulus_pa), even);
            let disc = even.clone().of_tip(TipShape::RigidDisc, radius_m, modulus_pa);
            let sphere = even.of_tip(TipShape::Sphere, radius_m, modulus_pa);
            assert!(disc.is_sound() && sphere.is_sound());
            assert_eq!((sphere.rows[0].force_n, sphere.rows[0].stiffness_n_per_m), (0.0, 0.0));
            for (row, depth_m) in (1..9).map(|row| (row, 1e-3 * row as f64)) {
                let (disc, sphere) = (disc.rows[row], sphere.rows[row]);
                assert!(
                    near(disc.force_n, disc_n_per_m * depth_m) && near(disc.stiffness_n_per_m, disc_n_per_m),
                    "{disc:?}"
                );
                let into_m = depth_m + spared_m_per_n * sphere.force_n;
                let (force_n, stiffness) = if into_m < radius_m {
                    let touches_m = (radius_m * into_m).sqrt();
                    (4.0 / 3.0 * modulus_pa * touches_m * into_m, 2.0 * modulus_pa * touches_m)
                } else {
                    (whole_n_per_m * (into_m - radius_m / 3.0), whole_n_per_m)
                };
                assert!(near(sphere.force_n, force_n), "{spared_m_per_n} {sphere:?} {force_n}");
                assert!(near(sphere.stiffness_n_per_m, (stiffness.recip() - spared_m_per_n).recip()), "{sphere:?}");
            }
        }
    }

    #[test]
    fn a_law_meets_its_rows_and_is_smooth_between_them() {
        let law = hardening();
        assert!(law.is_sound());
        assert!((law.reach_m() - 2e-3).abs() < 1e-15);
        for (index, row) in law.rows.iter().enumerate() {
            let at = law.at_depth(index as f64 * law.step_m);
            assert!((at.force_n - row.force_n).abs() < 1e-12 && (at.drag_n_s_per_m - row.drag_n_s_per_m).abs() < 1e-12);
            assert!((at.stiffness_n_per_m - row.stiffness_n_per_m).abs() < 1e-6, "{index}: {at:?}");
        }
        // The force is a parabola here, which cubics follow exactly; beyond the last row it is a straight line.
        for depth_m in [1e-4, 3e-4, 7e-4, 1.21e-3, 1.9e-3, 2.2e-3, 4e-3] {
            let x = depth_m / law.step_m;
            let end = x.min(4.0);
            let force_n = 0.1 * end + 0.02 * end * end + (x - end) * (0.1 + 0.04 * end);
            let at = law.at_depth(depth_m);
            assert!((at.force_n - force_n).abs() < 1e-12, "{depth_m}: {at:?}");
            let slope = (law.at_depth(depth_m + 1e-8).force_n - law.at_depth(depth_m - 1e-8).force_n) / 2e-8;
            assert!((at.stiffness_n_per_m - slope).abs() < 1e-4 * slope, "{depth_m}: {at:?} {slope}");
            assert!((law.depth_of(force_n) - depth_m).abs() < 1e-12, "{depth_m}: {}", law.depth_of(force_n));
            if x < 4.0 {
                let near = [at.across_n_per_m - (50.0 + 3.0 * x), at.damping_n_s_per_m - (0.5 + 0.1 * x)];
                assert!(near.iter().chain([&(at.across_n_s_per_m - (0.3 + 0.07 * x))]).all(|v| v.abs() < 1e-12));
            }
        }
        // Where the slopes differ from the chord, the stiffness is still the derivative of the force.
        let bent = Law {
            is_coarse: false,
            step_m: 1.0,
            rows: vec![
                Row { stiffness_n_per_m: 3.0, ..Row::default() },
                Row { force_n: 1.0, stiffness_n_per_m: 0.5, ..Row::default() },
            ],
        };
        for depth_m in [0.1, 0.4, 0.85] {
            let slope = (bent.at_depth(depth_m + 1e-7).force_n - bent.at_depth(depth_m - 1e-7).force_n) / 2e-7;
            assert!((bent.at_depth(depth_m).stiffness_n_per_m - slope).abs() < 1e-6, "{depth_m}");
        }
        assert_eq!(law.at_depth(-1.0), law.rows[0]);
        assert_eq!([law.depth_of(0.0), law.depth_of(-1.0)], [0.0; 2]);
    }

    #[test]
    fn a_law_that_no_client_can_use_is_not_sound() {
        let sound = hardening();
        let broken: [fn(&mut Law); 7] = [
            |law| law.rows.truncate(1),
            |law| law.step_m = 0.0,
            |law| law.step_m = f64::INFINITY,
            |law| law.rows[2].force_n = 0.0,
            |law| law.rows[1].drag_n_s_per_m = f64::NAN,
            |law| law.rows[1].across_n_per_m = -1.0,
            |law| law.rows[4].damping_n_s_per_m = f64::INFINITY,
        ];
        for spoil in broken {
            let mut law = sound.clone();
            spoil(&mut law);
            assert!(!law.is_sound(), "{law:?}");
        }
        let two = Law { rows: sound.rows[..2].to_vec(), ..sound };
        assert!(two.is_sound());
    }

    #[test]
    fn a_linear_law_is_a_spring_at_every_depth() {
        let law = Law::linear(400.0, 0.5);
        for depth_m in [0.0, 1e-3, 0.05, 0.1, 0.3] {
            let row = law.at_depth(depth_m);
            assert!((row.force_n - 400.0 * depth_m).abs() < 1e-9 && (row.stiffness_n_per_m - 400.0).abs() < 1e-9);
            let others = [row.across_n_per_m, row.damping_n_s_per_m, row.across_n_s_per_m, row.drag_n_s_per_m];
            assert_eq!(others, [400.0, 0.5, 0.5, 0.0]);
            assert!((law.depth_of(row.force_n) - depth_m).abs() < 1e-9);
        }
    }
}
