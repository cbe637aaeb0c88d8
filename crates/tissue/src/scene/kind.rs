//! Distinguishes scenes from scripts by their keys, because users often give one where the other is wanted.

use crate::scene::toml_document::Document;
use palpate_refusal::{Reason, Result};

/// The kind of a TOML text in a file, folder or collection: scene or script.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextKind {
    /// Describes a tissue ([`Scene`](super::Scene)).
    Scene,
    /// Describes what is done to a tissue ([`Script`](super::script::Script)).
    Script,
}

/// Hint in refusals: the order of scene and script on the command line.
pub(super) const ORDER: &str = "give the scene first, then the script (of `replay`: the script, then --scene)";

impl TextKind {
    /// Returns the word for this kind in messages: `"scene"` or `"script"`.
    pub fn name(self) -> &'static str {
        match self {
            TextKind::Scene => "scene",
            TextKind::Script => "script",
        }
    }

    /// Returns the other kind: script for scene, scene for script.
    #[must_use]
    pub fn other(self) -> Self {
        match self {
            TextKind::Scene => TextKind::Script,
            TextKind::Script => TextKind::Scene,
        }
    }

    /// Returns top-level keys that only this kind has.
    fn keys(self) -> &'static [&'static str] {
        match self {
            TextKind::Scene => &["sheet", "mesh", "springs", "anchor_springs", "damping", "volume", "stepping"],
            TextKind::Script => &["scenes", "duration_s", "sample_every_s", "sample_points", "force", "tool", "tissue"],
        }
    }

    /// Returns the message for a text of the other kind that lies in the folder of this kind.
    pub(super) fn misplaced(self) -> String {
        let other = self.other().name();
        format!("is a {other} in the folder of {}s: move it to the folder of {other}s", self.name())
    }

    /// Refuses a document that has keys of the other kind and none of this kind.
    pub(super) fn check(self, document: &Document) -> Result<()> {
        let has_keys_of = |kind: TextKind| kind.keys().iter().any(|key| document.has(key));
        if has_keys_of(self) || !has_keys_of(self.other()) {
            return Ok(());
        }
        Err(document.refuse(Reason::WrongKind, format!("is a {}: {ORDER}", self.other().name())))
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
