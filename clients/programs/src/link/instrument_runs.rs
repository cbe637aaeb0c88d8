//! The runs of `link --instrument`: one, or many with random hands and networks.

use palpate_haptics::hand::HANDS;
use palpate_simulated::network::{Conditions, Transport};
use palpate_simulated::random::Random;
use serde_json::{Map, Value, json};

use super::instrument::{InstrumentKind, InstrumentOutcome, run};
use super::setup::Setup;
use super::{LinkArguments, with_tissue};
use crate::ClientFailure;
use crate::table;

/// Networks of random runs: round trip, s, jitter each way, s, and loss.
const NETWORKS: [[f64; 3]; 6] = [
    [0.0, 0.0, 0.0],
    [0.0005, 0.0, 0.0],
    [0.010, 0.002, 0.001],
    [0.050, 0.0, 0.01],
    [0.050, 0.010, 0.001],
    [0.120, 0.040, 0.01],
];
const OUTAGES_S: [f64; 4] = [0.0, 0.0, 0.1, 0.4];

/// Performs the run, or as many as `--random` says, and prints the results.
///
/// # Errors
/// Returns an error if a run fails.
pub(super) fn print(arguments: &LinkArguments, setup: &Setup, kind: InstrumentKind) -> Result<(), ClientFailure> {
    let Some(runs) = arguments.random else {
        let outcome = with_tissue(|| run(setup, kind))?;
        if arguments.json {
            crate::tell!("{}", Value::Object(figures(setup, &outcome)));
        } else {
            table::print(&rows(setup, &outcome));
        }
        return Ok(());
    };
    let (mut worst, mut unstable) = (Map::new(), 0_u64);
    for seed in arguments.seed..arguments.seed.saturating_add(runs) {
        let setup = drawn(setup, seed);
        let outcome = with_tissue(|| run(&setup, kind).map_err(|error| format!("seed {seed}: {error}")))?;
        unstable += u64::from(outcome.unstable_at_s.is_some());
        let figures = figures(&setup, &outcome);
        for (key, is_worse) in [
            ("energy_min_j", (|new, old| new < old) as fn(f64, f64) -> bool),
            ("force_error_percent", |new, old| new > old),
            ("torque_error_percent", |new, old| new > old),
        ] {
            let Some(value) = figures[key].as_f64() else { continue };
            if worst.get(key).is_none_or(|found: &Value| is_worse(value, found["worst"].as_f64().unwrap_or(value))) {
                worst.insert(key.to_owned(), json!({ "worst": value, "seed": seed }));
            }
        }
        if !arguments.json {
            crate::tell!("{}", Value::Object(figures));
        }
    }
    worst.insert("runs".to_owned(), json!(runs));
    worst.insert("unstable".to_owned(), json!(unstable));
    crate::tell!("{}", Value::Object(worst));
    Ok(())
}

/// Returns the setup with the hand and the network of a seed.
fn drawn(setup: &Setup, seed: u64) -> Setup {
    let mut random = Random::new(seed, 3);
    let hand = *random.one_of(&HANDS);
    let [round_trip_s, jitter_s, loss] = *random.one_of(&NETWORKS);
    let transport = *random.one_of(&[Transport::Stream, Transport::Datagram]);
    let outage_s = *random.one_of(&OUTAGES_S);
    let conditions = Conditions { transport, round_trip_s, jitter_s, loss, outage_s, ..setup.conditions };
    Setup { hand, conditions, seed, ..setup.clone() }
}

/// Returns the figures of a run, by name.
fn figures(setup: &Setup, outcome: &InstrumentOutcome) -> Map<String, Value> {
    let Conditions { transport, round_trip_s, jitter_s, loss, outage_s, .. } = setup.conditions;
    let limits: Map<String, Value> =
        outcome.limits.iter().map(|(name, count)| ((*name).to_owned(), json!(count))).collect();
    let figures = json!({
        "scene": setup.model.scene.name,
        "hand": setup.hand.name,
        "device": setup.device.name,
        "seed": setup.seed,
        "transport": transport.name(),
        "rtt_ms": 1e3 * round_trip_s,
        "jitter_ms": 1e3 * jitter_s,
        "loss": loss,
        "outage_ms": 1e3 * outage_s,
        "tips": outcome.tips,
        "force_error_percent": outcome.force_error_percent,
        "torque_error_percent": outcome.torque_error_percent,
        "true_force_max_n": outcome.true_force_max_n,
        "true_torque_max_n_m": outcome.true_torque_max_n_m,
        "energy_min_j": outcome.energy_min_j,
        "jump_max_n": outcome.jump_max_n,
        "true_jump_max_n": outcome.true_jump_max_n,
        "severed": outcome.severed,
        "true_severed": outcome.true_severed,
        "unstable_at_s": outcome.unstable_at_s,
        "predicted_ticks": outcome.predicted_ticks,
        "limited_ticks": limits,
    });
    match figures {
        Value::Object(figures) => figures,
        _ => Map::new(),
    }
}

fn rows(setup: &Setup, outcome: &InstrumentOutcome) -> Vec<(&'static str, String)> {
    let percent =
        |value: Option<f64>| value.map_or("no contact".to_owned(), |value| format!("{} %", table::rounded(value)));
    let limits: Vec<String> =
        outcome.limits.iter().filter(|limit| limit.1 > 0).map(|(name, count)| format!("{name} {count}")).collect();
    vec![
        ("scene", setup.model.scene.name.clone()),
        ("hand, device", format!("{}, {}", setup.hand.name, setup.device.name)),
        ("tips", outcome.tips.to_string()),
        ("error of the force", percent(outcome.force_error_percent)),
        ("error of the torque", percent(outcome.torque_error_percent)),
        ("largest true force", table::with_unit(outcome.true_force_max_n, "N")),
        ("largest true torque", table::with_unit(outcome.true_torque_max_n_m, "N·m")),
        ("least energy received", table::with_unit(outcome.energy_min_j, "J")),
        ("largest jump", table::with_unit(outcome.jump_max_n, "N")),
        ("largest true jump", table::with_unit(outcome.true_jump_max_n, "N")),
        ("severed, without network", format!("{}, {}", outcome.severed, outcome.true_severed)),
        ("unstable", outcome.unstable_at_s.map_or("never".to_owned(), |at_s| format!("at {at_s:.3} s"))),
        ("ticks from the copy", outcome.predicted_ticks.to_string()),
        ("ticks limited", if limits.is_empty() { "none".to_owned() } else { limits.join(", ") }),
    ]
}
