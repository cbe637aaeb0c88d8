//! `palpate journal export`: writes recorded values for other programs.

use std::io::Write;
use std::path::PathBuf;

use palpate_session::journal::pb;
use serde_json::json;

use super::super::{Failure, with_progress};
use super::output::{output, written};
use super::{JournalSource, foxglove};

#[derive(clap::Args)]
#[command(
    after_help = "jsonl and csv contain the values recorded while the session ran, without a simulation: place, \
    displacement and force of each tool, some 100 times a second. mcap simulates the journal again, for Foxglove: \
    curves of each tool and of the energies (palpate.journal.v1.ToolCurve, TissueCurve), and the points of the \
    tissue 30 times a second (foxglove.PointCloud, frame `tissue`)."
)]
pub(super) struct ExportArguments {
    #[command(flatten)]
    source: JournalSource,
    /// Output format
    #[arg(long, value_enum)]
    format: ExportFormat,
    /// Output file; required for mcap [default: the standard output]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum ExportFormat {
    /// One object per line
    Jsonl,
    /// One row per line, with names in the first line
    Csv,
    /// For Foxglove
    Mcap,
}

fn array(v: Option<pb::Vector>) -> [f32; 3] {
    v.map_or([0.0; 3], |v| [v.x, v.y, v.z])
}

/// Exports a journal.
pub(super) fn export(arguments: &ExportArguments) -> Result<(), Failure> {
    let ExportArguments { source, format, output: file } = arguments;
    if *format == ExportFormat::Mcap {
        let missing = || Failure::Refused("--output: is missing; mcap is written to a file".to_owned());
        return foxglove::export(source, file.as_deref().ok_or_else(missing)?);
    }
    let mut reader = source.open()?;
    let (length, rate_hz) = (reader.length(), reader.header().rate_hz);
    let mut out = output(file.as_deref())?;
    let result = match format {
        ExportFormat::Csv => writeln!(
            out,
            "step,time_s,tool,place_x_m,place_y_m,place_z_m,displacement_x_m,displacement_y_m,displacement_z_m,force_x_n,\
             force_y_n,force_z_n"
        ),
        ExportFormat::Jsonl | ExportFormat::Mcap => Ok(()),
    };
    type Written = (std::io::Result<()>, u64);
    let (result, until_step) = with_progress("byte", length, file.is_none(), |progress| -> Result<Written, Failure> {
        let mut result = result;
        let mut until_step = reader.header().begin_step;
        while let Some(batch) = reader.next_batch()?.filter(|_| result.is_ok()) {
            for moment in batch.felt()? {
                let rows = &mut moment.tools.iter();
                result =
                    result.and_then(|()| rows.try_for_each(|tool| row(&mut *out, *format, moment.step, rate_hz, tool)));
            }
            until_step = batch.until_step;
            progress(reader.position());
        }
        Ok((result, until_step))
    })?;
    written(result.and_then(|()| out.flush()))?;
    source.tell_damage(reader.damage(), until_step, None)
}

#[allow(clippy::cast_precision_loss)]
fn row(out: &mut dyn Write, format: ExportFormat, step: u64, rate_hz: f64, felt: &pb::FeltTool) -> std::io::Result<()> {
    let time_s = if rate_hz > 0.0 { step as f64 / rate_hz } else { 0.0 };
    let [place_m, displacement_m, force_n] = [felt.place_m, felt.displacement_m, felt.force_n].map(array);
    if format == ExportFormat::Jsonl {
        let line = json!({ "step": step, "time_s": time_s, "tool": felt.tool, "place_m": place_m,
            "displacement_m": displacement_m, "force_n": force_n });
        return writeln!(out, "{line}");
    }
    write!(out, "{step},{time_s},{}", felt.tool)?;
    [place_m, displacement_m, force_n].iter().flatten().try_for_each(|number| write!(out, ",{number}"))?;
    writeln!(out)
}
