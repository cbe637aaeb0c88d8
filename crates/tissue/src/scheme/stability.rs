//! Computes how fast a tissue can vibrate, and how many substeps that requires.

use crate::scene::{Integrator, Scene, Springs};
use crate::scheme::{Bound, Oscillator, Scheme, entry};

/// Largest turn of the fastest vibration per substep of central differences, rad: dt·ω_b ≤ θ. The scheme is
/// stable below 2; its error falls with θ². At 0.25 the force of the stiffest scenes is within 5e-3.
pub const THETA: f64 = 0.25;

/// Returns the factor, from 1 to 8, by which a turn must be smaller than [`THETA`] because vibrations last.
/// `omega_per_s` is the fastest vibration ω_b, rad/s; `decay_s` is τ = 2m/C, s, which may be infinite. If
/// nothing vibrates and nothing damps (0·∞), it is 1.
///
/// Central differences make a vibration ω faster by ω(dt·ω)²/24. The phase error adds up for as long as the
/// vibration lasts, τ, to (ω·τ)(dt·ω)²/24. The same error then requires a turn smaller by √(ω·τ). Up to ω_b·τ =
/// 27 the turn `THETA` itself suffices. Beyond 27·8² a run ends before the motion does, and no scheme of second
/// order is suitable. (Measured on scenes with C = 0 and k/K″ from 4 to 100 for 1 to 2 s: errors of 2e-2 of the
/// largest displacement without this factor, 3e-4 with it.)
pub fn endurance(omega_per_s: f64, decay_s: f64) -> f64 {
    let turns = omega_per_s * decay_s;
    // Nothing vibrates, and nothing damps it.
    if turns.is_nan() { 1.0 } else { (turns / 27.0).sqrt().clamp(1.0, 8.0) }
}

/// Returns an upper bound of the largest eigenvalue of the springs' stiffness matrix under any deformation,
/// with the reference masses, N/m.
///
/// On a sheet this is
/// [`largest_stiffness_of_a_sheet_n_per_m`](crate::scene::largest_stiffness_of_a_sheet_n_per_m). On a mesh it is
/// k·β + K″·ε, with β the bound of the graph's Laplacian divided by k
/// ([`StiffnessBound`](crate::scene::StiffnessBound)) and ε the largest excess of K″/m of a point over the
/// reference value. A volume replaces k·β by
/// [`Swelling::bound_n_per_m`](crate::scene::Swelling::bound_n_per_m). If burns make the tissue stiffer, k is that of a tissue that has
/// burnt through everywhere ([`Cutting::burnt_stiffness_factor`](crate::scene::Cutting::burnt_stiffness_factor)).
pub fn largest_stiffness_n_per_m(scene: &Scene) -> f64 {
    let (springs, anchor_n_per_m) = (stiffest_springs(scene), scene.anchor_stiffness_n_per_m);
    scene.body.kind().stiffness_bound_n_per_m(&springs, anchor_n_per_m, scene.volume_stiffness_pa)
}

/// Returns the springs of a tissue that has burnt through everywhere.
fn stiffest_springs(scene: &Scene) -> Springs {
    scene.springs.stiffened(scene.cutting.burnt_stiffness())
}

/// Returns an upper bound of the springs' stiffness without the pressure of a volume, N/m: k·β + K″·ε on a
/// mesh, with β and ε as in [`largest_stiffness_n_per_m`], to which it is equal for a tissue without a volume.
pub fn stiffness_of_springs_n_per_m(scene: &Scene) -> f64 {
    scene.body.kind().spring_bound_n_per_m(&stiffest_springs(scene), scene.anchor_stiffness_n_per_m)
}

/// Returns the approximate factor from rounding errors of displacements, m, to force, N; in N/m. The errors of
/// many points hardly add up to a change of the volume: λ + κ·σ/√n, with λ the springs' stiffness
/// ([`stiffness_of_springs_n_per_m`]), κ the volume's, σ = Σ a²/(m·V0) and n points. Without a volume it is λ.
#[allow(clippy::cast_precision_loss)]
pub fn approximate_stiffness_n_per_m(scene: &Scene) -> f64 {
    let of_springs = stiffness_of_springs_n_per_m(scene);
    let points = scene.shape().point_count() as f64;
    let of_pressure = |swelling_m: f64| scene.volume_stiffness_pa * swelling_m / points.sqrt();
    of_springs + scene.volume().map_or(0.0, |volume| of_pressure(volume.swelling.by_pressure_m))
}

/// Number of vibrations between the slowest and the fastest at which stability is tested: a scheme may fail in
/// between.
const VIBRATIONS: u32 = 48;

/// Largest growth factor of a vibration per substep that counts as stable: 1 plus rounding error.
const NO_GROWTH: f64 = 1.0 + 1e-7;

/// Returns whether no vibration grows, for springs up to `stiffness` = (ω·dt)², without unit
/// ([`Oscillator::scaled_spring_stiffness`]). It tests that each eigenvalue of the scheme's propagator has at
/// most size 1 (+ 1e-7 for rounding), at 49 stiffnesses z = `stiffness`·(k/48)², k = 0 to 48; a fault between
/// them would stay unseen.
pub fn is_stable(scheme: &Scheme, stiffness: f64) -> bool {
    (0..=VIBRATIONS).all(|k| {
        // Dense towards the stiff end, where schemes fail first.
        let part = f64::from(k) / f64::from(VIBRATIONS);
        scheme.growth(stiffness * part * part) <= NO_GROWTH
    })
}

/// Returns the fewest substeps, at least 1, in a step of `step_s`, s, with which any scheme is stable.
/// Saturates at `u32::MAX`.
///
/// This is dt·ω_b ≤ 2, the bound of central differences: u₊ − (2 − W)·u + u₋ = 0 with W = (dt·ω)² has the
/// solutions zⁿ with z² − (2 − W)·z + 1 = 0, and both are on the unit circle if |2 − W| ≤ 2.
pub fn least_substeps(step_s: f64, oscillator: &Oscillator) -> u32 {
    substeps_of_turn(step_s, oscillator.omega_bound_per_s(), 2.0)
}

/// Returns about the fewest substeps in a step of `step_s`, s, with which an integrator is stable
/// ([`is_stable`]). It tries upwards from [`least_substeps`], an eighth more each time. It ends, even if the
/// test never succeeds, where the fastest vibration turns by 0.1 rad in a substep, C·dt/m is at most 1 and τ·ω²·dt at most 0.1:
/// there every scheme is stable but for rounding. Saturates at `u32::MAX`.
pub fn stable_substeps(integrator: Integrator, step_s: f64, oscillator: &Oscillator) -> u32 {
    let mut substeps = least_substeps(step_s, oscillator);
    let stable = |substeps: u32| {
        let substep_s = step_s / f64::from(substeps);
        let scheme = Scheme::fit(integrator, oscillator.scaled(substep_s));
        is_stable(&scheme, oscillator.scaled_spring_stiffness(substep_s))
    };
    // All schemes are stable up to dt·ω = 0.3 even without damping, up to dt·C/m = 2 (`rk4` to 2.785), and where viscosity decides up to
    // dt·τ·ω² = 0.11 (`exponential4`; `central` to 1); because of rounding, the test may never succeed.
    let omega_per_s = oscillator.omega_bound_per_s();
    let by_viscosity_per_s = oscillator.viscous_time_s * omega_per_s * omega_per_s / 0.1;
    let by_damping_per_s = oscillator.damping_n_s_per_m / oscillator.mass_kg;
    let fastest_per_s = (omega_per_s / 0.1).max(by_damping_per_s).max(by_viscosity_per_s);
    let most = (step_s * fastest_per_s).min(f64::from(u32::MAX));
    while !stable(substeps) && f64::from(substeps) < most {
        substeps = substeps.saturating_add(substeps / 8 + 1);
    }
    substeps
}

/// Returns the number of substeps in a step of `step_s`, s, that an integrator gets without rehearsals. For
/// exponential schemes, `rk4` and `auto` (as `central`) it is [`stable_substeps`]; for `central` and `lagged`,
/// what makes them as accurate as they promise:
///
/// dt·ω_b ≤ [`THETA`]/e, with e = [`endurance`] at τ = 2m/C; for `lagged` also C·dt/m ≤ 1, half of its bound 2
/// (W + 2g < 4 with W = 0). A viscous tissue, and one with branches, gets at least [`stable_substeps`]. Saturates at `u32::MAX`.
pub fn substeps(integrator: Integrator, step_s: f64, oscillator: &Oscillator) -> u32 {
    let decay_s = 2.0 * oscillator.mass_kg / oscillator.damping_n_s_per_m;
    let omega = oscillator.omega_bound_per_s();
    let turn = || substeps_of_turn(step_s, omega, THETA / endurance(omega, decay_s));
    // Half the stable damping, so that light points do not ring with the substep.
    let lag = || substeps_of_turn(step_s, oscillator.damping_n_s_per_m / oscillator.mass_kg, 1.0);
    let stable = || stable_substeps(integrator, step_s, oscillator);
    let accurate = match entry(integrator).bound {
        Bound::Stable => return stable(),
        Bound::Turn => turn(),
        Bound::TurnAndLag => turn().max(lag()),
    };
    let is_elastic = oscillator.viscous_time_s == 0.0 && !oscillator.relaxes();
    if is_elastic { accurate } else { accurate.max(stable()) }
}

/// Returns the fewest substeps, at least 1, with dt·`omega_per_s` ≤ `theta`, dt = `step_s` / substeps; in s,
/// rad/s and rad. Saturates at `u32::MAX`.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn substeps_of_turn(step_s: f64, omega_per_s: f64, theta: f64) -> u32 {
    (step_s * omega_per_s / theta).ceil().clamp(1.0, f64::from(u32::MAX)) as u32
}

#[cfg(test)]
mod tests {
    #![allow(clippy::cast_precision_loss)]
    use super::*;
    use crate::scene::{MaxwellBranch, Named, largest_stiffness_of_a_sheet_n_per_m};
    use crate::scheme::Coefficients;

    /// Every scheme.
    fn all() -> impl Iterator<Item = Integrator> {
        Integrator::NAMES.iter().map(|entry| entry.1).filter(|integrator| *integrator != Integrator::Auto)
    }

    fn springs(k: f64, shear: f64, bending: bool) -> Springs {
        Springs { stiffness_n_per_m: k, shear_stiffness_n_per_m: shear, bending, pretension_n_per_m: 0.0 }
    }

    #[test]
    fn the_largest_stiffness_is_that_of_the_fastest_wave() {
        // With bending and a shear of 2 to 2.5 k, the fastest wave is on an edge between two corners.
        let cases = [(1.0, 1.0), (1.0, 0.0), (0.0, 2.0), (3.0, 0.2), (0.1, 5.0), (0.0, 0.0), (1.0, 2.2), (2.0, 4.8)];
        for (k, shear) in cases {
            for bending in [false, true] {
                // Force on a point of u = e^{i(aj + bk)}: over all its springs, 1 − cos of the phase between
                // their ends.
                let wave = |a: f64, b: f64| {
                    let both_ways = |stiffness: f64, phase: f64| 2.0 * stiffness * (1.0 - phase.cos());
                    let bending = if bending { both_ways(k, 2.0 * a) + both_ways(k, 2.0 * b) } else { 0.0 };
                    both_ways(k, a) + both_ways(k, b) + both_ways(shear, a + b) + both_ways(shear, a - b) + bending
                };
                let angles = (0..=720).map(|n| f64::from(n) * std::f64::consts::PI / 720.0);
                let most = angles.clone().flat_map(|a| angles.clone().map(move |b| wave(a, b))).fold(0.0, f64::max);
                let found = largest_stiffness_of_a_sheet_n_per_m(&springs(k, shear, bending));
                assert!(found >= most - 1e-12 && found <= most * (1.0 + 1e-4), "{k} {shear} {bending}: {found} {most}");
            }
        }
    }

    #[test]
    fn vibrations_that_last_ask_for_smaller_turns() {
        assert_eq!([endurance(10.0, 2.7), endurance(1.0, 1.0), endurance(0.0, f64::INFINITY)], [1.0; 3]);
        assert!((endurance(100.0, 1.08) - 2.0).abs() < 1e-12);
        assert_eq!([endurance(1e3, 1e3), endurance(1.0, f64::INFINITY)], [8.0; 2]);
    }

    #[test]
    fn stable_is_as_few_substeps_as_do_not_grow() {
        let omega_per_s = |stiffness: f64| (stiffness / 0.01_f64).sqrt();
        for spring_stiffness_n_per_m in [0.0, 10.0, 3e3, 4e5] {
            for damping_n_s_per_m in [0.0, 0.05, 8.0, 400.0] {
                let oscillator = Oscillator {
                    mass_kg: 0.01,
                    damping_n_s_per_m,
                    anchor_stiffness_n_per_m: 5.0,
                    spring_stiffness_n_per_m,
                    viscous_time_s: 0.0,
                    branches: Default::default(),
                };
                for integrator in all() {
                    let grows = |substeps: u32| {
                        let substep_s = 1e-3 / f64::from(substeps);
                        let scheme = Scheme::fit(integrator, oscillator.scaled(substep_s));
                        !is_stable(&scheme, oscillator.scaled_spring_stiffness(substep_s))
                    };
                    let found = stable_substeps(integrator, 1e-3, &oscillator);
                    let case = format!("{integrator:?} {spring_stiffness_n_per_m} {damping_n_s_per_m}: {found}");
                    let turn = omega_per_s(spring_stiffness_n_per_m + 5.0) * 1e-3;
                    // Without damping some grow by less than rounding tells, however short the substep.
                    assert!(!grows(found) || damping_n_s_per_m == 0.0 && turn / f64::from(found) <= 0.1, "{case}");
                    // The search goes by eighths: what is a fifth shorter grows, or turns by more than 2.
                    let fewer = found * 4 / 5;
                    assert!(fewer == 0 || grows(fewer) || turn / f64::from(fewer) > 2.0, "{case}");
                    assert!(turn / f64::from(found) <= 2.0, "{case}");
                }
                let turn = |integrator| {
                    let substeps = f64::from(substeps(integrator, 1e-3, &oscillator));
                    omega_per_s(spring_stiffness_n_per_m + 5.0) * 1e-3 / substeps
                };
                // Vibrations that last for 2m/C ask for a smaller turn of the yardsticks.
                let most = THETA / endurance(oscillator.omega_bound_per_s(), 0.02 / damping_n_s_per_m) * (1.0 + 1e-12);
                assert!(turn(Integrator::Central) <= most && turn(Integrator::Lagged) <= most);
                let lagged = substeps(Integrator::Lagged, 1e-3, &oscillator);
                assert!(damping_n_s_per_m / 0.01 * 1e-3 / f64::from(lagged) <= 1.0);
                assert_eq!(
                    substeps(Integrator::Rk4, 1e-3, &oscillator),
                    stable_substeps(Integrator::Rk4, 1e-3, &oscillator)
                );
            }
        }
    }

    #[test]
    fn a_vibration_grows_by_what_its_damping_says() {
        // Of u̇̇ + g·u̇ + (a + z)·u = 0 the slower part of e^{λ}; a scheme of second order errs by its square.
        // With viscosity, of u̇̇ + (g + β·z)·u̇ + (a + z)·u = 0.
        for (a, g, z, viscosity) in [
            (0.01, 0.02, 0.0, 0.0),
            (0.01, 0.02, 0.05, 0.0),
            (0.04, 0.5, 0.0, 0.0),
            (0.001, 0.1, 0.02, 0.0),
            (0.0, 0.02, 0.02, 1.5),
            (0.0, 0.0, 0.05, 0.4),
        ] {
            let damping: f64 = g + viscosity * z;
            let square: f64 = 0.25 * damping * damping - a - z;
            let truth = (if square > 0.0 { square.sqrt() } else { 0.0 } - 0.5 * damping).exp();
            let lacks = |integrator: &Integrator| match integrator {
                Integrator::Stormer => a > 0.0,
                Integrator::Rk4 => viscosity > 0.0,
                _ => false,
            };
            for integrator in all().filter(|integrator| !lacks(integrator)) {
                let within = match integrator {
                    Integrator::Lagged => 3e-2,
                    Integrator::Rk4 => 1e-4,
                    Integrator::Exponential3 | Integrator::Exponential4 => 1e-3,
                    _ => 2e-3,
                };
                let of = Coefficients { anchor: a, damping: g, viscosity, ..Coefficients::default() };
                let found = Scheme::fit(integrator, of).growth(z);
                assert!((found - truth).abs() < within, "{integrator:?} {a} {g} {z} {viscosity}: {found} {truth}");
            }
        }
    }

    #[test]
    fn two_step_schemes_are_stable_as_far_as_they_say() {
        for viscosity in [0.0, 0.1, 0.4, 2.0] {
            let of = Coefficients { viscosity, ..Coefficients::default() };
            for (integrator, own) in [(Integrator::Central, 1.0), (Integrator::Stormer, 4.0 / 3.0)] {
                let (scheme, limit) = (Scheme::fit(integrator, of), 4.0 / (own + 4.0 * viscosity));
                assert!(is_stable(&scheme, 0.999 * limit), "{integrator:?} {viscosity}");
                assert!(!is_stable(&scheme, 1.001 * limit), "{integrator:?} {viscosity}");
            }
        }
    }

    /// Returns an oscillator as tissues have it.
    fn of_tissue(viscous_time_s: f64, branches: [MaxwellBranch; 3]) -> Oscillator {
        Oscillator {
            mass_kg: 1e-5,
            damping_n_s_per_m: 2e-4,
            anchor_stiffness_n_per_m: 0.0,
            spring_stiffness_n_per_m: 300.0,
            viscous_time_s,
            branches,
        }
    }

    /// Asserts that an integrator is stable with the substeps of a millisecond that it gets.
    fn assert_gets_enough(integrator: Integrator, oscillator: &Oscillator) {
        let substeps = substeps(integrator, 1e-3, oscillator);
        let substep_s = 1e-3 / f64::from(substeps);
        let scheme = Scheme::fit(integrator, oscillator.scaled(substep_s));
        let stiffness = oscillator.scaled_spring_stiffness(substep_s);
        assert!(is_stable(&scheme, stiffness), "{integrator:?} {oscillator:?}: {substeps}");
    }

    #[test]
    fn every_scheme_gets_enough_substeps_for_any_viscosity() {
        for viscous_time_s in [1e-6, 1e-5, 1e-4, 1e-3, 1e-2] {
            let oscillator = of_tissue(viscous_time_s, Default::default());
            for integrator in all().filter(|integrator| *integrator != Integrator::Rk4) {
                assert_gets_enough(integrator, &oscillator);
            }
        }
    }

    #[test]
    fn two_step_schemes_get_enough_substeps_for_any_branch() {
        for stiffness in [0.1, 3.0, 1e3] {
            for time_s in [1e-3, 0.03, 100.0] {
                for viscous_time_s in [0.0, 3e-5] {
                    let branch = MaxwellBranch { stiffness, time_s };
                    let oscillator = of_tissue(viscous_time_s, [branch, MaxwellBranch::default(), branch]);
                    for integrator in [Integrator::Stormer, Integrator::Central, Integrator::Lagged] {
                        assert_gets_enough(integrator, &oscillator);
                    }
                }
            }
        }
    }

    #[test]
    fn nothing_that_vibrates_needs_one_substep() {
        let oscillator = Oscillator {
            mass_kg: 1.0,
            damping_n_s_per_m: 0.0,
            anchor_stiffness_n_per_m: 0.0,
            spring_stiffness_n_per_m: 0.0,
            viscous_time_s: 0.0,
            branches: Default::default(),
        };
        for integrator in all() {
            assert_eq!(substeps(integrator, 1e-3, &oscillator), 1, "{integrator:?}");
        }
        // An absurd one asks for as many as can be counted, at once.
        let absurd = Oscillator { spring_stiffness_n_per_m: 1e40, ..oscillator };
        assert_eq!(least_substeps(1e-3, &absurd), u32::MAX);
    }
}
