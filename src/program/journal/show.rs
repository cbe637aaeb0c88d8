//! `palpate journal show`: prints the events of a session as lines.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;

use palpate_haptics::TipShape;
use palpate_refusal::printable::{printable, printable_json};
use palpate_session::journal::replay::{JournalItem, items};
use palpate_session::journal::{JournalReader, pb};
use serde_json::{Value, json};

use super::super::Failure;
use super::output::{output, utc, written};

#[derive(clap::Args)]
pub(super) struct ShowArguments {
    /// The journal
    file: PathBuf,
    /// Show each command [default: one line for successive commands of one kind to one tool]
    #[arg(long)]
    all: bool,
    /// Write JSON Lines, with each command
    #[arg(long)]
    json: bool,
}

/// Successive commands of one kind to one tool.
struct CommandRow {
    kind: &'static str,
    from: u64,
    to: u64,
    count: u64,
}

struct ShownJournal<'a> {
    out: &'a mut dyn Write,
    rate_hz: f64,
    rows: BTreeMap<u32, CommandRow>,
}

impl ShownJournal<'_> {
    #[allow(clippy::cast_precision_loss)]
    fn line(&mut self, step: u64, text: &str) -> std::io::Result<()> {
        writeln!(self.out, "{:>12.3} s  step {step:<10} {}", step as f64 / self.rate_hz, printable(text))
    }

    fn json(&mut self, line: &Value) -> std::io::Result<()> {
        writeln!(self.out, "{}", printable_json(line))
    }

    /// Ends the row of a tool.
    fn end(&mut self, tool: u32) -> std::io::Result<()> {
        let Some(CommandRow { kind, from, to, count }) = self.rows.remove(&tool) else { return Ok(()) };
        let many = if count == 1 { String::new() } else { format!(", {count} times until step {to}") };
        self.line(from, &format!("tool {tool}: {kind}{many}"))
    }

    fn end_all(&mut self) -> std::io::Result<()> {
        let tools: Vec<u32> = self.rows.keys().copied().collect();
        tools.into_iter().try_for_each(|tool| self.end(tool))
    }

    fn command(&mut self, step: u64, command: &pb::Command, all: bool) -> std::io::Result<()> {
        let kind = kind(command);
        if all {
            let late = if command.late { ", late" } else { "" };
            let sequence = command.sequence.map(|sequence| format!(", sequence {sequence}")).unwrap_or_default();
            return self.line(step, &format!("tool {}: {}{sequence}{late}", command.tool, told(command)));
        }
        match self.rows.get_mut(&command.tool) {
            Some(row) if row.kind == kind => (row.to, row.count) = (step, row.count + 1),
            _ => {
                self.end(command.tool)?;
                self.rows.insert(command.tool, CommandRow { kind, from: step, to: step, count: 1 });
            }
        }
        Ok(())
    }
}

fn kind(command: &pb::Command) -> &'static str {
    use pb::command::Action;
    match &command.action {
        _ if command.ends_lease => "its lease ends",
        Some(Action::Push(_)) => "pushes",
        Some(Action::Grasp(_)) => "grasps",
        Some(Action::Pose(pose)) if pose.tip.is_some_and(|tip| tip.grasps) => "holds with its tip",
        Some(Action::Pose(_)) => "touches with its tip",
        Some(Action::Tie(tie)) if tie.bites.is_empty() => "cuts a thread or clip",
        Some(Action::Tie(tie)) if tie.length_m.is_some() => "leads a thread",
        Some(Action::Tie(_)) => "leads a clip",
        Some(Action::Mark(_)) => "marks a place",
        Some(Action::Release(_)) | None => "is released",
    }
}

fn told(command: &pb::Command) -> String {
    use pb::command::Action;
    let vector = |v: Option<palpate_session::journal::Vector3>| {
        v.map(|v| format!("({}, {}, {})", v.x, v.y, v.z)).unwrap_or_default()
    };
    let kind = kind(command);
    match &command.action {
        Some(Action::Push(push)) => format!("{kind} with {} N at {} m", vector(push.force_n), vector(push.centre_m)),
        Some(Action::Grasp(grasp)) => format!("{kind} point {} by {} m", grasp.point, vector(grasp.displacement_m)),
        Some(Action::Pose(pose)) => format!("{kind} at {} m", vector(pose.place_m)),
        Some(Action::Tie(tie)) => format!("{kind}, number {}", tie.number),
        Some(Action::Mark(mark)) => format!("{kind}: {} m", vector(mark.place_m)),
        Some(Action::Release(_)) | None => kind.to_owned(),
    }
}

fn tissue(tissue: &pb::Tissue) -> String {
    format!(
        "the tissue: k {} N/m, K″ {} N/m, C {} N·s/m; {} with {} substeps in {}",
        tissue.stiffness_n_per_m,
        tissue.anchor_stiffness_n_per_m,
        tissue.damping_n_s_per_m,
        tissue.integrator,
        tissue.substeps,
        tissue.precision
    )
}

fn input(input: &pb::Input) -> String {
    use pb::input::What;
    match &input.what {
        Some(What::Command(command)) => format!("tool {}: {}", command.tool, told(command)),
        Some(What::Tissue(changed)) => tissue(changed),
        Some(What::Start(start)) => match start.until_step {
            Some(until) => format!("time runs until step {until}"),
            None => "time runs".to_owned(),
        },
        Some(What::Pause(_)) => "time stops".to_owned(),
        Some(What::DroppedSteps(dropped)) => format!("{} late steps were dropped", dropped.steps),
        Some(What::Revive(_)) => "revived, at rest".to_owned(),
        Some(What::Hold(hold)) => format!("held: {}", hold.reason),
        Some(What::ExerciseResult(result)) => {
            let score = result.score_percent.map_or(String::new(), |percent| format!(", score {percent:.1} %"));
            format!("the exercise ended at step {}{score}", result.step)
        }
        Some(What::PhaseEnd(end)) => format!("phase {} of the exercise was ended", end.phase),
        None => "an input of a later version".to_owned(),
    }
}

/// Returns the kind of an input, for programs.
fn name(input: &pb::Input) -> &'static str {
    use pb::input::What;
    match &input.what {
        Some(What::Command(_)) => "command",
        Some(What::Tissue(_)) => "tissue",
        Some(What::Start(_)) => "start",
        Some(What::Pause(_)) => "pause",
        Some(What::DroppedSteps(_)) => "dropped_steps",
        Some(What::Revive(_)) => "revive",
        Some(What::Hold(_)) => "hold",
        Some(What::ExerciseResult(_)) => "exercise_result",
        Some(What::PhaseEnd(_)) => "phase_end",
        None => "unknown",
    }
}

fn vector(v: Option<palpate_session::journal::Vector3>) -> Value {
    v.map_or(Value::Null, |v| json!([v.x, v.y, v.z]))
}

fn in_json(input: &pb::Input) -> Value {
    use pb::command::Action;
    use pb::input::What;
    let mut line = json!({ "step": input.step, "input": name(input), "text": self::input(input) });
    if let Some(What::Command(command)) = &input.what {
        line["tool"] = command.tool.into();
        line["sequence"] = command.sequence.into();
        line["client_time_ns"] = command.client_time_ns.into();
        line["late"] = command.late.into();
        line["ends_lease"] = command.ends_lease.into();
        match &command.action {
            Some(Action::Push(push)) => {
                line["push"] = json!({ "point": push.point, "centre_m": vector(push.centre_m), "force_n": vector(push.force_n),
                    "falloff_per_m": push.falloff_per_m, "falloff_offset": push.falloff_offset });
            }
            Some(Action::Grasp(grasp)) => {
                line["grasp"] = json!({ "point": grasp.point, "displacement_m": vector(grasp.displacement_m) });
            }
            Some(Action::Pose(pose)) => {
                line["pose"] = json!({ "place_m": vector(pose.place_m), "velocity_m_per_s": vector(pose.velocity_m_per_s),
                    "shape": pose.tip.and_then(|tip| TipShape::ALL.get(tip.shape as usize)).map(|shape| shape.name()), "radius_m": pose.tip.map(|tip| tip.radius_m), "grasps": pose.tip.map(|tip| tip.grasps) });
            }
            Some(Action::Tie(tie)) => {
                let bites: Vec<Value> = tie
                    .bites
                    .iter()
                    .map(|bite| json!({ "place_m": vector(bite.place_m), "radius_m": bite.radius_m }))
                    .collect();
                line["tie"] = json!({ "number": tie.number, "bites": bites, "length_m": tie.length_m, "friction": tie.friction,
                    "strength_n": tie.strength_n });
            }
            Some(Action::Mark(mark)) => {
                line["mark"] = json!({ "place_m": vector(mark.place_m), "diameter_m": mark.diameter_m });
            }
            Some(Action::Release(_)) | None => {}
        }
    }
    line
}

/// Prints the events of a journal.
pub(super) fn show(arguments: &ShowArguments) -> Result<(), Failure> {
    let mut reader = JournalReader::open(&arguments.file)?;
    let mut out = output(None)?;
    let mut failed = None;
    let shown = write(arguments, &mut reader, &mut *out, &mut failed);
    written(shown.and_then(|()| out.flush()))?;
    failed.map_or(Ok(()), Err)
}

fn write(
    arguments: &ShowArguments,
    reader: &mut JournalReader<'_>,
    out: &mut dyn Write,
    failed: &mut Option<Failure>,
) -> std::io::Result<()> {
    let header = reader.header().clone();
    let scene = header.scene.as_ref().map(|scene| scene.name.clone()).unwrap_or_default();
    if arguments.json {
        let line = json!({ "session_id": header.session_id, "run": header.run, "version": header.version, "scene": scene,
            "owner": header.owner, "rate_hz": header.rate_hz, "begin_step": header.begin_step });
        writeln!(out, "{}", printable_json(line))?;
    } else {
        let pb::Header { run, rate_hz, begin_step, .. } = &header;
        let [session_id, owner, version] = [&header.session_id, &header.owner, &header.version].map(printable);
        let scene = printable(scene);
        writeln!(out, "session {session_id}, run {run}, of {owner}: {scene}, {rate_hz} Hz, from step {begin_step}")?;
        writeln!(out, "written by Palpate {version}")?;
    }
    let rate_hz = if header.rate_hz > 0.0 { header.rate_hz } else { 1.0 };
    let mut shown = ShownJournal { out, rate_hz, rows: BTreeMap::new() };
    let (mut last, mut waiting) = ((header.begin_step, 0, None), Vec::new());
    loop {
        let read = reader.next_batch().and_then(|batch| match batch {
            Some(batch) => {
                waiting = batch.waiting()?.map_or(std::mem::take(&mut waiting), |newest| newest.inputs);
                Ok(Some((items(&batch)?, batch.end()?, batch.until_step, batch.unix_ns)))
            }
            None => Ok(None),
        });
        let (items, end, until_step, unix_ns) = match read {
            Ok(Some(read)) => read,
            Ok(None) => break,
            Err(refusal) => {
                *failed = Some(refusal.into());
                break;
            }
        };
        for item in items {
            match item {
                JournalItem::Input(input) if arguments.json => shown.json(&in_json(&input))?,
                JournalItem::Hash(hash) if arguments.json => {
                    shown.json(&json!({ "step": hash.step, "hash": hash.hash }))?;
                }
                JournalItem::Snapshot(snapshot) if arguments.json => {
                    let pb::Snapshot { step, hash, saved, .. } = snapshot;
                    shown.json(&json!({ "step": step, "snapshot_bytes": saved.len(), "hash": hash }))?;
                }
                JournalItem::Input(input) => match &input.what {
                    Some(pb::input::What::Command(command)) => shown.command(input.step, command, arguments.all)?,
                    _ => {
                        shown.end_all()?;
                        shown.line(input.step, &self::input(&input))?;
                    }
                },
                JournalItem::Hash(hash) if arguments.all => shown.line(hash.step, &format!("hash {}", hash.hash))?,
                JournalItem::Hash(_) => {}
                JournalItem::Snapshot(snapshot) => {
                    shown.end_all()?;
                    let size = snapshot.saved.len();
                    shown.line(snapshot.step, &format!("snapshot, {size} bytes, hash {}", snapshot.hash))?;
                }
            }
        }
        last = (until_step, unix_ns, end.or(last.2));
    }
    shown.end_all()?;
    let (step, unix_ns, end) = last;
    waiting.retain(|input| input.step >= step);
    for input in &waiting {
        if arguments.json {
            shown.json(&json!({ "step": input.step, "waiting": name(input), "text": self::input(input) }))?;
        } else {
            shown.line(input.step, &format!("waits for this step at the end: {}", self::input(input)))?;
        }
    }
    let ended = end.as_ref().map_or("unfinished: a server writes it, or was killed".to_owned(), |end| {
        let why = end.why().as_str_name().trim_start_matches("WHY_").to_lowercase();
        format!("{why}: {}", end.message)
    });
    let torn = match reader.torn_bytes() {
        0 => String::new(),
        bytes => format!("; {bytes} bytes after it belong to no whole batch"),
    };
    if arguments.json {
        let line =
            json!({ "durable_step": step, "ended": ended, "torn_bytes": reader.torn_bytes(), "time": utc(unix_ns) });
        return shown.json(&line);
    }
    shown.line(step, &format!("end, {} UTC: {ended}{torn}", utc(unix_ns)))
}
