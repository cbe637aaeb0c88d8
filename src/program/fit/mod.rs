//! `palpate fit`: measured curves of force over depth become a scene.

mod plot;
mod report;

use std::io::{ErrorKind, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use palpate_fitting::curve_file::{MeasuredCurve, UsualTip, read_curves};
use palpate_fitting::fit::{Fit, fit};
use palpate_fitting::options::{FitOptions, FitProgress};
use palpate_fitting::scene_text::{rounded, with_values};
use palpate_haptics::TipShape;
use palpate_refusal::printable::printable;
use palpate_refusal::{Reason, Refusal, positive};
use palpate_tissue::Model;
use palpate_tissue::files;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::tissue_parameter::TissueParameter;
use palpate_tissue::scene::{Named, Scene};
use report::FitReport;

use super::scene::{SceneArguments, compile};
use super::{Failure, clock_s, say, write_file};

/// Lines of the head of a table that a fitted scene quotes, and their length, characters.
const SOURCE_LINES: usize = 10;
const SOURCE_CHARACTERS: usize = 200;

#[derive(clap::Args)]
pub(crate) struct FitArguments {
    /// The curves: a CSV file with the columns time_s, depth_m and force_n, also in other units, and optionally curve, tip,
    /// tip_radius_m, place_x_m, place_y_m and place_z_m
    curves: PathBuf,
    #[command(flatten)]
    scene: SceneArguments,
    /// A parameter to fit, by its key in the scene, such as material.youngs_modulus_pa; may be repeated. Default: all that the
    /// scene has and the curves can tell
    #[arg(long = "parameter", value_name = "KEY")]
    parameters: Vec<String>,
    /// The tip of a table without a column `tip`: disc (an even pressure), rigid (a rigid disc) or sphere; the last two need a
    /// solid
    #[arg(long, value_name = "SHAPE", default_value = "disc")]
    tip: TipShape,
    /// The radius of the tip of a table without a column `tip_radius_m`, mm
    #[arg(long, value_name = "MM", default_value = "5")]
    radius_mm: f64,
    /// Write the scene with the fitted values here
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
    /// Draw measured and fitted curves, and the residuals, as SVG
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Threads of the runs. Default: as many as there are processors. Without effect on the result
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Show no progress
    #[arg(short, long)]
    quiet: bool,
}

/// Fits the parameters of a scene to curves; prints them, and writes the scene.
pub(crate) fn fit_curves(arguments: &FitArguments) -> Result<(), Failure> {
    let named = |name: &String| TissueParameter::named("--parameter", name);
    let parameters = arguments.parameters.iter().map(named).collect::<Result<Vec<_>, Refusal>>()?;
    let usual = UsualTip { shape: arguments.tip, radius_m: 1e-3 * positive("--radius-mm", arguments.radius_mm)? };
    let threads = match arguments.threads {
        Some(0) => return Err(Refusal::new(Reason::OutOfRange, "--threads", "must be 1 or more").into()),
        Some(threads) => threads,
        None => std::thread::available_parallelism().map_or(1, usize::from),
    };
    let (model, limits) = compile(&arguments.scene)?;
    let table = files::read_text(&arguments.curves, limits.trace_bytes)?;
    let curves = read_curves(&arguments.curves.display().to_string(), &table, usual)?;
    model.warnings.iter().for_each(|warning| say!("palpate: warning: {warning}"));
    let options = FitOptions { parameters: &parameters, threads, limits: &limits, stop: &AtomicBool::new(false) };
    let begun_s = clock_s();
    let fitted = with_fit_progress(arguments.quiet, |progress| fit(&model, &curves, &options, progress))?;
    fitted.warnings.iter().for_each(|warning| say!("palpate: warning: {warning}"));
    let report = FitReport::new(&model.scene.name, &curves, &fitted, clock_s() - begun_s);
    // First: a fit takes minutes, and a file that can't be written must not take its result away.
    let text = if arguments.json { report.json()? } else { report.to_string() };
    match std::io::stdout().write_all(text.as_bytes()) {
        // A reader that closed the pipe is not an error.
        Err(e) if e.kind() != ErrorKind::BrokenPipe => return Err(Failure::Failed(e.to_string())),
        _ => {}
    }
    if let Some(path) = &arguments.output {
        write_file(path, scene_text(arguments, path, &table, &curves, &fitted, &limits)?.as_bytes())?;
    }
    if let Some(path) = &arguments.plot {
        write_file(path, plot::svg(&curves, &fitted.fitted_n).as_bytes())?;
    }
    Ok(())
}

/// Runs a fit and, unless `quiet`, shows on a terminal how far it is.
fn with_fit_progress<T>(quiet: bool, work: impl FnOnce(&mut dyn FnMut(FitProgress)) -> T) -> T {
    let (begun_s, watched) = (clock_s(), !quiet && std::io::stderr().is_terminal());
    let done = work(&mut |FitProgress { runs, rms_n }| {
        if watched && clock_s() - begun_s > 1.0 {
            let residual = rms_n.map_or_else(String::new, |rms_n| format!(", residual {rms_n:.3e} N"));
            eprint!("\rrun {runs}{residual}   ");
        }
    });
    if watched && clock_s() - begun_s > 1.0 {
        say!("");
    }
    done
}

/// Returns the text of the scene with the fitted values, with where they come from at its beginning. It is read again: a scene that
/// names files by paths from its folder has to stay there.
fn scene_text(
    arguments: &FitArguments,
    path: &Path,
    table: &str,
    curves: &[MeasuredCurve],
    fitted: &Fit,
    limits: &Limits,
) -> Result<String, Failure> {
    let samples: usize = curves.iter().map(|curve| curve.force_n.len()).sum();
    let mut head = vec![format!(
        "Fitted to {} ({} {}, {samples} samples) by palpate {}: residual {:.3e} N, {:.2} % of the largest force; R² {:.5}.",
        printable(arguments.curves.display()),
        curves.len(),
        if curves.len() == 1 { "curve" } else { "curves" },
        env!("CARGO_PKG_VERSION"),
        fitted.residual.rms_n,
        100.0 * fitted.residual.relative_rms,
        fitted.residual.r_squared
    )];
    let source = table
        .trim_start_matches('\u{feff}')
        .lines()
        .map(str::trim)
        .take_while(|line| line.is_empty() || line.starts_with('#'));
    let source = source.filter_map(|line| line.strip_prefix('#')).take(SOURCE_LINES);
    head.extend(
        source.map(|line| {
            format!("Curves: {}", printable(line.trim().chars().take(SOURCE_CHARACTERS).collect::<String>()))
        }),
    );
    for found in &fitted.parameters {
        let [value, low, high] = [found.value, found.interval[0], found.interval[1]].map(rounded);
        let (name, unit, start) = (found.parameter.name(), found.parameter.unit(), rounded(found.start));
        head.push(format!("{name}: {value} {unit}, 95 % interval {low} to {high}; before: {start}."));
    }
    let (name, text, _) = arguments.scene.text(limits)?;
    let parameters: Vec<TissueParameter> = fitted.parameters.iter().map(|found| found.parameter).collect();
    let text = with_values(&text, arguments.scene.assignments(), &fitted.scene, &parameters, &head)
        .map_err(|refusal| Refusal { place: Some(name), ..refusal })?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let read = Scene::parse_in(folder, &path.display().to_string(), &text, &[], limits).map_err(|refusal| {
        let message = format!("the fitted scene can't be read there, so it was not written: {refusal}");
        Refusal::new(refusal.reason, "--output", message)
    })?;
    // The compiler of the scene has the last word.
    Model::compile(&read, limits)?;
    Ok(text)
}
