//! Scenes and scripts by name: the files of the server's folders, and the built-in ones.

use std::path::Path;
use std::sync::{Arc, Mutex};

use palpate_refusal::{Refusal, Result};
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::scene::collection::Collection;
use palpate_tissue::scene::kind::TextKind;
use palpate_tissue::scene::script::Script;
use palpate_tissue::scene::script_reader::fits;
use palpate_tissue::scene::{BUILT_IN, Scene};

/// The scenes and scripts that clients can ask for by name.
#[derive(Debug, Clone)]
pub struct Catalog {
    scenes: Collection,
    scripts: Collection,
    /// Built-in scenes that were loaded before, by name: laying out an organ takes about a second.
    built_in: Arc<Mutex<Vec<(String, Scene)>>>,
}

impl Catalog {
    /// Creates the catalog of two folders and the built-in scenes and scripts. Either folder may be missing.
    pub fn new(scenes: &Path, scripts: &Path) -> Self {
        Catalog {
            scenes: Collection::new(TextKind::Scene, scenes),
            scripts: Collection::new(TextKind::Script, scripts),
            built_in: Arc::default(),
        }
    }

    /// Returns the names of all scenes, sorted.
    pub fn names(&self, limits: &Limits) -> Vec<String> {
        self.scenes.names(limits)
    }

    /// Returns a refusal for each script in the folder of scenes and each scene in the folder of scripts. The catalog
    /// does not list such files.
    pub fn misplaced(&self, limits: &Limits) -> Vec<Refusal> {
        [&self.scenes, &self.scripts].into_iter().flat_map(|all| all.all_misplaced(limits)).collect()
    }

    /// Returns the names of the scenes whose text differs from the built-in scene of that name. They have not been
    /// validated.
    pub fn foreign_names(&self, limits: &Limits) -> Vec<String> {
        self.scenes.names_where(&self.scripts, limits, |name, text| !is_built_in(name, text))
    }

    /// Returns the names of all scripts, sorted.
    pub fn script_names(&self, limits: &Limits) -> Vec<String> {
        self.scripts.names(limits)
    }

    /// Returns the names of the scripts made for the scene named `scene`, sorted.
    pub fn script_names_for(&self, scene: &str, limits: &Limits) -> Vec<String> {
        self.scripts.names_where(&self.scenes, limits, |_, text| fits(text, scene))
    }

    /// Loads the scene named `name`; `assignments` ("key=value") override its keys. Keeps a built-in scene for later
    /// calls.
    ///
    /// # Errors
    /// Returns an error if there is no such scene, or if it is invalid.
    pub fn load(&self, name: &str, assignments: &[String], limits: &Limits) -> Result<Scene> {
        let (file, text) = self.scenes.text(name, &self.scripts, limits)?;
        let is_built_in = assignments.is_empty() && is_built_in(name, &text);
        if is_built_in && let Some((_, scene)) = lock(&self.built_in).iter().find(|known| known.0 == name) {
            return scene.check(limits).map(|()| scene.clone());
        }
        let scene = Scene::parse_in(self.scenes.folder(), &file, &text, assignments, limits)?;
        if is_built_in {
            let mut built_in = lock(&self.built_in);
            built_in.retain(|known| known.0 != name);
            built_in.push((name.to_owned(), scene.clone()));
        }
        Ok(scene)
    }

    /// Loads the script named `name` and binds it to `scene`.
    ///
    /// # Errors
    /// Returns an error if there is no such script, or if it is invalid for this scene.
    pub fn script(&self, name: &str, scene: &Scene, limits: &Limits) -> Result<Script> {
        let (file, text) = self.scripts.text(name, &self.scenes, limits)?;
        Script::parse(&file, &text, self.scripts.folder(), scene, limits)
    }
}

/// Returns whether `text` is exactly that of the built-in scene `name`.
fn is_built_in(name: &str, text: &str) -> bool {
    BUILT_IN.iter().any(|(other, own)| *other == name && *own == text)
}
