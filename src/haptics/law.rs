//! The force law of a tissue under a disc that is pressed straight in without haste: what the server sends ahead, once,
//! so that a client knows before it gets there how the force will rise.
//!
//! A stiffness at one place says nothing of the next millimetre, and tissue hardens: with 50 ms of delay and 50 mm/s a
//! hand is 2.5 mm further than what it last felt. A polynomial through past samples tells wildly wrong things there; the
//! tissue's own law, computed from its model (`sheet::tangent`), does not.

use std::sync::atomic::AtomicBool;

use crate::sheet::Model;
use crate::sheet::tangent::{self, Accuracy, Course, Deepened, Press, Pressed};

/// The law at one depth.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Row {
    /// Outward, N.
    pub force_n: f64,
    /// Along the normal, N/m.
    pub stiffness_n_per_m: f64,
    /// Across it, of a disc that sticks, N/m.
    pub across_n_per_m: f64,
    /// Along the normal, N·s/m.
    pub damping_n_s_per_m: f64,
    /// Across it, of a disc that sticks, N·s/m.
    pub across_n_s_per_m: f64,
    /// Across it, of a disc that slides, N·s/m.
    pub drag_n_s_per_m: f64,
}

/// Rows at equal distances of depth, from 0 on.
#[derive(Debug, Clone, PartialEq)]
pub struct Law {
    /// From a row to the next, m.
    pub step_m: f64,
    /// At least two.
    pub rows: Vec<Row>,
    /// Put together from coarser sheets (`coarse`), because the tissue's own takes too much work to be given at once:
    /// within a tenth of it.
    pub is_coarse: bool,
}

/// Rows of an exact law.
pub(super) const ROWS: u32 = 21;

/// How many radii of the disc a law reaches.
const REACH_IN_RADII: f64 = 4.0;

/// An exact law under way, one depth after another.
#[derive(Debug)]
pub struct Computation(Box<Press>);

/// What became of a computation.
#[derive(Debug)]
pub enum Progress {
    /// It can go on.
    UnderWay(Computation),
    /// The law.
    Done(Law),
    /// It would take more work than it may, or it was stopped.
    GivenUp,
}

impl Computation {
    /// Of the law under a disc of `radius_m` in the middle of the sheet, with at most `most_work` springs times iterations;
    /// none if they can't suffice.
    pub fn new(model: &Model, radius_m: f64, most_work: u64) -> Option<Self> {
        Press::within(model, course(model, radius_m, ROWS), Accuracy::EXACT, most_work)
            .map(|press| Computation(Box::new(press)))
    }

    /// Computes the next depth, unless `stop` is set. `model` is the one that it was begun for.
    pub fn advance(mut self, model: &Model, stop: &AtomicBool) -> Progress {
        match self.0.deepen(model, stop) {
            Deepened::Further => Progress::UnderWay(self),
            Deepened::Done => Progress::Done(Law::from_pressed(self.0.pressed())),
            Deepened::GivenUp => Progress::GivenUp,
        }
    }
}

/// In the middle of a sheet.
fn course(model: &Model, radius_m: f64, rows: u32) -> Course {
    let (centre_m, step_m) = (model.scene.sheet.extent_m() / 2.0, REACH_IN_RADII * radius_m / f64::from(rows - 1));
    Course { radius_m, centre_m, step_m, count: rows }
}

impl Law {
    /// That of a disc of `radius_m` in the middle of a sheet: some tenths of a second of work for a thousand points.
    pub fn of(model: &Model, radius_m: f64) -> Self {
        let Course { centre_m, step_m, count, .. } = course(model, radius_m, ROWS);
        Self::from_pressed(&tangent::press(model, radius_m, centre_m, step_m, count))
    }

    /// The same with at most `most_work` springs times iterations; none if they don't suffice, or if `stop` is set.
    pub fn within(model: &Model, radius_m: f64, most_work: u64, stop: &AtomicBool) -> Option<Self> {
        Self::pressed(model, radius_m, ROWS, Accuracy::EXACT, &mut { most_work }, stop)
    }

    /// A law of so many rows, whose work is taken from `work`.
    pub(super) fn pressed(
        model: &Model,
        radius_m: f64,
        rows: u32,
        accuracy: Accuracy,
        work: &mut u64,
        stop: &AtomicBool,
    ) -> Option<Self> {
        let mut press = Press::within(model, course(model, radius_m, rows), accuracy, *work)?;
        let mut deepened = Deepened::Further;
        while deepened == Deepened::Further {
            deepened = press.deepen(model, stop);
        }
        *work = press.left();
        (deepened == Deepened::Done).then(|| Self::from_pressed(press.pressed()))
    }

    fn from_pressed(pressed: &[Pressed]) -> Self {
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

    /// That of a linear spring and damper, which feel the same in every direction.
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

    /// Whether a client can use it: finite, rising, at least two rows.
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

    /// The law at a depth, m. Forces are cubic between rows, with the rows' stiffness as slopes; beyond the last row they
    /// go on as straight lines.
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

    /// The depth at which a force is met, m.
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

    /// The depth that it reaches, m.
    pub fn reach_m(&self) -> f64 {
        (self.rows.len() - 1) as f64 * self.step_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One that hardens, with rows 0.5 mm apart; each value differs from the others.
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
        // A cubic whose slopes differ from the chord has the slope that it says.
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
    fn a_law_that_would_take_too_long_or_that_nobody_waits_for_is_none() {
        let model = Model::paper(&["sheet.points=[9, 9]"]);
        let radius_m = 2.0 * model.scene.sheet.spacing_m;
        let (go_on, stop) = (AtomicBool::new(false), AtomicBool::new(true));
        let exact = Law::of(&model, radius_m);
        assert!(!exact.is_coarse && exact.rows.len() == 21);
        assert_eq!(Law::within(&model, radius_m, u64::MAX, &go_on).as_ref(), Some(&exact));
        assert!(Law::within(&model, radius_m, u64::MAX, &stop).is_none());
        // Too little for certain, and too little as it turns out.
        assert!(Law::within(&model, radius_m, 1000, &go_on).is_none());
        assert!(Computation::new(&model, radius_m, 1000).is_none());
        assert!(Computation::new(&model, radius_m, 100_000).is_some());
        assert!(Law::within(&model, radius_m, 100_000, &go_on).is_none());
        // Depth by depth it has the same bits, and once stopped it stays given up.
        let mut computation = Computation::new(&model, radius_m, u64::MAX).unwrap();
        for depth in 1.. {
            match computation.advance(&model, &go_on) {
                Progress::UnderWay(further) => computation = further,
                Progress::Done(law) => {
                    assert_eq!((law, depth), (exact, 21));
                    break;
                }
                Progress::GivenUp => panic!("given up at depth {depth}"),
            }
        }
        let Progress::UnderWay(computation) =
            Computation::new(&model, radius_m, u64::MAX).unwrap().advance(&model, &go_on)
        else {
            panic!("one depth is not all");
        };
        assert!(matches!(computation.advance(&model, &stop), Progress::GivenUp));
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
