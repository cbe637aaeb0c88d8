//! The file with the mesh of a scene file, as a client sends it to a server.

use std::path::{Path, PathBuf};

use super::document::{Document, Fields, read_text};
use super::source::unit_text;
use crate::limits::Limits;
use crate::refusal::Result;

/// What the section `[mesh]` of a scene file says of its mesh.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeshFile {
    /// The file; `None` for a mesh that is generated.
    pub path: Option<PathBuf>,
    /// The metres of its unit, or the unit's name.
    pub unit: String,
    /// So many vertices are simulated, if fewer than the file has.
    pub vertices: Option<u64>,
}

/// Of a scene file that is valid; `None` if its tissue is no mesh.
///
/// # Errors
/// Refuses a file that can't be read.
pub fn mesh_file(scene: &Path, limits: &Limits) -> Result<Option<MeshFile>> {
    let text = read_text(scene, limits.file_bytes)?;
    let document = Document::parse(&scene.display().to_string(), &text)?;
    let mut found = None;
    let read = |fields: &mut Fields<'_>| {
        let unit = fields.item("unit").and_then(|item| unit_text(&item).ok());
        found = Some(MeshFile {
            path: fields.text("file")?.map(|file| scene.parent().unwrap_or(Path::new("")).join(file)),
            unit: unit.unwrap_or_default(),
            vertices: fields.item("vertices").map(|item| item.whole()).transpose()?,
        });
        Ok(())
    };
    // Other keys are no matter of this: who reads the scene checks them.
    let _ = document.read(|fields| fields.item("mesh").map_or(Ok(()), |item| item.table(read)));
    Ok(found)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_file_of_a_mesh_is_beside_its_scene() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("scene.toml");
        let read = |text: &str| {
            std::fs::write(&scene, text).unwrap();
            mesh_file(&scene, &Limits::default()).unwrap()
        };
        assert_eq!(read(super::super::PAPER), None);
        let text = "[mesh]\nfile = \"a/organ.obj\"\nunit = \"mm\"\nother = 1\n[springs]\n";
        let found = read(text).unwrap();
        assert_eq!((found.path, found.vertices), (Some(folder.path().join("a/organ.obj")), None));
        let found = read("[mesh]\nfile = \"organ.obj\"\nunit = 0.0254\nvertices = 500\n").unwrap();
        assert_eq!((found.unit.as_str(), found.vertices), ("0.0254", Some(500)));
        assert_eq!(read("[mesh]\norgan = { name = \"liver\", edge_m = 0.01 }\n").unwrap(), MeshFile::default());
    }
}
