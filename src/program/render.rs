//! `palpate render`: draws a tissue while a script acts on it.

use std::path::PathBuf;

use palpate::render::{self, Film, View};
use palpate_session::surface::Refinement;
use palpate_texture as texture;
use palpate_tissue::scene::collection::find_script;

use super::scene::{SceneArguments, compile};
use super::{Failure, say, with_progress, write_file};

#[derive(clap::Args)]
pub(crate) struct RenderArguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// A script file, or the name of one that is in ./scripts or built in: `press`, `stroke`, …
    script: PathBuf,
    /// The file to write: a .png of one moment, or a .gif of the whole script
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The moment to draw, s, rounded to a step [default: the sample time with the largest displacement]
    #[arg(long, value_name = "SECONDS")]
    at_s: Option<f64>,
    /// The moment to draw, as the number of steps done
    #[arg(long, value_name = "STEP", conflicts_with = "at_s")]
    at: Option<u64>,
    /// Show the mesh instead of the texture
    #[arg(long)]
    wireframe: bool,
    /// Vertices between neighbouring points, 0 to 10 [default: enough for 300 along a side; 0 with --wireframe]
    #[arg(long, value_name = "N")]
    refine: Option<u32>,
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

/// Draws a picture or a film of the whole script.
pub(crate) fn render(arguments: &RenderArguments) -> Result<(), Failure> {
    let refused = |option: &str, message: String| Failure::Refused(format!("--{option}: {message}"));
    let extension = arguments.output.extension().and_then(|extension| extension.to_str()).map(str::to_lowercase);
    let moves = match extension.as_deref() {
        Some("png") => false,
        Some("gif") => true,
        _ => return Err(refused("output", format!("{}: must end in .png or .gif", arguments.output.display()))),
    };
    let most = render::LARGEST_SIDE;
    let size = arguments.size.split_once('x').and_then(|(x, y)| Some([x.parse().ok()?, y.parse().ok()?]));
    let size = size.filter(|size| size.iter().all(|side| (16..=most).contains(side))).ok_or_else(|| {
        refused("size", format!("must be WIDTHxHEIGHT, each from 16 to {most} pixels, but is `{}`", arguments.size))
    })?;
    if !(1.0..=50.0).contains(&arguments.frames_hz) {
        return Err(refused("frames-hz", format!("must be from 1 to 50, but is {}", arguments.frames_hz)));
    }
    let (model, limits) = compile(&arguments.scene)?;
    let script = find_script(&arguments.script, &model.scene, &limits)?;
    for warning in model.warnings.iter().chain(&script.warnings) {
        say!("palpate: warning: {warning}");
    }
    let rate_hz = model.scene.stepping.rate_hz;
    let at_step = arguments.at_s.map(|at_s| {
        let step = (at_s * rate_hz).round();
        let holds = step >= 0.0 && step <= script.steps as f64;
        let lasts_s = script.steps as f64 / rate_hz;
        let message = format!("must be from 0 to {lasts_s}, the script's duration, but is {at_s}");
        if holds { Ok(step as u64) } else { Err(refused("at-s", message)) }
    });
    let in_steps = arguments.at.map(|step| {
        let message = format!("must be from 0 to {}, the script's duration in steps, but is {step}", script.steps);
        if step <= script.steps { Ok(step) } else { Err(refused("at", message)) }
    });
    let at_step = at_step.or(in_steps).transpose()?;
    if moves && at_step.is_some() {
        return Err(refused(
            if arguments.at.is_some() { "at" } else { "at-s" },
            "applies to a .png only: a .gif shows the whole script".to_owned(),
        ));
    }
    let camera = arguments.camera.parse()?;
    let fine = if arguments.wireframe { 0 } else { Refinement::for_picture(&model.scene) };
    let refinement = Refinement::new(&model.scene, arguments.refine.unwrap_or(fine), &limits)?;
    let skin = if arguments.wireframe { None } else { Some(texture::image(&model.scene.appearance, &limits)?) };
    let view = View { camera, size, refinement, texture: skin };
    if moves {
        let mut file = Vec::new();
        with_progress("step", script.steps, false, |progress| {
            render::gif(&model, &script, &view, &limits, arguments.frames_hz, &mut file, progress)
        })?;
        return write_file(&arguments.output, &file);
    }
    let mut film = Film::new(&model, &script, &limits)?;
    let still = match at_step {
        Some(step) => film.at(step),
        None => film.deepest(),
    };
    write_file(&arguments.output, &still?.picture(&model, &view).png()?)
}
