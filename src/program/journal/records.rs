//! `palpate journal replay`: simulates a journal again and writes records, as `palpate run` does.

use std::io::Write;
use std::path::PathBuf;

use palpate_refusal::{Reason, Refusal};
use palpate_session::Session;
use palpate_session::journal::{Replay, ReplayEvent};
use palpate_session::run::{header, summary};
use palpate_tissue::scene::record::{Line, Record, Run, Summary, write_line};
use palpate_tissue::shape::{PointId, PointName};

use super::super::client::client;
use super::super::{Failure, clock_s, say, with_progress};
use super::JournalSource;
use super::output::{output, written};

#[derive(clap::Args)]
pub(super) struct ReplayArguments {
    #[command(flatten)]
    source: JournalSource,
    /// Write the records here instead of to the standard output
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Number of steps between records
    #[arg(long, value_name = "STEPS", default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..))]
    every: u64,
    /// A point in the records: X,Y of a sheet, or the number of a vertex; may be repeated. Tools are always in them
    #[arg(long, value_name = "POINT")]
    point: Vec<PointName>,
    /// The first step [default: that of the journal]
    #[arg(long, value_name = "STEP")]
    from: Option<u64>,
    /// The last step [default: that of the journal]
    #[arg(long, value_name = "STEP")]
    to: Option<u64>,
    /// Play at this multiple of real time [default: as fast as possible; on a server in real time]
    #[arg(long, value_name = "FACTOR")]
    speed: Option<f64>,
    /// Send the journal to this server, play it there for viewers, and compare its hashes; with --output write the
    /// records that the server sends; `palpate-client play --help` shows more options
    #[arg(long, value_name = "URL", conflicts_with = "config")]
    server: Option<String>,
    /// Show no progress
    #[arg(short, long)]
    quiet: bool,
}

/// Records of a session that is replayed.
struct Recorder<'r> {
    points: Vec<PointId>,
    every: u64,
    from: u64,
    out: &'r mut dyn Write,
    written: std::io::Result<()>,
    newest: Option<u64>,
    largest_m: f64,
    peak_n: f64,
}

impl Recorder<'_> {
    fn see(&mut self, session: &Session) {
        let step = session.step_count();
        if step < self.from || !step.is_multiple_of(self.every) || self.newest == Some(step) || self.written.is_err() {
            return;
        }
        self.newest = Some(step);
        let (energy_j, tools) = (Some(session.energy()), session.tool_records());
        let record = Record { energy_j, tools, ..session.record(Some(&self.points)) };
        self.largest_m = self.largest_m.max(session.tissue().largest_displacement_m());
        self.peak_n = self.peak_n.max(record.peak_n(self.points.is_empty()));
        self.written = write_line(self.out, &record);
    }
}

/// Plays a journal on a server.
fn through_server(arguments: &ReplayArguments, url: &str) -> Result<(), Failure> {
    let mut passed = vec![arguments.source.file.clone().into_os_string(), "--server".into(), url.into()];
    let steps = |step: Option<u64>| step.map(|step| step.to_string());
    let speed = arguments.speed.map(|speed| speed.to_string());
    for (option, value) in [("--from", steps(arguments.from)), ("--to", steps(arguments.to)), ("--speed", speed)] {
        if let Some(value) = value {
            passed.extend([option.into(), value.into()]);
        }
    }
    for point in &arguments.point {
        let text = match point {
            PointName::Point([x, y]) => format!("{x},{y}"),
            PointName::Vertex(vertex) => vertex.to_string(),
        };
        passed.extend(["--point".into(), text.into()]);
    }
    if let Some(output) = &arguments.output {
        passed.extend(["--every".into(), arguments.every.to_string().into()]);
        passed.extend(["--output".into(), output.clone().into_os_string()]);
    }
    if arguments.quiet {
        passed.push("--quiet".into());
    }
    client("play", &passed)
}

/// Simulates a journal again and writes its records, or plays it on a server.
pub(super) fn replay(arguments: &ReplayArguments) -> Result<(), Failure> {
    if let Some(url) = &arguments.server {
        return through_server(arguments, url);
    }
    let ReplayArguments { source, every, from, to, speed, quiet, .. } = arguments;
    if let Some(speed) = speed.filter(|speed| !(1e-3..=1e6).contains(speed)) {
        return Err(Failure::Refused(format!("--speed: must be from 0.001 to 1000000, but is {speed}")));
    }
    let mut replay = source.replay(*from)?.stopping_every(*every);
    let (model, from) = (replay.session().model().clone(), from.unwrap_or(replay.session().step_count()));
    let to = to.unwrap_or(u64::MAX).min(replay.survey().until_step);
    if to < from {
        let refusal = Refusal::new(Reason::OutOfRange, "--to", format!("is {to}, before the step {from} to begin at"));
        return Err(refusal.into());
    }
    let points = arguments.point.iter().map(|name| model.shape().find("--point", *name));
    let points = points.collect::<Result<Vec<_>, Refusal>>()?;
    let mut out = output(arguments.output.as_deref())?;
    let script = source.file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let mut recorder = Recorder {
        points,
        every: *every,
        from,
        out: &mut *out,
        written: Ok(()),
        newest: None,
        largest_m: 0.0,
        peak_n: 0.0,
    };
    let run: Run = header(&model, &script);
    recorder.written = write_line(recorder.out, &Line::Run(&run));
    let begun_s = clock_s();
    let played =
        with_progress("step", to, *quiet, |progress| play(&mut replay, &mut recorder, from, to, *speed, progress));
    played?;
    let Recorder { written: result, largest_m, peak_n, .. } = recorder;
    let summary = Summary {
        recoveries: replay.session().recoveries().list(),
        largest_displacement_m: largest_m,
        peak_reaction_n: peak_n,
        ..summary(replay.session().tissue(), clock_s() - begun_s)
    };
    written(result.and_then(|()| write_line(&mut *out, &Line::Summary(&summary))).and_then(|()| out.flush()))?;
    match replay.difference() {
        Some(difference) => Err(Failure::Failed(format!("{}: {difference}", source.file.display()))),
        None => {
            if !quiet && arguments.output.is_some() {
                say!("steps {from} to {to}, final hash {}", summary.final_hash);
            }
            let survey = replay.survey();
            source.tell_damage(survey.damage.as_deref(), survey.until_step, arguments.to)
        }
    }
}

#[allow(clippy::cast_precision_loss)]
fn play(
    replay: &mut Replay<'_>,
    recorder: &mut Recorder<'_>,
    from: u64,
    to: u64,
    speed: Option<f64>,
    progress: &mut dyn FnMut(u64),
) -> Result<(), Failure> {
    let rate_hz = replay.first().scene.stepping.rate_hz;
    replay.advance(from, &mut |_| Ok(()))?;
    recorder.see(replay.session());
    let begun_s = clock_s();
    let advanced = replay.advance(to, &mut |seen| {
        let ReplayEvent::Step(session) = seen else { return Ok(()) };
        recorder.see(session);
        let step = session.step_count();
        if let Some(speed) = speed {
            let due_s = begun_s + step.saturating_sub(from) as f64 / (rate_hz * speed);
            let early_s = due_s - clock_s();
            if early_s > 0.001 {
                let _ = recorder.out.flush();
                std::thread::sleep(std::time::Duration::from_secs_f64(early_s));
            }
        }
        if step.is_multiple_of(1024) {
            progress(step);
        }
        Ok(())
    });
    Ok(advanced?)
}
