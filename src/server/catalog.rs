//! The scenes and scripts that a server knows by name: `NAME.toml` in its folders, and the built-in ones.

use std::path::{Path, PathBuf};

use crate::limits::Limits;
use crate::refusal::{Reason, Refusal, Result, excerpt};
use crate::scene::document::read_text;
use crate::scene::reader::fits;
use crate::scene::script::{self, Script};
use crate::scene::{self, Scene};

/// Texts by name: the files of a folder, and the built-in ones.
#[derive(Debug, Clone)]
struct Collection {
    folder: PathBuf,
    built_in: &'static [(&'static str, &'static str)],
}

impl Collection {
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

    /// The text of that name, after the name that refusals use for it; `None` if there is none. A file of the folder
    /// overrides a built-in text. Refusals name the file without its folder: clients do not learn the server's paths.
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
    scenes: Collection,
    scripts: Collection,
}

impl Catalog {
    /// The scenes and scripts of two folders, either of which may be missing, and the built-in ones.
    pub fn new(scenes: &Path, scripts: &Path) -> Self {
        Catalog {
            scenes: Collection { folder: scenes.to_owned(), built_in: &scene::BUILT_IN },
            scripts: Collection { folder: scripts.to_owned(), built_in: &script::BUILT_IN },
        }
    }

    /// The names of all scenes, sorted.
    pub fn names(&self) -> Vec<String> {
        self.scenes.names()
    }

    /// The names of all scripts, sorted.
    pub fn script_names(&self) -> Vec<String> {
        self.scripts.names()
    }

    /// The names of the scripts that are made for the scene of that name, sorted.
    pub fn script_names_for(&self, scene: &str, limits: &Limits) -> Vec<String> {
        let fits = |name: &String| match self.scripts.text(name, limits) {
            Ok(Some((_, text))) => fits(&text, scene),
            _ => true,
        };
        self.script_names().into_iter().filter(fits).collect()
    }

    /// Loads the scene of that name; `--set` assignments override its keys.
    ///
    /// # Errors
    /// Returns an error if there is no such scene, or if it is invalid.
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

    /// Loads the script of that name and binds it to a scene.
    ///
    /// # Errors
    /// Returns an error if there is no such script, or if it is invalid for this scene.
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

/// Whether `name` is a plain word, which can't lead out of the folder.
fn is_name(name: &str) -> bool {
    !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_')
}
