//! `palpate organ`: makes the mesh of an organ.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::io::Write as _;
use std::path::PathBuf;

use palpate_mesh::TriangleMesh;
use palpate_mesh::organ::{self, Organ, OrganError};

use super::{Failure, say, write_file};

#[derive(clap::Args)]
pub(crate) struct OrganArguments {
    /// The organ: a name of --list
    #[arg(required_unless_present = "list")]
    name: Option<String>,
    /// Length of the edges, mm: half as long gives four times as many vertices
    #[arg(long, value_name = "MM", default_value_t = 2.5)]
    edge_mm: f64,
    /// Seed of the shape, an integer
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// The OBJ file to write, in metres
    #[arg(short, long, value_name = "FILE.obj", required_unless_present = "list")]
    output: Option<PathBuf>,
    /// List the organs
    #[arg(long, exclusive = true)]
    list: bool,
}

/// Makes an organ, or lists them.
pub(crate) fn organ(arguments: &OrganArguments) -> Result<(), Failure> {
    let (Some(name), Some(output)) = (&arguments.name, &arguments.output) else { return list() };
    if output.extension().is_none_or(|extension| !extension.eq_ignore_ascii_case("obj")) {
        return Err(Failure::Refused(format!("--output: {}: must end in .obj", output.display())));
    }
    let refused = |argument: &str, error: OrganError| Failure::Refused(format!("{argument}: {error}"));
    let organ: Organ = name.parse().map_err(|error| refused("NAME", error))?;
    let mesh = organ::generate(organ, arguments.edge_mm * 1e-3, arguments.seed).map_err(|error| {
        let argument = if matches!(error, OrganError::NotAManifold { .. }) { "--seed" } else { "--edge-mm" };
        refused(argument, error)
    })?;
    write_file(output, obj(organ, &mesh).as_bytes())?;
    let groups: Vec<String> =
        mesh.groups.iter().map(|group| format!("{} ({})", group.name, group.vertices.len())).collect();
    let (vertices, triangles) = (mesh.vertices_m.len(), mesh.triangles.len());
    say!("{}: {vertices} vertices, {triangles} triangles; groups: {}", output.display(), groups.join(", "));
    Ok(())
}

/// Lists the organs.
fn list() -> Result<(), Failure> {
    let lines = Organ::ALL.map(|organ| format!("{organ:12} {}\n", organ.description()));
    std::io::stdout().write_all(lines.concat().as_bytes()).map_err(|error| Failure::Failed(error.to_string()))
}

/// An OBJ file: a triangle is in the groups that all its vertices are in.
fn obj(organ: Organ, mesh: &TriangleMesh) -> String {
    let mut text = format!("# {organ}, made by palpate organ; coordinates in metres\no {organ}\n");
    // Writing to a string does not fail.
    for place in &mesh.vertices_m {
        let _ = writeln!(text, "v {} {} {}", place.x, place.y, place.z);
    }
    let mut numbers = BTreeMap::new();
    for uv in mesh.uv.iter().flatten().flatten() {
        let count = numbers.len() + 1;
        numbers.entry(uv.map(f32::to_bits)).or_insert_with(|| {
            let _ = writeln!(text, "vt {} {}", uv[0], uv[1]);
            count
        });
    }
    let mut named = String::new();
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        let is_whole = |vertices: &[u32]| triangle.iter().all(|v| vertices.binary_search(v).is_ok());
        let groups = mesh.groups.iter().filter(|group| is_whole(&group.vertices));
        let names: Vec<&str> = groups.map(|group| group.name.as_str()).collect();
        let names = if names.is_empty() { "default".to_owned() } else { names.join(" ") };
        if names != named {
            let _ = writeln!(text, "g {names}");
            named = names;
        }
        text.push('f');
        for corner in 0..3 {
            let _ = write!(text, " {}", triangle[corner] + 1);
            let uv = mesh.uv.as_ref().and_then(|uv| numbers.get(&uv[t][corner].map(f32::to_bits)));
            if let Some(uv) = uv {
                let _ = write!(text, "/{uv}");
            }
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_has_all_vertices_triangles_and_groups() {
        let mesh = organ::generate(Organ::Gallbladder, 3.5e-3, 1).unwrap();
        let text = obj(Organ::Gallbladder, &mesh);
        let lines = |kind: &str| text.lines().filter(|line| line.split(' ').next() == Some(kind)).count();
        assert_eq!((lines("v"), lines("f")), (mesh.vertices_m.len(), mesh.triangles.len()));
        assert!(mesh.groups.iter().all(|group| text.contains(&format!("\ng {}\n", group.name))));
    }
}
