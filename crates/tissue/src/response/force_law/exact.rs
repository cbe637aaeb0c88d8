//! The exact force law of a tissue under a disc: the whole tissue is pressed in, depth after depth
//! (`response::tangent`).

use std::sync::atomic::AtomicBool;

use palpate_haptics::force_law::{Law, Row};

use super::disc::Disc;
use crate::body::model::Model;
use crate::body::severed::Cuts;
use crate::response::tangent::{self, Accuracy, Course, Deepened, Press, Pressed};

/// Rows of an exact law.
pub(super) const ROWS: u32 = 21;

/// Largest depth of a law, in radii of the disc.
const REACH_IN_RADII: f64 = 4.0;

/// An exact force law under computation, one depth after another, so that its thread can do other work in between.
/// [`Computation::advance`] consumes it and returns it until the law is done or given up.
#[derive(Debug)]
pub struct Computation(Box<Press>);

/// The result of [`Computation::advance`].
#[derive(Debug)]
pub enum LawProgress {
    /// Further depths are left; continue with this.
    UnderWay(Computation),
    /// The complete law of 21 depths; the computation has ended.
    Done(Law),
    /// The computation would exceed its work, or it was stopped: it has ended, and nothing of it is left.
    GivenUp,
}

impl Computation {
    /// Begins the computation of the law of a tissue with these cuts under a disc, with at most `most_work` springs times iterations for all
    /// depths. `None` if they can't suffice. Unwinds with a refusal if there is no memory
    /// ([`attempt`](crate::memory::attempt)).
    pub fn new(model: &Model, cuts: &Cuts, disc: Disc, most_work: u64) -> Option<Self> {
        let press = Press::within(model, cuts, course(disc, ROWS), Accuracy::EXACT, most_work)?;
        Some(Computation(Box::new(press)))
    }

    /// Computes the next depth on the calling thread; given up if another thread sets `stop`. `model` must be the one
    /// that the computation was begun with.
    pub fn advance(mut self, model: &Model, stop: &AtomicBool) -> LawProgress {
        match self.0.deepen(model, stop) {
            Deepened::Further => LawProgress::UnderWay(self),
            Deepened::Done => LawProgress::Done(from_pressed(self.0.pressed())),
            Deepened::GivenUp => LawProgress::GivenUp,
        }
    }
}

pub(super) fn course(Disc { radius_m, at_m }: Disc, rows: u32) -> Course {
    let step_m = REACH_IN_RADII * radius_m / f64::from(rows - 1);
    Course { radius_m, centre_m: at_m, step_m, count: rows, points: usize::MAX, within_m: f64::INFINITY }
}

/// Computes the exact law of a disc of `radius_m` (m) in the middle of a whole tissue ([`Disc::in_middle`]), with unlimited
/// work. It takes some tenths of a second for a thousand points. The law has 21 rows, from 0 to four radii deep, each
/// a solution at rest with its tangent ([`Tangent`](crate::response::tangent::Tangent): stiffness S, damping B and
/// drag D, turned so that z is the normal). Along the normal the row has S_zz and B_zz, across it ½(S_xx + S_yy) and
/// ½(B_xx + B_yy), and as drag D. Unwinds with a refusal if there is no memory ([`attempt`](crate::memory::attempt)).
///
/// ```
/// use palpate_tissue::scene::PAPER;
/// use palpate_tissue::{Model};
/// use palpate_tissue::response::force_law;
///
/// let model = Model::parse("paper", PAPER, &["sheet.points=[9, 9]"])?;
/// let law = force_law::exact(&model, 2.0 * model.shape().edge_m());
/// assert!(law.is_sound() && !law.is_coarse);
/// // The deeper, the stiffer; and the law reaches as deep as four radii.
/// let (first, last) = (law.at_depth(0.0), law.at_depth(law.reach_m()));
/// assert_eq!(first.force_n, 0.0);
/// assert!(last.stiffness_n_per_m > first.stiffness_n_per_m, "{first:?} {last:?}");
/// println!("{:.1} N/m at the surface, {:.1} N at {:.3} m", first.stiffness_n_per_m, last.force_n, law.reach_m());
/// # Ok::<(), palpate_refusal::Refusal>(())
/// ```
pub fn exact(model: &Model, radius_m: f64) -> Law {
    let Course { centre_m, step_m, count, .. } = course(Disc::in_middle(model, radius_m), ROWS);
    from_pressed(&tangent::press(model, radius_m, centre_m, step_m, count))
}

/// Computes the exact law of a disc on a tissue with these cuts, of 21 rows as [`exact`] does, with at most `most_work` springs times
/// iterations. `None` if they do not suffice, or if another thread sets `stop`. Unwinds with a refusal if there is no memory.
pub fn exact_within(model: &Model, cuts: &Cuts, disc: Disc, most_work: u64, stop: &AtomicBool) -> Option<Law> {
    follow(model, cuts, course(disc, ROWS), Accuracy::EXACT, &mut { most_work }, stop)
}

/// Computes the law of a course of depths, and subtracts its work from `work`.
pub(super) fn follow(
    model: &Model,
    cuts: &Cuts,
    course: Course,
    accuracy: Accuracy,
    work: &mut u64,
    stop: &AtomicBool,
) -> Option<Law> {
    let mut press = Press::within(model, cuts, course, accuracy, *work)?;
    let mut deepened = Deepened::Further;
    while deepened == Deepened::Further {
        deepened = press.deepen(model, stop);
    }
    *work = press.left();
    (deepened == Deepened::Done).then(|| from_pressed(press.pressed()))
}

fn from_pressed(pressed: &[Pressed]) -> Law {
    let row = |pressed: &Pressed| {
        let tangent::Tangent { stiffness_n_per_m: s, damping_n_s_per_m: b, drag_n_s_per_m, .. } = pressed.tangent;
        Row {
            force_n: pressed.force_n,
            stiffness_n_per_m: s.z_axis.z,
            across_n_per_m: 0.5 * (s.x_axis.x + s.y_axis.y),
            damping_n_s_per_m: b.z_axis.z,
            across_n_s_per_m: 0.5 * (b.x_axis.x + b.y_axis.y),
            drag_n_s_per_m,
        }
    };
    let step_m = pressed.get(1).map_or(0.0, |pressed| pressed.depth_m);
    Law { step_m, rows: pressed.iter().map(row).collect(), is_coarse: false }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_law_that_would_take_too_long_or_that_nobody_waits_for_is_none() {
        let model = Model::paper(&["sheet.points=[9, 9]"]);
        let radius_m = 2.0 * model.shape().edge_m();
        let whole = Cuts::default();
        let (go_on, stop) = (AtomicBool::new(false), AtomicBool::new(true));
        let (exact, disc) = (exact(&model, radius_m), Disc::in_middle(&model, radius_m));
        assert!(!exact.is_coarse && exact.rows.len() == 21);
        assert_eq!(exact_within(&model, &whole, disc, u64::MAX, &go_on).as_ref(), Some(&exact));
        assert!(exact_within(&model, &whole, disc, u64::MAX, &stop).is_none());
        // Too little for certain, and too little as it turns out.
        assert!(exact_within(&model, &whole, disc, 1000, &go_on).is_none());
        assert!(Computation::new(&model, &whole, disc, 1000).is_none());
        assert!(Computation::new(&model, &whole, disc, 100_000).is_some());
        assert!(exact_within(&model, &whole, disc, 100_000, &go_on).is_none());
        // Depth by depth it has the same bits, and once stopped it stays given up.
        let mut computation = Computation::new(&model, &whole, disc, u64::MAX).unwrap();
        for depth in 1.. {
            match computation.advance(&model, &go_on) {
                LawProgress::UnderWay(further) => computation = further,
                LawProgress::Done(law) => {
                    assert_eq!((law, depth), (exact, 21));
                    break;
                }
                LawProgress::GivenUp => panic!("given up at depth {depth}"),
            }
        }
        let LawProgress::UnderWay(computation) =
            Computation::new(&model, &whole, disc, u64::MAX).unwrap().advance(&model, &go_on)
        else {
            panic!("one depth is not all");
        };
        assert!(matches!(computation.advance(&model, &stop), LawProgress::GivenUp));
    }
}
