//! The first law that a client gets, and the change to the exact one.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use super::blades::knife;
use super::copies::cut;
use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, open};
use crate::common::{model, scene_with};
use glam::DVec3;
use palpate_haptics::force_law::{Law, Row};
use palpate_haptics::{ContactState, Device, Instrument, Tip, Touching};
use palpate_proto::{instrument, pb, touch};
use palpate_session::wire;
use palpate_tissue::response::force_law::{self, Disc};
use palpate_tissue::scene::BUILT_IN;
use palpate_tissue::{Cuts, Model};
use pb::touch_response::Message as Heard;

/// The number of the law that a sample's local model names, if it has a model. Server and client mean the same: under
/// a touch the law passes through the sample.
fn law_of(sample: &pb::Sample, laws: &[Law]) -> Option<usize> {
    let model = touch::from_local_model(sample.tools.first()?.local_model.as_ref()?, sample.step);
    let law = laws.get(model.law as usize).expect("the law comes before the model that names it");
    if model.contact_state != ContactState::Free {
        let repeated_n = Touching::at_sample(&model, law).force_n(&model, law, model.velocity_m_per_s);
        assert!((repeated_n - model.force_n).length() < 1e-6, "{repeated_n} beside {}", model.force_n);
    }
    Some(model.law as usize)
}

fn tissue(name: &str, sets: &[&str]) -> Arc<Model> {
    let text = BUILT_IN.iter().find(|scene| scene.0 == name).unwrap().1;
    model(&scene_with(text, sets))
}

/// The largest differences of force and stiffness at the depths of the exact law: of the force as a part of the force
/// there and of the largest, of the stiffness as a part of the largest.
fn apart(exact: &Law, coarse: &Law) -> [f64; 3] {
    let depths = (1..exact.rows.len()).map(|row| row as f64 * exact.step_m);
    let pairs: Vec<[Row; 2]> = depths.map(|depth_m| [exact.at_depth(depth_m), coarse.at_depth(depth_m)]).collect();
    let stiffest = exact.rows.iter().map(|row| row.stiffness_n_per_m).fold(0.0, f64::max);
    let strongest_n = exact.rows.iter().map(|row| row.force_n).fold(0.0, f64::max);
    let force = pairs.iter().map(|[exact, coarse]| (coarse.force_n / exact.force_n - 1.0).abs());
    let force_n = pairs.iter().map(|[exact, coarse]| (coarse.force_n - exact.force_n).abs());
    let stiffness = pairs.iter().map(|[exact, coarse]| (coarse.stiffness_n_per_m - exact.stiffness_n_per_m).abs());
    [force.fold(0.0, f64::max), force_n.fold(0.0, f64::max) / strongest_n, stiffness.fold(0.0, f64::max) / stiffest]
}

#[test]
fn a_first_law_is_within_a_tenth_of_the_exact_one() {
    let never = AtomicBool::new(false);
    let membrane = "anchor_springs.stiffness_n_per_m=1e-3";
    let cases: [(&str, &[&str]); 5] = [
        ("paper", &[]),
        ("liver", &["sheet.points=[32, 24]", membrane]),
        ("liver", &[]),
        ("stomach", &[]),
        ("fibrotic", &[]),
    ];
    for (name, sets) in cases {
        let model = tissue(name, sets);
        let first = force_law::first(&model, &Cuts::default(), Disc::in_middle(&model, 0.005), &never).unwrap();
        let [force, of_largest, stiffness] = apart(&force_law::exact(&model, 0.005), &first);
        println!(
            "{name} {sets:?}: coarse {}, force {force:.4} ({of_largest:.4} of the largest), stiffness {stiffness:.4} apart",
            first.is_coarse
        );
        assert!(first.is_sound(), "{name} {sets:?}: {first:?}");
        // A membrane without springs below it hardly resists at first: there a coarse grid is off by more than a
        // tenth of very little.
        assert!(if sets.is_empty() { force } else { of_largest } < 0.1, "{name} {sets:?}: {force}, {of_largest}");
        assert!(stiffness < 0.15, "{name} {sets:?}: {stiffness}");
    }
}

/// Sheets whose exact law takes too long for any test, and those that are hard to put in few points.
#[test]
fn every_tissue_has_a_first_law() {
    let never = AtomicBool::new(false);
    let cases: [(&str, &[&str], f64); 6] = [
        ("liver", &["sheet.points=[331, 331]", "anchor_springs.stiffness_n_per_m=1e-6"], 0.005),
        ("liver", &["sheet.points=[1001, 1001]", "anchor_springs.stiffness_n_per_m=1e-6"], 0.003),
        ("liver", &["sheet.points=[2001, 3]"], 0.005),
        ("paper", &["sheet.points=[501, 501]"], 0.005),
        ("paper", &["sheet.points=[2, 2]"], 0.005),
        ("paper", &["sheet.points=[12, 31]", "sheet.fixed=[[3, 5], [11, 30]]"], 0.1),
    ];
    for (name, sets, radius_m) in cases {
        let model = tissue(name, sets);
        let first = force_law::first(&model, &Cuts::default(), Disc::in_middle(&model, radius_m), &never);
        assert!(first.as_ref().is_some_and(Law::is_sound), "{name} {sets:?}: {first:?}");
    }
    let stopped = AtomicBool::new(true);
    let liver = tissue("liver", &[]);
    assert_eq!(force_law::first(&liver, &Cuts::default(), Disc::in_middle(&liver, 0.005), &stopped), None);
}

/// Leads tool 0 of a stream by the client's clock.
struct Lead {
    touch: TestTouch,
    begun: Instant,
    sequence: u64,
}

impl Lead {
    /// Into the middle of `paper`.
    async fn press(&mut self, z_m: f64) {
        self.lead(DVec3::new(0.5, 0.5, z_m)).await;
    }

    async fn lead(&mut self, place_m: DVec3) {
        self.sequence += 1;
        let DVec3 { x, y, z } = place_m;
        let pose = pb::Pose { position_m: Some(pb::Vector3 { x, y, z }), ..Default::default() };
        let command = pb::Command {
            tool: 0,
            sequence: Some(self.sequence),
            client_time_ns: u64::try_from((Duration::from_secs(1) + self.begun.elapsed()).as_nanos()).unwrap(),
            action: Some(pb::command::Action::Pose(pose)),
            ..Default::default()
        };
        self.touch.command(command).await;
    }
}

fn with_device(session: &str, tools: &[u32]) -> pb::TouchOpen {
    let device = touch::device(&Device::named("omega3").unwrap());
    pb::TouchOpen { device: Some(device), ..open(session, tools) }
}

/// A server with these keys of `[limits]`. No deadline decides here.
fn limited(limits: &str) -> TestServer {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, format!("[limits]\nwork_s = 3600.0\n{limits}\n")).unwrap();
    TestServer::start(&["--config", config.to_str().unwrap()])
}

/// A session of `paper`, whose exact law takes twice the work of a first one.
async fn session(server: &TestServer) -> String {
    let scene = scene_with(palpate_tissue::scene::PAPER, &["stepping.integrator=\"lagged\"", "stepping.substeps=1"]);
    let source = pb::create_session_request::Source::Scene(wire::scene::scene(&scene));
    server.create(source, false).await.unwrap().session_id
}

#[tokio::test]
async fn a_coarse_law_is_changed_for_the_exact_one_by_a_model_that_names_it() {
    let server = limited("");
    let session = session(&server).await;
    let mut touch = TestTouch::open(&server, with_device(&session, &[0])).await.unwrap();
    let opened = touch.opened.take().unwrap().law.unwrap();
    assert!(opened.coarse && opened.number == 0, "{opened:?}");
    let mut laws = vec![touch::from_law(&opened).unwrap()];
    let mut lead = Lead { touch, begun: Instant::now(), sequence: 0 };
    // Until some models have named either law; the tool is pressed in all the while.
    let mut named = [0_u32; 2];
    tokio::time::timeout(10 * TEST_TIMEOUT, async {
        while named.iter().any(|models| *models < 20) {
            lead.press(-0.002).await;
            match lead.touch.hear().await.unwrap().unwrap() {
                Heard::ForceLaw(update) => {
                    assert_eq!((update.coarse_number, update.reason.as_str()), (0, ""));
                    let law = update.law.unwrap();
                    assert_eq!((law.number as usize, law.coarse), (laws.len(), false), "it is sent once");
                    laws.push(touch::from_law(&law).unwrap());
                }
                Heard::Sample(sample) => {
                    let Some(law) = law_of(&sample, &laws) else { continue };
                    let is_told = laws.len() == 2;
                    assert!(law == 0 || is_told);
                    named[law] += 1;
                }
                _ => {}
            }
        }
    })
    .await
    .unwrap_or_else(|_| panic!("models that named each law: {named:?}"));
    // A client that comes later begins with the exact law, and gets no other.
    let mut later = TestTouch::open(&server, with_device(&session, &[1])).await.unwrap();
    let law = later.opened.take().unwrap().law.unwrap();
    assert!(!law.coarse && law.number == 0);
    assert_eq!(touch::from_law(&law).unwrap(), laws[1]);
    for _ in 0..10 {
        assert!(matches!(later.hear().await.unwrap(), Some(Heard::Sample(_))));
    }
}

#[tokio::test]
async fn a_law_beyond_the_bound_stays_coarse_and_says_so_once() {
    let server = limited("law_work = 1000000");
    let session = session(&server).await;
    // Of each stream: also where it is known already.
    for tool in 0..2 {
        let mut touch = TestTouch::open(&server, with_device(&session, &[tool])).await.unwrap();
        assert!(touch.opened.take().unwrap().law.unwrap().coarse);
        let (mut updates, mut after) = (Vec::new(), 0);
        while after < 10 {
            match touch.hear().await.unwrap().unwrap() {
                Heard::ForceLaw(update) => updates.push(update),
                Heard::Sample(_) => after += u32::from(!updates.is_empty()),
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(updates.len(), 1, "{updates:?}");
        let pb::ForceLawUpdate { coarse_number, law, reason, message, .. } = updates.pop().unwrap();
        assert_eq!((coarse_number, law, reason.as_str()), (0, None, "NOT_AVAILABLE"));
        assert!(message.contains("limits.law_work"), "{message}");
    }
}

#[tokio::test]
async fn another_tissue_brings_its_law_which_models_then_name() {
    let server = limited("");
    let session = session(&server).await;
    let mut touch = TestTouch::open(&server, with_device(&session, &[0])).await.unwrap();
    let mut laws = vec![touch::from_law(&touch.opened.take().unwrap().law.unwrap()).unwrap()];
    laws.push(touch.exact_law().await);
    let mut lead = Lead { touch, begun: Instant::now(), sequence: 0 };
    let request = pb::UpdateTissueRequest {
        session_id: session.clone(),
        stiffness_n_per_m: Some(20.0),
        anchor_stiffness_n_per_m: Some(10.0),
        ..Default::default()
    };
    let changed = server.sessions().await.update_tissue(request).await.unwrap().into_inner();
    let mut named = [0_u32; 4];
    tokio::time::timeout(10 * TEST_TIMEOUT, async {
        while named[3] < 20 {
            lead.press(-0.002).await;
            match lead.touch.hear().await.unwrap().unwrap() {
                Heard::ForceLaw(update) => {
                    let of_tissue = (laws.len() == 2).then_some(changed.step);
                    assert_eq!((update.coarse_number, update.tissue_step), (laws.len() as u32 - 1, of_tissue));
                    let law = update.law.unwrap();
                    assert_eq!((law.number as usize, law.coarse), (laws.len(), of_tissue.is_some()));
                    laws.push(touch::from_law(&law).unwrap());
                }
                Heard::Sample(sample) => {
                    let Some(law) = law_of(&sample, &laws) else { continue };
                    named[law] += 1;
                }
                _ => {}
            }
        }
    })
    .await
    .unwrap_or_else(|_| panic!("models that named each law: {named:?}"));
    assert_eq!(named[0], 0, "a law that was replaced");
    // It is the law of the tissue as the session has it.
    let scene = wire::scene::from_scene(&changed.session.unwrap().scene.unwrap(), None).unwrap();
    assert_eq!((scene.springs.stiffness_n_per_m, scene.anchor_stiffness_n_per_m), (20.0, 10.0));
    let exact = force_law::exact(&model(&scene), 0.005);
    assert_eq!(laws[3], exact);
    assert!(apart(&exact, &laws[1])[1] > 0.1, "the tissues hardly differ");
}

#[tokio::test]
async fn a_tool_that_goes_to_the_rim_gets_the_law_of_the_rim_and_none_on_the_way_through_the_middle() {
    let server = limited("");
    let scene = scene_with(BUILT_IN.iter().find(|scene| scene.0 == "liver").unwrap().1, &[]);
    let source = pb::create_session_request::Source::Scene(wire::scene::scene(&scene));
    let session = server.create(source, false).await.unwrap().session_id;
    let model = model(&scene);
    let in_middle = Disc::in_middle(&model, 0.005);
    let mut touch = TestTouch::open(&server, with_device(&session, &[0])).await.unwrap();
    let mut laws = vec![touch::from_law(&touch.opened.take().unwrap().law.unwrap()).unwrap()];
    let mut lead = Lead { touch, begun: Instant::now(), sequence: 0 };
    let at_rim = in_middle.follow(&model, DVec3::new(0.005, 0.0375, 0.0));
    let [middle, rim] = [in_middle, at_rim].map(|disc| {
        force_law::exact_within(&model, &Cuts::default(), disc, u64::MAX, &AtomicBool::new(false)).unwrap()
    });
    // The middle, a place that is as the middle, one radius from the fixed rim, and a place with that distance
    // elsewhere. The tool is above them: the law comes before it touches.
    let course = [(0.0375, 0.0375, &middle), (0.03, 0.045, &middle), (0.005, 0.0375, &rim), (0.045, 0.07, &rim)];
    for (at, (x_m, y_m, law)) in course.into_iter().enumerate() {
        let mut named = 0_u32;
        tokio::time::timeout(10 * TEST_TIMEOUT, async {
            let from = lead.sequence + 1;
            while named < 20 {
                lead.lead(DVec3::new(x_m, y_m, 0.002)).await;
                match lead.touch.hear().await.unwrap().unwrap() {
                    Heard::ForceLaw(update) => {
                        let told = update.law.unwrap();
                        assert_eq!((told.number as usize, told.coarse, update.tissue_step), (laws.len(), false, None));
                        laws.push(touch::from_law(&told).unwrap());
                    }
                    Heard::Sample(sample) => {
                        let Some(of_model) = law_of(&sample, &laws) else { continue };
                        named += u32::from(laws[of_model] == *law && sample.tools[0].acknowledged_sequence >= from);
                    }
                    _ => {}
                }
            }
        })
        .await
        .unwrap_or_else(|_| panic!("({x_m}, {y_m}): {named} models named its law, of {}", laws.len()));
        // The coarse one and the exact one of the middle. Places between the middle and the rim may have others.
        assert!(at > 1 || laws.len() == 2, "{} laws", laws.len());
    }
}

#[tokio::test]
async fn a_tool_over_a_wound_gets_the_law_of_the_tissue_as_it_is_cut() {
    let server = limited("");
    let scene = scene_with(BUILT_IN.iter().find(|scene| scene.0 == "fibrotic").unwrap().1, &[]);
    let source = pb::create_session_request::Source::Scene(wire::scene::scene(&scene));
    let session = server.create(source, false).await.unwrap().session_id;
    let model = model(&scene);
    let mut touch = TestTouch::open(&server, with_device(&session, &[0])).await.unwrap();
    let mut laws = vec![touch::from_law(&touch.opened.take().unwrap().law.unwrap()).unwrap()];
    let mut lead = Lead { touch, begun: Instant::now(), sequence: 0 };
    let at_m = DVec3::new(0.0395, 0.0375, 0.0);
    let disc = Disc { radius_m: 0.005, at_m };
    let law = |cuts: &Cuts, disc: Disc| {
        force_law::exact_within(&model, cuts, disc, u64::MAX, &AtomicBool::new(false)).unwrap()
    };
    let whole = law(&Cuts::default(), Disc::in_middle(&model, 0.005).follow(&model, at_m));
    let with_knife = pb::TouchOpen { instruments: vec![instrument::instrument(&knife(), 2)], ..open(&session, &[2]) };
    let mut knife = TestTouch::open(&server, with_knife).await.unwrap();
    let mut expected = whole.clone();
    for cuts in 0..3_u32 {
        let mut named = 0_u32;
        tokio::time::timeout(10 * TEST_TIMEOUT, async {
            while named < 20 {
                // Above the tissue: the law comes before it touches.
                lead.lead(at_m + 0.002 * DVec3::Z).await;
                match lead.touch.hear().await.unwrap().unwrap() {
                    Heard::ForceLaw(update) => {
                        let told = update.law.unwrap();
                        assert_eq!((told.number as usize, update.tissue_step), (laws.len(), None));
                        laws.push(touch::from_law(&told).unwrap());
                    }
                    Heard::Sample(sample) => {
                        named += u32::from(law_of(&sample, &laws).is_some_and(|of_model| laws[of_model] == expected));
                    }
                    _ => {}
                }
            }
        })
        .await
        .unwrap_or_else(|_| panic!("{cuts} cuts: {named} models named their law, of {}", laws.len()));
        if cuts == 2 {
            break;
        }
        // From one side to the middle, and on to the other.
        let from_m = DVec3::new(0.03625, 0.02 + 0.0175 * f64::from(cuts), -0.005);
        cut(&knife, 100 * u64::from(cuts), from_m, 0.0175).await;
        knife.settle().await;
        let sequence = 100 * (u64::from(cuts) + 1) - 1;
        let release = Some(pb::command::Action::Release(pb::Release {}));
        knife.command(pb::Command { tool: 2, sequence: Some(sequence), action: release, ..Default::default() }).await;
        knife.sample_with(|sample| sample.tools.iter().any(|tool| tool.acknowledged_sequence == sequence)).await;
        let parts =
            server.sessions().await.save_snapshot(pb::SaveSnapshotRequest { session_id: session.clone() }).await;
        let bytes = palpate_client::snapshot::collect(parts.unwrap().into_inner()).await.unwrap();
        let tip = Tip { radius_m: 0.005, ..Tip::default() };
        let copy = palpate_session::journal::replay::tissue_copy(&bytes, &Instrument::of_tip(tip)).unwrap();
        let before = expected.clone();
        expected = law(&copy.cuts(), disc);
        assert!(apart(&expected, &before)[1] > 0.02, "{cuts}: {:?}", apart(&expected, &before));
    }
    assert!(apart(&expected, &whole)[1] > 0.05, "{:?}", apart(&expected, &whole));
}
