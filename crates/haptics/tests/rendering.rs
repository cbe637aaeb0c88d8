//! The rendering law and its safety envelope, without a network: forces that a device must never get.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use glam::{DMat3, DVec3};
use palpate_haptics::device::{DEVICES, Device, SAFE_FORCE_N, UNDECLARED};
use palpate_haptics::envelope::{ENGAGE_S, FRESH_S, PAUSE_S, SLEW_N_PER_S, STALE_S, Wanted};
use palpate_haptics::force_law::Row;
use palpate_haptics::pose_playback::{Path, Play, RELEASE_S, SPEED_M_PER_S};
use palpate_haptics::renderer::{BIAS_S, MAX_LAWS};
use palpate_haptics::{ContactState, Envelope, Law, LimitCause, LocalModel, Renderer, RenderingState, Touching};
use proptest::prelude::*;

const TICK_S: f64 = 1e-3;

/// A spring of 400 N/m whose surface is at z = 0.
fn law() -> Law {
    Law::linear(400.0, 0.5)
}

fn omega() -> Device {
    Device::named("omega3").unwrap()
}

/// A server's model of a tool at `place_m`.
fn model(sequence: u64, time_s: f64, place_m: DVec3) -> LocalModel {
    let depth_m = (-place_m.z).max(0.0);
    LocalModel {
        sequence,
        client_time_s: time_s,
        step: sequence,
        place_m,
        velocity_m_per_s: DVec3::ZERO,
        force_n: 400.0 * depth_m * DVec3::Z,
        stiffness_n_per_m: DMat3::IDENTITY * 400.0,
        damping_n_s_per_m: DMat3::IDENTITY * 0.5,
        surface_m: DVec3::new(place_m.x, place_m.y, 0.0),
        normal: DVec3::Z,
        curvature_per_m: DMat3::ZERO,
        valid_m: 0.01,
        friction: 0.2,
        contact_state: if depth_m > 0.0 { ContactState::Sticking } else { ContactState::Free },
        law: 0,
    }
}

fn enabled(device: Device) -> Envelope {
    let mut envelope = Envelope::new(device, DVec3::ZERO);
    envelope.enable();
    envelope
}

/// A renderer that engages in the air and is then pressed to a depth; and the next tick.
fn pressed(depth_m: f64) -> (Renderer, u32) {
    let mut renderer = Renderer::new(law(), enabled(omega()));
    let mut tick = 0;
    while f64::from(tick) * TICK_S < ENGAGE_S + 1.0 {
        let now_s = f64::from(tick) * TICK_S;
        let down = ((now_s - ENGAGE_S - 0.1) / 0.5).clamp(0.0, 1.0);
        let place_m = DVec3::new(0.0, 0.0, 0.001 - (0.001 + depth_m) * down);
        renderer.receive(model(u64::from(tick) + 1, now_s, place_m), now_s);
        renderer.tick(now_s, place_m);
        tick += 1;
    }
    (renderer, tick)
}

#[test]
fn a_press_is_rendered_as_the_model_says() {
    let (mut renderer, tick) = pressed(0.005);
    let force = renderer.tick(f64::from(tick) * TICK_S, DVec3::new(0.0, 0.0, -0.005));
    assert!((force.z - 2.0).abs() < 1e-6 && force.truncate().length() < 1e-9, "{force}");
    assert_eq!(renderer.state(), RenderingState::Enabled);
}

#[test]
fn a_force_without_news_fades_pauses_decays_and_comes_back_only_on_enable() {
    let (mut renderer, first) = pressed(0.005);
    let place_m = DVec3::new(0.0, 0.0, -0.005);
    let silent_s = f64::from(first - 1) * TICK_S;
    let mut tick = first;
    let mut at = |renderer: &mut Renderer, age_s: f64| {
        let mut force = DVec3::ZERO;
        while f64::from(tick) * TICK_S - silent_s <= age_s {
            force = renderer.tick(f64::from(tick) * TICK_S, place_m);
            tick += 1;
        }
        (force.z, tick)
    };
    assert!((at(&mut renderer, FRESH_S).0 - 2.0).abs() < 1e-6);
    let (faded_n, _) = at(&mut renderer, STALE_S);
    assert!(faded_n < 1.1 && faded_n > 0.9, "{faded_n} N at {STALE_S} s");
    assert_eq!(renderer.state(), RenderingState::Enabled);
    let (decayed_n, _) = at(&mut renderer, PAUSE_S + 0.002);
    assert!(decayed_n < 2.0 * (-3.0_f64).exp(), "{decayed_n} N at {PAUSE_S} s");
    assert_eq!(renderer.state(), RenderingState::Paused);
    // A new model alone does not end the pause.
    let (_, mut tick) = at(&mut renderer, 0.5);
    for _ in 0..200 {
        let now_s = f64::from(tick) * TICK_S;
        renderer.receive(model(u64::from(tick) + 10, now_s, place_m), now_s);
        assert!(renderer.tick(now_s, place_m).length() < 0.01);
        tick += 1;
    }
    assert_eq!(renderer.state(), RenderingState::Paused);
    // Nor does `enable` while the tool is deep in the tissue: it engages only in the air.
    renderer.envelope.enable();
    for step in 0..1500 {
        let now_s = f64::from(tick) * TICK_S;
        let up = (f64::from(step) - 300.0).clamp(0.0, 60.0) * 1e-4 - (f64::from(step) - 700.0).clamp(0.0, 60.0) * 1e-4;
        let place_m = place_m + up * DVec3::Z;
        renderer.receive(model(u64::from(tick) + 10, now_s, place_m), now_s);
        let force = renderer.tick(now_s, place_m).length();
        if step < 300 {
            assert!(force < 0.01, "{force} N before it engaged");
        }
        tick += 1;
        if step == 1499 {
            assert!(force > 1.5, "{force} N once it has engaged again");
        }
    }
}

#[test]
fn what_is_not_finite_is_a_fault_that_lets_go_and_needs_a_reset() {
    for broken in [DVec3::NAN, DVec3::INFINITY, DVec3::new(0.0, f64::NEG_INFINITY, 0.0)] {
        let (mut renderer, mut tick) = pressed(0.005);
        let mut before = renderer.tick(f64::from(tick) * TICK_S, DVec3::new(0.0, 0.0, -0.005));
        for _ in 0..100 {
            tick += 1;
            let force = renderer.tick(f64::from(tick) * TICK_S, broken);
            assert!(force.is_finite() && (force - before).length() <= SLEW_N_PER_S * TICK_S * 1.001);
            before = force;
        }
        assert_eq!(before, DVec3::ZERO);
        assert_eq!(renderer.state(), RenderingState::Fault);
        renderer.envelope.enable();
        assert_eq!(renderer.state(), RenderingState::Fault, "a fault is reset first");
        renderer.envelope.reset();
        renderer.envelope.enable();
        assert_eq!(renderer.state(), RenderingState::Enabled);
    }
}

#[test]
fn models_that_are_broken_or_late_are_refused_and_counted() {
    let (mut renderer, tick) = pressed(0.005);
    let (now_s, place_m) = (f64::from(tick) * TICK_S, DVec3::new(0.0, 0.0, -0.005));
    let newest = model(u64::from(tick) + 1, now_s, place_m);
    renderer.receive(LocalModel { force_n: DVec3::splat(f64::NAN), ..newest }, now_s);
    renderer.receive(LocalModel { normal: DVec3::ZERO, ..newest }, now_s);
    renderer.receive(LocalModel { sequence: 3, force_n: 100.0 * DVec3::Z, ..newest }, now_s);
    renderer.receive(LocalModel { force_n: 100.0 * DVec3::Z, ..newest }, f64::NAN);
    assert_eq!(renderer.refused(), 4);
    assert!((renderer.tick(now_s, place_m).z - 2.0).abs() < 1e-6);
}

#[test]
fn an_age_that_is_not_finite_is_a_fault() {
    for age_s in [f64::NAN, f64::INFINITY] {
        let mut envelope = enabled(UNDECLARED);
        let wanted = |now_s: f64, age_s: f64| Wanted {
            now_s,
            place_m: DVec3::ZERO,
            velocity_m_per_s: DVec3::ZERO,
            force_n: 0.1 * DVec3::Z,
            age_s: Some(age_s),
        };
        envelope.render(&wanted(0.0, 0.0));
        let force_n = envelope.render(&wanted(TICK_S, age_s));
        assert!(force_n.is_finite() && envelope.state() == RenderingState::Fault, "{age_s}: {force_n}");
        assert_eq!(envelope.count(LimitCause::NotFinite).0, 1);
    }
}

#[test]
fn the_norm_is_clamped_not_the_components() {
    for device in DEVICES.iter().chain([&UNDECLARED]) {
        let mut envelope = enabled(*device);
        let direction = DVec3::new(1.0, 2.0, 2.0) / 3.0;
        let mut force = DVec3::ZERO;
        for tick in 0..3000 {
            let now_s = f64::from(tick) * TICK_S;
            // Pressed further and further in, so that energy is not a limit.
            let place_m = -direction * (f64::from(tick) * 1e-5);
            let force_n = if tick < 600 { DVec3::ZERO } else { 50.0 * direction };
            let wanted = Wanted { now_s, place_m, velocity_m_per_s: -0.01 * direction, force_n, age_s: Some(0.0) };
            force = envelope.render(&wanted);
        }
        let most_n = device.most_n().min(device.continuous_n);
        assert!((force.length() - most_n).abs() < 1e-9, "{}: {force}", device.name);
        assert!((force.normalize() - direction).length() < 1e-9, "{}: turned to {force}", device.name);
        assert!(most_n <= SAFE_FORCE_N);
    }
}

#[test]
fn outside_the_workspace_is_a_fault() {
    let mut envelope = enabled(omega());
    let wanted = |x: f64| Wanted {
        now_s: 0.0,
        place_m: DVec3::new(x, 0.0, 0.0),
        velocity_m_per_s: DVec3::ZERO,
        force_n: DVec3::Z,
        age_s: Some(0.0),
    };
    envelope.render(&wanted(0.07));
    assert_eq!(envelope.state(), RenderingState::Enabled);
    envelope.render(&wanted(0.08));
    assert_eq!((envelope.state(), envelope.count(LimitCause::Workspace).0), (RenderingState::Fault, 1));
}

#[test]
fn a_sample_is_repeated_along_the_way_since() {
    // A model of the past, and a tool that has moved since: deeper, and sideways until it slides.
    let law = law();
    let old = model(1, 0.0, DVec3::new(0.0, 0.0, -0.002));
    let mut touching = Touching::at_sample(&old, &law);
    let still = |touching: &Touching| touching.force_n(&old, &law, DVec3::ZERO);
    assert!((still(&touching) - old.force_n).length() < 1e-12);
    touching.move_to(&old, &law, DVec3::new(0.0, 0.0, -0.004));
    assert!((still(&touching).z - 1.6).abs() < 1e-9);
    touching.move_to(&old, &law, DVec3::new(0.0004, 0.0, -0.004));
    assert!((still(&touching).x + 0.16).abs() < 1e-9, "sticks: {}", still(&touching));
    touching.move_to(&old, &law, DVec3::new(0.01, 0.0, -0.004));
    assert!((still(&touching).x + 0.32).abs() < 1e-9, "slides: {}", still(&touching));
    touching.move_to(&old, &law, DVec3::new(0.0096, 0.0, -0.004));
    assert!((still(&touching).x + 0.16).abs() < 1e-9, "turns back: {}", still(&touching));
    touching.move_to(&old, &law, DVec3::new(0.0096, 0.0, 0.001));
    assert_eq!(still(&touching), DVec3::ZERO);
}

/// A tissue that hardens, times `share`. A coarse law may tell nine tenths of it; another tissue may be anything.
fn hardening(share: f64) -> Law {
    let row = |row: u32| {
        let depth_m = f64::from(row) * 1e-3;
        Row {
            force_n: share * (300.0 * depth_m + 2e4 * depth_m * depth_m),
            stiffness_n_per_m: share * (300.0 + 4e4 * depth_m),
            across_n_per_m: 150.0,
            damping_n_s_per_m: 0.3,
            across_n_s_per_m: 0.2,
            drag_n_s_per_m: 0.1,
        }
    };
    Law { step_m: 1e-3, rows: (0..=10).map(row).collect(), is_coarse: share != 1.0 }
}

/// A run of a renderer whose hand moves up and down in the tissue with the full delay of a network: forces of all
/// ticks, N. Models name law 1, that of the tissue, from tick `changed` on; before, they name one that is `share` of
/// it.
fn rendered_across(share: f64, changed: u32) -> Vec<DVec3> {
    const DELAY_TICKS: u32 = 50;
    let laws = [hardening(share), hardening(1.0)];
    let place = |tick: u32| {
        let now_s = f64::from(tick) * TICK_S;
        let down = ((now_s - ENGAGE_S - 0.1) / 0.5).clamp(0.0, 1.0);
        let swing = 0.0015 * (std::f64::consts::TAU * 3.0 * (now_s - 1.2).max(0.0)).sin();
        DVec3::new(0.0, 0.0, 0.001 - 0.004 * down - swing)
    };
    let mut renderer = Renderer::new(laws[0].clone(), enabled(omega()));
    let mut forces = Vec::new();
    for tick in 0..3000_u32 {
        let now_s = f64::from(tick) * TICK_S;
        if tick == changed.saturating_sub(10) {
            assert!(renderer.learn(1, laws[1].clone()));
        }
        if let Some(then) = tick.checked_sub(DELAY_TICKS) {
            // The tissue is as the exact law says, with its surface at 0; the server places the surface by the law
            // that it names.
            let (law, depth_m) = (u32::from(tick >= changed), (-place(then).z).max(0.0));
            let force_n = laws[1].at_depth(depth_m).force_n;
            let surface_m = place(then) + laws[law as usize].depth_of(force_n) * DVec3::Z;
            let model = model(u64::from(tick), f64::from(then) * TICK_S, place(then));
            let surface_m = if depth_m > 0.0 { surface_m } else { model.surface_m };
            renderer.receive(LocalModel { force_n: force_n * DVec3::Z, surface_m, law, ..model }, now_s);
        }
        forces.push(renderer.tick(now_s, place(tick)));
    }
    assert_eq!((renderer.state(), renderer.refused()), (RenderingState::Enabled, 0));
    forces
}

#[test]
fn a_change_of_law_is_no_jump_of_force() {
    let steepest = |forces: &[DVec3]| forces.windows(2).map(|two| (two[1] - two[0]).length()).fold(0.0, f64::max);
    // A coarse law, and those of tissues that were softer or stiffer than the one that acts now.
    for share in [0.9, 0.6, 1.4] {
        // In the middle of a fast stroke, where the two laws differ most over the way since the sample, and elsewhere.
        let ([old, new], mut sharpest) = ([u32::MAX, 0].map(|changed| rendered_across(share, changed)), 0.0_f64);
        for changed in (1400..1740).step_by(17) {
            let forces = rendered_across(share, changed);
            let at = changed as usize;
            assert_eq!(forces[..at], old[..at]);
            // As long as the bias of the change lasts, which decays with its time constant.
            let [own_n, other_n, found_n] = [&old, &new, &forces].map(|forces| steepest(&forces[at - 1..at + 100]));
            let (own_n, bias_n) = (own_n.max(other_n), (old[at] - new[at]).length());
            assert!(
                found_n <= own_n + bias_n * TICK_S / BIAS_S + 1e-9,
                "{share}: {found_n} N in a tick, {own_n} N without a change"
            );
            sharpest = sharpest.max(bias_n / own_n);
        }
        println!("{share}: a bias of up to {sharpest} times the change in a tick");
        // Taken over at once, the change would be felt.
        assert!(sharpest > 1.5, "{share}: {sharpest}");
    }
}

#[test]
fn laws_are_bounded_and_one_that_is_not_known_changes_nothing() {
    let place_m = DVec3::new(0.0, 0.0, -0.005);
    // The newest model's law is stiffer than the first.
    let met = || {
        let (mut renderer, tick) = pressed(0.005);
        assert!(!renderer.learn(0, Law::linear(800.0, 0.5)), "the first stays what it is");
        assert!(!renderer.learn(1, Law { step_m: f64::NAN, ..law() }));
        let now_s = f64::from(tick) * TICK_S;
        renderer.receive(LocalModel { law: 7, ..model(u64::from(tick) + 1, now_s, place_m) }, now_s);
        assert!((renderer.tick(now_s, place_m).z - 2.0).abs() < 1e-6);
        assert!(renderer.learn(8, Law::linear(800.0, 0.5)));
        let surface_m = -0.0025 * DVec3::Z;
        let newest = model(u64::from(tick) + 2, now_s + TICK_S, place_m);
        renderer.receive(LocalModel { law: 8, surface_m, ..newest }, now_s + TICK_S);
        (renderer, now_s)
    };
    let deeper_n = |renderer: &mut Renderer, now_s: f64| renderer.tick(now_s + TICK_S, place_m - 1e-5 * DVec3::Z).z;
    let (mut before, now_s) = met();
    let before_n = deeper_n(&mut before, now_s);
    // It is kept, whatever comes; others go when there are too many.
    let (mut renderer, now_s) = met();
    let most = u32::try_from(MAX_LAWS).unwrap();
    assert!((100..100 + 2 * most).all(|number| renderer.learn(number, law())));
    assert!(renderer.learn(1, law()) && !renderer.learn(8, law()), "a law that was forgotten is new");
    assert_eq!(deeper_n(&mut renderer, now_s), before_n);
    // Another server begins with its own.
    renderer.begin(law());
    assert!(renderer.learn(1, law()));
}

#[test]
fn a_path_is_played_as_it_was_walked_and_never_faster_than_allowed() {
    let walked = |time_s: f64| DVec3::new(0.03 * time_s, 0.0, 0.002 * (7.0 * time_s).sin());
    let mut path = Path::default();
    let mut before: Option<DVec3> = None;
    // Commands come in bursts of seven, 25 ms late.
    for step in 0..4000_u32 {
        let now_s = f64::from(step) * TICK_S;
        if step % 7 == 0 && step >= 32 {
            for k in 0..7 {
                let time_s = f64::from(step - 32 + k) * TICK_S;
                path.receive(time_s, walked(time_s), now_s);
            }
        }
        let Some(Play::Pose(place_m, time_s)) = path.step(now_s, TICK_S) else { continue };
        if step > 1000 {
            assert!((place_m - walked(time_s)).length() < 1e-6, "step {step}");
            let before = before.replace(place_m).unwrap_or(place_m);
            let speed = (place_m - before).length() / TICK_S;
            assert!(speed < 0.05, "{speed} m/s in step {step}: knots show");
            assert!(now_s - time_s < 0.06, "{} s late in step {step}", now_s - time_s);
        } else {
            before = Some(place_m);
        }
    }
    // After an outage: released, no backlog, the speed limit holds.
    let mut last = before.unwrap();
    for step in 4000..4600_u32 {
        let now_s = f64::from(step) * TICK_S;
        match path.step(now_s, TICK_S) {
            Some(Play::Pose(place_m, _)) => {
                assert!(now_s < 4.0 + RELEASE_S);
                last = place_m;
            }
            played => assert_eq!(played, Some(Play::Release)),
        }
    }
    assert_eq!(path.counts()[2], 1);
    for k in 0..500_u32 {
        let time_s = 4.0 + f64::from(k) * TICK_S;
        path.receive(time_s, last + DVec3::new(0.1, 0.0, -0.01), 4.6);
    }
    let mut before: Option<DVec3> = None;
    for step in 4600..5000_u32 {
        let Some(Play::Pose(place_m, _)) = path.step(f64::from(step) * TICK_S, TICK_S) else { break };
        if let Some(before) = before {
            assert!((place_m - before).length() <= SPEED_M_PER_S * TICK_S * 1.001);
        }
        before = Some(place_m);
    }
}

#[test]
fn broken_and_stale_commands_change_nothing() {
    let mut path = Path::default();
    assert_eq!(path.step(0.0, TICK_S), None);
    assert!(path.receive(1.0, DVec3::Z, 0.0));
    assert!(!path.receive(1.0, DVec3::ZERO, 0.0));
    assert!(!path.receive(0.5, DVec3::ZERO, 0.0));
    assert!(!path.receive(2.0, DVec3::NAN, 0.0));
    assert!(!path.receive(f64::INFINITY, DVec3::ZERO, 0.0));
    assert_eq!(path.counts()[1], 4);
    assert_eq!(path.step(0.001, TICK_S), Some(Play::Pose(DVec3::Z, 1.0)));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    /// For any models and any movement of a hand: no force exceeds its limits, none changes faster than the slew, and
    /// the port gives no energy that a hand would notice.
    #[test]
    fn any_forces_and_any_hand_stay_within_the_envelope(
        forces in prop::collection::vec(prop::array::uniform3(-40.0..40.0_f64), 8),
        speeds in prop::collection::vec(prop::array::uniform3(-0.15..0.15_f64), 24),
        device in 0..DEVICES.len(),
        ages in prop::collection::vec(0.0..0.2_f64, 8),
    ) {
        let device = DEVICES[device];
        let mut envelope = enabled(device);
        let (mut place_m, mut velocity, mut before, mut energy_j) = (DVec3::ZERO, DVec3::ZERO, DVec3::ZERO, 0.0);
        for tick in 0..2400_u32 {
            let part = tick as usize / 100;
            // A hand does not change its speed at once.
            velocity += 0.02 * (DVec3::from(speeds[part]) - velocity);
            let moved_m = velocity * TICK_S;
            place_m += moved_m;
            energy_j -= before.dot(moved_m);
            prop_assert!(energy_j >= -1e-3, "{energy_j} J at tick {tick}");
            if place_m.length() > 0.9 * device.workspace_m {
                velocity = -velocity;
                place_m = place_m.clamp_length_max(0.9 * device.workspace_m);
            }
            let wanted = Wanted {
                now_s: f64::from(tick) * TICK_S,
                place_m,
                velocity_m_per_s: velocity,
                force_n: if tick < 5 { DVec3::ZERO } else { DVec3::from(forces[part % 8]) },
                age_s: Some(ages[part % 8]),
            };
            let force = envelope.render(&wanted);
            prop_assert!(force.is_finite() && force.length() <= device.most_n() + 1e-9);
            prop_assert!((force - before).length() <= SLEW_N_PER_S * TICK_S + 1e-9);
            before = force;
            if envelope.state() != RenderingState::Enabled {
                envelope.enable();
            }
        }
    }
}
