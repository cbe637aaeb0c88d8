//! A coarse force law: what a client receives at once if the exact law takes longer than it should wait.
//!
//! It is combined from small sheets of the same tissue (`tangent::stand_in`). The first is all of the sheet, or
//! the part that notices the disc, with few points: it includes the rim. Then follow smaller and smaller ones
//! around the disc, with half the spacing each time. Under a given force, each of these lets the disc go deeper
//! than the same piece of tissue with the coarser points; these differences are added to the depth in the
//! first.
//!
//! On a mesh, it is the law of the points around the disc, as many as time allows: those beyond are held. A solid carries a
//! load farther. There it is the law of the whole with larger cells, refined in the same way by the points around the disc
//! with the two sizes of cells.
//!
//! A law near a cut or a burn is that of the points around the disc too: sheets of other points have none.

use std::f64::consts::PI;
use std::sync::atomic::AtomicBool;

use palpate_haptics::force_law::{Law, Row};

use super::disc::Disc;
use super::exact::{ROWS as EXACT_ROWS, course, follow};
use crate::body::model::Model;
use crate::body::severed::Cuts;
use crate::body::window::half_window_m;
use crate::response::tangent::{self, Accuracy, Course};

/// Largest work of a first law, springs times iterations: 46 ms of processor time, at 27 ns per unit on an AMD EPYC
/// (family 26). Work is counted, not timed, so that every machine gives the same law.
const WORK: u64 = 1_700_000;

/// The part of it that an exact law may take before a coarse one is computed instead. If an exact law is begun
/// in vain, the sheet is small, and the rest suffices for it.
const EXACT_WORK: u64 = 1_000_000;

/// Work of the first law of a tissue whose law is linear, of which one depth is solved: 0.2 s.
const LINEAR_WORK: u64 = 8_000_000;

/// How many times as large cells are tried where all of a solid takes more, and how many of its own points around the disc
/// are computed.
const LARGER: [f64; 3] = [2.0, 3.0, 4.0];
const OWN_POINTS: f64 = 4000.0;

/// Rows of a coarse law: cubics between them follow the exact law to one per cent.
const ROWS: u32 = 6;

/// Half the intervals along the longer side of each small sheet, and the work reserved for the choices with
/// fewer: they are tried if the work for many does not suffice.
const HALF_INTERVALS: [(u32, u64); 2] = [(6, 400_000), (4, 0)];

/// Number of points of a mesh that are computed, and the work reserved for the choices with fewer.
const POINTS: [(usize, u64); 3] = [(500, 650_000), (250, 200_000), (120, 0)];

/// Distance of points, in radii of the disc, that is fine enough under the disc.
const FINE_ENOUGH: f64 = 0.7;

/// Computes the first force law of a disc on a tissue with these cuts, on the calling thread: the exact one if it takes little work, otherwise a
/// coarse one ([`Law::is_coarse`]), on a uniform tissue without cuts that of its middle. `None` if that would take more than about 50 ms (0.3 s on a solid) as
/// well, if another thread sets `stop`, or if the coarse law is not sound. Work is counted, not timed, so every
/// machine gives the same law. Unwinds with a refusal if there is no memory ([`attempt`](crate::memory::attempt)).
pub fn first(model: &Model, cuts: &Cuts, disc: Disc, stop: &AtomicBool) -> Option<Law> {
    if model.scene.body.kind().law_is_linear() {
        let mut work = LINEAR_WORK;
        let all = follow(model, cuts, course(disc, ROWS), Accuracy::COARSE, &mut work, stop);
        if let Some(law) = all.filter(Law::is_sound) {
            return Some(Law { is_coarse: true, ..law });
        }
        return of_larger_cells(model, cuts, disc, stop);
    }
    let mut work = EXACT_WORK;
    let exact = follow(model, cuts, course(disc, EXACT_ROWS), Accuracy::EXACT, &mut work, stop);
    let mut left = WORK - EXACT_WORK + work;
    exact.or_else(|| {
        if model.shape().is_uniform() && !cuts.are_none() {
            return of_fewer_points(model, cuts, disc, usize::MAX, &mut left, stop);
        }
        if !model.shape().is_uniform() {
            return POINTS.iter().find_map(|(points, kept)| {
                let most = left.saturating_sub(*kept);
                let mut work = most;
                let law = of_fewer_points(model, cuts, disc, *points, &mut work, stop);
                left -= most - work;
                law
            });
        }
        HALF_INTERVALS.iter().find_map(|(half, kept)| {
            let most = left.saturating_sub(*kept);
            let mut work = most;
            let law = coarse(model, disc.radius_m, *half, &mut work, stop);
            left -= most - work;
            law
        })
    })
}

/// Computes the law of a solid with larger cells, without cuts, refined around the disc by its own cells.
fn of_larger_cells(model: &Model, cuts: &Cuts, disc: Disc, stop: &AtomicBool) -> Option<Law> {
    let edge_m = model.shape().edge_m();
    for times in LARGER {
        let larger = model.with_cells(times * edge_m)?;
        let (whole, half_ball) = (course(disc, ROWS), (1.5 / PI * OWN_POINTS).cbrt() * edge_m);
        let around = Course { within_m: half_ball.max(disc.radius_m + 3.0 * times * edge_m), ..whole };
        let none = Cuts::default();
        let of = |model: &Model, cuts: &Cuts, course: Course| {
            follow(model, cuts, course, Accuracy::COARSE, &mut { LINEAR_WORK }, stop)
        };
        if let Some(law) = of(&larger, &none, whole) {
            let law = refined(&law, &of(model, cuts, around)?, &of(&larger, &none, around)?);
            return law.is_sound().then_some(Law { is_coarse: true, ..law });
        }
    }
    None
}

/// Computes a law with `points` of a mesh, or with all that notice the disc on a sheet, and subtracts its work from `work`.
fn of_fewer_points(
    model: &Model,
    cuts: &Cuts,
    disc: Disc,
    points: usize,
    work: &mut u64,
    stop: &AtomicBool,
) -> Option<Law> {
    let course = Course { points, ..course(disc, ROWS) };
    let law = follow(model, cuts, course, Accuracy::COARSE, work, stop)?;
    law.is_sound().then_some(Law { is_coarse: true, ..law })
}

/// Returns the law `first`, in which the disc goes deeper under each force by as much as `fine` yields more
/// than `coarse`.
#[allow(clippy::cast_precision_loss)]
fn refined(first: &Law, fine: &Law, coarse: &Law) -> Law {
    let parts = [(first, 1.0), (fine, 1.0), (coarse, -1.0)];
    // The depth under a force, m, and its derivative by the force, m/N.
    let yields = |force_n: f64| {
        parts.iter().fold((0.0, 0.0), |(depth_m, rise), (law, sign)| {
            let at_m = law.depth_of(force_n);
            (depth_m + sign * at_m, rise + sign / law.at_depth(at_m).stiffness_n_per_m.max(f64::MIN_POSITIVE))
        })
    };
    let largest_n = first.rows.last().map_or(0.0, |row| row.force_n).max(f64::MIN_POSITIVE);
    let rows = (0..first.rows.len()).map(|row| {
        let depth_m = row as f64 * first.step_m;
        let (force_n, rise) = force_at(depth_m, largest_n, &yields);
        let stiffness_n_per_m = if rise > 0.0 { 1.0 / rise } else { 0.0 };
        Row { force_n, stiffness_n_per_m, ..first.at_depth(first.depth_of(force_n)) }
    });
    Law { rows: rows.collect(), ..first.clone() }
}

/// Returns the force under which `yields` gives `depth_m`, N, and the slope of the depth there: Newton's
/// method, kept between two bounds. `largest_n` is of the order of the largest force.
fn force_at(depth_m: f64, largest_n: f64, yields: &dyn Fn(f64) -> (f64, f64)) -> (f64, f64) {
    let (mut low, mut high) = (0.0, largest_n);
    for _ in 0..8 {
        high *= if yields(high).0 < depth_m { 2.0 } else { 1.0 };
    }
    let mut force_n = if depth_m > 0.0 { 0.5 * high } else { 0.0 };
    for _ in 0..40 {
        let (at_m, rise) = yields(force_n);
        if at_m < depth_m {
            low = force_n;
        } else {
            high = force_n;
        }
        let next_n = force_n + (depth_m - at_m) / rise;
        let next_n = if next_n > low && next_n < high { next_n } else { 0.5 * (low + high) };
        if (next_n - force_n).abs() <= 1e-9 * largest_n {
            break;
        }
        force_n = next_n;
    }
    (force_n, yields(force_n).1)
}

/// Computes a coarse law from sheets with about twice `half` intervals along the longer side, and subtracts its
/// work from `work`.
fn coarse(model: &Model, radius_m: f64, half: u32, work: &mut u64, stop: &AtomicBool) -> Option<Law> {
    let whole = Cuts::default();
    let mut of = |model: &Model| {
        let course = course(Disc::in_middle(model, radius_m), ROWS);
        follow(model, &whole, course, Accuracy::COARSE, work, stop)
    };
    let (size_m, edge_m) = (model.shape().extent().size_m(), model.shape().edge_m());
    let half_m = half_window_m(model, radius_m).min(0.5 * model.shape().longest_side_m());
    // Choose intervals that also end at the rim of the shorter side.
    let shorter_m = half_m.min(0.5 * size_m.x.min(size_m.y));
    let fitting = if shorter_m > 0.0 { best_half(half, half_m / shorter_m) } else { half };
    let mut spacing_m = half_m / f64::from(fitting);
    let mut law = if spacing_m <= edge_m { of(model)? } else { of(&tangent::stand_in(model, spacing_m, half_m))? };
    let finest_m = edge_m.max(FINE_ENOUGH * radius_m);
    while spacing_m > finest_m {
        let finer_m = (0.5 * spacing_m).max(finest_m);
        let half_m = f64::from(best_half(half, spacing_m / finer_m)) * finer_m;
        let [fine, before] = [finer_m, spacing_m].map(|apart_m| of(&tangent::stand_in(model, apart_m, half_m)));
        law = refined(&law, &fine?, &before?);
        spacing_m = finer_m;
    }
    law.is_sound().then_some(Law { is_coarse: true, ..law })
}

/// Returns the number of intervals near `half` at which a sheet whose points are `ratio` times as far apart
/// ends nearly where the finer one does.
fn best_half(half: u32, ratio: f64) -> u32 {
    let misses = |half: u32| {
        let intervals = f64::from(half) / ratio;
        (intervals.round() / intervals - 1.0).abs()
    };
    [half - 1, half + 1].into_iter().fold(half, |best, other| if misses(other) < misses(best) { other } else { best })
}

#[cfg(test)]
mod tests {

    use super::super::exact;
    use super::*;

    /// Largest difference of force and of stiffness at the depths of the exact law, relative to the largest of each.
    fn apart(exact: &Law, other: &Law) -> [f64; 2] {
        let depths = (0..exact.rows.len()).map(|row| row as f64 * exact.step_m);
        let pairs: Vec<_> = depths.map(|depth_m| (exact.at_depth(depth_m), other.at_depth(depth_m))).collect();
        [|row: &Row| row.force_n, |row: &Row| row.stiffness_n_per_m].map(|of| {
            let largest = pairs.iter().map(|pair| of(&pair.0)).fold(0.0, f64::max);
            pairs.iter().map(|(exact, other)| (of(exact) - of(other)).abs()).fold(0.0, f64::max) / largest
        })
    }

    #[test]
    fn a_coarse_law_knows_the_rim_and_what_is_under_the_disc() {
        let never = AtomicBool::new(false);
        // A membrane that hardly anything but its rim holds, and one that its anchor springs hold as well.
        for anchor_stiffness in ["0.01", "0.5"] {
            let anchor_stiffness = format!("anchor_springs.stiffness_n_per_m={anchor_stiffness}");
            let model = Model::paper(&["sheet.points=[25, 25]", "sheet.fixed=\"edges\"", &anchor_stiffness]);
            let radius_m = model.shape().edge_m();
            let first = first(&model, &Cuts::default(), Disc::in_middle(&model, radius_m), &never).unwrap();
            let [force, stiffness] = apart(&exact(&model, radius_m), &first);
            println!("{anchor_stiffness}: force {force:.4}, stiffness {stiffness:.4} apart");
            assert!(first.is_coarse && first.is_sound());
            assert!(force < 0.1 && stiffness < 0.15, "{anchor_stiffness}: {force} {stiffness}");
        }
    }

    #[test]
    fn sheets_of_two_spacings_end_nearly_at_the_same_place() {
        assert_eq!(best_half(6, 2.0), 6);
        assert_eq!(best_half(4, 2.0), 4);
        // Of 5, 6 and 7 intervals, 7 are nearly 4 of 1.75 each.
        assert_eq!(best_half(6, 1.75), 7);
    }

    #[test]
    fn a_law_of_some_points_of_an_organ_says_that_it_is_coarse() {
        let model = Model::gallbladder(&[]);
        let shape = model.shape();
        let at_m = shape.rest_m(shape.nearest(glam::DVec3::new(0.02, 0.0, -0.05)));
        let (disc, mut work) = (Disc { radius_m: 0.006, at_m }, WORK);
        let law = of_fewer_points(&model, &Cuts::default(), disc, 250, &mut work, &AtomicBool::new(false)).unwrap();
        assert!(law.is_coarse && law.is_sound() && law.at_depth(0.003).force_n > 0.0 && work < WORK);
    }
}
