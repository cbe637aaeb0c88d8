//! `palpate mesh`: reads a mesh file, reports its properties and errors, repairs it and writes it.

use std::fmt::{self, Display};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use palpate_geometry::decimate::{MIN_VERTICES, decimate};
use palpate_geometry::repair::{Repair, SurfaceMeasure, repair};
use palpate_geometry::report::{Finding, LISTED, MeshReport, Spread};
use palpate_geometry::write::{Format, write};
use palpate_geometry::{
    Group, MeshError, ReadLimits, TriangleMesh, Unit, VolumeRegion, prepare, read, read_label, report,
};
use palpate_refusal::printable::{printable, printable_json};
use palpate_tissue::files;
use serde::Serialize;

use super::{Failure, write_file};

#[derive(clap::Args)]
pub(crate) struct MeshArguments {
    /// The mesh file
    file: PathBuf,
    /// Unit of the file's lengths: m, cm, mm, or the metres of one unit; with --label by default the file's own or mm, else required
    #[arg(long, value_name = "UNIT")]
    unit: Option<String>,
    /// The label of a label map (NRRD, NIfTI, DICOM) whose surface is the mesh; default: its only one
    #[arg(long, value_name = "N")]
    label: Option<i64>,
    /// Write the report as JSON
    #[arg(long)]
    json: bool,
    /// Repair the mesh as far as possible, and report the repairs
    #[arg(long)]
    repair: bool,
    /// Make it coarser: at most this many vertices, 4 or more
    #[arg(long, value_name = "N")]
    vertices: Option<usize>,
    /// Write the mesh to a file that ends in .obj, .stl or .ply; its lengths are metres
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Report on a mesh.
#[derive(Default, Serialize)]
struct MeshDescription {
    file: String,
    /// Changes and omissions of reading.
    notes: Vec<String>,
    /// Changes that every scene makes, and those of repair and decimation.
    done: Vec<String>,
    /// Its size before, if it was repaired or made coarser.
    before: Option<SurfaceMeasure>,
    /// Reason why the result differs from the request.
    faults: Vec<String>,
    #[serde(flatten)]
    report: MeshReport,
    /// Vertices with a name, which `fixed` of a scene may give.
    groups: Vec<ToldGroup>,
    regions: Vec<ToldRegion>,
    /// Unit of the file, in which places are printed.
    #[serde(skip)]
    unit: Unit,
}

/// Vertices with a name.
#[derive(Serialize)]
struct ToldGroup {
    name: String,
    vertices: usize,
}

/// A part of the inside with a name.
#[derive(Serialize)]
struct ToldRegion {
    name: String,
    volume_m3: f64,
}

/// Checks a mesh; repairs and writes it if requested.
pub(crate) fn mesh(arguments: &MeshArguments) -> Result<(), Failure> {
    let name = arguments.file.display().to_string();
    if arguments.unit.is_none() && arguments.label.is_none() {
        let message = "no unit: mesh files do not state theirs; give --unit mm, cm, m, or the metres of one unit";
        return Err(Failure::Refused(format!("{name}: {message}")));
    }
    let unit = arguments.unit.as_deref().map(str::parse::<Unit>).transpose();
    let unit = unit.map_err(|problem| Failure::Refused(format!("--unit: {problem}")))?;
    if let Some(vertices) = arguments.vertices.filter(|vertices| *vertices < MIN_VERTICES) {
        let message = format!("--vertices: must be at least {MIN_VERTICES}, but is {vertices}");
        return Err(Failure::Refused(message));
    }
    let output = arguments.output.as_ref().map(|path| Ok((path, Format::of(&path.display().to_string())?)));
    let output = output
        .transpose()
        .map_err(|problem: palpate_geometry::Problem| Failure::Refused(format!("--output: {problem}")))?;
    let limits = ReadLimits::default();
    let bytes = files::read(&arguments.file, limits.bytes as u64)?;
    let folder = arguments.file.parent().unwrap_or(Path::new(""));
    let neighbours = |name: &str| files::read_regular(&folder.join(name), limits.bytes as u64).ok();
    let read = match arguments.label {
        Some(label) => read_label(&name, &bytes, label, unit, &limits),
        None => read(&name, &bytes, unit.unwrap_or_default(), &neighbours, &limits),
    };
    let found = match read {
        Ok(found) => found,
        Err(error) => return refuse(arguments, &name, error, unit.unwrap_or_default()),
    };
    drop(bytes);
    let unit = found.unit;
    let told = MeshDescription { file: name, notes: found.notes, unit, ..MeshDescription::default() };
    let (mut told, mesh) = treat(arguments, found.mesh, told);
    let group = |group: &Group| ToldGroup { name: group.name.clone(), vertices: group.vertices.len() };
    told.groups = mesh.groups.iter().map(group).collect();
    let region = |VolumeRegion { name, vertices_m, triangles }: &VolumeRegion| ToldRegion {
        name: name.clone(),
        volume_m3: palpate_geometry::report::volume(vertices_m, triangles),
    };
    told.regions = mesh.regions.iter().map(region).collect();
    print(arguments, &told)?;
    if let Some(finding) = told.report.refusal() {
        let message = format!("{}: {}", told.file, finding.text(unit));
        return Err(if arguments.repair { Failure::Failed(message) } else { Failure::Refused(message) });
    }
    output.map_or(Ok(()), |(path, format)| write_mesh(path, &mesh, format))?;
    if told.faults.is_empty() {
        return Ok(());
    }
    Err(Failure::Failed(format!("{}: not as asked for: {}", told.file, told.faults.join("; "))))
}

/// Repairs a mesh and makes it coarser, if requested, and reports the result.
fn treat(arguments: &MeshArguments, mesh: TriangleMesh, mut told: MeshDescription) -> (MeshDescription, TriangleMesh) {
    let mut mesh = if arguments.repair {
        let repaired = repair(&mesh, &Repair::default());
        (told.done, told.faults, told.before) = (repaired.told, repaired.faults, Some(repaired.before));
        told.report = report(&repaired.mesh);
        repaired.mesh
    } else {
        let prepared = prepare(mesh);
        told.report = prepared.report();
        told.done = prepared.notes;
        prepared.mesh
    };
    if let Some(vertices) = arguments.vertices.filter(|vertices| *vertices < mesh.vertices_m.len()) {
        let before = mesh.vertices_m.len();
        told.before = told.before.or_else(|| Some(SurfaceMeasure::of(&mesh)));
        mesh = decimate(&mesh, vertices).mesh;
        told.report = report(&mesh);
        told.done.push(format!("Vertices decimated: {before} to {}.", mesh.vertices_m.len()));
        if mesh.vertices_m.len() > vertices {
            told.faults.push(format!(
                "{} vertices are left, more than {vertices}: fewer would fold the surface",
                mesh.vertices_m.len()
            ));
        }
    }
    (told, mesh)
}

fn write_mesh(path: &Path, mesh: &TriangleMesh, format: Format) -> Result<(), Failure> {
    write_file(path, &write(mesh, format))
}

/// Reports a file that can't be read as a mesh; also as JSON, if requested.
fn refuse(arguments: &MeshArguments, name: &str, error: MeshError, unit: Unit) -> Result<(), Failure> {
    let message = error.to_string();
    if arguments.json {
        let report = MeshReport { problems: vec![Finding::from(error)], ..MeshReport::default() };
        print(arguments, &MeshDescription { file: name.to_owned(), report, unit, ..MeshDescription::default() })?;
    }
    Err(Failure::Refused(message))
}

fn print(arguments: &MeshArguments, told: &MeshDescription) -> Result<(), Failure> {
    let text = if arguments.json {
        printable_json(serde_json::to_string_pretty(told).map_err(|e| Failure::Failed(e.to_string()))?) + "\n"
    } else {
        told.to_string()
    };
    match std::io::stdout().write_all(text.as_bytes()) {
        // A reader that closed the pipe is not an error.
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(Failure::Failed(e.to_string())),
        _ => Ok(()),
    }
}

/// Largest number of groups that the table lists.
const GROUPS_TOLD: usize = 20;

/// The width of the names in the table.
const NAMES: usize = 16;

impl Display for MeshDescription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let report = &self.report;
        let mut row = |name: &str, value: &dyn Display| writeln!(f, "{name:NAMES$}{}", printable(value));
        let spread = |spread: &Spread, factor: f64, unit: &str| {
            let Spread { least, median, largest } = spread;
            format!("{:.3} to {:.3} {unit}, median {:.3}", least * factor, largest * factor, median * factor)
        };
        row("vertices", &report.vertices)?;
        row("triangles", &report.triangles)?;
        row("surfaces", &report.components)?;
        row("holes", &report.holes)?;
        for border in &report.borders {
            row("", &border.text(self.unit))?;
        }
        let [x, y, z] = report.extent_m.map(|side| side * 1e3);
        row("size", &format!("{x:.2} × {y:.2} × {z:.2} mm"))?;
        let was = |text: String| if self.before.is_some() { format!(", was {text}") } else { String::new() };
        let area = |area_m2: f64| format!("{:.3} cm²", area_m2 * 1e4);
        let volume = |volume_m3: Option<f64>, open: &str| {
            volume_m3.map_or_else(|| open.to_owned(), |volume_m3| format!("{:.3} ml", volume_m3 * 1e6))
        };
        let before = self.before.unwrap_or_default();
        row("area", &format!("{}{}", area(report.area_m2), was(area(before.area_m2))))?;
        let now = volume(report.volume_m3, "not closed: [volume] of a scene needs a mesh that is");
        row("volume", &format!("{now}{}", was(volume(before.volume_m3, "not closed"))))?;
        row("edges", &spread(&report.edge_m, 1e3, "mm"))?;
        row("triangle areas", &spread(&report.triangle_m2, 1e6, "mm²"))?;
        let Spread { least, median, largest } = report.valence;
        row("edges a vertex", &format!("{least:.0} to {largest:.0}, median {median:.0}"))?;
        for (number, ToldGroup { name, vertices }) in self.groups.iter().take(GROUPS_TOLD).enumerate() {
            row(if number == 0 { "groups" } else { "" }, &format!("{name}: {vertices} vertices"))?;
        }
        match self.groups.len().saturating_sub(GROUPS_TOLD) {
            0 => {}
            more => row("", &format!("and {more} more; --json lists all"))?,
        }
        for (number, ToldRegion { name, volume_m3 }) in self.regions.iter().take(GROUPS_TOLD).enumerate() {
            row(if number == 0 { "regions" } else { "" }, &format!("{name}: {:.3} ml", volume_m3 * 1e6))?;
        }
        for (name, lines) in [("read", &self.notes), ("done", &self.done)] {
            for line in lines {
                row(name, line)?;
            }
        }
        for fault in &self.faults {
            row("not as asked", fault)?;
        }
        for finding in &report.problems {
            row(if finding.problem.is_refused() { "refused" } else { "warning" }, &finding.text(self.unit))?;
        }
        for (name, count) in report.counts.iter().filter(|(_, count)| **count > LISTED) {
            row("and more", &format!("{count} of `{name}` in all"))?;
        }
        Ok(())
    }
}
