//! The scenes and scripts that a server knows by name: `NAME.toml` in its folders, and those built in.

use std::path::{Path, PathBuf};

use crate::limits::Limits;
use crate::pace::excerpt;
use crate::refusal::{Reason, Refusal, Result};
use crate::scene::document::read_text;
use crate::scene::script::{self, Script};
use crate::scene::{self, Scene};

/// Texts by name.
#[derive(Debug, Clone)]
struct Shelf {
    folder: PathBuf,
    built_in: &'static [(&'static str, &'static str)],
}

impl Shelf {
    /// Every name, sorted.
    fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = self.built_in.iter().map(|text| text.0.to_owned()).collect();
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

    /// What refusals call the text of that name, and the text; none if there is none. The folder's own goes before one
    /// built in. Clients learn the file's name, not where the server keeps it.
    fn text(&self, name: &str, limits: &Limits) -> Result<Option<(String, String)>> {
        let path = self.folder.join(format!("{name}.toml"));
        if is_name(name) && path.is_file() {
            let file = format!("{name}.toml");
            let text = read_text(&path, limits.file_bytes)
                .map_err(|refusal| Refusal { place: Some(file.clone()), ..refusal })?;
            return Ok(Some((file, text)));
        }
        let built_in = self.built_in.iter().find(|text| text.0 == name);
        Ok(built_in.map(|(name, text)| ((*name).to_owned(), (*text).to_owned())))
    }
}

/// Scenes and scripts by name.
#[derive(Debug, Clone)]
pub struct Catalog {
    scenes: Shelf,
    scripts: Shelf,
}

impl Catalog {
    /// Those of two folders, which may be missing.
    pub fn new(scenes: &Path, scripts: &Path) -> Self {
        Catalog {
            scenes: Shelf { folder: scenes.to_owned(), built_in: &scene::BUILT_IN },
            scripts: Shelf { folder: scripts.to_owned(), built_in: &script::BUILT_IN },
        }
    }

    /// Every scene's name, sorted.
    pub fn names(&self) -> Vec<String> {
        self.scenes.names()
    }

    /// Every script's name, sorted.
    pub fn script_names(&self) -> Vec<String> {
        self.scripts.names()
    }

    /// The scene of that name, with `--set` assignments over it.
    pub fn load(&self, name: &str, assignments: &[String], limits: &Limits) -> Result<Scene> {
        match self.scenes.text(name, limits)? {
            Some((file, text)) => {
                Scene::parse(&file, &text, assignments, limits).map(|scene| scene.found_in(&self.scenes.folder))
            }
            None => {
                let (name, names) = (excerpt(name), self.names().join(", "));
                let message = format!("there is no scene `{name}`; there are {names}");
                Err(Refusal::new(Reason::UnknownScene, "scene_name", message))
            }
        }
    }

    /// The script of that name, bound to a scene.
    pub fn script(&self, name: &str, scene: &Scene, limits: &Limits) -> Result<Script> {
        match self.scripts.text(name, limits)? {
            Some((file, text)) => Script::parse(&file, &text, &self.scripts.folder, scene, limits),
            None => {
                let (name, names) = (excerpt(name), self.script_names().join(", "));
                let message = format!("there is no script `{name}`; there are {names}");
                Err(Refusal::new(Reason::UnknownScript, "script_name", message))
            }
        }
    }
}

/// A plain word: nothing that could lead out of the folder.
fn is_name(name: &str) -> bool {
    !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_')
}
