//! `palpate journal render`: draws a picture or a film of a session.

use std::path::PathBuf;

use palpate::render::{self, Arrow, Gif, Still, View};
use palpate_session::Session;
use palpate_session::journal::{Replay, ReplayEvent};
use palpate_session::surface::{Refinement, Skin};
use palpate_texture as texture;

use super::super::{Failure, with_progress, write_file};
use super::JournalSource;

#[derive(clap::Args)]
pub(super) struct RenderArguments {
    #[command(flatten)]
    source: JournalSource,
    /// The file to write: a .png of one moment, or a .gif
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The moment to draw, as the number of steps done [default: that of the largest force on a tool]
    #[arg(long, value_name = "STEP")]
    at: Option<u64>,
    /// The first step of a film [default: that of the journal]
    #[arg(long, value_name = "STEP")]
    from: Option<u64>,
    /// The last step of a film [default: that of the journal]
    #[arg(long, value_name = "STEP")]
    to: Option<u64>,
    /// Show the mesh instead of the texture
    #[arg(long)]
    wireframe: bool,
    /// The camera: azimuth about the tissue's normal and elevation, degrees; distance, in sides of the sheet
    #[arg(long, value_name = "AZIMUTH,ELEVATION[,DISTANCE]", default_value = "25,32,2", allow_hyphen_values = true)]
    camera: String,
    /// Size of the image, pixels
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "800x600")]
    size: String,
    /// Images per second of a GIF
    #[arg(long, value_name = "HZ", default_value_t = 20.0)]
    frames_hz: f64,
}

/// Returns the tissue at the present step to draw, with an arrow for the force on each tool.
fn still(session: &Session, shown: Option<&std::sync::Arc<Skin>>) -> Still {
    let felt = session.felt().into_iter().filter(|felt| felt.force_n.length() > 0.0);
    let shape = session.model().shape();
    let arrow = |felt: palpate_session::input::Felt| Arrow {
        point: shape.nearest(felt.place_m - felt.displacement_m),
        towards: -felt.force_n,
    };
    Still::of(session, shown, felt.map(arrow).collect())
}

/// Returns the step of the largest recorded force on a tool.
fn strongest(source: &JournalSource) -> Result<u64, Failure> {
    let mut reader = source.open()?;
    let mut found = (0.0, reader.header().begin_step);
    while let Some(batch) = reader.next_batch()? {
        for moment in batch.felt()? {
            for force_n in moment.tools.iter().filter_map(|tool| tool.force_n) {
                let squared =
                    f64::from(force_n.x).powi(2) + f64::from(force_n.y).powi(2) + f64::from(force_n.z).powi(2);
                if squared > found.0 {
                    found = (squared, moment.step);
                }
            }
        }
        // A moment after the last whole step is not simulated.
        found.1 = found.1.min(batch.until_step);
    }
    Ok(found.1)
}

fn check(replay: &Replay<'_>, source: &JournalSource) -> Result<(), Failure> {
    let differs = replay.difference().map(|difference| format!("{}: {difference}", source.file.display()));
    differs.map_or(Ok(()), |message| Err(Failure::Failed(message)))
}

/// Draws a picture, or a film.
pub(super) fn render(arguments: &RenderArguments) -> Result<(), Failure> {
    let refused = |option: &str, message: String| Failure::Refused(format!("--{option}: {message}"));
    let RenderArguments { source, output, at, from, to, frames_hz, .. } = arguments;
    let extension = output.extension().and_then(|extension| extension.to_str()).map(str::to_lowercase);
    let moves = match extension.as_deref() {
        Some("png") => false,
        Some("gif") => true,
        _ => return Err(refused("output", format!("{}: must end in .png or .gif", output.display()))),
    };
    let most = render::LARGEST_SIDE;
    let size = arguments.size.split_once('x').and_then(|(x, y)| Some([x.parse().ok()?, y.parse().ok()?]));
    let size = size.filter(|size| size.iter().all(|side| (16..=most).contains(side))).ok_or_else(|| {
        refused("size", format!("must be WIDTHxHEIGHT, each from 16 to {most} pixels, but is `{}`", arguments.size))
    })?;
    if !(1.0..=50.0).contains(frames_hz) {
        return Err(refused("frames-hz", format!("must be from 1 to 50, but is {frames_hz}")));
    }
    let begin = if moves { *from } else { Some(at.map_or_else(|| strongest(source), Ok)?) };
    let mut replay = source.replay(begin)?;
    let (model, limits) = (replay.session().model().clone(), source.limits()?);
    let fine = if arguments.wireframe { 0 } else { Refinement::for_picture(&model.scene) };
    let refinement = Refinement::new(&model.scene, fine, &limits)?;
    let skin = if arguments.wireframe { None } else { Some(texture::image(&model.scene.appearance, &limits)?) };
    let view = View { camera: arguments.camera.parse()?, size, refinement, texture: skin };
    let shown = Skin::of(&model);
    let go_to = |replay: &mut Replay<'_>, step: u64| -> Result<(), Failure> {
        replay.advance(step, &mut |_: ReplayEvent<'_>| Ok(()))?;
        check(replay, source)
    };
    let begin = begin.unwrap_or_else(|| replay.session().step_count());
    go_to(&mut replay, begin)?;
    if !moves {
        let image = still(replay.session(), shown.as_ref()).picture(&model, &view);
        write_file(output, &image.png()?)?;
        let survey = replay.survey();
        return source.tell_damage(survey.damage.as_deref(), survey.until_step, *at);
    }
    let last = to.unwrap_or(u64::MAX).min(replay.survey().until_step);
    let mut file = Vec::new();
    let mut film = Gif::new(&mut file, &view, *frames_hz, model.scene.stepping.rate_hz)?;
    with_progress("step", last, false, |progress| -> Result<(), Failure> {
        for frame in 0.. {
            let step = begin.saturating_add(film.step(frame));
            if step > last {
                break;
            }
            go_to(&mut replay, step)?;
            film.add(&still(replay.session(), shown.as_ref()).picture(&model, &view))?;
            progress(step);
        }
        Ok(())
    })?;
    drop(film);
    write_file(output, &file)?;
    let survey = replay.survey();
    source.tell_damage(survey.damage.as_deref(), survey.until_step, *to)
}
