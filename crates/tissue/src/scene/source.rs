//! Reads or generates the mesh of a scene: a file beside the scene, or an organ.

use std::path::Path;
use std::sync::{Arc, Mutex};

use palpate_geometry::organ::{self, Organ, OrganError};
use palpate_geometry::{ReadLimits, TriangleMesh, Unit};

use crate::files;
use crate::limits::Limits;
use crate::lock::lock;
use crate::scene::toml_document::{Fields, Item};
use palpate_refusal::{Reason, Result, excerpt};

/// The files that a scene may name.
#[derive(Debug, Clone, Copy)]
pub(super) enum Files<'a> {
    /// No file: the scene came from a client.
    None,
    /// The files in a folder.
    In(&'a Path),
    /// One mesh file, given by its name and bytes.
    Given(&'a str, &'a [u8]),
}

/// A mesh and its origin.
pub(super) enum SourceMesh {
    /// A generated mesh, which is free of defects.
    Made(TriangleMesh),
    /// The mesh of a file.
    Read(TriangleMesh),
}

impl Files<'_> {
    /// Reads the mesh that a section names by `organ`, or by `file`, `unit` and the `label` of a scan, whose unit is the
    /// file's own, or mm, if there is none. Also returns the key, for refusals.
    pub(super) fn mesh<'a>(self, fields: &mut Fields<'a>, limits: &Limits) -> Result<(SourceMesh, Item<'a>)> {
        if let Some(organ) = fields.item("organ") {
            if let Some(file) = fields.item("file") {
                return Err(file.refuse(Reason::WrongKind, "does not go with organ: a mesh is read or made"));
            }
            return Ok((SourceMesh::Made(made(&organ, limits)?), organ));
        }
        let label = fields.item("label").map(|item| item.whole()).transpose()?;
        let unit = if label.is_some() && fields.item("unit").is_none() {
            None
        } else {
            let item = fields.required("unit")?;
            let unit = unit_text(&item)?.parse::<Unit>();
            Some(unit.map_err(|_| item.wrong("\"m\", \"cm\", \"mm\" or the metres of a unit"))?)
        };
        let file = fields.required("file")?;
        Ok((SourceMesh::Read(self.read(&file, label, unit, limits)?), file))
    }

    /// Reads the mesh file that an item names, or a label of it. Files that this file names in turn must have bare names and be
    /// in the same folder.
    fn read(self, item: &Item<'_>, label: Option<u64>, unit: Option<Unit>, limits: &Limits) -> Result<TriangleMesh> {
        // Refusals use the name in the scene, so that clients do not learn where the server's files are.
        let name = item.text()?;
        let refuse = |message: String| Err(item.refuse(Reason::WrongKind, message));
        let (bytes, path) = match self {
            Files::None => return refuse("names a file: a scene that a client sends can't".to_owned()),
            Files::Given(given, _) if given != name => {
                return refuse(format!(
                    "names `{}`, but the mesh that was given is `{}`",
                    excerpt(&name),
                    excerpt(given)
                ));
            }
            Files::Given(_, bytes) => (bytes.to_owned(), None),
            Files::In(folder) => {
                let path = folder.join(&name);
                let bytes = files::read_regular(&path, limits.mesh_bytes)
                    .map_err(|refusal| item.refuse(refusal.reason, format!("{name}: {}", refusal.message)))?;
                (bytes, Some(path))
            }
        };
        let beside = |name: &str| files::read_regular(&path.as_ref()?.parent()?.join(name), limits.mesh_bytes).ok();
        let most = usize::try_from(limits.mesh_bytes).unwrap_or(usize::MAX);
        let within = ReadLimits { bytes: most, vertices: limits.points, triangles: limits.points.saturating_mul(4) };
        let found = match label {
            Some(label) => {
                let label = i64::try_from(label).unwrap_or(i64::MAX);
                palpate_geometry::read_label(&name, &bytes, label, unit, &within)
            }
            None => palpate_geometry::read(&name, &bytes, unit.unwrap_or_default(), &beside, &within),
        };
        Ok(found.map_err(|error| item.refuse(Reason::Unreadable, error.to_string()))?.mesh)
    }
}

/// Returns the unit that an item gives: its name, or its length in metres.
pub(super) fn unit_text(item: &Item<'_>) -> Result<String> {
    item.as_text().map_or_else(|| item.number().map(|metres| metres.to_string()), |text| Ok(text.to_owned()))
}

/// What determines a generated organ: its name, the bits of its edge length, its seed.
type Recipe = (&'static str, u64, u64);

/// The organs generated last, newest last. Generating one may take a second, and scenes are read again and
/// again.
static KEPT: Mutex<Vec<(Recipe, Arc<TriangleMesh>)>> = Mutex::new(Vec::new());

/// Largest number of organs that are kept, and of their vertices in all.
const MAX_KEPT: usize = 4;
const MAX_VERTICES_KEPT: usize = 200_000;

/// Generates the organ that a table describes, or copies it from those kept.
fn made(item: &Item<'_>, limits: &Limits) -> Result<TriangleMesh> {
    item.table(|fields| {
        let name = fields.required("name")?;
        let organ: Organ =
            name.text()?.parse().map_err(|error: OrganError| name.refuse(Reason::WrongKind, error.to_string()))?;
        let edge_m = fields.required_number("edge_m")?;
        let seed = fields.item("seed").map_or(Ok(1), |item| item.whole())?;
        let recipe = (organ.name(), edge_m.to_bits(), seed);
        let known = lock(&KEPT).iter().find(|(other, _)| *other == recipe).map(|(_, mesh)| mesh.clone());
        if let Some(mesh) = known {
            return Ok(TriangleMesh::clone(&mesh));
        }
        let mesh = organ::generate_within(organ, edge_m, seed, limits.points).map_err(|error| {
            let (reason, key) = match error {
                OrganError::TooFine { .. } => (Reason::TooLarge, "edge_m"),
                OrganError::NotAManifold { .. } => (Reason::OutOfRange, "seed"),
                _ => (Reason::OutOfRange, "edge_m"),
            };
            fields.refuse(reason, key, error.to_string())
        })?;
        if mesh.vertices_m.len() <= MAX_VERTICES_KEPT {
            let mut kept = lock(&KEPT);
            kept.retain(|(other, _)| *other != recipe);
            kept.push((recipe, Arc::new(mesh.clone())));
            let too_many = |kept: &[(Recipe, Arc<TriangleMesh>)]| {
                let vertices: usize = kept.iter().map(|(_, mesh)| mesh.vertices_m.len()).sum();
                kept.len() > MAX_KEPT || vertices > MAX_VERTICES_KEPT
            };
            while too_many(&kept) {
                kept.remove(0);
            }
        }
        Ok(mesh)
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use crate::limits::Limits;
    use crate::scene::Scene;

    /// A scan of 12 × 10 × 10 voxels with the label 3 in the middle 8 × 6 × 6.
    fn scan() -> Vec<u8> {
        let mut file = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 12 10 10\nencoding: raw\n\n".to_vec();
        let is_inner = |n: usize| {
            [(n % 12, 12), (n / 12 % 10, 10), (n / 120, 10)].iter().all(|(at, side)| (2..side - 2).contains(at))
        };
        file.extend((0..1200).map(|n| u8::from(is_inner(n)) * 3));
        file
    }

    fn solid(keys: &str) -> Result<f64, String> {
        let text = format!(
            "name = \"a\"\n[solid]\nfile = \"scan.nrrd\"\n{keys}\ncells = 500\nfixed = \"none\"\n\
             foundation_n_per_m3 = 2e4\n[material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = 0.45\n"
        );
        let scene = Scene::parse_given("scene", &text, ("scan.nrrd", &scan()), &Limits::default());
        let mesh = scene.map_err(|refusal| refusal.to_string())?.body.kind().mesh().unwrap();
        Ok(palpate_geometry::report::volume(&mesh.vertices_m, &mesh.triangles))
    }

    #[test]
    fn a_label_of_a_scan_is_a_solid_in_millimetres_unless_the_scene_says_another_unit() {
        // 288 voxels.
        for (keys, volume_m3) in
            [("label = 3", 288e-9), ("label = 3\nunit = \"cm\"", 288e-6), ("unit = \"mm\"", 288e-9)]
        {
            let found = solid(keys).unwrap();
            assert!((found / volume_m3 - 1.0).abs() < 1e-3, "{keys}: {found}");
        }
        for (keys, says) in [
            ("label = 2", "solid.file: scan.nrrd: no voxel has the label 2: there are 3"),
            ("label = \"liver\"", "solid.label: must be a whole number"),
            ("", "solid.unit: is missing"),
        ] {
            let refusal = solid(keys).unwrap_err();
            assert!(refusal.contains(says), "{refusal}");
        }
    }
}
