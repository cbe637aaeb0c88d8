//! The scenes and scripts that a server knows by name: those of its folders, and the built-in ones.

use std::path::Path;

use crate::limits::Limits;
use crate::refusal::Result;
use crate::scene::Scene;
use crate::scene::collection::Collection;
use crate::scene::kind::Kind;
use crate::scene::reader::fits;
use crate::scene::script::Script;

/// Scenes and scripts by name.
#[derive(Debug, Clone)]
pub struct Catalog {
    scenes: Collection,
    scripts: Collection,
}

impl Catalog {
    /// The scenes and scripts of two folders, either of which may be missing, and the built-in ones.
    pub fn new(scenes: &Path, scripts: &Path) -> Self {
        Catalog { scenes: Collection::new(Kind::Scene, scenes), scripts: Collection::new(Kind::Script, scripts) }
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
        let fits = |name: &String| {
            let text = self.scripts.text(name, &self.scenes, limits);
            text.map_or(true, |(_, text)| fits(&text, scene))
        };
        self.script_names().into_iter().filter(fits).collect()
    }

    /// Loads the scene of that name; `--set` assignments override its keys.
    ///
    /// # Errors
    /// Returns an error if there is no such scene, or if it is invalid.
    pub fn load(&self, name: &str, assignments: &[String], limits: &Limits) -> Result<Scene> {
        let (file, text) = self.scenes.text(name, &self.scripts, limits)?;
        Scene::parse_in(self.scenes.folder(), &file, &text, assignments, limits)
    }

    /// Loads the script of that name and binds it to a scene.
    ///
    /// # Errors
    /// Returns an error if there is no such script, or if it is invalid for this scene.
    pub fn script(&self, name: &str, scene: &Scene, limits: &Limits) -> Result<Script> {
        let (file, text) = self.scripts.text(name, &self.scenes, limits)?;
        Script::parse(&file, &text, self.scripts.folder(), scene, limits)
    }
}
