//! Properties of every input: no text makes a reader panic, no command moves the tissue out of bounds, and a refused
//! input changes nothing.
#![allow(clippy::unwrap_used)]

use std::path::Path;

use crate::common::cases;
use crate::common::{SMALL, model, scene};
use glam::DVec3;
use palpate_session::Session;
use palpate_session::command::Command;
use palpate_session::intake::Intake;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::{Action, Script};
use palpate_tissue::scene::{PAPER, Scene};
use palpate_tissue::shape::PointId;
use proptest::prelude::*;

const SCRIPT: &str = include_str!("../scripts/oblique-60.toml");

/// `text` with a piece replaced.
fn spoilt(text: &'static str) -> impl Strategy<Value = String> {
    let piece = prop_oneof![
        any::<String>(),
        Just("nan".to_owned()),
        Just("-1e400".to_owned()),
        Just("99999999999999999999".to_owned()),
        Just("[".to_owned()),
        Just("[[force]]".to_owned()),
        Just("\u{0}".to_owned()),
        "[-0-9e.]{1,12}",
    ];
    (any::<prop::sample::Index>(), 0..40_usize, piece).prop_map(move |(at, length, piece)| {
        let places: Vec<usize> = text.char_indices().map(|place| place.0).collect();
        let from = at.index(places.len());
        let to = (from + length).min(places.len() - 1);
        format!("{}{piece}{}", &text[..places[from]], &text[places[to]..])
    })
}

/// Any number that a client can send.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![8 => -3.0..3.0_f64, 1 => any::<f64>(), 1 => Just(f64::NAN), 1 => Just(1e4), 1 => Just(0.0)]
}

fn vector() -> impl Strategy<Value = DVec3> {
    (number(), number(), number()).prop_map(DVec3::from)
}

fn action() -> impl Strategy<Value = Action> {
    let poke = (0.0..0.35_f64, 0.0..0.25_f64, vector(), number(), number()).prop_map(|(x, y, force_n, c, c1)| {
        Action::Push(Poke {
            point: None,
            centre_m: DVec3::new(x, y, 0.0),
            force_n,
            falloff_per_m: c.abs() * 50.0,
            falloff_offset: c1,
        })
    });
    let grasp = (0..8_usize, 0..6_usize, vector())
        .prop_map(|(i, j, by)| Action::Grasp { point: PointId::new(5 * i + j), displacement_m: by * 0.1 });
    prop_oneof![4 => poke, 4 => grasp, 1 => Just(Action::Release)]
}

fn command() -> impl Strategy<Value = Command> {
    let at_step = prop_oneof![Just(None), (0..60_u64).prop_map(Some)];
    let time_to_live_s = prop_oneof![4 => Just(None), 1 => number().prop_map(Some)];
    (0..4_u32, 0..400_u64, at_step, time_to_live_s, action()).prop_map(
        |(tool, sequence, at_step, time_to_live_s, action)| Command {
            tool,
            sequence: Some(sequence),
            client_time_ns: 0,
            by_datagram: false,
            at_step,
            time_to_live_s,
            action,
            arrival_ns: 1,
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: cases::short_or_long(100, 4000), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_scene_text_panics(text in spoilt(PAPER)) {
        if let Ok(scene) = Scene::parse("spoilt", &text, &[], &Limits::default()) {
            prop_assert!(scene.check(&Limits::default()).is_ok());
        }
    }

    #[test]
    fn no_script_text_panics(text in spoilt(SCRIPT)) {
        let paper = Scene::parse("paper", PAPER, &[], &Limits::default()).unwrap();
        let _ = Script::parse("spoilt", &text, Path::new("scripts"), &paper, &Limits::default());
    }

    #[test]
    fn no_assignment_panics(assignment in any::<String>()) {
        let _ = Scene::parse("paper", PAPER, &[assignment], &Limits::default());
    }

    #[test]
    fn any_commands_leave_the_tissue_finite_and_refused_ones_leave_no_trace(
        commands in prop::collection::vec((0..5_u64, command()), 1..40),
        precision in prop_oneof![Just("f32"), Just("f64")],
    ) {
        let set = format!("stepping.precision={precision}");
        let scene = Scene::parse("small", SMALL, &[set], &Limits::default()).unwrap();
        // Returns which commands were refused, and the final state.
        let run = |left_out: &[bool]| {
            let limits = Limits::default();
            let mut intake = Intake::new(&scene, &limits);
            intake.acquire(&[0, 1, 2], "test", 60.0, 1, 0).unwrap();
            let mut session = Session::new(&model(&scene));
            let mut due = Vec::new();
            let mut refused = vec![false; commands.len()];
            for (index, (steps, command)) in commands.iter().enumerate() {
                if !left_out[index] {
                    refused[index] = intake.submit(1, vec![command.clone()], 0).is_err();
                }
                for _ in 0..*steps {
                    intake.take_due(session.step_count(), 0, &mut due);
                    session.advance(&mut due, |session| {
                        for tool in session.sample(None).tools {
                            let contact = tool.contact.unwrap();
                            assert!(contact.displacement_m.is_finite() && contact.force_on_tool_n.is_finite());
                        }
                    });
                }
            }
            (session.tissue().state_hash(), refused)
        };
        let (with_refused, refused) = run(&vec![false; commands.len()]);
        let (without, none) = run(&refused);
        prop_assert_eq!(with_refused, without);
        prop_assert!(!none.contains(&true));
    }
}

#[test]
fn the_small_scene_is_a_scene() {
    assert_eq!(scene(SMALL).sheet().unwrap().points, [7, 5]);
}
