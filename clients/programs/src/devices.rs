//! `palpate-client devices`: lists devices, or tests the timing of one.

use std::path::PathBuf;
use std::time::Duration;

use palpate_client::devices::{DeviceReport, Found, check, list, open};
use palpate_client::{Error, HapticDevice};
use palpate_haptics::Device;
use palpate_refusal::printable::{printable, printable_json};
use serde_json::{Value, json};

use crate::{ClientFailure, table, within};

/// Arguments of `devices`.
#[derive(clap::Args)]
pub(crate) struct DevicesArguments {
    /// Read this device for some seconds, set no force, and report how well it keeps time
    #[arg(long, value_name = "NAME")]
    test: Option<String>,
    /// The maker's library, if it is not where the system looks for libraries
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
    /// Duration of the test, s
    #[arg(long, value_name = "SECONDS", default_value_t = 5.0, value_parser = seconds)]
    seconds: f64,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

fn seconds(text: &str) -> Result<f64, String> {
    within(text, 0.1..=3600.0)
}

/// Lists devices, or tests one.
///
/// # Errors
/// Returns an error if the device to test is missing or fails.
pub(crate) async fn devices(arguments: &DevicesArguments) -> Result<(), ClientFailure> {
    let (library, is_json) = (arguments.library.clone(), arguments.json);
    let Some(name) = arguments.test.clone() else {
        let found = tokio::task::spawn_blocking(move || list(library.as_deref())).await.unwrap_or_default();
        if is_json {
            crate::tell!("{}", printable_json(json!({ "devices": found.iter().map(one).collect::<Vec<_>>() })));
        } else {
            show(&found);
        }
        return Ok(());
    };
    let lasts = Duration::from_secs_f64(arguments.seconds);
    let tested = tokio::task::spawn_blocking({
        let name = name.clone();
        move || {
            let mut device = open(&name, library.as_deref())?;
            Ok::<_, Error>((device.descriptor(), check(&mut *device, lasts)))
        }
    });
    let (device, checked) = tested.await.map_err(|error| ClientFailure::Failed(error.to_string()))??;
    if is_json {
        crate::tell!("{}", printable_json(report(&name, &device, &checked)));
    } else {
        table::print(&rows(&device, &checked));
    }
    match &checked.failure {
        Some(why) => Err(ClientFailure::Failed(format!("{name}: {why}"))),
        None if checked.not_finite > 0 => Err(ClientFailure::Failed(format!("{name}: positions are not finite"))),
        None => Ok(()),
    }
}

fn one(found: &Found) -> Value {
    json!({ "name": found.name, "is_there": found.is_there, "about": found.about })
}

fn show(found: &[Found]) {
    let width = found.iter().map(|found| found.name.chars().count()).max().unwrap_or(0);
    for Found { name, is_there, about } in found {
        crate::tell!("{} {:<width$}  {}", if *is_there { "+" } else { "-" }, printable(name), printable(about));
    }
    crate::tell!("\n`palpate-client devices --test NAME` reads one for 5 s; `bridge --device NAME` touches with it.");
}

fn report(name: &str, device: &Device, checked: &DeviceReport) -> Value {
    let micros = |[p50, p99, max]: [f64; 3]| json!({ "p50": 1e6 * p50, "p99": 1e6 * p99, "max": 1e6 * max });
    json!({
        "name": name, "model": device.name, "force_n": device.force_n, "continuous_n": device.continuous_n,
        "stiffness_n_per_m": device.stiffness_n_per_m, "damping_n_s_per_m": device.damping_n_s_per_m,
        "workspace_m": device.workspace_m, "ticks": checked.ticks, "rate_hz": checked.rate_hz,
        "changes_hz": checked.changes_hz, "period_us": micros(checked.period_s), "call_us": micros(checked.call_s),
        "place_m": checked.place_m.map(|corners| corners.map(|corner| corner.to_array())), "buttons": checked.buttons,
        "not_finite": checked.not_finite, "failure": checked.failure,
    })
}

fn rows(device: &Device, checked: &DeviceReport) -> Vec<(&'static str, String)> {
    let micros = |[p50, p99, max]: [f64; 3]| format!("{:.0} / {:.0} / {:.0} µs", 1e6 * p50, 1e6 * p99, 1e6 * max);
    let place = checked.place_m.map(|corners| {
        let [least, most] = corners.map(|corner| 1e3 * corner);
        format!("{:.1} to {:.1}, {:.1} to {:.1}, {:.1} to {:.1} mm", least.x, most.x, least.y, most.y, least.z, most.z)
    });
    let pressed: Vec<String> =
        (0..u32::BITS).filter(|bit| checked.buttons >> bit & 1 != 0).map(|bit| format!("number {bit}")).collect();
    vec![
        ("model", device.name.to_owned()),
        ("largest force", format!("{} N, {} N for long", device.force_n, device.continuous_n)),
        ("largest stiffness", format!("{:.0} N/m", device.stiffness_n_per_m)),
        ("workspace", format!("{:.0} mm about its middle", 1e3 * device.workspace_m)),
        ("ticks", format!("{}, {:.0} a second", checked.ticks, checked.rate_hz)),
        ("positions that changed", format!("{:.0} a second", checked.changes_hz)),
        ("x, y and z", place.unwrap_or_else(|| "none".to_owned())),
        ("buttons pressed, from 0", if pressed.is_empty() { "none".to_owned() } else { pressed.join(", ") }),
        ("                        p50 / p99 / max", String::new()),
        ("between ticks", micros(checked.period_s)),
        ("in the device's calls", micros(checked.call_s)),
    ]
}
