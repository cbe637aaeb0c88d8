//! Runs of random combinations, for properties that must hold for every combination.

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate::force_law::{self, Disc};
use palpate::limits::Limits;
use palpate::scene::{BUILT_IN, Scene};
use palpate::sheet::Model;
use palpate_touch::Tip;
use palpate_touch::device::DEVICES;
use palpate_touch::hand::HANDS;
use serde_json::{Value, json};

use super::run::{Outcome, Setup, run};
use super::tissue::Spot;
use super::{Arguments, figures};
use crate::Failure;
use crate::simulated::network::Conditions;
use crate::simulated::random::Random;
use crate::table;

/// Tissues of the random runs.
const TISSUES: [&str; 3] = ["fibrotic", "liver", "stomach"];

/// Constant round-trip times of the random runs, s. Half of the runs use one of the four profiles instead.
const ROUND_TRIPS_S: [f64; 6] = [0.0, 0.002, 0.01, 0.02, 0.05, 0.1];

/// Number of runs between two reports of the progress.
const REPORT_EVERY: usize = 50;

/// The worst value of one figure, and the run that it is from.
struct Worst {
    name: &'static str,
    /// Whether a larger value is worse.
    largest: bool,
    of: fn(&Outcome) -> Option<f64>,
    found: Option<(f64, Value)>,
}

/// Performs the runs on all processors and prints the worst value of each figure.
pub(super) fn print(arguments: &Arguments, runs: u64) -> Result<(), Failure> {
    let limits = Limits::default();
    let tip = Tip::default();
    let mut tissues = BTreeMap::new();
    for (name, text) in BUILT_IN.iter().filter(|scene| TISSUES.contains(&scene.0)) {
        let scene = Scene::parse(name, text, &[], &limits)?;
        let model = Model::compile(&scene, &limits)?;
        let law = Arc::new(force_law::exact(&model, tip.radius_m));
        tissues.insert(*name, (model, law));
    }
    let setup = |seed: u64| {
        let mut random = Random::new(seed, 3);
        let (model, law) = &tissues[random.one_of(&TISSUES)];
        let profiles = <super::Profile as clap::ValueEnum>::value_variants();
        let conditions = if random.between(0.0, 1.0) < 0.5 {
            random.one_of(profiles).conditions()
        } else {
            Conditions { round_trip_s: *random.one_of(&ROUND_TRIPS_S), ..Conditions::default() }
        };
        let conditions = arguments.on(conditions);
        let (hand, device) = (*random.one_of(&HANDS), *random.one_of(&DEVICES));
        Setup {
            model: model.clone(),
            law: law.clone(),
            disc: Disc::in_middle(model, tip.radius_m),
            tip,
            spot: Spot::new(model, model.shape().extent().middle_m(), tip.radius_m),
            hand,
            device,
            conditions,
            stall_s: 0.0,
            scheme: arguments.scheme,
            deadband: arguments.deadband,
            up_deadband: arguments.up_deadband,
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
                    let outcome = run(&setup);
                    if let Ok(mut results) = results.lock() {
                        results.push((setup.seed, setup, outcome));
                        if results.len().is_multiple_of(REPORT_EVERY) {
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

fn report(arguments: &Arguments, results: &[(u64, Setup, Result<Outcome, String>)]) -> Result<(), Failure> {
    let worst = |name, largest, of| Worst { name, largest, of, found: None };
    let mut all = [
        worst("energy_min_j", false, |outcome| Some(outcome.energy_min_j)),
        worst("jump_max_n", true, |outcome| Some(outcome.jump_max_n)),
        worst("force_error_rms_percent", true, |outcome| outcome.force_error_rms_percent),
        worst("rendered_share", false, |outcome| outcome.rendered_share),
        worst("guard_share", true, |outcome| Some(outcome.guard_share)),
        worst("force_max_n", true, |outcome| Some(outcome.force_max_n)),
    ];
    let mut unstable = 0_u64;
    for (seed, setup, outcome) in results {
        let outcome = outcome.as_ref().map_err(|error| Failure::Failed(format!("seed {seed}: {error}")))?;
        unstable += u64::from(outcome.unstable_at_s.is_some());
        for worst in &mut all {
            let Some(value) = (worst.of)(outcome) else { continue };
            let beaten = worst.found.as_ref().is_none_or(|(w, _)| if worst.largest { value > *w } else { value < *w });
            if beaten {
                worst.found = Some((value, figures(setup, outcome)));
            }
        }
        if !arguments.json {
            let f = outcome;
            crate::tell!(
                "{seed:>6} {:<9} {:<7} {:<9} rtt {:>5.1} ms jitter {:>4.1} loss {:<6} error {:>7.2} % energy {:>10.2e} J jump \
                 {:.3} N guard {:.4} share {:.3} pauses {} faults {} {}",
                setup.model.scene.name,
                setup.hand.name,
                setup.device.name,
                1e3 * setup.conditions.round_trip_s,
                1e3 * setup.conditions.jitter_s,
                setup.conditions.loss,
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
        crate::tell!("\n{} runs, {unstable} unstable. Worst values:", results.len());
        for worst in &all {
            let Some((value, run)) = &worst.found else { continue };
            let value = match worst.name.rsplit_once('_') {
                Some((_, "j")) => table::with_unit(*value, "J"),
                Some((_, "n")) => table::with_unit(*value, "N"),
                Some((_, "percent")) => format!("{} %", table::rounded(*value)),
                _ => table::percent(*value),
            };
            crate::tell!("{:<26} {value:<12} seed {}", worst.name, run["seed"]);
        }
    }
    Ok(())
}
