//! Runs of random combinations, for properties that must hold for every combination.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::device::DEVICES;
use palpate_haptics::hand::HANDS;
use palpate_haptics::{Law, Tip};
use palpate_refusal::Refusal;
use palpate_simulated::network::{Conditions, Transport};
use palpate_simulated::random::Random;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::scene::{BUILT_IN, Scene};
use serde_json::{Value, json};

use super::figures::figures;
use super::laws::PlaceLaws;
use super::measure::LinkOutcome;
use super::run::run;
use super::setup::{Rendering, Setup, TissueChange};
use super::spot::Spot;
use super::{LinkArguments, changed, law_of};
use crate::ClientFailure;
use crate::table;

/// Tissues of the random runs.
const TISSUES: [&str; 3] = ["fibrotic", "liver", "stomach"];

/// Constant round-trip times of the random runs, s. Half of the runs use one of the four profiles instead.
const ROUND_TRIPS_S: [f64; 6] = [0.0, 0.002, 0.01, 0.02, 0.05, 0.1];

/// Alternatives of the other properties; the first of each is the common case.
const TRANSPORTS: [Transport; 2] = [Transport::Stream, Transport::Datagram];
const MORE_LOSS: [f64; 4] = [0.0, 0.001, 0.01, 0.1];
const BURSTS: [f64; 2] = [1.0, 5.0];
const OUTAGES_S: [f64; 6] = [0.0, 0.0, 0.0, 0.1, 0.2, 0.4];
const RATES_BIT_PER_S: [f64; 6] = [0.0, 0.0, 0.0, 1e6, 3e6, 10e6];
const QUEUE_S: f64 = 0.1;
const DEADBANDS: [[f64; 2]; 2] = [[0.0, 0.0], [0.1, 0.05]];
const SECOND_TOOLS_M: [f64; 4] = [0.0, 0.0, 0.015, 0.025];
/// Factors of the stiffness of a tissue that changes.
const FACTORS: [f64; 2] = [0.7, 1.5];
/// Fraction of the runs in which the tissue changes.
const CHANGES: f64 = 0.3;
/// Places, as fractions of the distance from the middle to one radius from the rim.
const PLACES: [f64; 4] = [0.0, 0.0, 0.5, 1.0];

/// A tissue of the random runs.
struct Choice {
    model: Arc<Model>,
    laws: Arc<PlaceLaws>,
    law: Arc<Law>,
    disc: Disc,
    /// The tissue with each of the factors above; the time of the change is drawn.
    changes: Vec<TissueChange>,
}

impl Choice {
    fn new(name: &str, text: &str, tip: &Tip) -> Result<Self, Refusal> {
        let limits = Limits::default();
        let model = Model::compile(&Scene::parse(name, text, &[], &limits)?, &limits)?;
        let disc = Disc::in_middle(&model, tip.radius_m);
        let changes =
            FACTORS.iter().map(|factor| changed(&model, tip.shape, 0.0, *factor)).collect::<Result<_, _>>()?;
        let laws = Arc::new(PlaceLaws::new(&model, tip.shape));
        Ok(Choice { law: law_of(&laws, disc)?, laws, disc, model, changes })
    }

    /// Returns a place at a fraction of the distance from the middle to one radius from the rim.
    fn place_m(&self, part: f64, tip: &Tip) -> DVec3 {
        let extent = self.model.shape().extent();
        let to_rim_m = 0.5 * (extent.most_m.x - extent.least_m.x) - tip.radius_m;
        extent.middle_m() - part * to_rim_m * DVec3::X
    }
}

/// Number of runs between two reports of the progress.
const REPORT_EVERY: usize = 50;

/// The worst value of one figure, and the run that it is from.
struct Worst {
    name: &'static str,
    /// Whether a larger value is worse.
    largest: bool,
    of: fn(&LinkOutcome) -> Option<f64>,
    found: Option<(f64, Value)>,
}

/// Performs the runs on all processors and prints the worst value of each figure.
pub(super) fn print(arguments: &LinkArguments, runs: u64) -> Result<(), ClientFailure> {
    let tip = Tip::default();
    let mut tissues = BTreeMap::new();
    for (name, text) in BUILT_IN.iter().filter(|scene| TISSUES.contains(&scene.0)) {
        tissues.insert(*name, Choice::new(name, text, &tip)?);
    }
    let setup = |seed: u64| drawn(arguments, &tissues, tip, seed);
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
    let mut results = results.into_inner().map_err(|error| ClientFailure::Failed(error.to_string()))?;
    results.sort_by_key(|result| result.0);
    report(arguments, &results)
}

/// Returns the setup of the run of a seed.
fn drawn(arguments: &LinkArguments, tissues: &BTreeMap<&str, Choice>, tip: Tip, seed: u64) -> Setup {
    let mut random = Random::new(seed, 3);
    let choice = &tissues[random.one_of(&TISSUES)];
    let profiles = <super::Profile as clap::ValueEnum>::value_variants();
    let conditions = if random.between(0.0, 1.0) < 0.5 {
        random.one_of(profiles).conditions()
    } else {
        Conditions { round_trip_s: *random.one_of(&ROUND_TRIPS_S), ..Conditions::default() }
    };
    let (hand, device) = (*random.one_of(&HANDS), *random.one_of(&DEVICES));
    let conditions = Conditions {
        transport: *random.one_of(&TRANSPORTS),
        loss: conditions.loss.max(*random.one_of(&MORE_LOSS)),
        burst: *random.one_of(&BURSTS),
        outage_s: *random.one_of(&OUTAGES_S),
        rate_bit_per_s: *random.one_of(&RATES_BIT_PER_S),
        queue_s: QUEUE_S,
        ..conditions
    };
    let [deadband, up_deadband] = *random.one_of(&DEADBANDS);
    let second_m = *random.one_of(&SECOND_TOOLS_M);
    let change = (random.between(0.0, 1.0) < CHANGES).then(|| TissueChange {
        at_s: random.between(0.0, arguments.seconds),
        ..random.one_of(&choice.changes).clone()
    });
    let place_m = choice.place_m(*random.one_of(&PLACES), &tip);
    Setup {
        model: choice.model.clone(),
        laws: choice.laws.clone(),
        law: choice.law.clone(),
        disc: choice.disc,
        tip,
        spot: Spot::new(&choice.model, place_m, &tip),
        hand,
        device,
        conditions,
        stall_s: 0.0,
        // All are sheets.
        scheme: arguments.scheme.unwrap_or(Rendering::Model),
        deadband,
        up_deadband,
        second_m,
        second_hand: arguments.second_hand,
        change,
        duration_s: arguments.seconds,
        seed,
    }
}

fn report(
    arguments: &LinkArguments,
    results: &[(u64, Setup, Result<LinkOutcome, String>)],
) -> Result<(), ClientFailure> {
    let worst = |name, largest, of| Worst { name, largest, of, found: None };
    let mut all = [
        worst("energy_min_j", false, |outcome| Some(outcome.energy_min_j)),
        worst("jump_max_n", true, |outcome| Some(outcome.jump_max_n)),
        worst("force_error_rms_percent", true, |outcome| outcome.force_error_rms_percent),
        worst("rendered_share", false, |outcome| outcome.rendered_share),
        worst("depth_error_percent", true, |outcome| outcome.depth_error_percent),
        worst("guard_share", true, |outcome| Some(outcome.guard_share)),
        worst("force_max_n", true, |outcome| Some(outcome.force_max_n)),
    ];
    let mut unstable = 0_u64;
    for (seed, setup, outcome) in results {
        let outcome = outcome.as_ref().map_err(|error| ClientFailure::Failed(format!("seed {seed}: {error}")))?;
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
                "{seed:>6} {:<9} {:<7} {:<9} {:<8} rtt {:>5.1} ms jitter {:>4.1} loss {:<6} error {:>7.2} % energy {:>10.2e} J jump \
                 {:.3} N guard {:.4} share {:.3} pauses {} faults {} {}",
                setup.model.scene.name,
                setup.hand.name,
                setup.device.name,
                setup.conditions.transport.name(),
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
