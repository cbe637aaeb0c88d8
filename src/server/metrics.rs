//! The metrics for Prometheus: counts of the stepping threads, the current state of the sessions, and network
//! traffic. They name no session: a caller that knows a session's ID can use it.

use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::{fmt, io};

use axum::Router;
use axum::http::header;
use axum::routing::get;
use futures_util::stream::{Stream, StreamExt};
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, MetricEncoder, NoLabelSet, text};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::{Registry, Unit};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

use super::connections::{self, Connection, ConnectionSlots};
use super::fleet::{Fleet, Standing};
use super::job_pool::JobPool;
use super::journals::{Journals, KeeperTally};
use super::traffic::Traffic;
use palpate_realtime::thread_counters::{Count, ThreadCounters, Times};
use palpate_realtime::{Pacer, RunState};
use palpate_session::budget::{Budget, Purpose, Resource};
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::scene::record::AuditedError;

/// Creates the registry of all metrics. Their values are read when Prometheus requests them.
pub(super) fn registry(
    pacer: &Arc<Pacer>,
    traffic: &Traffic,
    job_pool: &JobPool,
    journals: Option<&Journals>,
    fleet: Option<Arc<Fleet>>,
) -> Registry {
    let mut registry = Registry::with_prefix("palpate");
    let connections = "Connections that are open";
    registry.register("connections", connections, traffic.connections.clone());
    registry.register("connected", "Connections so far", traffic.connected.clone());
    let failed = "Connections whose TLS handshake failed";
    registry.register("tls_handshakes_failed", failed, traffic.handshakes_failed.clone());
    let silent = "Connections that sent no request in time";
    registry.register("silent_connections", silent, traffic.silent.clone());
    let cuts = "Connections that a transport has cut, by side and reason (RFC 9113)";
    registry.register("transport_cuts", cuts, traffic.cuts.clone());
    let useless = "1 while the contents of these files are not in use: unreadable or invalid";
    registry.register("useless_files", useless, traffic.useless_files.clone());
    let (bytes_in, bytes_out) = (traffic.bytes_in.clone(), traffic.bytes_out.clone());
    registry.register_with_unit("received", "Data received from clients, before encryption", Unit::Bytes, bytes_in);
    registry.register_with_unit("sent", "Data sent to clients, before encryption", Unit::Bytes, bytes_out);
    registry.register("calls", "Calls that were admitted", traffic.calls.clone());
    registry.register("commands", "Commands to tools that were accepted", traffic.commands.clone());
    let sessions = "Datagram sessions that were accepted";
    registry.register("datagram_sessions", sessions, traffic.datagram_sessions.clone());
    let refused = "Datagram sessions that were refused: without a valid ticket, of another site, or too slow";
    registry.register("datagram_sessions_refused", refused, traffic.datagram_sessions_refused.clone());
    let refusals = "Calls and commands that were refused, by reason";
    registry.register("refusals", refusals, traffic.refusals.clone());
    registry.register_collector(Box::new(Stepping(pacer.clone())));
    registry.register_collector(Box::new(Heavy(job_pool.clone())));
    if let Some(journals) = journals {
        registry.register_collector(Box::new(JournalGauges(journals.tally.clone())));
    }
    if let Some(fleet) = fleet {
        registry.register_collector(Box::new(InFleet(move || fleet.standing())));
    }
    registry
}

/// The metrics of the server as a member of its fleet.
struct InFleet<F>(F);

impl<F> fmt::Debug for InFleet<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("InFleet")
    }
}

impl<F: Fn() -> Standing + Send + Sync + 'static> Collector for InFleet<F> {
    #[allow(clippy::cast_precision_loss)]
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let now = (self.0)();
        for (name, help, unit, value) in [
            ("acts", "1 while the server may step and answer for its sessions", None, f64::from(u8::from(now.acts))),
            ("fence", "Time that is left for this if etcd confirms nothing more", Some(&Unit::Seconds), now.to_fence_s),
            ("nodes", "Servers of the fleet that this one sees", None, now.nodes as f64),
            ("load", "Fraction of the stepping threads that its sessions use, 0 to 1", None, now.load),
            ("sessions", "Sessions that it owns", None, now.sessions as f64),
            ("sessions_without_standby", "Sessions that it owns and that have no standby server", None, {
                now.without_standby as f64
            }),
            ("unmirrored", "Bytes of its journals that are not on a second disk yet", Some(&Unit::Bytes), {
                now.unmirrored_bytes as f64
            }),
        ] {
            let gauge = ConstGauge::new(value);
            let name = format!("fleet_{name}");
            gauge.encode(encoder.encode_descriptor(&name, help, unit, MetricType::Gauge)?)?;
        }
        for (name, help, unit, count) in [
            ("mirrored", "Bytes of its journals copied to a second disk", Some(&Unit::Bytes), now.mirrored_bytes),
            ("taken_over", "Sessions whose owner was gone and that continue here", None, now.taken_over),
            ("moved", "Sessions that were moved from here to another server", None, now.moved),
            ("lost", "Sessions that another server had taken over when this one returned", None, now.lost),
        ] {
            let counter = ConstCounter::new(count);
            let name = format!("fleet_{name}");
            counter.encode(encoder.encode_descriptor(&name, help, unit, MetricType::Counter)?)?;
        }
        Ok(())
    }
}

/// The metrics of the journals.
#[derive(Debug)]
struct JournalGauges(Arc<KeeperTally>);

impl Collector for JournalGauges {
    #[allow(clippy::cast_precision_loss)]
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let KeeperTally { bytes, rounds, broken, lag_ns } = &*self.0;
        for (name, help, unit, count) in [
            ("journal_written", "Data written to journals", Some(&Unit::Bytes), bytes),
            ("journal_rounds", "How often written data was flushed to the disk", None, rounds),
            ("journal_broken", "Sessions whose journal can't be written any more", None, broken),
        ] {
            let counter = ConstCounter::new(count.load(Ordering::Relaxed));
            counter.encode(encoder.encode_descriptor(name, help, unit, MetricType::Counter)?)?;
        }
        let help = "Time from the newest event until it was on the disk, in the last flush";
        let lag = ConstGauge::new(lag_ns.load(Ordering::Relaxed) as f64 * 1e-9);
        lag.encode(encoder.encode_descriptor("journal_lag", help, Some(&Unit::Seconds), MetricType::Gauge)?)
    }
}

/// The metrics of the job pool.
struct Heavy(JobPool);

impl fmt::Debug for Heavy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Heavy")
    }
}

impl Collector for Heavy {
    #[allow(clippy::cast_precision_loss)]
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let load = self.0.load();
        let waiting = ConstGauge::new(load.waiting as f64);
        let help = "Jobs (creation of sessions, force laws) that wait for their turn";
        waiting.encode(encoder.encode_descriptor("job_pool_waiting", help, None, MetricType::Gauge)?)?;
        let (unit, help) = (Some(&Unit::Seconds), "Age of the oldest job that runs or waits");
        ConstGauge::new(load.oldest_s).encode(encoder.encode_descriptor(
            "job_pool_oldest",
            help,
            unit,
            MetricType::Gauge,
        )?)
    }
}

/// The metrics of the stepping threads and the sessions.
struct Stepping(Arc<Pacer>);

impl fmt::Debug for Stepping {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Stepping")
    }
}

/// The durations that all stepping threads measured, as one histogram.
struct Histogram {
    sum_s: f64,
    /// Upper bound of each bucket, s, and the number of durations within it and above the bound before.
    buckets: Vec<(f64, u64)>,
}

impl Histogram {
    fn of<'t>(mut times: impl Iterator<Item = &'t Times>) -> Self {
        let first = times.next().map_or_else(|| (0.0, Vec::new()), |times| (times.sum_s(), times.buckets()));
        let (sum_s, buckets) = times.fold(first, |(sum_s, mut buckets), times| {
            buckets.iter_mut().zip(times.buckets()).for_each(|(sum, more)| sum.1 += more.1);
            (sum_s + times.sum_s(), buckets)
        });
        Histogram { sum_s, buckets }
    }
}

impl EncodeMetric for Histogram {
    fn encode(&self, mut encoder: MetricEncoder<'_>) -> fmt::Result {
        let count = self.buckets.iter().map(|bucket| bucket.1).sum();
        encoder.encode_histogram::<NoLabelSet>(self.sum_s, count, &self.buckets, None)
    }

    fn metric_type(&self) -> MetricType {
        MetricType::Histogram
    }
}

/// Counters of the stepping threads: name, description, and how to read it.
type CounterTable = [(&'static str, &'static str, fn(&ThreadCounters) -> &Count); 11];

const COUNTS: CounterTable = [
    ("rested_steps", "Steps that were skipped because the tissue was at rest", |tally| &tally.rested_steps),
    ("overruns", "Steps that were due and dropped", |tally| &tally.overruns),
    ("late_commands", "Commands that arrived too late for their step", |tally| &tally.late_commands),
    ("paused_commands", "Commands without effect: their tool was paused after recoveries", |tally| {
        &tally.paused_commands
    }),
    ("lapsed_leases", "Leases of tools that expired", |tally| &tally.lapsed_leases),
    ("guard_events", "Returns of the guard to a checkpoint, or of a solid to its shape", |tally| &tally.guard_events),
    ("recoveries", "Returns of a tissue to an earlier state", |tally| &tally.recoveries),
    ("held_sessions", "Sessions stopped by an instability, a bug of the program or lack of memory", |tally| {
        &tally.held_sessions
    }),
    ("limited_steps", "Steps in which a tool was slowed to the speed limit", |tally| &tally.limited_steps),
    ("dropped_poses", "Poses that were not newer, or skipped as a backlog", |tally| &tally.dropped_poses),
    ("stale_releases", "Tools released because no poses arrived any more", |tally| &tally.stale_releases),
];

impl Collector for Stepping {
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_wrap)]
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let pacer = &self.0;
        let mut tell = |name: &str, help: &str, unit: Option<&Unit>, metric: &dyn EncodeMetric| {
            metric.encode(encoder.encode_descriptor(name, help, unit, metric.metric_type())?)
        };
        let step_time = Histogram::of(pacer.tallies().map(|tally| &tally.step_time));
        tell("step_time", "Duration of a step, with all messages that it sent", Some(&Unit::Seconds), &step_time)?;
        let lateness = Histogram::of(pacer.tallies().map(|tally| &tally.lateness));
        tell("step_lateness", "Delay of the start of a step after it was due", Some(&Unit::Seconds), &lateness)?;
        for (name, help, count) in COUNTS {
            let sum: u64 = pacer.tallies().map(|tally| count(tally).get()).sum();
            tell(name, help, None, &ConstCounter::new(sum))?;
        }

        let audits = pacer.audit_tally();
        for (name, help, count) in [
            ("audited_windows", "Windows (runs of steps) whose error was measured", &audits.windows),
            ("audited_windows_above_tolerance", "Measured windows with an error above tolerance", &audits.above),
            ("corrections", "Tissues that are stepped more accurately because of an audit", &audits.corrections),
        ] {
            tell(name, help, None, &ConstCounter::new(count.get()))?;
        }
        let busy_s = audits.busy_ns.get() as f64 * 1e-9;
        tell("audit_time", "Processor time of the auditor", Some(&Unit::Seconds), &ConstCounter::new(busy_s))?;

        let sessions = pacer.list();
        let statuses: Vec<_> = sessions.iter().map(|handle| handle.status()).collect();
        let mut states = encoder.encode_descriptor("sessions", "Sessions, by state", None, MetricType::Gauge)?;
        for (name, is) in [
            (
                "running",
                (|status| status.state == RunState::Running && !status.resting)
                    as fn(&palpate_realtime::Status) -> bool,
            ),
            ("resting", |status| status.state == RunState::Running && status.resting),
            ("paused", |status| status.state == RunState::Paused),
            ("held", |status| status.state == RunState::Held),
        ] {
            let count = statuses.iter().filter(|status| is(status)).count();
            states.encode_family(&[("state", name)])?.encode_gauge(&(count as i64))?;
        }
        let budget = &pacer.budget;
        let help = "Memory in use, by purpose";
        let mut taken = encoder.encode_descriptor("memory_taken", help, Some(&Unit::Bytes), MetricType::Gauge)?;
        for purpose in Purpose::ALL {
            let bytes = budget.bytes_for(purpose) as i64;
            taken.encode_family(&[("for", purpose.name())])?.encode_gauge(&bytes)?;
        }
        let mut gauge = |name: &str, help: &str, value: f64| {
            let gauge = ConstGauge::new(value);
            gauge.encode(encoder.encode_descriptor(name, help, None, MetricType::Gauge)?)
        };
        let points: usize = sessions.iter().map(|handle| handle.model.len()).sum();
        let awake: usize = statuses.iter().map(|status| status.awake_points).sum();
        let streams: usize = sessions.iter().map(|handle| handle.streams()).sum();
        gauge("memory_budget_bytes", "Memory available to callers", budget.bytes() as f64)?;
        gauge("callers", "Callers that are connected or own something", budget.accounts().len() as f64)?;
        gauge("held_tools", "Tools that are held", budget.taken(Resource::Leases) as f64)?;
        gauge("points", "Mass points of all sessions", points as f64)?;
        gauge("awake_points", "Mass points that the last steps of all sessions computed", awake as f64)?;
        gauge("streams", "Streams that read a session", streams as f64)?;
        gauge("viewers", "Streams of frames", pacer.viewers() as f64)?;
        let newest = sessions.iter().filter_map(|handle| handle.audited().newest);
        let worst = newest.map(|(_, error)| error).reduce(AuditedError::max).unwrap_or_default();
        let help = "Largest error of a displacement in the newest audits, relative to the largest";
        gauge("audited_displacement_error_max", help, worst.displacement)?;
        gauge("audited_force_error_max", "Largest relative error of a force in the newest audits", worst.force)?;
        let running = statuses.iter().filter(|status| status.state == RunState::Running);
        let slowest = running.map(|status| status.dilation.value).fold(1.0, f64::min);
        gauge("time_dilation_min", "Simulated over real time of the session that is furthest behind", slowest)
    }
}

/// Maximum number of connections to the metrics; a new one replaces the oldest.
pub(super) const SCRAPERS: usize = 16;

/// The connections to the metrics, as a listener.
struct Scrapers(SocketAddr, Pin<Box<dyn Stream<Item = io::Result<Connection>> + Send>>);

impl axum::serve::Listener for Scrapers {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        loop {
            match self.1.next().await {
                Some(Ok(connection)) => return (connection, self.0),
                Some(Err(_)) => {}
                None => std::future::pending().await,
            }
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.0)
    }
}

/// Serves the metrics on `listener` until `shutdown` is cancelled.
pub(super) async fn serve(
    listener: TcpListener,
    limits: &Limits,
    registry: Registry,
    shutdown: CancellationToken,
) -> io::Result<()> {
    // One request at a time: more would only slow each other down.
    let registry = Arc::new(Mutex::new(registry));
    let told = move || {
        let registry = registry.clone();
        async move {
            let mut body = String::new();
            let encoded = text::encode(&mut body, &lock(&registry));
            let kind = [(header::CONTENT_TYPE, "application/openmetrics-text; version=1.0.0; charset=utf-8")];
            encoded.map(|()| (kind, body)).map_err(|_| axum::http::StatusCode::INTERNAL_SERVER_ERROR)
        }
    };
    let limits = Limits { connections: SCRAPERS, connections_per_address: SCRAPERS, ..limits.clone() };
    let slots = Arc::new(ConnectionSlots::new(&limits, Some(SCRAPERS)));
    // The other metrics and budgets cover the server's clients; requests for metrics are not counted there.
    let budget = Budget::new(&limits, 1, 1);
    let address = listener.local_addr()?;
    let connections = connections::incoming(listener, None, slots, &limits, budget, Arc::default(), Arc::default());
    let router = Router::new().route("/metrics", get(told));
    let serving = axum::serve(Scrapers(address, Box::pin(connections)), router);
    serving.with_graceful_shutdown(shutdown.cancelled_owned()).await
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn the_dashboard_and_the_alerts_know_the_metrics_of_a_fleet() {
        let standing = || Standing {
            acts: true,
            to_fence_s: 2.5,
            nodes: 3,
            load: 0.25,
            sessions: 12,
            without_standby: 1,
            mirrored_bytes: 1 << 40,
            unmirrored_bytes: 7,
            taken_over: 2,
            moved: 3,
            lost: 4,
        };
        let mut registry = Registry::with_prefix("palpate");
        registry.register_collector(Box::new(InFleet(standing)));
        let mut told = String::new();
        text::encode(&mut told, &registry).unwrap();
        for line in ["palpate_fleet_acts 1.0", "palpate_fleet_fence_seconds 2.5", "palpate_fleet_lost_total 4"] {
            assert!(told.lines().any(|told| told == line), "{line} is not in {told}");
        }
        let is_part = |c: char| c.is_ascii_alphanumeric() || c == '_';
        let names = |text: &str| -> BTreeSet<String> {
            let found = text.split(|c| !is_part(c)).filter(|word| word.starts_with("palpate_fleet_"));
            found.map(str::to_owned).collect()
        };
        let samples = told.lines().filter(|line| !line.starts_with('#'));
        let there: BTreeSet<String> = samples.flat_map(&names).collect();
        assert_eq!(there, names(include_str!("../../contrib/grafana.json")));
        let alerted = names(include_str!("../../contrib/prometheus-rules.yaml"));
        assert!(alerted.len() > 4 && alerted.is_subset(&there), "{alerted:?} are not all of {there:?}");
    }
}
