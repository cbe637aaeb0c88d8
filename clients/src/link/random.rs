//! Many runs of random combinations: what must hold of any, holds of all.

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate::haptics::Law;
use palpate::haptics::device::DEVICES;
use palpate::haptics::hand::HANDS;
use palpate::limits::Limits;
use palpate::scene::tip::Tip;
use palpate::scene::{BUILT_IN, Scene};
use palpate::sheet::Model;
use serde_json::{Value, json};

use super::network::{Dice, Weather};
use super::run::{Found, Setup, run};
use super::{Arguments, figures};
use crate::Failure;

/// Tissues of the random runs.
const TISSUES: [&str; 3] = ["fibrotic", "liver", "stomach"];

/// Round trips of the random runs, s: each is a constant delay, or one of the four profiles.
const ROUND_TRIPS_S: [f64; 6] = [0.0, 0.002, 0.01, 0.02, 0.05, 0.1];

/// Runs between two words on how far it is.
const TOLD_EVERY: usize = 50;

/// Of one figure, the worst and whose it is.
struct Worst {
    name: &'static str,
    /// Larger is worse.
    largest: bool,
    of: fn(&Found) -> Option<f64>,
    found: Option<(f64, Value)>,
}

/// Runs them on all processors, and prints the worst of each figure.
pub(super) fn print(arguments: &Arguments, runs: u64) -> Result<(), Failure> {
    let refused = |refusal: palpate::refusal::Refusal| Failure::Refused(refusal.to_string());
    let limits = Limits::default();
    let tip = Tip::default();
    let mut tissues = BTreeMap::new();
    for (name, text) in BUILT_IN.iter().filter(|scene| TISSUES.contains(&scene.0)) {
        let scene = Scene::parse(name, text, &[], &limits).map_err(refused)?;
        let model = Model::compile(&scene, &limits).map_err(refused)?;
        let law = Arc::new(Law::of(&model, tip.radius_m));
        tissues.insert(*name, (model, law));
    }
    let setup = |seed: u64| {
        let mut dice = Dice::new(seed, 3);
        let (model, law) = &tissues[dice.one_of(&TISSUES)];
        let profiles = <super::Profile as clap::ValueEnum>::value_variants();
        let weather = if dice.between(0.0, 1.0) < 0.5 {
            dice.one_of(profiles).weather()
        } else {
            Weather { round_trip_s: *dice.one_of(&ROUND_TRIPS_S), jitter_s: 0.0, loss: 0.0 }
        };
        let (hand, device) = (*dice.one_of(&HANDS), *dice.one_of(&DEVICES));
        Setup {
            model: model.clone(),
            law: law.clone(),
            tip,
            hand,
            device,
            weather,
            stall_s: 0.0,
            scheme: arguments.scheme,
            deadband: arguments.deadband,
            duration_s: arguments.seconds,
            seed,
        }
    };
    let next = std::sync::atomic::AtomicU64::new(0);
    let results = std::sync::Mutex::new(Vec::new());
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..workers {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                    if index >= runs {
                        return;
                    }
                    let setup = setup(arguments.seed.wrapping_add(index));
                    let found = run(&setup);
                    if let Ok(mut results) = results.lock() {
                        results.push((setup.seed, setup, found));
                        if results.len().is_multiple_of(TOLD_EVERY) {
                            crate::say!("palpate-client: {} of {runs} runs", results.len());
                        }
                    }
                }
            });
        }
    });
    let mut results = results.into_inner().map_err(|error| Failure::Failed(error.to_string()))?;
    results.sort_by_key(|result| result.0);
    report(arguments, &results)
}

fn report(arguments: &Arguments, results: &[(u64, Setup, Result<Found, String>)]) -> Result<(), Failure> {
    let worst = |name, largest, of| Worst { name, largest, of, found: None };
    let mut all = [
        worst("energy_min_j", false, |found| Some(found.energy_min_j)),
        worst("jump_max_n", true, |found| Some(found.jump_max_n)),
        worst("force_error_rms_percent", true, |found| found.force_error_rms_percent),
        worst("rendered_share", false, |found| found.rendered_share),
        worst("guard_share", true, |found| Some(found.guard_share)),
        worst("force_max_n", true, |found| Some(found.force_max_n)),
    ];
    let mut unstable = 0_u64;
    for (seed, setup, found) in results {
        let found = found.as_ref().map_err(|error| Failure::Failed(format!("seed {seed}: {error}")))?;
        unstable += u64::from(found.unstable_at_s.is_some());
        for worst in &mut all {
            let Some(value) = (worst.of)(found) else { continue };
            let beaten = worst.found.as_ref().is_none_or(|(w, _)| if worst.largest { value > *w } else { value < *w });
            if beaten {
                worst.found = Some((value, figures(setup, found)));
            }
        }
        if !arguments.json {
            let f = found;
            crate::tell!(
                "{seed:>6} {:<9} {:<7} {:<9} rtt {:>5.1} ms jitter {:>4.1} loss {:<6} error {:>7.2} % energy {:>10.2e} J jump \
                 {:.3} N guard {:.4} share {:.3} pauses {} faults {} {}",
                setup.model.scene.name,
                setup.hand.name,
                setup.device.name,
                1e3 * setup.weather.round_trip_s,
                1e3 * setup.weather.jitter_s,
                setup.weather.loss,
                f.force_error_rms_percent.unwrap_or(f64::NAN),
                f.energy_min_j,
                f.jump_max_n,
                f.guard_share,
                f.rendered_share.unwrap_or(f64::NAN),
                f.pauses,
                f.faults,
                if f.unstable_at_s.is_some() { "UNSTABLE" } else { "" }
            );
        }
    }
    let fields = all.iter().filter_map(|worst| {
        let (value, run) = worst.found.as_ref()?;
        Some((worst.name.to_owned(), json!({ "worst": value, "run": run })))
    });
    let mut fields: serde_json::Map<String, Value> = fields.collect();
    fields.insert("runs".to_owned(), json!(results.len()));
    fields.insert("unstable".to_owned(), json!(unstable));
    if arguments.json {
        crate::tell!("{}", Value::Object(fields));
    } else {
        crate::tell!("\n{} runs, {unstable} unstable. Worst of each:", results.len());
        for worst in &all {
            let Some((value, run)) = &worst.found else { continue };
            crate::tell!("{:<26} {value:<12.5} seed {}", worst.name, run["seed"]);
        }
    }
    Ok(())
}
