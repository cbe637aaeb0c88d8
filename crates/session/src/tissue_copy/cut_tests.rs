//! Tests of copies of a tissue that is cut: by the client's own blade, by others, and before the copy began.

use super::*;
use palpate_haptics::{MotionState, ReportedSpring};

/// A sheet and a solid.
fn models() -> [(&'static str, Arc<Model>); 2] {
    let sheet = "[sheet]\npoints = [25, 25]\nspacing_m = 0.004\npoint_mass_kg = 1e-3\nfixed = \"edges\"\n[springs]\nstiffness_n_per_m = 60\n\
                 pretension_n_per_m = 2\n[anchor_springs]\nstiffness_n_per_m = 1\n[damping]\ncoefficient_n_s_per_m = 0.02\n";
    let solid = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.01\n\
                 fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                 [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\ndensity_kg_per_m3 = 980\n\
                 damping_per_s = 60\n[stepping]\nsubsteps = 4\n";
    [("sheet", sheet), ("solid", solid)].map(|(kind, text)| (kind, Model::parse(kind, text, &[]).unwrap()))
}

/// The middle of the top, m.
fn top_m(model: &Model) -> DVec3 {
    let extent = model.shape().extent();
    extent.middle_m().with_z(extent.most_m.z)
}

fn blade() -> Tip {
    let edge_m = DVec3::new(0.006, 0.0, 0.04);
    Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m, ..Tip::default() }
}

/// Number of ticks of a cut, and the tick at which the blade is out of the tissue again.
const CUT: u32 = 150;
const OUT: u32 = 350;

/// Where the tip of the blade is at a tick of a cut through the middle of the top, m, and above the tissue afterwards.
fn blade_m(model: &Model, tick: u32) -> DVec3 {
    let y_m = 0.6 * model.shape().extent().size_m().y * (f64::from(tick.min(CUT)) / f64::from(CUT) - 0.5);
    let z_m = if tick <= CUT { -0.012 } else { 0.05 };
    top_m(model) + DVec3::new(0.0013, y_m, z_m)
}

/// Where a tip is at a tick that presses beside the cut once it is made, m.
fn press_m(model: &Model, tick: u32) -> DVec3 {
    let down = f64::from(tick.saturating_sub(CUT + 50)) / 300.0;
    top_m(model) + DVec3::new(0.004, 0.001, 0.002 - 0.006 * down.min(1.0))
}

fn disc() -> Tip {
    Tip { radius_m: 0.005, friction: 0.3, ..Tip::default() }
}

/// A server's session.
struct Served {
    session: Session,
    /// The version and the number of springs that were reported.
    reported: (u32, usize),
}

impl Served {
    fn new(model: &Arc<Model>) -> Self {
        Served { session: Session::new(model), reported: (0, 0) }
    }

    /// Cuts with tool 1 and presses with tool 0. Returns the force on that, N.
    fn step(&mut self, tick: u32, cuts: bool) -> DVec3 {
        let model = self.session.model().clone();
        let mut due = vec![led(0, press_m(&model, tick), disc())];
        if cuts {
            due.push(led(1, blade_m(&model, tick), blade()));
        }
        self.session.advance(&mut due, |_| {});
        self.session.tissue().tool_contact(0).map_or(DVec3::ZERO, |felt| felt.force_on_tool_n)
    }

    /// Returns what was severed since the last report; `None` if that is nothing.
    fn report(&mut self) -> Option<ReportedCuts> {
        let (cuts, (version, count)) = (self.session.tissue().cuts(), self.reported);
        self.reported = (cuts.version(), cuts.len());
        let springs = cuts.reported(count).map(|(spring, _)| spring).collect();
        (cuts.version() > version).then_some(ReportedCuts { version: cuts.version(), continues: true, springs })
    }

    /// Returns all that is severed.
    fn all(&self) -> ReportedCuts {
        let cuts = self.session.tissue().cuts();
        let springs = cuts.reported(0).map(|(spring, _)| spring).collect();
        ReportedCuts { version: cuts.version(), continues: false, springs }
    }
}

fn names(cuts: &Cuts) -> Vec<(u32, u32)> {
    let mut names: Vec<_> = cuts.reported(0).map(|(spring, _)| spring.name()).collect();
    names.sort_unstable();
    names
}

fn at(place_m: DVec3) -> InstrumentPose {
    InstrumentPose::at(place_m)
}

fn tick_s(tick: u32) -> f64 {
    f64::from(tick) * TICK_S
}

#[test]
fn a_copy_has_the_cuts_of_others_and_feels_them() {
    for (kind, model) in models() {
        let mut served = Served::new(&model);
        let copy = || TissueCopy::new(&model, disc());
        let (mut follows, mut whole, mut late) = (copy(), copy(), copy());
        let ticks = 1500;
        let (mut off_n, mut most_n) = ([0.0_f64; 3], 0.0_f64);
        for tick in 0..ticks {
            let truth_n = served.step(tick, true);
            if tick % 40 == 39 {
                served.report().iter().for_each(|cuts| follows.follow(cuts).unwrap());
            }
            if tick == CUT + 40 {
                // One that begins now begins with the cuts that there are.
                late.follow(&served.all()).unwrap();
            }
            let felt_n = [&mut follows, &mut whole, &mut late]
                .map(|copy| copy.feel(tick_s(tick), &at(press_m(&model, tick)), &[]).unwrap().wrench.force_n);
            if tick + 300 >= ticks {
                most_n = most_n.max(truth_n.length());
                off_n.iter_mut().zip(felt_n).for_each(|(off_n, felt_n)| *off_n = off_n.max(felt_n.distance(truth_n)));
            }
        }
        let off = off_n.map(|off_n| off_n / most_n);
        println!("{kind}: {} springs, {most_n:.3} N; off by {off:.4?}", served.session.tissue().cuts().len());
        assert!(off[0] < 0.01 && off[2] < 0.01 && off[1] > 0.05, "{kind}: {off:?}");
        assert!(served.session.tissue().cuts().len() > 5 && whole.cuts().is_empty());
        for copy in [&follows, &late] {
            assert_eq!(names(&copy.cuts()), names(&served.session.tissue().cuts()), "{kind}");
            assert_eq!(copy.topology_version(), Some(served.session.tissue().cuts().version()));
        }
    }
}

#[test]
fn an_own_cut_stays_if_the_server_has_it_and_is_taken_back_if_not() {
    for (kind, model) in models() {
        let led_by = |copy: &mut TissueCopy, tick: u32| copy.feel(tick_s(tick), &at(blade_m(&model, tick)), &[]);
        let mut copy = TissueCopy::new(&model, blade());
        (0..OUT).for_each(|tick| assert!(led_by(&mut copy, tick).is_some()));
        let (cut, version) = (names(&copy.cuts()), copy.cuts().version());
        assert!(cut.len() > 5, "{kind}: {}", cut.len());
        // The server is told of the blade later, but cuts as the copy did.
        let springs: Vec<ReportedSpring> = copy.cuts().reported(0).map(|(spring, _)| spring).collect();
        let (first, last) = springs.split_at(springs.len() - 3);
        copy.follow(&ReportedCuts { version: 9, continues: true, springs: first.to_vec() }).unwrap();
        assert_eq!((names(&copy.cuts()), copy.cuts().version()), (cut.clone(), version), "{kind}");
        let mut confirmed = TissueCopy::new(&model, blade());
        (0..OUT).for_each(|tick| assert!(led_by(&mut confirmed, tick).is_some()));
        confirmed.follow(&ReportedCuts { version: 9, continues: true, springs: first.to_vec() }).unwrap();
        confirmed.follow(&ReportedCuts { version: 11, continues: true, springs: last.to_vec() }).unwrap();
        // Before the time is over, nothing is taken back.
        let until = |from: u32, seconds: f64| from..from + (seconds / TICK_S) as u32;
        until(OUT, 1.5).for_each(|tick| assert!(led_by(&mut copy, tick).is_some()));
        assert_eq!(names(&copy.cuts()), cut, "{kind}");
        until(OUT + 1500, 0.9).for_each(|tick| assert!(led_by(&mut copy, tick).is_some()));
        assert_eq!(names(&copy.cuts()).len(), cut.len() - 3, "{kind}");
        assert!(last.iter().all(|spring| !names(&copy.cuts()).contains(&spring.name())), "{kind}");
        assert_eq!(copy.topology_version(), Some(9));
        until(OUT, 3.0).for_each(|tick| assert!(led_by(&mut confirmed, tick).is_some()));
        assert_eq!(names(&confirmed.cuts()), cut, "{kind}");
    }
}

#[test]
fn a_copy_begins_anew_if_the_server_undoes_a_cut_and_only_then() {
    for (kind, model) in models() {
        let mut served = Served::new(&model);
        (0..CUT).for_each(|tick| _ = served.step(tick, true));
        let all = served.all();
        let mut copy = TissueCopy::new(&model, disc());
        copy.follow(&all).unwrap();
        // Presses anew, from a tick on.
        let press = |copy: &mut TissueCopy, from: u32| {
            let felt = (0..1000).map(|tick| copy.feel(tick_s(from + tick), &at(press_m(&model, tick)), &[]).unwrap());
            felt.last().unwrap()
        };
        press(&mut copy, 0);
        let steps = copy.session.step_count();
        // All are sent anew after the guard of the server went back and cut again.
        copy.follow(&ReportedCuts { version: all.version + 2, ..all.clone() }).unwrap();
        assert_eq!((copy.session.step_count(), copy.topology_version()), (steps, Some(all.version + 2)), "{kind}");
        let kept = all.springs[..all.springs.len() / 2].to_vec();
        copy.follow(&ReportedCuts { version: all.version + 3, continues: false, springs: kept.clone() }).unwrap();
        assert_eq!((copy.session.step_count(), copy.cuts().len()), (0, kept.len()), "{kind}");
        let felt = press(&mut copy, 1000);
        // As one that never had the others.
        let mut other = TissueCopy::new(&model, disc());
        other.follow(&ReportedCuts { version: 1, continues: false, springs: kept }).unwrap();
        let expected = press(&mut other, 0);
        let off = felt.wrench.force_n.distance(expected.wrench.force_n) / expected.wrench.force_n.length();
        assert!(off < 0.01 && felt.own_work_j.is_finite(), "{kind}: {off}");
        // A report of another tissue is ignored as a whole.
        let names_before = names(&copy.cuts());
        let bad = ReportedSpring { place: u32::MAX, number: 0, part: 0.5 };
        for continues in [true, false] {
            copy.follow_cuts(&ReportedCuts { version: 99, continues, springs: vec![all.springs[0], bad] });
            assert_eq!(names(&copy.cuts()), names_before, "{kind}");
        }
        assert_eq!(copy.topology_version(), Some(all.version + 3));
    }
}

/// Where the server has another client's blade is a guess: its cuts come by reports.
#[test]
fn the_blade_or_heat_of_another_client_severs_nothing_in_a_copy() {
    for (kind, model) in models() {
        let mut copy = TissueCopy::new(&model, disc());
        let burning = Tip { burn_s: 0.01, ..disc() };
        for tick in 0..CUT {
            let motion = |place_m: DVec3| MotionState { time_s: tick_s(tick), place_m, velocity_m_per_s: DVec3::ZERO };
            let others = [
                OtherTool { tool: 5, tip: blade(), motion: motion(blade_m(&model, tick)) },
                OtherTool { tool: 6, tip: burning, motion: motion(top_m(&model) - 0.003 * DVec3::Z) },
            ];
            let away_m = top_m(&model) + 0.05 * DVec3::Z;
            assert!(copy.feel(tick_s(tick), &at(away_m), &others).is_some());
        }
        assert_eq!(copy.others.iter().flatten().count(), 2, "{kind}");
        assert!(copy.cuts().is_empty(), "{kind}: {} springs", copy.cuts().len());
    }
}
