//! Output of a run's figures: a table for people, and JSON.

use palpate_haptics::datagram_health::Carried;
use palpate_simulated::network::Conditions;
use serde_json::{Value, json};

use super::measure::LinkOutcome;
use super::setup::{Rendering, Setup};
use crate::table;

/// Returns the figures of a run as rows of a table; `server` is the server of a run in real time.
pub(super) fn rows(setup: &Setup, outcome: &LinkOutcome, server: Option<&str>) -> Vec<(&'static str, String)> {
    let (scene, hand, device) = (&setup.model.scene.name, setup.hand.name, setup.device.name);
    let scheme = format!("{:?}", setup.scheme).to_lowercase();
    let Conditions { transport, round_trip_s, jitter_s, loss, burst, outage_s, rate_bit_per_s, queue_s } =
        setup.conditions;
    let network = match server {
        Some(url) => format!("the real one, to {url}"),
        None => {
            let [round_trip, jitter] = [round_trip_s, jitter_s].map(|time_s| table::rounded(1e3 * time_s));
            let mut text = format!(
                "{}, {round_trip} ms round trip, ± {jitter} ms each way, {} lost",
                transport.name(),
                table::percent(loss)
            );
            if burst > 1.0 {
                text += &format!(", {} in a row", table::rounded(burst));
            }
            if outage_s > 0.0 {
                text += &format!(", an outage of {} ms once a second", table::rounded(1e3 * outage_s));
            }
            if rate_bit_per_s > 0.0 {
                let [rate, queue] = [1e-3 * rate_bit_per_s, 1e3 * queue_s].map(table::rounded);
                text += &format!(", {rate} kbit/s each way with a queue of {queue} ms");
            }
            text
        }
    };
    let unstable =
        outcome.unstable_at_s.map_or("no".to_owned(), |at_s| format!("yes, after {} s", table::rounded(at_s)));
    let or_none = |value: Option<f64>, show: &dyn Fn(f64) -> String| value.map_or("none".to_owned(), show);
    let [limited, dropped, released] = outcome.path;
    let mut rows = vec![
        ("scene", format!("{scene}, {hand} hand, device {device}, rendering {scheme}")),
        ("network", network),
        ("duration", format!("{} s, seed {}", table::rounded(setup.duration_s), setup.seed)),
        ("depths of the task", format!("{} of the whole", table::percent(outcome.scale))),
        (
            "force error",
            format!(
                "{} rms, {} in the 99th percentile",
                or_none(outcome.force_error_rms_percent, &|error| format!("{} %", table::rounded(error))),
                table::with_unit(outcome.force_error_p99_n, "N")
            ),
        ),
        (
            "along the normal",
            format!(
                "{} off in the mean, gain {}",
                or_none(outcome.force_bias_n, &|bias_n| table::with_unit(bias_n, "N")),
                or_none(outcome.force_gain, &table::rounded)
            ),
        ),
        (
            "depth",
            format!(
                "{} rms ({} of it), {} in the 99th percentile from that of a hand without a network",
                or_none(outcome.depth_error_rms_m, &|error_m| table::with_unit(error_m, "m")),
                or_none(outcome.depth_error_percent, &|percent| format!("{} %", table::rounded(percent))),
                or_none(outcome.depth_error_p99_m, &|error_m| table::with_unit(error_m, "m"))
            ),
        ),
        (
            "largest force",
            format!(
                "{} rendered, {} true",
                table::with_unit(outcome.force_max_n, "N"),
                table::with_unit(outcome.true_force_max_n, "N")
            ),
        ),
        ("force rendered", format!("{} of the true one", or_none(outcome.rendered_share, &table::percent))),
        ("largest jump", format!("{} in a tick", table::with_unit(outcome.jump_max_n, "N"))),
        (
            "least energy at the port",
            format!("{} (below 0: it gave some)", table::with_unit(outcome.energy_min_j, "J")),
        ),
        ("passivity acted", format!("in {} of the ticks in contact", table::percent(outcome.guard_share))),
        ("unstable", unstable),
        ("pauses, faults", format!("{}, {}", outcome.pauses, outcome.faults)),
        (
            "samples",
            format!(
                "{} a second, {} kbit/s",
                table::rounded(outcome.packets_per_s),
                table::rounded(outcome.kbit_per_s)
            ),
        ),
        ("commands", format!("{} a second", table::rounded(outcome.commands_per_s))),
        (
            "age of the model",
            or_none(outcome.model_age_ms_p99, &|age_ms| {
                format!("{} ms in the 99th percentile", table::rounded(age_ms))
            }),
        ),
        (
            "path of the tool",
            format!("{limited} steps at the speed limit, {dropped} commands dropped, {released} releases"),
        ),
        ("limits that acted", table::acted(outcome.interventions.iter().copied())),
    ];
    if setup.stall_s > 0.0 {
        rows.insert(2, ("stalls of the client", format!("{} ms once a second", table::rounded(1e3 * setup.stall_s))));
    }
    if setup.up_deadband > 0.0 {
        rows.insert(2, ("deadband of poses", table::percent(setup.up_deadband)));
    }
    if setup.deadband > 0.0 {
        rows.insert(2, ("deadband", table::percent(setup.deadband)));
    }
    if setup.second_m > 0.0 {
        let (away, hand) = (table::with_unit(setup.second_m, "m"), setup.second_hand.name());
        rows.insert(2, ("second tool", format!("{away} away, {hand} hand")));
    }
    if let Some(change) = &setup.change {
        let [at_s, factor] = [change.at_s, change.factor].map(table::rounded);
        rows.insert(2, ("change of the tissue", format!("after {at_s} s, {factor} times as stiff")));
    }
    if let Some(percent) = outcome.force_error_after_outages_percent {
        let share = table::percent(outcome.after_outages_share.unwrap_or(0.0));
        let row = format!("{} % rms from 50 ms after each on ({share} of the ticks)", table::rounded(percent));
        rows.push(("force error without outages", row));
    }
    if setup.conditions.rate_bit_per_s > 0.0 {
        rows.push(("dropped by the queues", outcome.overflowed.to_string()));
    }
    if setup.scheme == Rendering::Prediction {
        rows.push(("from the copy of the tissue", format!("{} ticks", outcome.predicted_ticks)));
    }
    if let Some(late) = outcome.late_ticks {
        rows.push(("late ticks", late.to_string()));
    }
    if let Some(Carried { sent, came, fell_back }) = outcome.carried {
        rows.push(("datagrams", format!("{sent} up, {came} down; the stream took over {fell_back} times")));
    }
    rows
}

/// Returns the figures of a run as JSON: its parameters and its results.
pub(super) fn figures(setup: &Setup, outcome: &LinkOutcome) -> Value {
    let (Value::Object(mut all), Value::Object(found)) = (asked(setup), found(outcome)) else { return Value::Null };
    all.extend(found);
    if let Some(Carried { sent, came, fell_back }) = outcome.carried {
        let carried = [("datagrams_up", sent), ("datagrams_down", came), ("fell_back", fell_back)];
        all.extend(carried.map(|(name, count)| (name.to_owned(), json!(count))));
    }
    Value::Object(all)
}

fn asked(setup: &Setup) -> Value {
    json!({
        "scene": setup.model.scene.name,
        "hand": setup.hand.name,
        "device": setup.device.name,
        "scheme": format!("{:?}", setup.scheme).to_lowercase(),
        "rtt_ms": 1e3 * setup.conditions.round_trip_s,
        "jitter_ms": 1e3 * setup.conditions.jitter_s,
        "loss": setup.conditions.loss,
        "transport": setup.conditions.transport.name(),
        "loss_burst": setup.conditions.burst,
        "outage_ms": 1e3 * setup.conditions.outage_s,
        "bandwidth_kbit": 1e-3 * setup.conditions.rate_bit_per_s,
        "queue_ms": 1e3 * setup.conditions.queue_s,
        "stall_ms": 1e3 * setup.stall_s,
        "deadband": setup.deadband,
        "up_deadband": setup.up_deadband,
        "seconds": setup.duration_s,
        "seed": setup.seed,
        "second_tool_mm": 1e3 * setup.second_m,
        "second_hand": setup.second_hand.name(),
        "tissue_change_s": setup.change.as_ref().map(|change| change.at_s),
        "tissue_change_factor": setup.change.as_ref().map(|change| change.factor),
        "place_m": setup.spot.at_m.to_array(),
    })
}

fn found(outcome: &LinkOutcome) -> Value {
    let interventions: serde_json::Map<String, Value> =
        outcome.interventions.iter().map(|(name, ticks)| ((*name).to_owned(), json!(ticks))).collect();
    let [limited, dropped, released] = outcome.path;
    json!({
        "scale": outcome.scale,
        "force_error_rms_percent": outcome.force_error_rms_percent,
        "force_error_after_outages_percent": outcome.force_error_after_outages_percent,
        "after_outages_share": outcome.after_outages_share,
        "force_bias_n": outcome.force_bias_n,
        "force_gain": outcome.force_gain,
        "depth_error_rms_m": outcome.depth_error_rms_m,
        "depth_error_p99_m": outcome.depth_error_p99_m,
        "depth_error_percent": outcome.depth_error_percent,
        "force_error_p99_n": outcome.force_error_p99_n,
        "energy_min_j": outcome.energy_min_j,
        "jump_max_n": outcome.jump_max_n,
        "guard_share": outcome.guard_share,
        "rendered_share": outcome.rendered_share,
        "packets_per_s": outcome.packets_per_s,
        "kbit_per_s": outcome.kbit_per_s,
        "overflowed": outcome.overflowed,
        "model_age_ms_p99": outcome.model_age_ms_p99,
        "peak_ratio": outcome.peak_ratio,
        "unstable": outcome.unstable_at_s.is_some(),
        "unstable_at_s": outcome.unstable_at_s,
        "true_force_max_n": outcome.true_force_max_n,
        "force_max_n": outcome.force_max_n,
        "pauses": outcome.pauses,
        "faults": outcome.faults,
        "commands_per_s": outcome.commands_per_s,
        "speed_limited_steps": limited,
        "commands_dropped": dropped,
        "releases": released,
        "interventions_ticks": interventions,
        "predicted_ticks": outcome.predicted_ticks,
        "late_ticks": outcome.late_ticks,
    })
}
