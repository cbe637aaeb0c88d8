//! Tells scenes, scripts and exercises apart by their keys, because users often give one where another is wanted.

use crate::scene::toml_document::Document;
use palpate_refusal::{Reason, Result};

/// The kind of a TOML text in a file, folder or collection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextKind {
    /// Describes a tissue ([`Scene`](super::Scene)).
    Scene,
    /// Describes what is done to a tissue ([`Script`](super::script::Script)).
    Script,
    /// Describes a task for a trainee ([`Exercise`](super::exercise::Exercise)).
    Exercise,
}

/// Hint in refusals: the order of scene and script on the command line.
pub(super) const ORDER: &str = "give the scene first, then the script (of `replay`: the script, then --scene)";

impl TextKind {
    /// All kinds.
    const ALL: [Self; 3] = [TextKind::Scene, TextKind::Script, TextKind::Exercise];

    /// Returns the word for this kind in messages: `"scene"`, `"script"` or `"exercise"`.
    pub fn name(self) -> &'static str {
        match self {
            TextKind::Scene => "scene",
            TextKind::Script => "script",
            TextKind::Exercise => "exercise",
        }
    }

    /// Returns the article of that word.
    pub(super) fn article(self) -> &'static str {
        if self == TextKind::Exercise { "an" } else { "a" }
    }

    /// Returns the advice for a text of this kind where another one is wanted.
    pub(super) fn advice(self) -> &'static str {
        match self {
            TextKind::Scene | TextKind::Script => ORDER,
            TextKind::Exercise => "give it by --exercise",
        }
    }

    /// Returns top-level keys that only this kind has.
    fn keys(self) -> &'static [&'static str] {
        match self {
            TextKind::Scene => &["sheet", "mesh", "springs", "anchor_springs", "damping", "volume", "stepping"],
            TextKind::Script => &["duration_s", "sample_every_s", "sample_points", "force", "tool", "tissue"],
            TextKind::Exercise => &["instructions", "lumps", "criterion", "coverage", "lift", "avoid", "time_limit_s"],
        }
    }

    /// Returns the kind of a document that has keys of another kind and none of this one.
    pub(super) fn mistaken(self, document: &Document) -> Option<Self> {
        let has_keys_of = |kind: TextKind| kind.keys().iter().any(|key| document.has(key));
        let others = Self::ALL.into_iter().filter(|kind| *kind != self);
        if has_keys_of(self) { None } else { others.into_iter().find(|kind| has_keys_of(*kind)) }
    }

    /// Returns the message for a text of `other` kind that lies in the folder of this kind.
    pub(super) fn misplaced(self, other: Self) -> String {
        let (article, other) = (other.article(), other.name());
        format!("is {article} {other} in the folder of {}s: move it to the folder of {other}s", self.name())
    }

    /// Refuses a document that has keys of another kind and none of this kind.
    pub(super) fn check(self, document: &Document) -> Result<()> {
        let Some(other) = self.mistaken(document) else { return Ok(()) };
        Err(document.refuse(Reason::WrongKind, format!("is {} {}: {}", other.article(), other.name(), other.advice())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_is_no_script_and_what_is_neither_is_read_on() {
        let parse = |text: &str| Document::parse("file.toml", text).unwrap();
        let (scene, script) = (parse("[sheet]\n"), parse("duration_s = 1.0\n"));
        assert!(TextKind::Scene.check(&scene).is_ok() && TextKind::Script.check(&script).is_ok());
        let refused = TextKind::Script.check(&scene).unwrap_err().to_string();
        assert!(refused.starts_with("file.toml: is a scene: give the scene first, then the script"), "{refused}");
        let refused = TextKind::Scene.check(&script).unwrap_err().to_string();
        assert!(refused.starts_with("file.toml: is a script: give the scene first"), "{refused}");
        for neither in ["", "name = \"x\"\n", "[sheet]\n[[force]]\n"] {
            assert!(TextKind::Scene.check(&parse(neither)).is_ok() && TextKind::Script.check(&parse(neither)).is_ok());
        }
    }
}
