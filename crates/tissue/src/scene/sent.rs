//! The mesh file of a scene, as a client sends it to a server.

use std::path::{Path, PathBuf};

use palpate_geometry::write::{Format, write};

use super::Scene;
use super::source::unit_text;
use crate::files;
use crate::limits::Limits;
use crate::scene::toml_document::{Document, Fields};
use palpate_refusal::Result;

/// The mesh that the section `[mesh]` or `[solid]` of a scene file names. Read from the text alone: the mesh file need not
/// exist.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeshFile {
    /// The path of the file; `None` if the mesh is generated or the text names none.
    pub path: Option<PathBuf>,
    /// The unit's name, such as `"mm"`, or its length in metres, as text; empty if the text has none, as for a
    /// generated mesh.
    pub unit: String,
    /// Wanted number of simulated vertices, if fewer than the file has; `None` if the text has none.
    pub vertices: Option<u64>,
}

/// Returns the mesh file that a valid scene file names, with its path resolved from the scene's folder; `None`
/// if the tissue is not a mesh. Of a scene that is not valid, it may return `None` or what it finds.
///
/// # Errors
/// Refuses a scene file that can't be read ([`files::read_text`], at most `limits.file_bytes` bytes) or is not
/// TOML.
pub fn mesh_file(scene: &Path, limits: &Limits) -> Result<Option<MeshFile>> {
    let text = files::read_text(scene, limits.file_bytes)?;
    let folder = scene.parent().unwrap_or(Path::new(""));
    Ok(said(&scene.display().to_string(), &text)?
        .map(|said| MeshFile { path: said.path.map(|path| folder.join(path)), ..said }))
}

/// Returns the mesh file that the text of a valid scene names, with the path as it is written; `None` if the
/// tissue is not a mesh, or if `file` or `vertices` is of the wrong kind. Refusals call the text `name`.
///
/// # Errors
/// Refuses a text that is not TOML.
pub fn said(name: &str, text: &str) -> Result<Option<MeshFile>> {
    let document = Document::parse(name, text)?;
    let mut found = None;
    let read = |fields: &mut Fields<'_>| {
        let unit = fields.item("unit").and_then(|item| unit_text(&item).ok());
        found = Some(MeshFile {
            path: fields.text("file")?.map(PathBuf::from),
            unit: unit.unwrap_or_default(),
            vertices: fields.item("vertices").map(|item| item.whole()).transpose()?,
        });
        Ok(())
    };
    // Other errors do not matter here: reading the scene checks them.
    let _ = document.read(|fields| {
        let section = fields.item("mesh").or_else(|| fields.item("solid"));
        section.map_or(Ok(()), |item| item.table(read))
    });
    Ok(found)
}

/// Returns the mesh that belongs to a scene besides its text ([`BodyKind::mesh`]) as a file to send: its name `"mesh.obj"`,
/// its bytes (OBJ, with groups and texture coordinates), and its unit `"m"`. `None` if the text describes the whole tissue.
///
/// [`BodyKind::mesh`]: super::BodyKind::mesh
pub fn file(scene: &Scene) -> Option<(&'static str, Vec<u8>, &'static str)> {
    Some(("mesh.obj", write(&scene.body.kind().mesh()?, Format::Obj), "m"))
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
