//! The scenes that a server knows by name: `NAME.toml` in its folder, and those built in.

use std::path::{Path, PathBuf};

use crate::limits::Limits;
use crate::pace::excerpt;
use crate::refusal::{Reason, Refusal, Result};
use crate::scene::{BUILT_IN, Scene};

/// Scenes by name.
#[derive(Debug, Clone)]
pub struct Catalog {
    folder: PathBuf,
}

impl Catalog {
    /// Those of `folder`, which may be missing.
    pub fn new(folder: &Path) -> Self {
        Catalog { folder: folder.to_owned() }
    }

    /// Every name, sorted.
    pub fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = BUILT_IN.iter().map(|scene| scene.0.to_owned()).collect();
        for entry in std::fs::read_dir(&self.folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.extension().is_some_and(|extension| extension == "toml")
                && let Some(name) = path.file_stem().and_then(|name| name.to_str())
                && is_name(name)
            {
                names.push(name.to_owned());
            }
        }
        names.sort_unstable();
        names.dedup();
        names
    }

    /// The scene of that name, with `--set` assignments over it. The folder's own goes before one built in.
    pub fn load(&self, name: &str, assignments: &[String], limits: &Limits) -> Result<Scene> {
        let path = self.folder.join(format!("{name}.toml"));
        if is_name(name) && path.is_file() {
            // Clients learn the file's name, not where the server keeps it.
            let file = format!("{name}.toml");
            let text = crate::scene::document::read_text(&path, limits.file_bytes)
                .map_err(|refusal| Refusal { place: Some(file.clone()), ..refusal })?;
            let scene = Scene::parse(&file, &text, assignments, limits)?;
            return Ok(scene.found_in(&self.folder));
        }
        match BUILT_IN.iter().find(|scene| scene.0 == name) {
            Some((_, text)) => Scene::parse(name, text, assignments, limits),
            None => {
                let (name, names) = (excerpt(name), self.names().join(", "));
                let message = format!("there is no scene `{name}`; there are {names}");
                Err(Refusal::new(Reason::UnknownScene, "scene_name", message))
            }
        }
    }
}

/// A plain word: nothing that could lead out of the folder.
fn is_name(name: &str) -> bool {
    !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_')
}
