//! A tick allocates and frees no memory and takes no lock, whatever arrives; and mistakes of its caller are harmless.
#![allow(unsafe_code, clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use glam::{DMat3, DVec3};
use palpate_client::Reading;
use palpate_client::bridge::{Offline, PositionOrigin};
use palpate_haptics::{
    ContactState, Device, InstrumentPose, Law, LocalModel, OtherTool, Predicted, Predictor, RenderingState, Wrench,
};
use palpate_proto::{pb, touch};
use pb::touch_response::Message as Heard;
use prost::Message;

thread_local! {
    /// Calls of this thread to the allocator, in both directions.
    static REQUESTS: Cell<u64> = const { Cell::new(0) };
}

/// The system's allocator, which counts its calls.
struct CountingAllocator;

// SAFETY: it only counts.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        REQUESTS.set(REQUESTS.get() + 1);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        REQUESTS.set(REQUESTS.get() + 1);
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(place, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

fn bytes(message: Heard) -> Vec<u8> {
    pb::TouchResponse { message: Some(message) }.encode_to_vec()
}

fn opened() -> Vec<u8> {
    let law = Some(touch::law(&Law::linear(400.0, 0.5), 0));
    bytes(Heard::Opened(pb::TouchOpened { law, ..Default::default() }))
}

fn further(number: u32) -> Vec<u8> {
    let law = Some(touch::law(&Law::linear(400.0 + f64::from(number), 0.5), number));
    bytes(Heard::ForceLaw(pb::ForceLawUpdate { law, ..Default::default() }))
}

/// A sample of a tool at a height over a spring, m.
fn sample(sequence: u64, client_time_s: f64, z_m: f64, law: u32) -> Vec<u8> {
    let model = LocalModel {
        sequence,
        client_time_s,
        step: sequence,
        place_m: z_m * DVec3::Z,
        velocity_m_per_s: DVec3::ZERO,
        force_n: 400.0 * (-z_m).max(0.0) * DVec3::Z,
        stiffness_n_per_m: 400.0 * DMat3::IDENTITY,
        damping_n_s_per_m: 0.5 * DMat3::IDENTITY,
        surface_m: DVec3::ZERO,
        normal: DVec3::Z,
        curvature_per_m: DMat3::ZERO,
        valid_m: 0.01,
        friction: 0.2,
        contact_state: if z_m < 0.0 { ContactState::Sticking } else { ContactState::Free },
        law,
    };
    let tool = pb::ToolSample { local_model: Some(touch::local_model(&model)), ..Default::default() };
    bytes(Heard::Sample(pb::Sample { step: sequence, tools: vec![tool], ..Default::default() }))
}

fn device() -> Device {
    Device::named("omega3").unwrap()
}

/// Above the surface for half a second, then down to 3 mm below it and up again, every second.
fn z_m(time_s: f64) -> f64 {
    0.001 - 0.004 * (std::f64::consts::TAU * (time_s - 0.5)).sin().max(0.0)
}

/// A copy of the tissue: a spring, N/m.
struct SpringCopy(f64);

impl Predictor for SpringCopy {
    fn feel(&mut self, _: f64, pose: &InstrumentPose, _: &[OtherTool]) -> Option<Predicted> {
        let place_m = pose.place_m;
        let contact_state = if place_m.z < 0.0 { ContactState::Sticking } else { ContactState::Free };
        let wrench = Wrench::of_force(self.0 * (-place_m.z).max(0.0) * DVec3::Z);
        Some(Predicted { wrench, contact_state, own_work_j: 0.0, others_work_j: 0.0 })
    }
}

#[test]
fn a_tick_asks_for_no_memory_and_gives_none_back() {
    for up_deadband in [0.0, 0.1] {
        let Offline { mut ticker, mut record } =
            Offline::new(device(), PositionOrigin::Tissue, DVec3::ZERO, up_deadband);
        let (mut most_n, mut requests) = (0.0_f64, 0);
        for tick in 0..6000_u32 {
            let time_s = 1e-3 * f64::from(tick);
            // Connections, laws and models, faster than a server sends them.
            if tick % 2500 == 100 {
                record.arrive(&opened()).unwrap();
            }
            if tick % 7 == 0 {
                record.arrive(&further(1 + tick)).unwrap();
            }
            // Copies arrive, replace each other, and end with their connection. None is freed in a tick.
            if tick % 1000 == 300 {
                record.predict(Box::new(SpringCopy(400.0)));
            }
            let sent_s = time_s - 0.02;
            record.arrive(&sample(1 + u64::from(tick), 1.0 + sent_s, z_m(sent_s), 1 + tick / 7 * 7)).unwrap();
            let reading = Reading { place_m: z_m(time_s) * DVec3::Z, enable: tick % 1000 > 150 };
            let before = REQUESTS.get();
            let force_n = ticker.tick(reading, time_s);
            requests += REQUESTS.get() - before;
            most_n = most_n.max(force_n.z);
        }
        assert_eq!(requests, 0, "deadband {up_deadband}");
        assert!(most_n > 0.8, "{most_n} N: nothing was rendered");
        assert!((3000..5000).contains(&ticker.predicted()), "{}", ticker.predicted());
        assert_eq!(ticker.state(), Some(RenderingState::Enabled));
    }
}

#[test]
fn laws_that_do_not_fit_wait_and_the_newest_model_counts() {
    let Offline { mut ticker, mut record } = Offline::new(device(), PositionOrigin::Tissue, DVec3::ZERO, 0.0);
    record.arrive(&opened()).unwrap();
    let enable = Reading { place_m: 0.001 * DVec3::Z, enable: true };
    for tick in 0..700_u32 {
        let time_s = 1e-3 * f64::from(tick);
        record.arrive(&sample(1 + u64::from(tick), 1.0 + time_s, 0.001, 0)).unwrap();
        ticker.tick(enable, time_s);
    }
    // No tick runs for a tenth of a second in which more arrives than fits.
    for number in 1..200 {
        record.arrive(&further(number)).unwrap();
        record.arrive(&sample(700 + u64::from(number), 1.7, 0.001, number)).unwrap();
    }
    let mut force_n = DVec3::ZERO;
    for tick in 800..1300_u32 {
        let time_s = 1e-3 * f64::from(tick);
        // Slowly in, at 10 mm/s; the sample is a tenth of a second old.
        let at = |tick: u32| (0.001 - 1e-5 * (f64::from(tick) - 899.0)).min(0.001);
        let z_m = at(tick);
        record.arrive(&sample(200 + u64::from(tick), 0.9 + time_s, at(tick - 100), 199)).unwrap();
        force_n = ticker.tick(Reading { place_m: z_m * DVec3::Z, enable: true }, time_s);
    }
    // 400 N/m over 2 mm by the sample, 599 N/m (the newest law) over the rest, and the damping. Each sample lowers
    // that by 2 mN, which decays within 20 ms, so 40 mN are still there.
    assert!((force_n.z - 0.8 - 0.599 - 0.005 - 0.04).abs() < 2e-3, "{force_n}");
}

#[test]
fn clocks_that_jump_and_places_that_are_none_are_harmless() {
    let Offline { mut ticker, mut record } = Offline::new(device(), PositionOrigin::Workspace, DVec3::X, 0.1);
    // Before the first connection there is no force.
    assert_eq!(ticker.tick(Reading { place_m: DVec3::ZERO, enable: true }, 5.0), DVec3::ZERO);
    assert_eq!((ticker.state(), ticker.model_age_s()), (None, None));
    record.arrive(&opened()).unwrap();
    let mut sequence = 0;
    let mut at = |ticker: &mut palpate_client::bridge::Ticker,
                  record: &mut palpate_client::bridge::OfflineNetwork,
                  time_s: f64,
                  z_m: f64,
                  enable| {
        sequence += 1;
        record.arrive(&sample(sequence, 1e6, z_m, 0)).unwrap();
        ticker.tick(Reading { place_m: z_m * DVec3::Z, enable }, time_s)
    };
    for time_s in [6.0, 6.0, 6.0, 3.0, f64::MAX, -f64::MAX, 1e300, 0.0, 0.001, 0.0005, 0.002] {
        let force_n = at(&mut ticker, &mut record, time_s, 0.001, true);
        assert!(force_n.is_finite() && force_n.length() < 1e-9, "{time_s}: {force_n}");
    }
    for (time_s, z_m) in [(f64::NAN, 0.0), (0.003, f64::NAN), (f64::INFINITY, 0.0), (0.004, f64::INFINITY)] {
        let force_n = at(&mut ticker, &mut record, time_s, z_m, false);
        assert!(force_n.is_finite() && force_n.length() < 1e-9, "{time_s}: {force_n}");
        assert_eq!(ticker.state(), Some(RenderingState::Fault));
    }
    // A change from false to true is what enables.
    at(&mut ticker, &mut record, 0.005, 0.001, true);
    assert_eq!(ticker.state(), Some(RenderingState::Enabled));
    assert!((ticker.place_m() - DVec3::new(1.0, 0.0, 0.001)).length() < 1e-12);
    ticker.disable();
    assert_eq!(ticker.state(), Some(RenderingState::Disabled));
}

#[test]
fn bytes_that_are_no_message_are_refused() {
    let mut record = Offline::new(device(), PositionOrigin::Tissue, DVec3::ZERO, 0.0).record;
    assert!(record.arrive(&[0xff; 9]).is_err());
    let unsound = pb::TouchOpened { law: Some(pb::ForceLaw::default()), ..Default::default() };
    assert!(record.arrive(&bytes(Heard::Opened(unsound))).is_err());
    assert!(record.arrive(&bytes(Heard::Opened(pb::TouchOpened::default()))).is_err());
    assert!(record.arrive(&[]).is_ok(), "an empty message is a message of a newer server");
}

/// The code that a tick runs has no lock in it, and reads no clock.
#[test]
fn a_tick_takes_no_lock() {
    let source = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let haptics = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../crates/haptics/src");
    let files = ["bridge/ticker.rs", "bridge/hands.rs", "exchange.rs"].map(|name| source.join(name));
    let rules = ["renderer.rs", "envelope.rs", "local_model.rs", "force_law.rs", "dead_reckoning.rs", "prediction.rs"]
        .map(|name| haptics.join(name));
    for file in files.iter().chain(&rules) {
        let text = std::fs::read_to_string(file).unwrap();
        for word in ["Mutex", "RwLock", "Condvar", "OnceLock", "Instant", "SystemTime", "park()", "mpsc"] {
            assert!(!text.contains(word), "{} has {word}", file.display());
        }
    }
}
