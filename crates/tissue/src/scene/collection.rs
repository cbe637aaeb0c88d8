//! Finds scenes, scripts and exercises by name: the files `NAME.toml` of a folder, and the built-in texts.

use std::path::{Path, PathBuf};

use super::exercise;
use super::kind::TextKind;
use super::script::{self, Script};
use super::{BUILT_IN, Scene};
use crate::files;
use crate::limits::Limits;
use crate::scene::script_reader::made_for;
use crate::scene::toml_document::Document;
use palpate_refusal::{Reason, Refusal, Result, did_you_mean, excerpt};

/// The scenes, scripts or exercises that can be given by name: the files `NAME.toml` of a folder and the built-in
/// ones. A name has letters and digits of ASCII, `-` and `_`. Each call reads the folder anew.
#[derive(Debug, Clone)]
pub struct Collection {
    folder: PathBuf,
    built_in: &'static [(&'static str, &'static str)],
    kind: TextKind,
    /// Whether refusals may suggest files of the working directory.
    names_files: bool,
}

impl Collection {
    /// Creates the collection of a folder, which need not exist, and the built-in texts of that kind. Nothing
    /// is read yet.
    pub fn new(kind: TextKind, folder: &Path) -> Self {
        let built_in: &'static [_] = match kind {
            TextKind::Scene => &BUILT_IN,
            TextKind::Script => &script::BUILT_IN,
            TextKind::Exercise => &exercise::BUILT_IN,
        };
        Collection { folder: folder.to_owned(), built_in, kind, names_files: false }
    }

    /// Returns the collection for a user of a command-line program, not for clients: refusals may suggest a
    /// file of the working directory.
    #[must_use]
    pub(super) fn for_user(self) -> Self {
        Collection { names_files: true, ..self }
    }

    /// Returns the folder whose files override the built-in texts, as it was given; it need not exist.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Returns every name, sorted, each once, without those of files that belong in the folder of the other
    /// kind. It reads every file of the folder, at most `limits.file_bytes` of each; names of files that can't
    /// be read are included.
    pub fn names(&self, limits: &Limits) -> Vec<String> {
        self.files_and_built_in().into_iter().filter(|name| self.misplaced(name, limits).is_none()).collect()
    }

    /// Returns the names, sorted, each once, whose name and text `is_wanted` accepts (called as
    /// `is_wanted(name, text)`), and the names of files that can't be read. Files of the other kind are left
    /// out. `others` is the collection of the other kind. Each file is read once.
    pub fn names_where(
        &self,
        others: &Collection,
        limits: &Limits,
        is_wanted: impl Fn(&str, &str) -> bool,
    ) -> Vec<String> {
        let stays = |name: &String| match self.text(name, others, limits) {
            Ok((_, text)) => is_wanted(name, &text),
            // Of the other kind.
            Err(refusal) => refusal.reason != Reason::WrongKind,
        };
        self.files_and_built_in().into_iter().filter(stays).collect()
    }

    /// Returns a refusal for each file that belongs in the folder of the other kind, sorted by name; its place
    /// is `NAME.toml`. Empty if there are none. Files that can't be read are left out.
    pub fn all_misplaced(&self, limits: &Limits) -> Vec<Refusal> {
        self.files_and_built_in().iter().filter_map(|name| self.misplaced(name, limits)).collect()
    }

    fn misplaced(&self, name: &str, limits: &Limits) -> Option<Refusal> {
        let text = files::read_regular_text(&self.file(name)?, limits.file_bytes).ok()?;
        self.refuse_other_kind(&format!("{name}.toml"), &text).err()
    }

    /// Refuses the text of a file of this folder if it is of the other kind.
    fn refuse_other_kind(&self, file: &str, text: &str) -> Result<()> {
        let other = Document::parse(file, text).ok().and_then(|document| self.kind.mistaken(&document));
        if let Some(other) = other {
            let refusal = Refusal::new(Reason::WrongKind, "", self.kind.misplaced(other));
            return Err(Refusal { place: Some(file.to_owned()), ..refusal });
        }
        Ok(())
    }

    fn files_and_built_in(&self) -> Vec<String> {
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

    /// Returns the path of that name in the folder, if something is there. Reading it may still fail.
    fn file(&self, name: &str) -> Option<PathBuf> {
        let path = self.folder.join(format!("{name}.toml"));
        (is_name(name) && path.symlink_metadata().is_ok()).then_some(path)
    }

    fn has(&self, name: &str) -> bool {
        self.file(name).is_some() || self.built_in.iter().any(|text| text.0 == name)
    }

    /// Returns the name that refusals use for a text (`NAME.toml` for a file, `NAME` for a built-in text), and
    /// the text. A file in the folder overrides a built-in text. Refusals name the file without its folder, so
    /// that clients do not learn the server's paths. `others` is the collection of the other kind: a name found
    /// there gets a hint.
    ///
    /// # Errors
    /// Refuses an unknown name ([`Reason::UnknownScene`] or [`Reason::UnknownScript`]; the message lists the
    /// names), a file of the other kind ([`Reason::WrongKind`]), and a file that [`files::read_regular_text`]
    /// refuses: not a regular file, not UTF-8, or with more than `limits.file_bytes` bytes. The text itself may
    /// be invalid.
    pub fn text(&self, name: &str, others: &Collection, limits: &Limits) -> Result<(String, String)> {
        if let Some(path) = self.file(name) {
            let file = format!("{name}.toml");
            let text = files::read_regular_text(&path, limits.file_bytes)
                .map_err(|refusal| Refusal { place: Some(file.clone()), ..refusal })?;
            self.refuse_other_kind(&file, &text)?;
            return Ok((file, text));
        }
        let built_in = self.built_in.iter().find(|text| text.0 == name);
        built_in
            .map(|(name, text)| ((*name).to_owned(), (*text).to_owned()))
            .ok_or_else(|| self.unknown(name, others, limits))
    }

    fn unknown(&self, name: &str, others: &Collection, limits: &Limits) -> Refusal {
        let (kind, names) = (self.kind.name(), self.names(limits));
        let file = format!("{name}.toml");
        let hint = if self.names_files && is_name(name) && Path::new(&file).is_file() {
            format!("; did you mean the file `{file}`?")
        } else if others.has(name) {
            format!("; `{name}` is {} {}: {}", others.kind.article(), others.kind.name(), others.kind.advice())
        } else {
            let meant = did_you_mean(name, names.iter().map(String::as_str));
            let own =
                if self.names_files { format!("; give your own {kind} by its path, FILE.toml") } else { String::new() };
            meant + &own
        };
        let message = format!("there is no {kind} `{}`; there are {}{hint}", excerpt(name), names.join(", "));
        let (reason, field) = match self.kind {
            TextKind::Scene => (Reason::UnknownScene, "scene_name"),
            TextKind::Script => (Reason::UnknownScript, "script_name"),
            TextKind::Exercise => (Reason::UnknownExercise, "exercise_name"),
        };
        Refusal::new(reason, field, message)
    }
}

/// Returns whether `name` is a plain word, which can't lead out of the folder.
pub(super) fn is_name(name: &str) -> bool {
    !name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_')
}

/// Returns the name that a user gave as a path: a plain word that is not a file.
pub(super) fn name_in(path: &Path) -> Option<&str> {
    path.to_str().filter(|name| is_name(name) && !path.is_file())
}

/// Folder of the scripts that a user of the programs can give by name.
const SCRIPTS: &str = "scripts";

/// Reads the scene that a user gave: the path of a file, or the name of a scene in `folder` or of a built-in
/// one. A plain word that is not a file of the working directory is a name. `--set` assignments override its
/// keys.
///
/// # Errors
/// Refuses an unknown name or a file of the other kind, as [`Collection::text`] does; a file that can't be
/// read; and every text or assignment that [`Scene::parse_in`] refuses.
pub fn find_scene(path: &Path, folder: &Path, assignments: &[String], limits: &Limits) -> Result<Scene> {
    let (name, text, folder) = scene_text(path, folder, limits)?;
    Scene::parse_in(&folder, &name, &text, assignments, limits)
}

/// Returns the scene that a user gave, as to [`find_scene`]: the name that refusals use for it, its text, and the folder of the files
/// that it names.
///
/// # Errors
/// Refuses an unknown name, and a file that can't be read.
pub fn scene_text(path: &Path, folder: &Path, limits: &Limits) -> Result<(String, String, PathBuf)> {
    let Some(name) = name_in(path) else {
        let of_files = path.parent().unwrap_or(Path::new("")).to_owned();
        return Ok((path.display().to_string(), files::read_text(path, limits.file_bytes)?, of_files));
    };
    let scenes = Collection::new(TextKind::Scene, folder).for_user();
    let (file, text) = scenes.text(name, &Collection::new(TextKind::Script, Path::new(SCRIPTS)), limits)?;
    Ok((file, text, folder.to_owned()))
}

/// Returns the script that a user gave (a file, or the name of one in ./scripts or of a built-in one): the name
/// that refusals use for it, its text, and the folder of its traces.
fn script_text(path: &Path, limits: &Limits) -> Result<(String, String, PathBuf)> {
    let of_file = |path: &Path| {
        let folder = path.parent().unwrap_or(Path::new("")).to_owned();
        Ok((path.display().to_string(), files::read_text(path, limits.file_bytes)?, folder))
    };
    let Some(name) = name_in(path) else { return of_file(path) };
    let scripts = Collection::new(TextKind::Script, Path::new(SCRIPTS)).for_user();
    if let Some(file) = scripts.file(name) {
        return of_file(&file);
    }
    let (file, text) = scripts.text(name, &Collection::new(TextKind::Scene, Path::new("scenes")), limits)?;
    Ok((file, text, PathBuf::from(SCRIPTS)))
}

/// Reads the script that a user gave (the path of a file, or the name of one in ./scripts or of a built-in one)
/// and binds it to `scene`. A plain word that is not a file of the working directory is a name. Traces are in
/// the script's folder.
///
/// # Errors
/// Refuses an unknown name, a file that can't be read, and every text that [`Script::parse`] refuses, scenes
/// among them.
pub fn find_script(path: &Path, scene: &Scene, limits: &Limits) -> Result<Script> {
    let (name, text, folder) = script_text(path, limits)?;
    Script::parse(&name, &text, &folder, scene, limits)
}

/// Returns the names of the scenes that a user's script (given as to [`find_script`]) is made for, in its
/// order; empty if it names none or is not TOML.
///
/// # Errors
/// Refuses an unknown name, and a script that can't be read.
pub fn scenes_of(path: &Path, limits: &Limits) -> Result<Vec<String>> {
    Ok(made_for(&script_text(path, limits)?.1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_of_the_other_kind_has_no_name_and_is_told() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("poke.toml"), "duration_s = 1.0\n").unwrap();
        std::fs::write(folder.path().join("mine.toml"), "[sheet]\n").unwrap();
        let [scenes, scripts] = [TextKind::Scene, TextKind::Script].map(|kind| Collection::new(kind, folder.path()));
        let limits = Limits::default();
        let [of_scenes, of_scripts] = [scenes.names(&limits), scripts.names(&limits)];
        let has = |names: &[String], name: &str| names.iter().any(|other| other == name);
        assert!(has(&of_scenes, "mine") && !has(&of_scenes, "poke"), "{of_scenes:?}");
        assert!(has(&of_scripts, "poke") && !has(&of_scripts, "mine"), "{of_scripts:?}");
        let told = |all: &Collection| all.all_misplaced(&limits).iter().map(ToString::to_string).collect::<Vec<_>>();
        assert_eq!(told(&scenes), ["poke.toml: is a script in the folder of scenes: move it to the folder of scripts"]);
        assert_eq!(told(&scripts), ["mine.toml: is a scene in the folder of scripts: move it to the folder of scenes"]);
    }

    #[test]
    fn an_unknown_name_is_refused_with_all_names_and_the_nearest() {
        let folder = Path::new("no-such-folder");
        let [scenes, scripts] = [TextKind::Scene, TextKind::Script].map(|kind| Collection::new(kind, folder));
        let limits = Limits::default();
        let refused = scenes.text("papr", &scripts, &limits).unwrap_err();
        assert_eq!(refused.reason, Reason::UnknownScene);
        assert!(
            refused.message.ends_with(
                "there are colon, fibrotic, gallbladder, gallbladder-bed, kidney, liver, liver-organ, liver-solid, paper, phantom, prostate, stomach; did you mean `paper`?"
            ),
            "{refused}"
        );
        let refused = scripts.text("vertical", &scenes, &limits).unwrap_err();
        assert!(refused.message.ends_with("vertical-60; did you mean `vertical-60`?"), "{refused}");
        let swapped = scenes.text("vertical-60", &scripts, &limits).unwrap_err();
        assert!(swapped.message.contains("`vertical-60` is a script: give the scene first"), "{swapped}");
        assert!(scenes.text("../paper", &scripts, &limits).is_err());
        assert!(scripts.text("vertical-60", &scenes, &limits).is_ok());
    }
    /// Opening a pipe waits for a writer: such a file, or one that a scene names, would block a server's start.
    #[cfg(unix)]
    #[test]
    fn what_is_no_file_is_told_as_that_and_nobody_waits_for_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        for pipe in ["pipe.toml", "pipe.obj"] {
            assert!(std::process::Command::new("mkfifo").arg(path(pipe)).status().unwrap().success());
        }
        std::os::unix::fs::symlink("nowhere", path("dangling.toml")).unwrap();
        std::os::unix::fs::symlink("/dev/zero", path("zero.toml")).unwrap();
        std::fs::create_dir(path("folder.toml")).unwrap();
        std::fs::write(path("mesh.toml"), "[mesh]\nfile = \"pipe.obj\"\nunit = \"m\"\npoint_mass_kg = 1e-3\n").unwrap();
        for (name, told) in [
            ("pipe", "pipe.toml: is not a regular file"),
            ("dangling", "dangling.toml: can't be opened"),
            ("zero", "zero.toml: is not a regular file"),
            ("folder", "folder.toml: is a folder"),
            ("mesh", "mesh.file: pipe.obj: is not a regular file"),
        ] {
            let refused = find_scene(Path::new(name), folder.path(), &[], &Limits::default()).unwrap_err().to_string();
            assert!(refused.contains(told), "{refused}");
        }
    }
}
