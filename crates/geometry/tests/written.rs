//! Volume meshes as other programs write them: Gmsh 4.15 and meshio 5.3. Each encloses what its writer computed.
//!
//! All are a ball of 30 mm with a lump of 12 mm in it, in tetrahedra with edges of 22 mm.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use palpate_geometry::report::volume;
use palpate_geometry::{MeshError, ReadLimits, ReadMesh, Unit, read, report};

/// The volume of the tetrahedra, and of those of the lump, mm³: Gmsh's measure `volume` of its elements.
const BALL: f64 = 96_948.466_380_465_12;
const LUMP: f64 = 4_923.665_238_105_63;

/// The volume within the triangles of the curved mesh, each split at the middles of its edges, mm³: by its nodes alone,
/// computed with NumPy. Gmsh integrates 112,768.8 over the curved elements; the ball has 113,097.3, and the corners alone
/// enclose 96,948.5.
const CURVED: f64 = 108_730.082_617_365_83;

macro_rules! written {
    ($($name:literal),*) => { [$(($name, &include_bytes!(concat!("common/written/", $name))[..])),*] };
}

fn files() -> [(&'static str, &'static [u8]); 8] {
    written!(
        "gmsh.mesh",
        "gmsh.inp",
        "gmsh-curved.inp",
        "meshio.mesh",
        "meshio.meshb",
        "meshio.inp",
        "meshio.node",
        "meshio.ele"
    )
}

fn read_mm(name: &str, bytes: &[u8]) -> Result<ReadMesh, MeshError> {
    let beside = |wanted: &str| files().into_iter().find(|(name, _)| *name == wanted).map(|(_, bytes)| bytes.to_vec());
    read(name, bytes, "mm".parse::<Unit>().unwrap(), &beside, &ReadLimits::default())
}

fn refusal(name: &str, text: &str) -> String {
    read_mm(name, text.as_bytes()).map_or_else(|e| e.to_string(), |found| panic!("{name} is read: {:?}", found.mesh))
}

#[test]
fn a_volume_mesh_encloses_what_its_writer_computes() {
    for (name, bytes) in files() {
        let found = read_mm(name, bytes).unwrap_or_else(|e| panic!("{e}"));
        let told = report(&found.mesh);
        assert_eq!((told.holes, told.components, told.refusal()), (0, 1, None), "{name}: {told:?}");
        let wanted = if name.contains("curved") { CURVED } else { BALL };
        let ratio = told.volume_m3.unwrap() * 1e9 / wanted;
        assert!((ratio - 1.0).abs() < 1e-9, "{name}: {ratio}");
        // meshio writes no element sets.
        let regions = &found.mesh.regions;
        assert_eq!(regions.len(), if name == "meshio.inp" { 0 } else { 2 }, "{name}");
        if !regions.is_empty() {
            let least = regions.iter().map(|region| volume(&region.vertices_m, &region.triangles)).reduce(f64::min);
            let ratio = least.unwrap() * 1e9 / LUMP;
            assert!((ratio - 1.0).abs() < 1e-9, "{name}: {ratio}");
        }
    }
    let names = |at: usize| -> Vec<String> {
        let (name, bytes) = files()[at];
        read_mm(name, bytes).unwrap().mesh.regions.into_iter().map(|region| region.name).collect()
    };
    assert_eq!(names(0), ["medit:ref 5", "medit:ref 3"]);
    assert_eq!(names(1), ["Volume2", "Volume3"]);
    assert_eq!(names(7), ["region 5", "region 3"]);
}

#[test]
fn tetgen_numbers_points_from_0_or_1_and_either_file_may_be_named() {
    for first in [0, 1] {
        let [elements, nodes] = common::tetgen(first);
        let beside = |name: &str| match name {
            "a.node" => Some(nodes.clone().into_bytes()),
            "a.ele" => Some(elements.clone().into_bytes()),
            _ => panic!("{name}"),
        };
        for (name, text) in [("a.node", &nodes), ("folder/a.ele", &elements)] {
            let found = read(name, text.as_bytes(), Unit::METRE, &beside, &ReadLimits::default()).unwrap().mesh;
            assert_eq!((found.vertices_m.len(), found.triangles.len()), (6, 8));
            let marked = found.groups.iter().find(|group| group.name == "marker 1").unwrap();
            assert_eq!((marked.vertices.as_slice(), found.regions.len()), (&[4][..], 2));
        }
    }
    let [elements, nodes] = common::tetgen(0);
    let with = |elements: &str, nodes: &str| {
        let beside = |_: &str| Some(nodes.as_bytes().to_vec());
        read("a.ele", elements.as_bytes(), Unit::METRE, &beside, &ReadLimits::default()).unwrap_err().to_string()
    };
    for (says, message) in [
        ("a.ele: line 7: vertex 9 does not exist", with(&elements.replace("4 2 0 5 6", "4 2 0 9 6"), &nodes)),
        ("a.ele: line 7: the row ends early", with(&elements.replace("4 2 0 5 6 1 #", "4 2 0 #"), &nodes)),
        ("a.ele: line 2: elements of 5 nodes are not read", with(&elements.replace("8 4 1", "8 5 1"), &nodes)),
        ("a.node: line 1: points of dimension 2", with(&elements, &nodes.replace("7  3", "7  2"))),
        ("a.node: line 4: `x` is not a number", with(&elements, &nodes.replace("0 100  0", "0 x  0"))),
        ("a.node: line 4: node 1 is there twice", with(&elements, &nodes.replace("   2  ", "   1  "))),
        ("a.node: line 1: the file ends early", with(&elements, "")),
    ] {
        assert!(message.starts_with(says), "{message}");
    }
    let alone = read("a.node", nodes.as_bytes(), Unit::METRE, &|_| None, &ReadLimits::default()).unwrap_err();
    assert!(alone.to_string().contains("the file `a.ele`, which this one names, can't be read"), "{alone}");
}

#[test]
fn medit_and_abaqus_name_what_they_do_not_read() {
    let medit = common::medit_text();
    let abaqus = common::abaqus();
    for (says, message) in [
        ("line 3: a mesh of dimension 2", refusal("a.mesh", &medit.replace("3 # of", "2 # of"))),
        ("line 25: vertex 8 does not exist", refusal("a.mesh", &medit.replace("1 3 5 7 0", "1 3 5 9 0"))),
        ("the file ends early: `End`", refusal("a.mesh", &medit.replace("End", ""))),
        ("the file ends early: the section Vertices", refusal("a.mesh", "MeshVersionFormatted 1\nEnd\n")),
        ("`0,5` has a decimal comma", refusal("a.mesh", &medit.replace("0 0 0 1", "0 0 0,5 1"))),
        ("line 1: a part of the mesh is in another file", refusal("a.inp", "*Include, input=mesh.inp\n")),
        ("line 2: a part of the mesh is in another file", refusal("a.inp", "*Heading\n*Node, input=n.txt\n")),
        (
            "an assembly of more than one instance",
            refusal("a.inp", &abaqus.replace("*Node\n10", "*Instance\n*Node\n10")),
        ),
        (
            "line 3: an instance that is translated or rotated",
            refusal("a.inp", "*Instance, name=a\n0, 0, 0.\n0,0,0, 0,0,1, 90.\n"),
        ),
        ("elements in more than one part", refusal("a.inp", &(abaqus.clone() + "*PART\n*ELEMENT,TYPE=S3\n"))),
        ("elements of the type CAX4R are not read", refusal("a.inp", &abaqus.replace("C3D4H", "CAX4R"))),
        ("nodes in the system `C` are not read", refusal("a.inp", &abaqus.replace("system=R", "system=C"))),
        ("line 17: vertex 71 does not exist", refusal("a.inp", &abaqus.replacen(" 50, 70", " 50, 71", 1))),
        ("*ELEMENT without TYPE=", refusal("a.inp", "*ELEMENT, ELSET=a\n")),
        ("the file ends early: the section of elements", refusal("a.inp", "*NODE\n1,0,0,0\n")),
    ] {
        assert!(message.contains(says), "{says}: {message}");
    }
}
