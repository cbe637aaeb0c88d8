//! Scenes, scripts and exercises by name: the files of the server's folders, and the built-in ones.

use std::path::Path;
use std::sync::{Arc, Mutex};

use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::exercise_judge::check_criteria;
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::scene::collection::Collection;
use palpate_tissue::scene::exercise::Exercise;
use palpate_tissue::scene::kind::TextKind;
use palpate_tissue::scene::script::Script;
use palpate_tissue::scene::script_reader::fits;
use palpate_tissue::scene::{BUILT_IN, Scene};

/// The scenes, scripts and exercises that clients can ask for by name: the files `NAME.toml` of three folders, and the built-in
/// ones. A file replaces the built-in text of its name. Each call reads the folders anew. The `limits` of the methods
/// bound the size of a file and what a scene or script may contain. Clones share the scenes that were loaded.
#[derive(Debug, Clone)]
pub struct Catalog {
    scenes: Collection,
    scripts: Collection,
    exercises: Collection,
    /// Built-in scenes that were loaded before, by name: laying out an organ takes about a second.
    built_in: Arc<Mutex<Vec<(String, Scene)>>>,
}

impl Catalog {
    /// Creates the catalog of the built-in scenes, scripts and exercises, and of three folders: that of scenes, that of
    /// scripts, and that of exercises. Each folder may be missing. Reads nothing yet.
    pub fn new(scenes: &Path, scripts: &Path, exercises: &Path) -> Self {
        Catalog {
            scenes: Collection::new(TextKind::Scene, scenes),
            scripts: Collection::new(TextKind::Script, scripts),
            exercises: Collection::new(TextKind::Exercise, exercises),
            built_in: Arc::default(),
        }
    }

    /// Returns the names of all scenes, sorted, each once, including those of invalid or unreadable files. Leaves out
    /// files whose name has other characters than letters, digits, `-` and `_`, and scripts ([`Catalog::misplaced`]).
    pub fn names(&self, limits: &Limits) -> Vec<String> {
        self.scenes.names(limits)
    }

    /// Returns a refusal for each file of another kind in the folders of scenes, scripts and exercises, each
    /// sorted by name. The catalog does not list or load such files.
    pub fn misplaced(&self, limits: &Limits) -> Vec<Refusal> {
        [&self.scenes, &self.scripts, &self.exercises].into_iter().flat_map(|all| all.all_misplaced(limits)).collect()
    }

    /// Returns the names, sorted, of the scenes that are not exactly a built-in one: those of files with another name
    /// or another text, and of files that can't be read. The scenes are not validated.
    pub fn foreign_names(&self, limits: &Limits) -> Vec<String> {
        self.scenes.names_where(&self.scripts, limits, |name, text| !is_built_in(name, text))
    }

    /// Returns the names of all scripts, sorted, each once, including those of invalid or unreadable files, under the
    /// conditions of [`Catalog::names`].
    pub fn script_names(&self, limits: &Limits) -> Vec<String> {
        self.scripts.names(limits)
    }

    /// Returns the names, sorted, of the scripts made for the scene named `scene`, and of those that can't be read.
    /// The scripts are not validated, and the scene need not exist.
    pub fn script_names_for(&self, scene: &str, limits: &Limits) -> Vec<String> {
        self.scripts.names_where(&self.scenes, limits, |_, text| fits(text, scene))
    }

    /// Returns the valid exercises, sorted by the name of their files.
    pub fn exercises(&self, limits: &Limits) -> Vec<Exercise> {
        self.all_exercises(limits).filter_map(Result::ok).collect()
    }

    /// Returns a refusal for each invalid exercise, sorted by the name of its file: the list leaves it out.
    pub fn invalid_exercises(&self, limits: &Limits) -> Vec<Refusal> {
        self.all_exercises(limits).filter_map(Result::err).collect()
    }

    fn all_exercises(&self, limits: &Limits) -> impl Iterator<Item = Result<Exercise>> {
        let read = move |name: String| {
            let (file, text) = self.exercise_text(&name, limits)?;
            let exercise = Exercise::parse(&file, &text)?;
            check_criteria(&exercise)?;
            if exercise.name != name {
                let message = format!("is `{}`, but clients ask for the name of the file, `{name}`", exercise.name);
                return Err(Refusal { place: Some(file), ..Refusal::new(Reason::WrongKind, "name", message) });
            }
            Ok(exercise)
        };
        self.exercises.names(limits).into_iter().map(read)
    }

    /// Returns the text of the exercise named `name`, and the name of its file for refusals.
    ///
    /// # Errors
    /// Refuses an unknown name, and a file that can't be read or is no exercise. The text is not checked.
    pub fn exercise_text(&self, name: &str, limits: &Limits) -> Result<(String, String)> {
        self.exercises.text(name, &self.scenes, limits)
    }

    /// Loads the scene named `name`; `assignments` ("key=value") override its keys. Keeps a built-in scene without
    /// assignments for later calls.
    ///
    /// # Errors
    /// Refuses an unknown name, a file that can't be read or is a script, an assignment that does not fit the scene,
    /// and a scene that is invalid or beyond `limits`.
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

    /// Loads the script named `name` and binds it to `scene`, whose points its forces and changes refer to.
    ///
    /// # Errors
    /// Refuses an unknown name, a file that can't be read or is a scene, and a script that is invalid for this scene
    /// or beyond `limits`.
    pub fn script(&self, name: &str, scene: &Scene, limits: &Limits) -> Result<Script> {
        let (file, text) = self.scripts.text(name, &self.scenes, limits)?;
        Script::parse(&file, &text, self.scripts.folder(), scene, limits)
    }
}

/// Returns whether `text` is exactly that of the built-in scene `name`.
fn is_built_in(name: &str, text: &str) -> bool {
    BUILT_IN.iter().any(|(other, own)| *other == name && *own == text)
}
