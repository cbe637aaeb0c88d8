//! A session that was saved, and restored from bytes, continues with the same bits as one that never stopped.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::cast_precision_loss)]

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, OnceLock};

use crate::common;
use crate::common::cases::on_every_core;
use fastrand::Rng;
use glam::DVec3;
use palpate_haptics::{ContactState, Coupling, Tip};
use palpate_session::Session;
use palpate_session::command::{Command, Due};
use palpate_session::snapshot::{Saved, VERSION, seal};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::saved::SavedPlan;
use palpate_tissue::scene::profile::{CentreProfile, LoadProfile, MotionProfile, Move, Poke, Profile, StrengthProfile};
use palpate_tissue::scene::record::{AuditedError, Correction};
use palpate_tissue::scene::script::Action;
use palpate_tissue::scene::{Change, Integrator, Lanes, Named, PAPER, Precision, Scene};

/// Little is rehearsed: most scenes give the number of substeps.
fn limits() -> Limits {
    Limits { rehearsal_work: 1 << 20, ..Limits::default() }
}

const GALLBLADDER: &str = "[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.0035 }\n[material]\nyoungs_modulus_pa = 2e4\n\
                           thickness_m = 0.003\nfoundation_n_per_m3 = 5e6\n";

const SOLID: &str = "[solid]\norgan = { name = \"gallbladder\", edge_m = 0.0035 }\ncell_m = 0.007\n\
                     fixed = [{ group = \"neck\" }]\n[material]\nyoungs_modulus_pa = 2e4\npoissons_ratio = 0.4\n";

/// Events of a session before a step.
#[derive(Debug, Clone)]
enum SessionEvent {
    Command(Box<Due>),
    Change(Change),
    Correct(Correction),
}

/// A session's scene and all its inputs.
struct SnapshotCase {
    about: String,
    first: Scene,
    forces: Vec<LoadProfile>,
    moves: Vec<MotionProfile>,
    events: BTreeMap<u64, Vec<SessionEvent>>,
    steps: u64,
}

/// Steps from one comparison to the next: what differs once, differs from then on.
const TOLD_EVERY: u64 = 5;

/// Output of a session after a step.
#[derive(PartialEq, Debug)]
struct StepOutput {
    hash: u128,
    rest: String,
}

fn told(session: &Session) -> StepOutput {
    let tissue = session.tissue();
    let counts = (session.late_commands(), session.paused_commands(), session.path_counts());
    let guard = (tissue.guard_events(), tissue.substeps_done(), tissue.plan().substeps, tissue.checkpoint_step());
    let rest = format!(
        "{:?} {:?} {counts:?} {guard:?} {:?} {:?} {:?}",
        session.sample(None),
        session.energy(),
        session.recoveries().list(),
        session.hold_reason(),
        tissue.computed_fraction()
    );
    StepOutput { hash: tissue.state_hash(), rest }
}

impl SnapshotCase {
    fn model(&self) -> Arc<Model> {
        Model::compile(&self.first, &limits()).unwrap()
    }

    fn begin(&self) -> Session {
        let mut session = Session::new(&self.model());
        for (tool, profile) in self.forces.iter().enumerate() {
            session.play_force(tool, profile.clone());
        }
        for (tool, profile) in self.moves.iter().enumerate() {
            session.play_move(self.forces.len() + tool, profile.clone());
        }
        session
    }

    /// One step with its inputs.
    fn step(&self, session: &mut Session) {
        let mut due = Vec::new();
        for event in self.events.get(&session.step_count()).into_iter().flatten() {
            match event {
                SessionEvent::Command(command) => due.push(Due::clone(command)),
                SessionEvent::Change(change) => {
                    // After a correction, another tissue may need more rehearsals than are allowed here.
                    if let Ok(model) = session.model().changed(change, &self.first, &limits()) {
                        session.change(&model);
                    }
                }
                SessionEvent::Correct(correction) => {
                    let model = session.model().corrected(correction, &limits()).unwrap();
                    session.change(&model);
                }
            }
        }
        session.advance(&mut due, |_| {});
    }

    /// The model of a snapshot, made of the scene and the snapshot alone.
    fn resumed(&self, saved: &Saved, lanes: Option<&str>) -> Arc<Model> {
        let mut first = self.first.clone();
        if let Some(lanes) = lanes {
            first.stepping.lanes = Named::named("", lanes).unwrap();
        }
        Model::resumed(&first, saved.tissue(), &limits()).unwrap()
    }

    /// The session restored from bytes.
    fn restored(&self, bytes: &[u8], lanes: Option<&str>) -> Session {
        let saved = Saved::from_bytes(bytes, &limits()).unwrap_or_else(|e| panic!("{}: {e}", self.about));
        let model = self.resumed(&saved, lanes);
        Session::restore(&model, &saved).unwrap_or_else(|e| panic!("{}: {e}", self.about))
    }
}

fn vector(random: &mut Rng, size: f64) -> DVec3 {
    let mut part = || size * (2.0 * random.f64() - 1.0);
    DVec3::new(part(), part(), part())
}

fn command(tool: u32, sequence: u64, action: Action) -> Due {
    Due::in_time(Command { arrival_ns: 17 * sequence, ..Command::new(tool, Some(sequence), action) })
}

/// A random session.
fn case(seed: u64) -> SnapshotCase {
    let mut random = Rng::with_seed(seed);
    let schemes: Vec<&str> = common::schemes().collect();
    let scheme = schemes[seed as usize % schemes.len()];
    let on_mesh = seed % 8 == 3;
    let formats = if scheme.starts_with("exponential") { &["f32", "f64", "compensated"][..] } else { &["f32", "f64"] };
    let mut sets = vec![
        format!("stepping.integrator={scheme}"),
        "stepping.tolerance=1e-2".to_owned(),
        format!("stepping.precision={}", formats[random.usize(0..formats.len())]),
    ];
    if on_mesh {
        sets.push("stepping.substeps=8".to_owned());
    } else {
        sets.push(format!("stepping.substeps={}", random.u32(1..4)));
        sets.push(format!("sheet.points=[{}, {}]", random.u32(3..60), random.u32(3..60)));
        // Now and then too stiff for the substeps: the guard halves them, or takes the tissue back.
        let stiffness = [10.0, 10.0, 10.0, 3.0, 100.0, 3e4, 1e5, 1e9][random.usize(0..8)];
        sets.push(format!("springs.stiffness_n_per_m={stiffness:?}"));
        sets.push(format!("anchor_springs.stiffness_n_per_m={}", [5, 5, 50, 0][random.usize(0..4)]));
        sets.push(format!("damping.coefficient_n_s_per_m={}", [0.5, 0.5, 2.0, 0.05][random.usize(0..4)]));
        sets.push(format!("springs.bending={}", random.bool()));
        sets.push(format!("sheet.fixed={}", ["edges", "corners", "[]"][random.usize(0..3)]));
    }
    if random.u8(0..4) > 0 {
        sets.push(format!("sleep.tolerance={:?}", [0.0, 1e-3, 1e-2, 5e-2][random.usize(0..4)]));
    }
    // To make an organ takes longer than to step it.
    static ORGANS: OnceLock<[Scene; 2]> = OnceLock::new();
    let organs = || [GALLBLADDER, SOLID].map(|text| Scene::parse("organ", text, &[], &limits()).unwrap());
    let first = if on_mesh {
        let settings = Scene::parse("settings", PAPER, &sets, &limits()).unwrap();
        let (stepping, sleep_tolerance) = (settings.stepping, settings.sleep_tolerance);
        let organ = &ORGANS.get_or_init(organs)[usize::from(seed % 16 == 11)];
        Scene { stepping, sleep_tolerance, ..organ.clone() }
    } else {
        Scene::parse("random", PAPER, &sets, &limits()).unwrap()
    };
    let mut case = SnapshotCase {
        about: format!("seed {seed}, {sets:?}"),
        first,
        forces: Vec::new(),
        moves: Vec::new(),
        events: BTreeMap::new(),
        steps: random.u64(300..600),
    };
    profiles(&mut case, &mut random);
    let profiled = (case.forces.len() + case.moves.len()) as u32;
    for tool in profiled..profiled + random.u32(1..4) {
        hand(&mut case, &mut random, tool);
    }
    tissues(&mut case, &mut random, on_mesh);
    case
}

/// A point that may be grasped.
fn free(case: &SnapshotCase, random: &mut Rng) -> palpate_tissue::shape::PointId {
    let shape = case.first.shape();
    loop {
        let point = palpate_tissue::shape::PointId::new(random.usize(0..shape.point_count()));
        if !shape.is_fixed(point) || shape.point_count() < 10 {
            return point;
        }
    }
}

fn poke(case: &SnapshotCase, random: &mut Rng) -> Poke {
    let shape = case.first.shape();
    let (point, edge_m) = (free(case, random), shape.edge_m());
    let stiffness = case.first.anchor_stiffness_n_per_m + 0.3 * case.first.springs.stiffness_n_per_m.min(1000.0);
    let centre_m = if random.bool() { shape.rest_m(point) } else { shape.rest_m(point) + vector(random, 0.2 * edge_m) };
    let centre_m = if shape.dimensions() == 2 { centre_m.truncate().extend(0.0) } else { centre_m };
    Poke {
        point: random.bool().then_some(point),
        centre_m,
        force_n: vector(random, 0.3 * edge_m * stiffness),
        falloff_per_m: (0.5 + 2.0 * random.f64()) / edge_m,
        falloff_offset: 0.1 * random.f64(),
    }
}

/// Forces and movements as functions of time.
fn profiles(case: &mut SnapshotCase, random: &mut Rng) {
    for _ in 0..random.usize(0..3) {
        let Poke { centre_m, force_n, falloff_per_m, falloff_offset, .. } = poke(case, random);
        let edge_m = case.first.shape().edge_m();
        let centre = match random.u8(0..3) {
            0 => CentreProfile::Hops(vec![(3, centre_m), (200, centre_m + DVec3::X * 0.5 * edge_m)]),
            1 => {
                let points = [free(case, random), free(case, random)];
                let [a, b] = points.map(|point| (point, case.first.shape().rest_m(point)));
                CentreProfile::Points(vec![(0, a), (150, b)])
            }
            _ => CentreProfile::Path { from_m: centre_m, velocity_m_per_s: DVec3::new(edge_m, -2.0 * edge_m, 0.0) },
        };
        let strength = match random.u8(0..5) {
            0 => StrengthProfile::Scaled(force_n, Profile::Constant),
            1 => StrengthProfile::Scaled(force_n, Profile::Pulse { on: 40, off: 260 }),
            2 => StrengthProfile::Scaled(force_n, Profile::Ramp { from_s: 0.02, to_s: 0.2 }),
            3 => StrengthProfile::Scaled(force_n, Profile::Sine { frequency_hz: 7.0 }),
            _ => StrengthProfile::Recorded((0..30).map(|k| (11 * k, force_n * (k % 3) as f64)).collect()),
        };
        case.forces.push(LoadProfile { centre, strength, falloff_per_m, falloff_offset });
    }
    if random.u8(0..3) == 0 {
        let by_m = vector(random, 0.5 * case.first.shape().edge_m());
        let moves = vec![Move { from_s: 0.05, to_s: 0.2, by_m }, Move { from_s: 0.15, to_s: 0.4, by_m: -by_m }];
        case.moves.push(MotionProfile { point: free(case, random), moves });
    }
}

/// The commands to a tool: periods of pushing, grasping or leading it by poses, and of nothing.
fn hand(case: &mut SnapshotCase, random: &mut Rng, tool: u32) {
    let edge_m = case.first.shape().edge_m();
    let (mut step, mut sequence) = (random.u64(0..60), 0);
    let put = |events: &mut BTreeMap<u64, Vec<SessionEvent>>, step: u64, due: Due| {
        events.entry(step).or_default().push(SessionEvent::Command(Box::new(due)));
    };
    while step < case.steps {
        let until = step + random.u64(20..250);
        match random.u8(0..6) {
            0 | 1 => {
                while step < until {
                    sequence += 1;
                    let mut due = command(tool, sequence, Action::Push(poke(case, random)));
                    due.late = random.u8(0..8) == 0;
                    due.late_commands = u64::from(due.late);
                    due.command.time_to_live_s = random.bool().then_some(0.02);
                    put(&mut case.events, step, due);
                    step += random.u64(1..80);
                }
            }
            2 => {
                let point = free(case, random);
                let to_m = vector(random, 0.4 * edge_m);
                for part in 0..8_u8 {
                    sequence += 1;
                    let displacement_m = to_m * f64::from(part) / 8.0;
                    put(&mut case.events, step, command(tool, sequence, Action::Grasp { point, displacement_m }));
                    step += random.u64(1..12);
                }
            }
            3..=4 => step = pose(case, random, tool, [step, until], &mut sequence),
            _ => {}
        }
        sequence += 1;
        let mut last = command(tool, sequence, Action::Release);
        last.ends_lease = random.u8(0..4) == 0;
        match random.u8(0..3) {
            // It continues unchanged, and ends for lack of commands or never.
            0 => {}
            _ => put(&mut case.events, step.max(until), last),
        }
        step = step.max(until) + 1 + random.u64(0..100);
    }
}

/// Leads a tool onto the tissue and along it, by poses of a thousandth of a second that come in bursts. Returns the
/// step after the last.
fn pose(case: &mut SnapshotCase, random: &mut Rng, tool: u32, [from, until]: [u64; 2], sequence: &mut u64) -> u64 {
    let shape = case.first.shape();
    let edge_m = shape.edge_m();
    let point = free(case, random);
    let (rest_m, outward) = (shape.rest_m(point), shape.normal(point));
    let along = outward.any_orthonormal_vector();
    let mut stiffness = || 50.0 + 500.0 * random.f64();
    let spring = Coupling::Spring { stiffness_n_per_m: stiffness(), damping_n_s_per_m: 0.2 };
    let mut tip = Tip {
        radius_m: edge_m * (0.8 + random.f64()),
        friction: [0.0, 0.1, 0.5][random.usize(0..3)],
        grasps: random.u8(0..3) == 0,
        coupling: if random.bool() { Coupling::Constraint } else { spring },
        burn_s: if random.u8(0..3) == 0 { 0.01 } else { 0.0 },
        ..Tip::default()
    };
    let (kind, burst) = (random.u8(0..4), random.u64(1..12));
    let mut events: Vec<(u64, SessionEvent)> = Vec::new();
    for step in from..until {
        let passed = (step - from) as f64;
        let depth_m = (0.006 - 0.0003 * passed).max(-0.3 * edge_m);
        let place_m = rest_m + depth_m * outward + (1e-5 * passed.max(60.0)) * along;
        if kind == 3 && step == (from + until) / 2 {
            tip.friction = 0.3;
        }
        *sequence += 1;
        let velocity_m_per_s = (kind == 1).then_some(-0.3 * outward);
        let mut due = command(tool, *sequence, Action::Pose { place_m, velocity_m_per_s, tip });
        match kind {
            // At its step.
            0 => due.command.at_step = Some(step),
            _ => due.command.client_time_ns = step * 1_000_000 + random.u64(0..300_000),
        }
        let mut arrives = step / burst * burst + burst;
        if kind == 2 {
            due.command.by_datagram = true;
            arrives += random.u64(0..7);
            if random.u8(0..6) == 0 {
                continue;
            }
        }
        if kind == 0 {
            arrives = step;
        }
        events.push((arrives, SessionEvent::Command(Box::new(due))));
    }
    for (step, event) in events {
        case.events.entry(step).or_default().push(event);
    }
    until
}

/// Other tissues, and corrections.
fn tissues(case: &mut SnapshotCase, random: &mut Rng, on_mesh: bool) {
    for _ in 0..random.usize(0..3) {
        let factor = [0.5, 1.5, 2.0][random.usize(0..3)];
        let first = &case.first;
        let change = Change {
            stiffness_n_per_m: random.bool().then_some(first.springs.stiffness_n_per_m * factor),
            damping_n_s_per_m: random.bool().then_some(first.damping_n_s_per_m * factor),
            anchor_stiffness_n_per_m: Some(first.anchor_stiffness_n_per_m * factor),
            volume_stiffness_pa: None,
        };
        case.events.entry(random.u64(0..case.steps)).or_default().push(SessionEvent::Change(change));
    }
    for _ in 0..random.usize(0..2) {
        let integrators: Vec<Integrator> = Integrator::of_anchored().collect();
        let integrator = integrators[random.usize(0..integrators.len())];
        let step = random.u64(0..case.steps);
        let own = case.model();
        let compensates = integrator.name().starts_with("exponential");
        let precision = match own.precision {
            Precision::F64 => Precision::F64,
            _ if random.bool() => Precision::F64,
            _ if compensates && random.bool() => Precision::Compensated,
            other if other == Precision::Compensated && !compensates => Precision::F64,
            other => other,
        };
        let correction = Correction {
            step,
            audited_error: AuditedError::default(),
            reason: "a test".to_owned(),
            integrator: if random.bool() { integrator } else { own.plan.integrator },
            substeps: own.plan.substeps * random.u32(1..3) * if on_mesh { 2 } else { 1 },
            precision,
            sleep_tolerance: own.sleep_tolerance * 0.5,
        };
        // A scheme that does not compensate, in a format that does, is refused.
        let is_possible = own.corrected(&correction, &limits()).is_ok();
        if is_possible {
            case.events.entry(step).or_default().push(SessionEvent::Correct(correction));
        }
    }
}

/// Contents of the snapshots of all cases, to check that every part was tried.
#[derive(Default)]
struct Coverage(BTreeMap<&'static str, u32>);

impl Coverage {
    fn note(&mut self, session: &Session, case: &SnapshotCase) {
        let tissue = session.tissue();
        let mut add = |name: &'static str, holds: bool| *self.0.entry(name).or_default() += u32::from(holds);
        let awake = tissue.awake_points();
        add("part asleep", awake > 0 && awake < session.model().len());
        add("at rest", tissue.is_still() && tissue.largest_displacement_m() > 0.0);
        add("halved", tissue.plan().substeps > session.model().plan.substeps);
        add("recovered", session.recoveries().count() > 0);
        add("another tissue", session.model().scene.springs != case.first.springs);
        add("corrected", session.model().corrected.is_some());
        add("another format", session.model().precision != case.model().precision);
        for tool in session.sample(None).tools {
            let state = tool.feel.map(|feel| feel.contact_state);
            add("free", state == Some(ContactState::Free));
            add("sticking", state == Some(ContactState::Sticking));
            add("sliding", state == Some(ContactState::Sliding));
            add("holding", state == Some(ContactState::Holding));
            add("path by time", tool.place_time_s > 0.0);
            add("paused", tool.paused_until.is_some());
        }
        let shape = session.model().shape();
        let holds = |point| tissue.point(point).constraint_n.is_some() && !shape.is_fixed(point);
        add("grasped", palpate_tissue::shape::points(shape).any(holds));
    }
}

/// The widths of vectors of this machine, but the slow one.
fn widths() -> Vec<&'static str> {
    let available = |lanes: &&str| {
        let sets = [format!("stepping.lanes={lanes}"), "sheet.points=[3, 3]".to_owned()];
        Model::compile(&Scene::parse("test", PAPER, &sets, &Limits::default()).unwrap(), &limits()).is_ok()
    };
    ["neon", "avx2", "avx512"].into_iter().filter(available).collect()
}

fn bytes_of(session: &Session) -> Vec<u8> {
    session.save().to_bytes()
}

#[test]
fn a_hundred_random_sessions_go_on_with_the_same_bits() {
    let seeds: Vec<u64> = (0..100).collect();
    let tried = on_every_core(&seeds, |seed| goes_on_with_the_same_bits(*seed));
    let (mut seen, mut snapshots) = (Coverage::default(), 0);
    for (of_one, count) in tried {
        of_one.0.into_iter().for_each(|(name, times)| *seen.0.entry(name).or_default() += times);
        snapshots += count;
    }
    println!("{snapshots} snapshots: {:?}", seen.0);
    assert!(seen.0.values().all(|count| *count > 0), "{:?}", seen.0);
}

/// Restores the snapshots of a random session, and plays each to its end. Returns what they contained, and their number.
fn goes_on_with_the_same_bits(seed: u64) -> (Coverage, u32) {
    let (mut seen, widths, mut tried) = (Coverage::default(), widths(), 0_u32);
    let case = case(seed);
    let mut random = Rng::with_seed(!seed);
    let mut session = case.begin();
    let stops: BTreeSet<u64> = (0..3).map(|_| random.u64(0..case.steps)).collect();
    // The outputs, and the bytes at the stops.
    let (mut course, mut saved) = (Vec::new(), Vec::new());
    while session.step_count() < case.steps && session.hold_reason().is_none() {
        if stops.contains(&session.step_count()) {
            seen.note(&session, &case);
            let taken = session.save();
            assert_eq!(taken.step(), session.step_count());
            saved.push((session.step_count(), taken.to_bytes()));
        }
        case.step(&mut session);
        if session.step_count().is_multiple_of(TOLD_EVERY) {
            course.push(told(&session));
        }
    }
    let end = bytes_of(&session);
    for (index, (step, bytes)) in saved.into_iter().enumerate() {
        let lanes = (!widths.is_empty()).then(|| widths[index % widths.len()]);
        let mut again = case.restored(&bytes, lanes);
        assert_eq!(again.step_count(), step, "{}", case.about);
        assert!(bytes_of(&again) == bytes, "{}: what was restored is not what was saved at {step}", case.about);
        while again.step_count() < case.steps && again.hold_reason().is_none() {
            case.step(&mut again);
            let now = again.step_count();
            if now.is_multiple_of(TOLD_EVERY) {
                let before = &course[(now / TOLD_EVERY) as usize - 1];
                assert_eq!(told(&again), *before, "{}: saved at {step}, step {now}", case.about);
            }
        }
        assert!(bytes_of(&again) == end, "{}: saved at {step}, another state at the end", case.about);
        tried += 1;
    }
    (seen, tried)
}

/// A small session in which tools push, hold and touch, after some steps.
fn touched(sets: &[&str], steps: u64) -> Session {
    let always = ["sheet.points=[5, 4]", "stepping.integrator=exponential3", "stepping.substeps=2"];
    let first = common::scene_with(PAPER, &[&always[..], sets].concat());
    let mut session = Session::new(&Model::compile(&first, &limits()).unwrap());
    let (shape, edge_m) = (first.shape(), first.shape().edge_m());
    let tip = Tip { radius_m: edge_m, ..Tip::default() };
    let rest_m = shape.rest_m(shape.nearest(shape.extent().middle_m()));
    let poke = Poke {
        point: None,
        centre_m: rest_m,
        force_n: DVec3::new(0.02, 0.0, -0.1),
        falloff_per_m: 0.5 / edge_m,
        falloff_offset: 0.0,
    };
    for step in 0..steps {
        let mut due = Vec::new();
        if step % 40 == 3 {
            due.push(command(0, step + 1, Action::Push(poke)));
            let (point, displacement_m) = (shape.nearest(DVec3::ZERO), 1e-3 * DVec3::Z);
            due.push(command(1, step + 1, Action::Grasp { point, displacement_m }));
        }
        let place_m = rest_m + (0.003 - 1e-4 * step as f64) * DVec3::Z;
        let mut pose = command(2, step + 1, Action::Pose { place_m, velocity_m_per_s: None, tip });
        pose.command.client_time_ns = (step + 1) * 1_000_000;
        due.push(pose);
        session.advance(&mut due, |_| {});
    }
    session
}

fn is_finite(session: &Session) -> bool {
    session.model().points().all(|point| {
        let point = session.tissue().point(point);
        point.displacement_m.is_finite() && point.velocity_m_per_s.is_finite()
    })
}

/// Restores bytes whose checksum is made right. What is taken steps on, and stays finite. Tells whether it was taken.
fn is_taken(model: &Arc<Model>, mut bytes: Vec<u8>) -> bool {
    seal(&mut bytes);
    let restored = Saved::from_bytes(&bytes, &limits()).and_then(|saved| Session::restore(model, &saved));
    let Ok(mut session) = restored else { return false };
    assert!(is_finite(&session));
    for _ in 0..3 {
        session.advance(&mut Vec::new(), |_| {});
        assert!(is_finite(&session));
    }
    true
}

#[test]
fn bytes_that_were_cut_or_bent_are_refused_or_stay_finite() {
    for sets in [["stepping.precision=f64"], ["stepping.precision=f32"]] {
        let session = touched(&sets, 61);
        let (model, bytes) = (session.model(), bytes_of(&session));
        assert!(is_taken(model, bytes.clone()));
        for length in (0..bytes.len()).step_by(3) {
            let cut = bytes[..length].to_vec();
            assert!(Saved::from_bytes(&cut, &limits()).is_err(), "{length}");
            assert!(!is_taken(model, cut), "{length} of {} bytes were taken", bytes.len());
        }
        let (mut random, mut taken) = (Rng::with_seed(7), 0);
        for _ in 0..1500 {
            let mut bent = bytes.clone();
            let at = random.usize(0..bent.len());
            bent[at] ^= 1 << random.u8(0..8);
            let refusal = Saved::from_bytes(&bent, &limits()).map(drop).unwrap_err();
            assert_eq!(refusal.field, "snapshot", "{refusal}");
            taken += u32::from(is_taken(model, bent));
        }
        // Most bits are those of values at points, and another value may be as good.
        assert!(taken > 100 && taken < 1500, "{taken}");
        assert!(!is_taken(model, [&bytes[..], &[0; 8]].concat()));
    }
}

#[test]
fn a_snapshot_of_another_model_is_refused_by_what_differs() {
    let session = touched(&["stepping.precision=f32"], 20);
    let saved = Saved::from_bytes(&bytes_of(&session), &limits()).unwrap();
    let first = session.model().scene.clone();
    let refused = |change: &dyn Fn(&mut Scene), what: &str| {
        let mut scene = first.clone();
        change(&mut scene);
        let model = Model::compile(&scene, &limits()).unwrap();
        let refusal = Session::restore(&model, &saved).map(drop).unwrap_err();
        assert!(refusal.field == "snapshot" && refusal.message.contains(what), "{what}: {refusal}");
    };
    refused(&|scene| scene.sheet_mut().unwrap().points = [5, 5], "of 20 points, but this one has 25");
    refused(&|scene| scene.sheet_mut().unwrap().points = [4, 5], "of another scene");
    refused(&|scene| scene.sheet_mut().unwrap().point_mass_kg *= 2.0, "of another scene");
    refused(&|scene| scene.stepping.precision = Precision::F64, "but this one is in f64");
    refused(
        &|scene| scene.stepping.substeps = Some(3),
        "2 substeps a step, but this one is stepped by exponential3, 3",
    );
    refused(&|scene| scene.stepping.integrator = Integrator::Exponential2, "but this one is stepped by exponential2");
    refused(&|scene| scene.damping_n_s_per_m *= 2.0, "other coefficients");
    // Values that are only shown, and properties of the machine, are not part of it.
    let mut other = first.clone();
    (other.name, other.appearance.texture_seed, other.stepping.lanes) = ("other".into(), 9, Lanes::Plain);
    assert!(Session::restore(&Model::compile(&other, &limits()).unwrap(), &saved).is_ok());
}

#[test]
fn another_version_and_what_is_above_the_limits_is_refused() {
    let bytes = bytes_of(&touched(&[], 20));
    let refusal = |bytes: &[u8], limits: &Limits| Saved::from_bytes(bytes, limits).map(drop).unwrap_err();
    let mut newer = bytes.clone();
    newer[8] += 1;
    let told = refusal(&newer, &limits()).message;
    assert!(
        told.contains(&format!("version {}", VERSION + 1)) && told.contains(&format!("version {VERSION}")),
        "{told}"
    );
    let few = refusal(&bytes, &Limits { points: 19, ..limits() });
    assert!(few.message.contains("20 points, above the limit of 19"), "{few}");
    let session = touched(&[], 20);
    for (limits, what) in [
        (Limits { tools: 2, ..limits() }, "tool 2, but tools are numbered below 2"),
        (Limits { point_force_n: 0.01, ..limits() }, "above the limit of 0.01 N"),
    ] {
        // The number of tools is known before any of them is built.
        let restored = Saved::from_bytes(&bytes, &limits).and_then(|saved| Session::restore(session.model(), &saved));
        let refusal = restored.map(drop).unwrap_err();
        assert!(refusal.message.contains(what), "{refusal}");
    }
    assert!(refusal(b"", &limits()).message.contains("is not a snapshot"));
}

#[test]
fn letting_go_is_the_end_of_every_lease() {
    let bytes = bytes_of(&touched(&[], 50));
    let saved = Saved::from_bytes(&bytes, &limits()).unwrap();
    let model = Model::resumed(&touched(&[], 0).model().scene, saved.tissue(), &limits()).unwrap();
    let [mut one, mut other] = [(); 2].map(|()| Session::restore(&model, &saved).unwrap());
    one.let_go();
    one.advance(&mut Vec::new(), |_| {});
    let ends = |tool| Due { ends_lease: true, ..command(tool, 0, Action::Release) };
    other.advance(&mut (0..3).map(ends).collect(), |_| {});
    assert_eq!(told(&one), told(&other));
    assert!(bytes_of(&one) == bytes_of(&other));
    let tools = one.sample(None).tools;
    assert!(tools.len() == 3 && tools.iter().all(|tool| tool.expired && tool.feel.is_none()), "{tools:?}");
    // All of it comes to rest.
    common::advance(&mut one, 20_000);
    assert!(one.tissue().is_still() && one.tissue().largest_displacement_m() < 1e-4);
}

#[test]
fn one_number_at_a_time_goes_on_as_the_widest_vectors_do() {
    for sets in [["stepping.precision=f64"], ["stepping.precision=f32"], ["stepping.precision=compensated"]] {
        let mut session = touched(&sets, 30);
        let saved = Saved::from_bytes(&bytes_of(&session), &limits()).unwrap();
        let mut first = session.model().scene.clone();
        first.stepping.lanes = Lanes::Plain;
        let mut again = Session::restore(&Model::resumed(&first, saved.tissue(), &limits()).unwrap(), &saved).unwrap();
        assert_eq!(again.model().lanes, Lanes::Plain);
        for _ in 0..60 {
            [&mut session, &mut again].into_iter().for_each(|session| session.advance(&mut Vec::new(), |_| {}));
            assert_eq!(told(&session), told(&again), "{sets:?}");
        }
        assert!(bytes_of(&session) == bytes_of(&again), "{sets:?}");
    }
}

#[test]
fn changes_and_corrections_come_to_the_same_model_in_one_go() {
    let first = common::scene_with(common::SMALL, &["stepping.tolerance=1e-4"]);
    let roomy = Limits::default();
    let mut model = Model::compile(&first, &roomy).unwrap();
    let begun = model.scene.clone();
    let correction = Correction {
        step: 7,
        audited_error: AuditedError::default(),
        reason: "a test".to_owned(),
        integrator: Integrator::Exponential3,
        substeps: 5,
        precision: Precision::F64,
        sleep_tolerance: 1e-6,
    };
    let change = |stiffness: f64| Change { stiffness_n_per_m: Some(stiffness), ..Change::default() };
    for event in [Some(60.0), None, Some(0.0), Some(45.0)] {
        model = match event {
            Some(stiffness) => model.changed(&change(stiffness), &begun, &roomy).unwrap(),
            None => model.corrected(&correction, &roomy).unwrap(),
        };
        // Neither work for rehearsals nor the machine makes it another.
        let again = Model::resumed(&begun, &model.saved_plan(), &Limits { rehearsal_work: 0, ..limits() }).unwrap();
        assert_eq!(again.saved_plan(), model.saved_plan());
        assert_eq!((&again.scene, &again.plan, again.precision), (&model.scene, &model.plan, model.precision));
        assert_eq!((again.corrected, &again.warnings), (model.corrected, &model.warnings));
        assert_eq!((again.fingerprint(), again.sleep_tolerance), (model.fingerprint(), model.sleep_tolerance));
        // And what is made of it is the same.
        let [one, other] = [&model, &again].map(|model| model.changed(&change(33.0), &begun, &roomy).unwrap());
        assert_eq!((&one.plan, one.fingerprint()), (&other.plan, other.fingerprint()));
    }
    let state = model.saved_plan();
    for bent in [
        SavedPlan { substeps: 0, ..state },
        SavedPlan { integrator: Integrator::Auto, ..state },
        SavedPlan { precision: Precision::Auto, ..state },
        SavedPlan { stiffness_n_per_m: f64::NAN, ..state },
        SavedPlan { sleep_tolerance: -1.0, ..state },
        SavedPlan { substeps: u32::MAX, ..state },
    ] {
        assert!(Model::resumed(&begun, &bent, &roomy).is_err(), "{bent:?}");
    }
}

#[test]
fn what_has_never_moved_takes_no_bytes() {
    let scene = common::scene_with(PAPER, &["sheet.points=[400, 400]", "stepping.substeps=2"]);
    let mut session = Session::new(&Model::compile(&scene, &limits()).unwrap());
    assert!(bytes_of(&session).len() < 300);
    let poke = Poke {
        point: None,
        centre_m: scene.shape().rest_m(scene.sheet().unwrap().point([200, 200])),
        force_n: DVec3::new(0.0, 0.0, -0.1),
        falloff_per_m: 30.0,
        falloff_offset: 0.0,
    };
    session.advance(&mut vec![command(0, 1, Action::Push(poke))], |_| {});
    // All points would take twenty times as much.
    let bytes = bytes_of(&session).len();
    assert!(bytes < 1_000_000, "{bytes} bytes");
}

#[test]
fn the_bytes_of_a_snapshot_stay() {
    // If they change and the bits of a tip do not (`journal::REPLAYS`), so must the version of the format.
    let bytes = bytes_of(&touched(&["stepping.precision=f32"], 61));
    assert_eq!((VERSION, format!("{:032x}", xxhash_rust::xxh3::xxh3_128(&bytes))), (2, GOLDEN.to_owned()));
}

const GOLDEN: &str = "02089b5fabe359381324674378c12f05";
