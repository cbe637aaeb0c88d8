//! `restore` accepts the output of `save`: random sessions are driven to states that no surgeon would reach, by
//! whatever a server accepts, and each continues from its own snapshot with the same bits.
//!
//! Some 200 snapshots in every run of the tests; `PALPATE_SNAPSHOTS=5000` takes as many as that.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::cast_precision_loss)]

use std::collections::BTreeMap;
use std::sync::{Arc, OnceLock};

use crate::common;
use crate::common::cases;
use crate::common::moved;
use crate::common::random_scenes;
use fastrand::Rng;
use glam::DVec3;
use palpate_haptics::{Coupling, Tip};
use palpate_session::Session;
use palpate_session::command::{Command, Due};
use palpate_session::intake::Intake;
use palpate_session::snapshot::Saved;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::Action;
use palpate_tissue::scene::{BUILT_IN, Change, Integrator, Named, Precision, Scene};
use palpate_tissue::shape::PointId;

/// Steps for which a restored session is compared with the one that was saved.
const COMPARED_STEPS: u64 = 50;

/// Longest session, steps.
const LONGEST: u64 = 160;

const LEASE: u128 = 1;

const TOOLS: [u32; 3] = [0, 1, 4];

fn limits() -> Limits {
    Limits { rehearsal_work: 1 << 20, ..Limits::default() }
}

/// Returns the number of snapshots that are tried.
fn wanted() -> usize {
    cases::count("PALPATE_SNAPSHOTS", 80, 1000)
}

/// Actions before a step.
#[derive(Debug, Clone, Default)]
struct StepInputs {
    change: Option<Change>,
    due: Vec<Due>,
}

/// A built-in scene, compiled in `format`.
fn built_in(name: &str, precision: Precision) -> Scene {
    static SCENES: OnceLock<BTreeMap<&str, Scene>> = OnceLock::new();
    let scenes = SCENES.get_or_init(|| {
        let of = |name: &'static str| {
            let text = BUILT_IN.iter().find(|entry| entry.0 == name).unwrap().1;
            (name, Scene::parse(name, text, &[], &limits()).unwrap())
        };
        ["liver", "liver-organ", "gallbladder"].map(of).into()
    });
    let mut scene = scenes[name].clone();
    scene.stepping.precision = precision;
    scene
}

/// A random tissue: some are stepped with too few substeps, so that the guard has work.
fn scene(random: &mut Rng) -> Scene {
    let precision = [Precision::F32, Precision::F64, Precision::Compensated][random.usize(0..3)];
    let name = match random.u8(0..40) {
        0 => Some("liver-organ"),
        1..=4 => Some("gallbladder"),
        5..=14 => Some("liver"),
        _ => None,
    };
    let mut scene = match name {
        Some(name) => built_in(name, precision),
        None => {
            let case = random_scenes::case(random.u64(..));
            let mut scene = Scene::parse("random", &case.scene, &[], &limits()).unwrap();
            scene.stepping.precision = precision;
            scene
        }
    };
    let suits =
        |integrator: &Integrator| precision != Precision::Compensated || integrator.name().starts_with("exponential");
    let schemes: Vec<Integrator> = Integrator::of_anchored().filter(suits).collect();
    scene.stepping.integrator = schemes[random.usize(0..schemes.len())];
    scene.stepping.substeps = Some(if scene.sheet().is_some() { random.u32(1..6) } else { random.u32(4..16) });
    scene.sleep_tolerance = [None, Some(0.0), Some(1e-3), Some(5e-2)][random.usize(0..4)];
    scene
}

/// A factor of any size.
fn decades(random: &mut Rng, from: f64, to: f64) -> f64 {
    10.0_f64.powf(from + (to - from) * random.f64())
}

fn direction(random: &mut Rng) -> DVec3 {
    let mut part = || 2.0 * random.f64() - 1.0;
    DVec3::new(part(), part(), part())
}

fn any_point(shape: &dyn palpate_tissue::shape::RestShape, random: &mut Rng) -> PointId {
    PointId::new(random.usize(0..shape.point_count()))
}

fn poke(scene: &Scene, random: &mut Rng) -> Poke {
    let shape = scene.shape();
    let (point, edge_m) = (any_point(shape, random), shape.edge_m());
    let by_point = random.bool();
    let beside_m = if by_point { DVec3::ZERO } else { shape.longest_side_m() * 0.1 * direction(random) };
    let centre_m = shape.rest_m(point) + beside_m;
    Poke {
        point: by_point.then_some(point),
        centre_m: if shape.dimensions() == 2 { centre_m.truncate().extend(0.0) } else { centre_m },
        force_n: if random.u8(0..6) == 0 { DVec3::ZERO } else { decades(random, -6.0, 2.0) * direction(random) },
        falloff_per_m: match random.u8(0..6) {
            0 => 0.0,
            1 => decades(random, 30.0, 300.0),
            _ => decades(random, -1.0, 2.0) / edge_m,
        },
        falloff_offset: match random.u8(0..6) {
            0 => -1000.0 * random.f64(),
            1 => 1000.0 * random.f64(),
            _ => random.f64(),
        },
    }
}

fn tip(scene: &Scene, random: &mut Rng) -> Tip {
    let edge_m = scene.shape().edge_m();
    let spring = Coupling::Spring {
        stiffness_n_per_m: if random.bool() { decades(random, 0.0, 4.0) } else { decades(random, -12.0, 12.0) },
        damping_n_s_per_m: if random.bool() { random.f64() } else { decades(random, -12.0, 6.0) },
    };
    Tip {
        radius_m: edge_m * decades(random, -3.0, 1.0),
        friction: [0.0, 0.2, 10.0][random.usize(0..3)],
        grasps: random.u8(0..3) == 0,
        coupling: if random.u8(0..3) == 0 { spring } else { Coupling::Constraint },
        ..Tip::default()
    }
}

/// A holder of a tool: its present action and place.
struct RandomHand {
    tool: u32,
    place_m: DVec3,
    velocity_m: DVec3,
    tip: Tip,
    kind: u8,
    point: PointId,
}

impl RandomHand {
    fn new(tool: u32, scene: &Scene, random: &mut Rng) -> Self {
        let shape = scene.shape();
        let point = any_point(shape, random);
        let mut hand = RandomHand {
            tool,
            place_m: shape.rest_m(point),
            velocity_m: DVec3::ZERO,
            tip: tip(scene, random),
            kind: random.u8(0..8),
            point,
        };
        hand.turn(scene, random);
        hand
    }

    /// Goes on in another way: slowly into the tissue, along it, off it at speed, or beyond all that is sensible.
    fn turn(&mut self, scene: &Scene, random: &mut Rng) {
        let shape = scene.shape();
        let (rest_m, outward) = (shape.rest_m(self.point), shape.normal(self.point));
        let edge_m = shape.edge_m();
        let speed = [0.02, 0.3, 3.0][random.usize(0..3)] * edge_m;
        match random.u8(0..6) {
            0 => (self.place_m, self.velocity_m) = (rest_m + edge_m * outward, -speed * outward),
            1 => self.velocity_m = speed * outward.any_orthonormal_vector(),
            2 => self.velocity_m = speed * outward,
            3 => self.velocity_m = speed * direction(random),
            4 => self.place_m = rest_m + decades(random, -2.0, 2.0) * shape.longest_side_m() * direction(random),
            _ => self.place_m = rest_m + 0.5 * edge_m * direction(random),
        }
    }

    fn command(&mut self, scene: &Scene, step: u64, random: &mut Rng) -> Option<Command> {
        if random.u8(0..12) == 0 {
            self.turn(scene, random);
        }
        if random.u8(0..40) == 0 {
            *self = RandomHand::new(self.tool, scene, random);
            return Some(Command::new(self.tool, None, Action::Release));
        }
        self.place_m += self.velocity_m;
        let mut command = Command::new(self.tool, None, Action::Release);
        command.time_to_live_s = (random.u8(0..10) == 0).then(|| decades(random, -6.0, 18.0));
        command.action = match self.kind {
            0 | 1 if random.u8(0..4) == 0 => Action::Push(poke(scene, random)),
            2 | 3 if random.u8(0..3) == 0 => {
                let far_m = if random.u8(0..4) == 0 { decades(random, -8.0, 2.0) } else { decades(random, -2.0, 1.0) };
                let displacement_m = far_m * scene.shape().edge_m() * direction(random);
                Action::Grasp { point: self.point, displacement_m }
            }
            4..=7 => {
                let by_time = self.kind > 5;
                if by_time {
                    command.client_time_ns = match random.u8(0..60) {
                        0 => random.u64(..),
                        1 => 0,
                        _ => (step + 3) * 1_000_000 + random.u64(0..2_000_000),
                    };
                    command.by_datagram = self.kind == 7 && command.client_time_ns != 0;
                } else {
                    command.at_step = Some(step);
                }
                let moves = by_time && random.bool() && command.client_time_ns != 0;
                let velocity_m_per_s = moves.then(|| decades(random, -3.0, 200.0) * direction(random));
                Action::Pose { place_m: self.place_m, velocity_m_per_s, tip: self.tip }
            }
            _ => return None,
        };
        Some(command)
    }
}

/// Another tissue now and then.
fn change(scene: &Scene, random: &mut Rng) -> Option<Change> {
    if random.u8(0..100) > 0 {
        return None;
    }
    let factor = [0.0, 0.1, 0.5, 2.0, 10.0][random.usize(0..5)];
    Some(Change {
        stiffness_n_per_m: random.bool().then_some(scene.springs.stiffness_n_per_m * factor),
        damping_n_s_per_m: random.bool().then_some(scene.damping_n_s_per_m * factor),
        anchor_stiffness_n_per_m: random.bool().then_some(scene.anchor_stiffness_n_per_m * factor),
        volume_stiffness_pa: None,
    })
}

fn step(session: &mut Session, first: &Scene, inputs: &StepInputs) {
    if let Some(change) = &inputs.change
        && let Ok(model) = session.model().changed(change, first, &limits())
    {
        session.change(&model);
    }
    session.advance(&mut inputs.due.clone(), |_| {});
}

/// Returns all output of a session after a step.
fn told(session: &Session) -> (u128, String) {
    let tissue = session.tissue();
    let counts = (session.late_commands(), session.paused_commands(), session.path_counts());
    let guard = (tissue.guard_events(), tissue.substeps_done(), tissue.plan().substeps, tissue.checkpoint_step());
    let (sample, recoveries) = (session.sample(None), session.recoveries().list());
    let rest = format!("{sample:?} {:?} {counts:?} {guard:?} {recoveries:?}", session.energy());
    (tissue.state_hash(), format!("{rest} {:?}", session.hold_reason()))
}

/// A random session: what acted at each of its steps, and the bytes at some of them.
struct RandomSession {
    about: String,
    first: Scene,
    model: Arc<Model>,
    inputs: Vec<StepInputs>,
    saved: Vec<(u64, Vec<u8>)>,
    told: Vec<(u128, String)>,
}

fn course(seed: u64) -> RandomSession {
    let mut random = Rng::with_seed(seed);
    let first = scene(&mut random);
    let model = Model::compile(&first, &limits()).unwrap();
    let mut session = Session::new(&model);
    let mut intake = Intake::new(&first, &limits());
    intake.acquire(&TOOLS, "test", 60.0, LEASE, 0).unwrap();
    let mut hands: Vec<RandomHand> = TOOLS.iter().map(|tool| RandomHand::new(*tool, &first, &mut random)).collect();
    let about = format!(
        "seed {seed}: {} {:?} {} substeps {}, sleep {:?}",
        first.name,
        model.plan.integrator,
        model.plan.substeps,
        model.precision.name(),
        first.sleep_tolerance
    );
    let (mut all, mut saved, mut course) = (Vec::new(), Vec::new(), Vec::new());
    let stops: Vec<u64> = (0..4).map(|_| random.u64(0..LONGEST - COMPARED_STEPS)).collect();
    // Some begin late, or act for a short while.
    let (begin, end) = (random.u64(0..20), if random.u8(0..4) == 0 { 60 } else { LONGEST });
    while session.step_count() < LONGEST {
        let now = session.step_count();
        if stops.contains(&now) {
            saved.push((now, session.save().to_bytes()));
        }
        let mut inputs = StepInputs { change: change(&first, &mut random), due: Vec::new() };
        for hand in hands.iter_mut().filter(|_| (begin..end).contains(&now)) {
            if let Some(command) = hand.command(&first, now, &mut random) {
                // It refuses the commands that a server refuses.
                let _ = intake.submit(LEASE, vec![command], 0);
            }
        }
        intake.take_due(now, 0, &mut inputs.due);
        step(&mut session, &first, &inputs);
        if session.step_count() == now {
            break;
        }
        all.push(inputs);
        course.push(told(&session));
    }
    RandomSession { about, first, model, inputs: all, saved, told: course }
}

#[test]
fn what_a_session_has_reached_its_snapshot_restores_with_the_same_bits() {
    let (wanted, mut tried) = (wanted(), 0);
    let mut refused: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut seed = 0;
    while tried < wanted {
        let RandomSession { about, first, model, inputs, saved, told: course } = course(seed);
        seed += 1;
        for (at, bytes) in saved {
            tried += 1;
            let read = Saved::from_bytes(&bytes, &limits()).unwrap();
            let is_first = *read.tissue() == model.saved_plan();
            let made = if is_first { Ok(model.clone()) } else { Model::resumed(&first, read.tissue(), &limits()) };
            let restored = made.and_then(|model| Session::restore(&model, &read));
            let mut again = match restored {
                Ok(again) => again,
                Err(refusal) => {
                    refused.entry(refusal.to_string()).or_default().push(format!("{about}, step {at}"));
                    continue;
                }
            };
            let at = at as usize;
            if again.save().to_bytes() != bytes {
                refused.entry("OTHER BYTES".into()).or_default().push(format!("{about}, step {at}"));
                continue;
            }
            // Another server takes it in, as it takes a session that is handed over.
            match moved::moved(&model, &again, &limits()) {
                Ok(there) if there.save().to_bytes() == bytes => {}
                Ok(_) => refused.entry("OTHER BYTES THERE".into()).or_default().push(format!("{about}, step {at}")),
                Err(refusal) => {
                    refused.entry(format!("there: {refusal}")).or_default().push(format!("{about}, step {at}"));
                }
            }
            for now in at..(at + COMPARED_STEPS as usize).min(course.len()) {
                step(&mut again, &first, &inputs[now]);
                if told(&again) != course[now] {
                    refused.entry("OTHER BITS".into()).or_default().push(format!("{about}, saved at {at}, step {now}"));
                    break;
                }
            }
        }
    }
    println!("{tried} snapshots of {seed} sessions");
    for (what, cases) in &refused {
        println!("{} × {what}\n    {}", cases.len(), cases[..cases.len().min(4)].join("\n    "));
    }
    assert!(refused.is_empty(), "{} kinds", refused.len());
}

/// A session of a sheet that sleeps, in which a tool exerts some forces, each from its step on.
fn pushed(precision: &str, forces: &[(u64, Poke)]) -> Session {
    let precision = format!("stepping.precision={precision}");
    let sets = ["sheet.points=[40, 40]", "stepping.integrator=central", "stepping.substeps=2", "sleep.tolerance=1e-3"];
    let scene = common::scene_with(palpate_tissue::scene::PAPER, &[&sets[..], &[precision.as_str()]].concat());
    let mut session = Session::new(&Model::compile(&scene, &limits()).unwrap());
    for step in 0..60 {
        let acting = forces.iter().filter(|(at, _)| *at == step);
        let mut due = acting.map(|(_, poke)| Due::in_time(Command::new(0, Some(step), Action::Push(*poke)))).collect();
        session.advance(&mut due, |_| {});
    }
    session
}

fn force_at_a_point(force_n: DVec3, falloff_per_m: f64, falloff_offset: f64) -> Poke {
    let scene = common::scene_with(palpate_tissue::scene::PAPER, &["sheet.points=[40, 40]"]);
    let centre_m = scene.shape().rest_m(scene.sheet().unwrap().point([20, 20]));
    Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset }
}

#[test]
fn a_force_of_0_does_nothing_whatever_its_factor() {
    let push = (5, force_at_a_point(-DVec3::Z, 30.0, 0.0));
    for precision in ["f32", "f64"] {
        let alone = pushed(precision, &[push]);
        assert!(alone.tissue().largest_displacement_m() > 0.01);
        for offset in [-1000.0, 0.0, 700.0, 1000.0, f64::MAX] {
            let after = pushed(precision, &[(1, force_at_a_point(DVec3::ZERO, 30.0, offset)), push]);
            assert_eq!(after.tissue().state_hash(), alone.tissue().state_hash(), "{precision}, {offset}");
        }
    }
}

#[test]
fn a_force_that_falls_off_at_once_acts_on_its_own_point() {
    // e^(-c·r) is 1 at its centre, however large c is.
    for precision in ["f32", "f64"] {
        let course = |falloff_per_m| pushed(precision, &[(1, force_at_a_point(-DVec3::Z, falloff_per_m, 0.0))]);
        let expected = course(1e4).tissue().state_hash();
        for falloff_per_m in [1e20, 1e38, 1e40, 1e300, f64::MAX] {
            let found = course(falloff_per_m);
            assert!(found.tissue().largest_displacement_m() > 1e-3);
            assert_eq!(found.tissue().state_hash(), expected, "{precision}, {falloff_per_m:e}");
        }
    }
}
