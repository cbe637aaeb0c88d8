//! The scene argument of several subcommands.

use std::path::PathBuf;
use std::sync::Arc;

use palpate_refusal::Refusal;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::collection::{find_scene, scene_text};

use super::{Failure, load_config};

#[derive(clap::Args)]
pub(crate) struct SceneArguments {
    /// A scene file, or the name of one that is in --scenes or built in: `liver`, `liver-organ`, `paper`, …
    scene: PathBuf,
    /// Folder of the scenes that you can give by name
    #[arg(long, value_name = "DIR", default_value = "scenes")]
    scenes: PathBuf,
    /// Override a key of the scene: a TOML value, or a bare string; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Configuration file (TOML) with other limits, in a section [limits]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

impl SceneArguments {
    /// Returns the scene's name in refusals, its text, and the folder of the files that it names.
    pub(super) fn text(&self, limits: &Limits) -> Result<(String, String, PathBuf), Refusal> {
        scene_text(&self.scene, &self.scenes, limits)
    }

    /// Returns the values of `--set`, in their order.
    pub(super) fn assignments(&self) -> &[String] {
        &self.set
    }
}

/// Compiles the scene that the arguments name; returns it with the limits in force.
pub(super) fn compile(arguments: &SceneArguments) -> Result<(Arc<Model>, Limits), Failure> {
    compile_with(arguments, &[])
}

/// Compiles the scene that the arguments name with further keys overridden, `KEY=VALUE` each. Returns it with the
/// limits in force.
pub(super) fn compile_with(arguments: &SceneArguments, further: &[String]) -> Result<(Arc<Model>, Limits), Failure> {
    let limits = load_config(arguments.config.as_deref())?.limits.offline();
    let path = &arguments.scene;
    let scene = find_scene(path, &arguments.scenes, &[&arguments.set, further].concat(), &limits)?;
    // An error of compilation has no line.
    let in_scene = |refusal: Refusal| Refusal { place: Some(path.display().to_string()), ..refusal };
    Ok((Model::compile(&scene, &limits).map_err(in_scene)?, limits))
}
