//! Writes every organ as an OBJ file, in metres: `cargo run --release --example organs -- FOLDER [EDGE_MM [SEED]]`.

use std::fmt::Write;
use std::path::PathBuf;

use palpate_geometry::organ::{Organ, generate};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().ok_or("give a folder")?);
    let edge_mm: f64 = arguments.next().map_or(Ok(2.5), |edge| edge.parse())?;
    let seed: u64 = arguments.next().map_or(Ok(1), |seed| seed.parse())?;
    std::fs::create_dir_all(&folder)?;
    for organ in Organ::ALL {
        let mesh = generate(organ, edge_mm * 1e-3, seed)?;
        let mut text = String::new();
        for place in &mesh.vertices_m {
            writeln!(text, "v {} {} {}", place.x, place.y, place.z)?;
        }
        for uv in mesh.uv.iter().flatten().flatten() {
            writeln!(text, "vt {} {}", uv[0], uv[1])?;
        }
        for (t, [a, b, c]) in mesh.triangles.iter().enumerate() {
            let uv = 3 * t + 1;
            writeln!(text, "f {}/{} {}/{} {}/{}", a + 1, uv, b + 1, uv + 1, c + 1, uv + 2)?;
        }
        std::fs::write(folder.join(format!("{organ}.obj")), text)?;
        let groups: Vec<&str> = mesh.groups.iter().map(|group| group.name.as_str()).collect();
        println!("{organ}: {} vertices, groups {}", mesh.vertices_m.len(), groups.join(", "));
    }
    Ok(())
}
