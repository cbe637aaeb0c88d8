//! The measured error of a run, of windows of steps and of live sessions, and the corrections that follow from it.

use crate::common::metrics;
use std::time::Instant;

use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, force, repository};
use crate::common::{SMALL, model, playing, scene_with, script};
use glam::DVec3;
use palpate_haptics::Tip;
use palpate_proto::pb;
use palpate_session::Session;
use palpate_session::audit::Windows;
use palpate_session::command::{Command, Due};
use palpate_session::run::{RunOptions, run};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::record::{AuditedError, Correction, Summary};
use palpate_tissue::scene::script::Action;
use palpate_tissue::scene::{BUILT_IN, Integrator, Precision, Scene};
use palpate_tissue::select::audit::{AuditFinding, ErrorExtent, FINER, Mark, Origin, WindowInputs};
use pb::create_session_request::Source;
use serde_json::Value;

/// A force that comes and goes, beside the middle.
const PULSE: &str = "duration_s = 1.0\nsample_every_s = 0.02\nsample_points = [[3, 2], [1, 1], [5, 3]]\n[[force]]\n\
    point = [3, 2]\nforce_n = [0.1, 0.05, -0.3]\nfalloff_per_m = 20.0\nfalloff_offset = 0.0\n\
    profile = { type = \"pulse\", on_s = 0.1, off_s = 0.4 }\n";

/// A force that is never constant, along a path.
const SINE: &str = "duration_s = 2.0\nsample_every_s = 0.02\nsample_points = [[3, 2], [1, 1], [5, 3]]\n[[force]]\n\
    path = { from_m = [0.1, 0.1], velocity_m_per_s = [0.03, 0.01] }\nforce_n = [0.05, 0.1, -0.3]\n\
    falloff_per_m = 20.0\nfalloff_offset = 0.0\nprofile = { type = \"sine\", frequency_hz = 3.0 }\n";

/// A point that is grasped and moved.
const GRASP: &str = "duration_s = 1.0\nsample_every_s = 0.02\nsample_points = [[3, 2], [2, 2], [5, 3]]\n[[tool]]\n\
    point = [3, 2]\nmoves = [{ from_s = 0.0, to_s = 0.2, by_m = [0.0, 0.01, 0.02] }, \
    { from_s = 0.5, to_s = 0.6, by_m = [0.01, 0.0, -0.03] }]\n";

/// Runs a script, audited or not. Returns the summary and the records as written.
fn play(scene: &Scene, text: &str, held: bool, audited: bool) -> (Summary, Vec<Value>) {
    let script = script(text, scene);
    let mut output = Vec::new();
    let limits = Limits::default();
    let summary = run(
        &model(scene),
        &script,
        RunOptions { held, audit: audited, profile: None },
        &limits,
        &mut output,
        &|| 0.0,
        &mut |_| {},
    )
    .unwrap();
    let lines = String::from_utf8(output).unwrap();
    let lines = lines.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    (summary, lines.filter(|line| line.get("time_s").is_some()).collect())
}

/// The largest difference of any component of displacement and of reaction, relative to the largest component of each.
fn true_error(records: &[Value], truth: &[Value]) -> AuditedError {
    let numbers = |records: &[Value], key: &str| -> Vec<f64> {
        let points = records.iter().flat_map(|record| record["points"].as_array().unwrap().clone());
        points
            .flat_map(|point| point[key].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect::<Vec<_>>())
            .collect()
    };
    let part = |key: &str| {
        let (found, truth) = (numbers(records, key), numbers(truth, key));
        assert_eq!(found.len(), truth.len());
        let differences = found.iter().zip(&truth).map(|(a, b)| (a - b).abs());
        differences.fold(0.0, f64::max) / truth.iter().map(|v| v.abs()).fold(0.0, f64::max)
    };
    AuditedError { displacement: part("displacement_m"), force: part("reaction_n") }
}

#[test]
fn an_audit_finds_an_error_that_is_there() {
    let coarse: [&[&str]; 6] = [
        &["stepping.integrator=central", "stepping.substeps=1"],
        &["stepping.integrator=lagged", "stepping.substeps=1"],
        &["stepping.integrator=exponential2", "stepping.substeps=1"],
        &["stepping.integrator=exponential3", "stepping.substeps=1", "stepping.precision=compensated"],
        &["stepping.integrator=rk4", "stepping.substeps=1"],
        &["stepping.integrator=central", "stepping.substeps=2", "damping.coefficient_n_s_per_m=2.0"],
    ];
    for (index, settings) in coarse.into_iter().enumerate() {
        for (name, text) in [("pulse", PULSE), ("sine", SINE), ("grasp", GRASP)] {
            for held in [false, true] {
                let with = |more: &[&str]| scene_with(SMALL, &[settings, &["stepping.rate_hz=250"], more].concat());
                let (summary, records) = play(&with(&[]), text, held, true);
                let exact = ["stepping.integrator=auto", "stepping.substeps=auto", "stepping.precision=f64"];
                let exact = with(&[&exact[..], &["stepping.tolerance=1e-10", "sleep.tolerance=0"]].concat());
                let truth = true_error(&records, &play(&exact, text, held, false).1);
                let audited = summary.audited_error.unwrap();
                let parts = [(audited.displacement, truth.displacement), (audited.force, truth.force)];
                for (audited, truth) in parts {
                    assert!(truth > 1e-7, "{index} {name} {held}: there is no error to find: {truth:e}");
                    let ratio = audited / truth;
                    assert!((0.5..2.0).contains(&ratio), "{index} {name} {held}: {audited:e} of {truth:e}");
                }
            }
        }
    }
}

#[test]
fn an_audit_of_a_good_scene_is_within_its_tolerance() {
    // The script names a point of a sheet.
    for (name, text) in BUILT_IN.into_iter().filter(|scene| scene.1.contains("[sheet]")) {
        let scene = scene_with(text, &[]);
        let file = repository().join("scripts/vertical-60.toml");
        let error = play(&scene, &std::fs::read_to_string(file).unwrap(), false, true).0.audited_error.unwrap();
        assert!(error.largest() <= scene.stepping.tolerance && error.largest() > 0.0, "{name}: {error:?}");
    }
}

/// The actions that a client commands at a step.
type StepActions = fn(u64) -> Vec<(usize, Action)>;

/// A touch that presses, slides and releases; with `grasps`, a grasp that holds.
fn touching(grasps: bool, step: u64) -> Vec<(usize, Action)> {
    let t = step as f64 / 250.0;
    let tip = Tip { radius_m: 0.06, grasps, ..Tip::default() };
    let depth_m = 0.004 * (1.0 - (std::f64::consts::TAU * 1.5 * t).cos());
    vec![(0, Action::Pose { place_m: DVec3::new(0.13 + 0.02 * t, 0.1, 0.001 - depth_m), velocity_m_per_s: None, tip })]
}

fn pushing(step: u64) -> Vec<(usize, Action)> {
    let scene = scene_with(SMALL, &["stepping.rate_hz=250"]);
    script(SINE, &scene).actions_at(step).collect()
}

fn grasping(step: u64) -> Vec<(usize, Action)> {
    let z = 0.02 * (step as f64 / 250.0 * 9.0).sin();
    vec![(
        1,
        Action::Grasp {
            point: scene_with(SMALL, &[]).sheet().unwrap().point([2, 2]),
            displacement_m: DVec3::new(0.0, 0.5 * z, z),
        },
    )]
}

/// Runs a session with commands; `look` is called after each step.
fn commanded(scene: &Scene, told: StepActions, steps: u64, mut look: impl FnMut(&mut Session)) -> Session {
    let mut session = Session::new(&model(scene));
    for step in 0..steps {
        let due = |(tool, action)| Due::in_time(Command::new(tool as u32, Some(step + 1), action));
        session.advance(&mut told(step).into_iter().map(due).collect(), |_| {});
        assert_eq!(session.fault(), None);
        look(&mut session);
    }
    session
}

/// The findings of all windows of such a session, each repeated with `finer` times the substeps.
fn findings(scene: &Scene, told: StepActions, steps: u64, finer: u32) -> Vec<AuditFinding> {
    let (mut opening, mut found, mut asked) = (None, Vec::new(), false);
    commanded(scene, told, steps, |session| {
        match session.take_mark() {
            Some(Mark::Begin(look)) => opening = Some(look.open()),
            Some(Mark::End(look, inputs)) => {
                let audit = opening.take().unwrap().close(look, inputs);
                found.push(audit.work(finer, ErrorExtent::default(), &mut || true).unwrap());
                asked = false;
            }
            Some(Mark::Dropped) => panic!("a window was dropped"),
            None => {}
        }
        if !std::mem::replace(&mut asked, true) {
            session.request_audit(WindowInputs::default());
        }
    });
    found
}

#[test]
fn a_window_agrees_with_one_of_a_much_shorter_substep() {
    // The error of a tool that meets the sheet falls more slowly with the substep than the scheme's: contact begins
    // and ends within a substep, and a tip that sticks or slips a substep earlier ends elsewhere. So a quarter of the
    // substep reveals less of that error, and in some windows much less.
    let tools: [(&str, f64, f64, StepActions); 4] = [
        ("push", 2.0, 1.0, pushing),
        ("grasp of a point", 2.0, 1.0, grasping),
        ("touch", 5.0, 0.9, |step| touching(false, step)),
        ("grasp", 5.0, 0.9, |step| touching(true, step)),
    ];
    let schemes: [&[&str]; 5] = [
        &["stepping.integrator=central", "stepping.substeps=4"],
        &["stepping.integrator=exponential2", "stepping.substeps=4"],
        &["stepping.integrator=exponential3", "stepping.substeps=4", "stepping.precision=compensated"],
        &["stepping.integrator=exponential4", "stepping.substeps=4", "stepping.precision=f64"],
        &["stepping.integrator=rk4", "stepping.substeps=4", "stepping.precision=f64"],
    ];
    for (name, most, part, told) in tools {
        let (mut windows, mut beyond) = (0, Vec::new());
        for settings in schemes {
            let scene = scene_with(SMALL, &[settings, &["stepping.rate_hz=250"]].concat());
            let [audited, truth] = [FINER, 16 * FINER].map(|finer| findings(&scene, told, 700, finer));
            assert!(audited.len() >= 3 && audited.len() == truth.len(), "{name} {settings:?}: {}", audited.len());
            for (audited, truth) in audited.iter().zip(&truth) {
                assert_eq!(audited.step, truth.step);
                let ratio = audited.error.largest() / truth.error.largest();
                windows += 1;
                if !(most.recip()..most).contains(&ratio) {
                    beyond.push(format!("{settings:?}: {:?} of {:?}", audited.error, truth.error));
                }
            }
        }
        let within = 1.0 - beyond.len() as f64 / f64::from(windows);
        assert!(within >= part, "{name}: {within} of {windows} windows within {most}: {beyond:#?}");
    }
}

/// A fingertip that presses into the liver for 0.2 s, and glides from then on, at up to 0.1 m/s.
fn fingertip(step: u64) -> Vec<(usize, Action)> {
    let smooth =
        |t: f64| t.clamp(0.0, 1.0).powi(3) * (10.0 - 15.0 * t.clamp(0.0, 1.0) + 6.0 * t.clamp(0.0, 1.0).powi(2));
    let t = (step + 1) as f64 / 1000.0;
    let way_m = 0.015 * smooth((t - 0.3) / 0.3);
    let place_m = DVec3::new(0.028 + way_m, 0.035 + 0.2 * way_m, 0.001 - 0.004 * smooth(t / 0.2));
    vec![(0, Action::Pose { place_m, velocity_m_per_s: None, tip: Tip::default() })]
}

#[test]
fn a_tip_keeps_to_the_tolerance_of_liver() {
    let liver = BUILT_IN.into_iter().find(|scene| scene.0 == "liver").unwrap().1;
    let scene = scene_with(liver, &[]);
    let tolerance = scene.stepping.tolerance;
    let found = findings(&scene, fingertip, 600, FINER);
    assert!(found.len() >= 3, "{}", found.len());
    for finding in &found {
        // A press is far below it.
        let most = if finding.step < 300 { 0.02 } else { 1.0 } * tolerance;
        let AuditedError { displacement, force } = finding.error;
        assert!(displacement <= most && force <= most, "{finding:?}");
    }
}

#[test]
fn the_audit_changes_no_bit() {
    let tools: [StepActions; 3] = [pushing, grasping, |step| touching(false, step)];
    for told in tools {
        for precision in ["f32", "compensated", "f64"] {
            let precision = format!("stepping.precision={precision}");
            let scene = scene_with(SMALL, &["stepping.rate_hz=250", "stepping.integrator=exponential3", &precision]);
            let (mut windows, mut found) = (Windows::default(), 0);
            let audited =
                commanded(&scene, told, 1000, |session| found += usize::from(windows.look(session).is_some()));
            let alone = commanded(&scene, told, 1000, |_| {});
            assert!(found > 0);
            assert_eq!(audited.tissue().state_hash(), alone.tissue().state_hash());
        }
    }
    let scene = scene_with(SMALL, &[]);
    let hash = |audited| play(&scene, PULSE, true, audited).0.final_hash;
    assert_eq!(hash(true), hash(false));
}

#[test]
fn an_error_is_told_with_what_it_comes_from() {
    let of = |settings: &[&str]| {
        let scene = scene_with(SMALL, &[settings, &["stepping.rate_hz=250"]].concat());
        let found = findings(&scene, pushing, 700, FINER);
        found.iter().map(|finding| finding.origin).collect::<Vec<_>>()
    };
    let substep = of(&["stepping.integrator=central", "stepping.substeps=1"]);
    assert!(!substep.is_empty() && substep.iter().all(|origin| *origin == Some(Origin::Substep)), "{substep:?}");
    let rounding = ["stepping.integrator=exponential4", "stepping.substeps=40", "stepping.precision=f32"];
    let rounding = of(&[&rounding[..], &["stepping.tolerance=1e-9"]].concat());
    assert!(!rounding.is_empty() && rounding.iter().all(|origin| *origin == Some(Origin::Rounding)), "{rounding:?}");
    let none = of(&["stepping.tolerance=1e-4"]);
    assert!(!none.is_empty() && none.iter().all(Option::is_none), "{none:?}");
    // A long sheet, most of which sleeps though it moves a little.
    let asleep = ["sheet.points=[7, 120]", "sleep.tolerance=0.3", "stepping.tolerance=1e-6", "stepping.precision=f64"];
    let asleep = of(&[&asleep[..], &["springs.stiffness_n_per_m=300"]].concat());
    assert!(asleep.contains(&Some(Origin::Sleep)), "{asleep:?}");
}

/// Plays a script without an audit, but with the corrections recorded in another run.
fn corrected(scene: &Scene, text: &str, corrections: &[Correction]) -> Session {
    let script = script(text, scene);
    let mut session = playing(scene, &script);
    for step in 0..script.steps {
        for correction in corrections.iter().filter(|correction| correction.step == step) {
            let model = session.model().corrected(correction, &Limits::default()).unwrap();
            session.change(&model);
        }
        session.advance(&mut Vec::new(), |_| {});
    }
    session
}

#[test]
fn a_correction_acts_at_its_step() {
    let text = SINE.replace("duration_s = 2.0", "duration_s = 8.0").replace("0.03, 0.01", "0.003, 0.001");
    let substep = ["stepping.integrator=central", "stepping.substeps=2", "stepping.tolerance=1e-5"];
    let format = ["stepping.integrator=exponential4", "stepping.substeps=8", "stepping.precision=f32"];
    let format = [&format[..], &["stepping.tolerance=3e-10"]].concat();
    let more = ["stepping.integrator=exponential4", "stepping.substeps=1", "stepping.precision=f64"];
    let more = [&more[..], &["stepping.tolerance=1e-8"]].concat();
    let cases = [(&substep[..], Precision::F64), (&format[..], Precision::F64), (&more[..], Precision::F64)];
    for (settings, precision) in cases {
        let with = |correct: &str| scene_with(SMALL, &[settings, &["stepping.rate_hz=250", correct]].concat());
        let (summary, _) = play(&with("stepping.correct=true"), &text, false, true);
        let corrections = &summary.corrections;
        assert!((1..=4).contains(&corrections.len()), "{corrections:?}");
        assert!(corrections.iter().all(|one| one.step > 0 && one.audited_error.largest() > 3e-10), "{corrections:?}");
        assert_eq!(corrections.last().unwrap().precision, precision, "{corrections:?}");
        let again = corrected(&with("stepping.correct=false"), &text, corrections);
        assert_eq!(format!("{:032x}", again.tissue().state_hash()), summary.final_hash, "{corrections:?}");
        let (uncorrected, _) = play(&with("stepping.correct=false"), &text, false, true);
        assert_eq!(uncorrected.corrections, []);
        assert_ne!(uncorrected.final_hash, summary.final_hash);
    }
}

#[test]
fn a_correction_brings_the_error_below_the_tolerance() {
    let settings = ["stepping.integrator=exponential2", "stepping.substeps=1", "stepping.tolerance=1e-5"];
    let scene = scene_with(SMALL, &[&settings[..], &["stepping.rate_hz=250", "stepping.correct=true"]].concat());
    let (mut windows, mut errors) = (Windows::default(), Vec::new());
    let session = commanded(&scene, grasping, 4000, |session| {
        let Some(finding) = windows.look(session) else { return };
        errors.push(finding.error.largest());
        let limits = Limits::default();
        if let Some(correction) = session.model().correction(&finding, session.step_count(), &limits) {
            let model = session.model().corrected(&correction, &limits).unwrap();
            session.change(&model);
        }
    });
    let plan = session.tissue().plan();
    let was = (Integrator::Exponential2, 1);
    assert!(errors[0] > 1e-5 && (plan.integrator, plan.substeps) != was, "{errors:?}");
    assert!(errors.len() > 8 && errors[errors.len() - 4..].iter().all(|error| *error <= 1e-5), "{errors:?}");
}

/// A session with steps too coarse for its tolerance.
fn coarse(correct: bool) -> Source {
    let settings = ["stepping.integrator=lagged".to_owned(), "stepping.substeps=1".to_owned()];
    let mut scene = Scene::parse("paper", palpate_tissue::scene::PAPER, &settings, &Limits::default()).unwrap();
    scene.stepping.correct = correct;
    Source::Scene(palpate_session::wire::scene::scene(&scene))
}

/// Pushes up and down until the status is as `wanted`.
async fn push_until(server: &TestServer, session_id: &str, wanted: impl Fn(&pb::Session) -> bool) -> pb::Session {
    let pushed = |sequence: u64| force(0, sequence, if sequence.is_multiple_of(2) { -1.0 } else { -2.0 });
    command_until(server, session_id, pushed, wanted).await
}

async fn command_until(
    server: &TestServer,
    session_id: &str,
    command: impl Fn(u64) -> pb::Command,
    wanted: impl Fn(&pb::Session) -> bool,
) -> pb::Session {
    let touch = TestTouch::hold(server, session_id).await;
    let begun = Instant::now();
    for sequence in 1.. {
        touch.command(command(sequence)).await;
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        let status = server.status(session_id).await;
        if wanted(&status) {
            // So that the next to push can hold the tool.
            drop(touch);
            server.until_let_go().await;
            return status;
        }
        assert!(begun.elapsed() < TEST_TIMEOUT, "{status:?}");
    }
    unreachable!()
}

#[tokio::test]
async fn a_live_session_tells_its_audited_error_and_why() {
    let mut server = TestServer::start(&["--audit-share", "0.5", "--metrics", "127.0.0.1:0"]);
    let session = server.create(coarse(false), false).await.unwrap();
    assert_eq!(session.audit, None);
    let status = push_until(&server, &session.session_id, |status| status.audit.is_some()).await;
    let audit = status.audit.unwrap();
    let newest = audit.newest_error.unwrap();
    let tolerance = session.scene.unwrap().stepping.unwrap().tolerance.unwrap();
    assert!(audit.windows >= 1 && audit.step > 0 && newest.displacement > tolerance && newest.force > tolerance);
    assert!(newest.displacement < 0.5 && newest.force < 0.5, "{newest:?}");
    assert!(
        audit.windows_above_tolerance >= 1 && audit.reason.contains("substep") && audit.corrections == 0,
        "{audit:?}"
    );
    let metrics = metrics::scrape(&metrics::url(&mut server.out));
    let value = |name: &str| *metrics.get(name).unwrap_or_else(|| panic!("{metrics:?}"));
    assert!(
        value("palpate_audited_windows_total") >= 1.0 && value("palpate_audited_windows_above_tolerance_total") >= 1.0
    );
    assert!(value("palpate_audited_force_error_max") > tolerance && value("palpate_audit_time_seconds_total") > 0.0);
    assert_eq!(value("palpate_corrections_total"), 0.0);
    let log = server.log();
    assert!(log.contains("audited error above the tolerance") && log.contains("substep"), "{log}");
}

#[tokio::test]
async fn a_live_solid_tells_the_error_of_its_cells_and_a_sheet_has_none() {
    let folder = tempfile::tempdir().unwrap();
    let coarse_phantom = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.01\n\
        fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
        [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\n[stepping]\ntolerance = 1e-2\n";
    std::fs::write(folder.path().join("coarse-phantom.toml"), coarse_phantom).unwrap();
    let server = TestServer::start(&["--audit-share", "0.5", "--scenes", folder.path().to_str().unwrap()]);
    let phantom = server.create(Source::SceneName("coarse-phantom".into()), false).await.unwrap();
    assert_eq!(phantom.mesh_error_estimate, None);
    let is_known = |status: &pb::Session| status.mesh_error_estimate.is_some();
    let top_m = phantom.extent.unwrap().top_m;
    let pushed = |sequence: u64| {
        let mut command = force(0, sequence, -1e-3 * (1 + sequence % 2) as f64);
        let Some(pb::command::Action::Force(force)) = &mut command.action else { unreachable!() };
        force.centre = top_m.map(pb::force::Centre::AtM);
        command
    };
    let status = command_until(&server, &phantom.session_id, pushed, is_known).await;
    let estimate = status.mesh_error_estimate.unwrap();
    assert!((0.0..0.5).contains(&estimate.relative) && estimate.stiffness_n_per_m > 0.0, "{estimate:?}");
    assert_eq!(estimate.radius_m, Tip::default().radius_m);
    let sheet = server.create(coarse(false), false).await.unwrap();
    let status = push_until(&server, &sheet.session_id, |status| status.audit.is_some()).await;
    assert_eq!(status.mesh_error_estimate, None);
}

#[tokio::test]
async fn a_live_session_is_corrected_if_its_scene_says_so() {
    let server = TestServer::start(&["--audit-share", "0.5"]);
    let session = server.create(coarse(true), false).await.unwrap();
    assert!(session.scene.as_ref().unwrap().stepping.as_ref().unwrap().correct);
    let acted = |status: &pb::Session| {
        let correction = status.audit.as_ref().and_then(|audit| audit.newest_correction.clone());
        correction.is_some_and(|correction| correction.step < status.step && correction.integrator == status.integrator)
    };
    let status = push_until(&server, &session.session_id, acted).await;
    let audit = status.audit.unwrap();
    assert!(audit.corrections >= 1 && (status.integrator.as_str(), status.substeps) != ("lagged", 1), "{audit:?}");
    // The log is written by a thread of its own, after the correction has acted.
    push_until(&server, &session.session_id, |later| later.step > status.step + 500).await;
    let log = server.log();
    assert!(log.contains("tissue corrected"), "{log}");
}

#[tokio::test]
async fn a_correction_that_would_take_longer_than_a_scene_may_is_refused_and_told() {
    let Source::Scene(scene) = coarse(true) else { unreachable!() };
    // Without rehearsals, which would find another scheme, a correction is more substeps of this one.
    let limits = Limits { rehearsal_work: 1, ..Limits::default() };
    let model = Model::compile(&palpate_session::wire::scene::from_scene(&scene, None).unwrap(), &limits).unwrap();
    // Only for the predicted duration of the scene's own steps.
    let periods = 1.000_001 * model.predicted_step_s() * model.scene.stepping.rate_hz;
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, format!("[limits]\nperiods_per_step = {periods}\nrehearsal_work = 1\n")).unwrap();
    let server = TestServer::start(&["--audit-share", "0.5", "--config", config.to_str().unwrap()]);
    let session = server.create(coarse(true), false).await.unwrap();
    let told = |status: &pb::Session| status.audit.as_ref().is_some_and(|audit| !audit.refused_correction.is_empty());
    let status = push_until(&server, &session.session_id, told).await;
    let audit = status.audit.unwrap();
    assert!(audit.refused_correction.contains("limits.periods_per_step"), "{audit:?}");
    assert_eq!((audit.corrections, &*status.integrator, status.substeps), (0, "lagged", 1));
    // The log is written by a thread of its own.
    push_until(&server, &session.session_id, |later| later.step > status.step + 500).await;
    let log = server.log();
    assert!(log.contains("a correction was refused: stepping.rate_hz"), "{log}");
}

#[tokio::test]
async fn without_a_share_nothing_is_audited() {
    let server = TestServer::start(&["--audit-share", "0"]);
    let session = server.create(coarse(false), false).await.unwrap();
    // Long enough for several windows of a quarter of a second of simulated time.
    let status = push_until(&server, &session.session_id, |status| status.step > 2000).await;
    assert_eq!(status.audit, None);
}
