//! `palpate organ`: makes the mesh of an organ.

use std::io::Write as _;
use std::path::PathBuf;

use palpate_geometry::organ::{self, Organ, OrganError};
use palpate_geometry::write::{Format, write};

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
    /// The file to write, in metres: .obj, .stl or .ply
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// List the organs
    #[arg(long, exclusive = true)]
    list: bool,
}

/// Makes an organ, or lists them.
pub(crate) fn organ(arguments: &OrganArguments) -> Result<(), Failure> {
    let Some(name) = &arguments.name else { return list() };
    let refused = |argument: &str, error: OrganError| Failure::Refused(format!("{argument}: {error}"));
    let organ: Organ = name.parse().map_err(|error| refused("NAME", error))?;
    let Some(output) = &arguments.output else {
        return Err(Failure::Refused(format!("--output: is missing: give the file to write, such as {organ}.obj")));
    };
    let format = Format::of(&output.display().to_string());
    let format = format.map_err(|problem| Failure::Refused(format!("--output: {problem}")))?;
    let mesh = organ::generate(organ, arguments.edge_mm * 1e-3, arguments.seed).map_err(|error| {
        let argument = if matches!(error, OrganError::NotAManifold { .. }) { "--seed" } else { "--edge-mm" };
        refused(argument, error)
    })?;
    write_file(output, &write(&mesh, format))?;
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
