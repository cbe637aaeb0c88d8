//! Scenes by name or from files, as a server takes them.

use std::path::Path;

use palpate::limits::Limits;
use palpate::scene::Scene;
use palpate::wire;
use palpate_proto::pb::create_session_request::Source;
use palpate_proto::refusal::Reason;

use crate::Failure;

/// The scene of a session: one of the server's by its name, or the contents of a file that ends in .toml.
///
/// # Errors
/// Returns an error if the file can't be read, or if its scene is invalid.
pub(crate) fn source(scene: &str) -> Result<Source, Failure> {
    if Path::new(scene).extension().is_none_or(|extension| extension != "toml") {
        return Ok(Source::SceneName(scene.to_owned()));
    }
    let file = scene;
    let scene = Scene::load(Path::new(file), &[], &Limits::default())?;
    if scene.shape().dimensions() > 2 {
        let message = "is on a mesh: a server can't make a session of one yet, `palpate run` runs it offline";
        return Err(Failure::Refused(format!("{file}: {message}")));
    }
    Ok(Source::Scene(wire::scene::scene(&scene)))
}

/// The failure of a session with this scene. If the server does not know the name, it may be meant as a file: the message
/// says how to give one.
pub(crate) fn with_hint(scene: &str, failure: Failure) -> Failure {
    let file = format!("{scene}.toml");
    match failure {
        Failure::Refused(why) if why.contains(Reason::UnknownScene.as_str()) => {
            let hint = if Path::new(&file).is_file() {
                format!("did you mean the file `{file}`?")
            } else {
                "give your own scene by its path, --scene FILE.toml".to_owned()
            };
            Failure::Refused(format!("{why}; {hint}"))
        }
        failure => failure,
    }
}
