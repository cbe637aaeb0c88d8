//! Label maps of scans: a label becomes the closed surface of an organ, as large as its voxels and without their stairs.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use common::{Scan, gzip, small_scan};
use glam::{DMat3, DVec3};
use palpate_geometry::fill::{Lattice, filled};
use palpate_geometry::organ::{Organ, generate};
use palpate_geometry::{MeshError, ReadLimits, ReadMesh, TriangleMesh, Unit, read, read_label, report};

fn mm() -> Unit {
    "mm".parse().unwrap()
}

fn read_mm(name: &str, bytes: &[u8], label: i64) -> Result<ReadMesh, MeshError> {
    read_label(name, bytes, label, Some(mm()), &ReadLimits::default())
}

/// Asserts that a surface is closed and of some parts, and encloses the voxels of a label. Returns the mesh.
#[track_caller]
fn encloses(what: &str, scan: &Scan, label: u8, parts: usize) -> TriangleMesh {
    let mesh = read_mm("a.nii", &scan.nifti(false), i64::from(label)).unwrap_or_else(|e| panic!("{what}: {e}")).mesh;
    let told = report(&mesh);
    assert_eq!((told.holes, told.components, told.refusal()), (0, parts, None), "{what}: {told:?}");
    let ratio = told.volume_m3.unwrap() * 1e9 / scan.volume(label);
    println!("{what}: {} vertices, volume {ratio:.5} of that of the voxels", mesh.vertices_m.len());
    assert!((ratio - 1.0).abs() < 1e-3, "{what}: {ratio}");
    mesh
}

/// Mean angle between the triangles of a mesh and the surface of an ellipsoid, degrees; and the largest distance, mm, of its vertices
/// from it, to first order.
fn errors(mesh: &TriangleMesh, axes: DVec3, turn: DMat3) -> [f64; 2] {
    let normal = |at: DVec3| turn * (turn.transpose() * at / (axes * axes));
    let (mut sum, mut area) = (0.0, 0.0);
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|vertex| mesh.vertices_m[vertex as usize] * 1e3);
        let double = (b - a).cross(c - a);
        sum += double.length() * double.angle_between(normal((a + b + c) / 3.0)).to_degrees();
        area += double.length();
    }
    let far = |at: &DVec3| {
        let at = turn.transpose() * *at * 1e3;
        let level = (at / axes).length_squared() - 1.0;
        (level / (2.0 * (at / (axes * axes)).length())).abs()
    };
    [sum / area, mesh.vertices_m.iter().map(far).fold(0.0, f64::max)]
}

#[test]
fn the_surface_of_a_label_has_its_volume_and_place_and_no_stairs() {
    let axes = DVec3::new(30.0, 24.0, 18.0);
    let turn = DMat3::from_rotation_x(0.5) * DMat3::from_rotation_z(0.4);
    for (what, size, most) in [
        ("voxels of 1 mm", DVec3::ONE, [2.5, 0.4]),
        ("fine voxels", DVec3::splat(0.4), [1.0, 0.2]),
        ("slices of 3 mm", DVec3::new(0.8, 0.8, 3.0), [4.5, 1.5]),
        ("slices of 5 mm", DVec3::new(0.7, 0.7, 5.0), [9.0, 2.5]),
    ] {
        let scale = DMat3::from_diagonal(size);
        let sides = (DVec3::splat(66.0) / size).to_array().map(|side| side as usize);
        let inside = |at: DVec3| u8::from((turn.transpose() * at / axes).length() < 1.0) * 2;
        let scan = Scan::of(sides, scale, DVec3::splat(-33.0) + 0.5 * size, inside);
        let mesh = encloses(what, &scan, 2, 1);
        let [degrees, far] = errors(&mesh, axes, turn);
        println!("{what}: {degrees:.2} degrees, {far:.2} mm");
        assert!(degrees < most[0] && far < most[1], "{what}: {degrees} degrees, {far} mm");
    }
}

#[test]
fn a_liver_of_voxels_of_a_millimetre_is_a_liver() {
    let liver = generate(Organ::Liver, 4e-3, 1).unwrap();
    let least = liver.vertices_m.iter().copied().fold(DVec3::INFINITY, DVec3::min);
    let most = liver.vertices_m.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
    let cells = ((most - least) * 1e3).to_array().map(|side| side as usize + 3);
    let lattice = Lattice { origin_m: least - 1e-3, edge_m: 1e-3, cells };
    let parts = filled(&liver.vertices_m, &liver.triangles, &lattice).parts;
    let labels = parts.iter().map(|part| u8::from(*part > 0.5)).collect();
    let scan = Scan { sides: cells, axes: DMat3::IDENTITY, origin: lattice.origin_m * 1e3 + 0.5, labels };
    let mesh = encloses("liver", &scan, 1, 1);
    let told = report(&mesh);
    let ratio = told.volume_m3.unwrap() / report(&liver).volume_m3.unwrap();
    assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
    assert_eq!(told.problems, [], "even triangles, of which none cut each other");
}

#[test]
fn what_is_thin_or_small_keeps_its_volume() {
    let plate = Scan::of([40, 30, 9], DMat3::IDENTITY, DVec3::ZERO, |at| {
        u8::from(at.z == 4.0 && (3.0..36.0).contains(&at.x) && (3.0..26.0).contains(&at.y))
    });
    encloses("a plate of one voxel", &plate, 1, 1);
    let cube = Scan::of([7, 7, 7], DMat3::IDENTITY, DVec3::ZERO, |at| u8::from(at.distance(DVec3::splat(3.0)) < 1.5));
    encloses("a few voxels", &cube, 1, 1);
    let whole = Scan::of([20, 20, 20], DMat3::IDENTITY, DVec3::ZERO, |_| 1);
    encloses("all voxels", &whole, 1, 1);
    let one = Scan::of([1, 1, 1], DMat3::IDENTITY, DVec3::ZERO, |_| 1);
    encloses("one voxel", &one, 1, 1);
}

#[test]
fn formats_orders_and_encodings_give_the_same_surface_also_in_turned_and_mirrored_axes() {
    let small = small_scan();
    let turn = DMat3::from_rotation_y(0.7) * DMat3::from_diagonal(DVec3::new(-0.75, 1.0, 1.25));
    let scan = Scan { axes: turn, origin: DVec3::new(100.0, -50.0, 20.0), ..small };
    let wanted = encloses("mirrored", &scan, 3, 2);
    let middle = wanted.vertices_m.iter().sum::<DVec3>() / wanted.vertices_m.len() as f64 * 1e3;
    assert!(middle.distance(scan.origin + turn * DVec3::new(7.5, 6.5, 5.5)) < 0.5, "{middle}");
    for (name, bytes) in [
        ("a.nii", scan.nifti(true)),
        ("a.nii.gz", gzip(&scan.nifti(false))),
        ("a.nrrd", scan.nrrd(false, false)),
        ("a.nrrd", scan.nrrd(true, true)),
    ] {
        let found = read_mm(name, &bytes, 3).unwrap_or_else(|e| panic!("{e}")).mesh;
        assert_eq!(found.triangles, wanted.triangles, "{name}");
        // NIfTI has its axes in single precision.
        let far = found.vertices_m.iter().zip(&wanted.vertices_m).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
        assert!(far < 1e-8, "{name}: {far}");
    }
    for (space, signs) in [
        ("LPS", [1.0, 1.0, 1.0]),
        ("right-anterior-superior", [-1.0, -1.0, 1.0]),
        ("left-anterior-superior-time", [1.0, -1.0, 1.0]),
        ("LAST", [1.0, -1.0, 1.0]),
        ("3D-right-handed", [1.0, 1.0, 1.0]),
        ("3D-left-handed", [1.0, 1.0, -1.0]),
    ] {
        let signs = DVec3::from_array(signs);
        let axes = DMat3::from_diagonal(signs) * scan.axes;
        let file = Scan { axes, origin: signs * scan.origin, labels: scan.labels.clone(), ..scan }.nrrd(false, false);
        let mut file = edited(&file, "left-posterior-superior", space);
        if space.ends_with("time") || space == "LAST" {
            file = (0..4)
                .fold(file, |file, _| edited(&file, ")", ",0]"))
                .into_iter()
                .map(|b| if b == b']' { b')' } else { b })
                .collect();
        }
        let found = read_mm("a.nrrd", &file, 3).unwrap_or_else(|e| panic!("{e}")).mesh;
        assert_eq!(found, read_mm("a.nrrd", &scan.nrrd(false, false), 3).unwrap().mesh, "{space}");
    }
}

/// Returns a file with the first of a text replaced.
#[track_caller]
fn edited(file: &[u8], from: &str, to: &str) -> Vec<u8> {
    let text: String = file.iter().map(|byte| char::from(*byte)).collect();
    assert!(text.contains(from), "{from}");
    text.replacen(from, to, 1).chars().map(|letter| letter as u8).collect()
}

#[test]
fn the_icon_of_a_segmentation_does_not_change_it() {
    let wanted = read_mm("a.dcm", common::DICOM_BITS, 1).unwrap();
    let content = b"\x28\0\x10\0US\x02\0\x01\0\x28\0\x11\0US\x02\0\x01\0\x28\0\x30\0DS\x04\x009\\9 \
        \x28\0\0\x01US\x02\0\x08\0\xe0\x7f\x10\0OW\0\0\x02\0\0\0\0\0";
    let length = |bytes: usize| u32::try_from(bytes).unwrap().to_le_bytes();
    let mut icon = [b"\x88\0\0\x02SQ\0\0", &length(content.len() + 8)[..], b"\xfe\xff\0\xe0"].concat();
    icon.extend([&length(content.len())[..], content].concat());
    let at = common::DICOM_BITS.windows(4).rposition(|four| four == b"\xe0\x7f\x10\0").unwrap();
    let (before, pixels) = common::DICOM_BITS.split_at(at);
    for file in [[before, &icon, pixels].concat(), [before, pixels, &icon].concat()] {
        assert_eq!(read_mm("a.dcm", &file, 1), Ok(wanted.clone()));
    }
}

#[test]
fn label_maps_of_other_programs_are_read_where_they_are() {
    // nibabel 5.4, pynrrd 1.1 and highdicom 0.28. NumPy counts voxels of 4.5 mm³, and finds their middle.
    let of_arrays = DVec3::new(18.247_427_53, -14.999_797_96, 20.0);
    let of_slices = DVec3::new(36.876_489_06, -9.237_151_95, 20.0);
    for (name, bytes, label, voxels, middle) in [
        ("a.nii.gz", &include_bytes!("common/written/nibabel.nii.gz")[..], 4, 432.0, of_arrays),
        ("qform.nii", include_bytes!("common/written/nibabel-qform.nii"), 4, 432.0, of_arrays),
        ("a.nrrd", include_bytes!("common/written/pynrrd.nrrd"), 4, 432.0, of_arrays),
        ("bits.dcm", common::DICOM_BITS, 1, 432.0, of_slices),
        ("bits.dcm", common::DICOM_BITS, 2, 56.0, of_slices),
        ("fraction.dcm", include_bytes!("common/written/highdicom-fraction.dcm"), 1, 432.0, of_slices),
        ("labels.dcm", common::DICOM_LABELS, 1, 376.0, of_slices),
        ("implicit.dcm", include_bytes!("common/written/highdicom-implicit.dcm"), 2, 56.0, of_slices),
    ] {
        let mesh = read_mm(name, bytes, label).unwrap_or_else(|e| panic!("{e}")).mesh;
        let told = report(&mesh);
        // Of the file of labels the first has a cavity, which the second fills.
        let parts = if voxels == 376.0 { 2 } else { 1 };
        assert_eq!((told.holes, told.components, told.refusal()), (0, parts, None), "{name}: {told:?}");
        let ratio = told.volume_m3.unwrap() * 1e9 / (4.5 * voxels);
        assert!((ratio - 1.0).abs() < 1e-3, "{name}: {ratio}");
        let found = mesh.vertices_m.iter().sum::<DVec3>() / mesh.vertices_m.len() as f64 * 1e3;
        assert!(found.distance(middle) < 0.1, "{name}: {found}");
    }
}

#[test]
fn a_label_map_names_its_labels_and_what_is_not_read() {
    let scan = small_scan();
    let nrrd = scan.nrrd(false, false);
    let with = |from: &str, to: &str| {
        read_mm("a.nrrd", &edited(&nrrd, from, to), 3).map_or_else(|e| e.to_string(), |_| "read".to_owned())
    };
    let dicom = |from: &str, to: &str| {
        let bent = edited(common::DICOM_BITS, from, to);
        read_mm("a.dcm", &bent, 1).map_or_else(|e| e.to_string(), |_| "read".to_owned())
    };
    let plain = |name: &str, bytes: &[u8]| read(name, bytes, mm(), &|_| None, &ReadLimits::default());
    let mut two = scan.nifti(false);
    two[0..4].copy_from_slice(&540_i32.to_le_bytes());
    let image = Scan::of([24, 24, 24], DMat3::IDENTITY, DVec3::ZERO, |_| 0);
    let mut image = image.nifti(false);
    image[352..]
        .chunks_exact_mut(4)
        .zip(0_u16..)
        .for_each(|(voxel, n)| voxel.copy_from_slice(&f32::from(n).to_le_bytes()));
    let short = scan.nifti(false);
    for (says, message) in [
        ("choose one of its labels 3, 7", plain("a.nrrd", &nrrd).unwrap_err().to_string()),
        ("no voxel has the label 4: there are 3, 7", read_mm("a.nrrd", &nrrd, 4).unwrap_err().to_string()),
        ("no voxel has the label 0", read_mm("a.nrrd", &nrrd, 0).unwrap_err().to_string()),
        ("a file of Obj has no labels", read_mm("a.obj", common::obj().as_bytes(), 3).unwrap_err().to_string()),
        ("NIfTI-2 is not read", read_mm("a.nii", &two, 3).unwrap_err().to_string()),
        ("this is an image, not a label map", read_mm("a.nii", &image, 3).unwrap_err().to_string()),
        ("a part of the voxels is missing", read_mm("a.nii", &short[..short.len() - 1], 3).unwrap_err().to_string()),
        ("line 10: the encoding `bzip2` is not read", with("encoding: raw", "encoding: bzip2")),
        ("line 3: voxels of the type `block`", with("type: short", "type: block")),
        ("voxels in another file are not read", with("encoding: raw", "data file: x.raw")),
        ("the header has no `endian`", with("endian: little\n", "")),
        ("the header has no `endian`", with("endian: little\nencoding: raw", "encoding: gzip")),
        ("line 9: `foo` is no order of bytes", with("endian: little", "endian: foo")),
        ("line 5: the space `patient` is not read", with("left-posterior-superior", "patient")),
        ("line 7: `(1,x,0,0)` is not a vector", with("(1,0,0)", "(1,x,0,0)")),
        ("the axes of the voxels are not finite, in one plane", with("(1,0,0)", "(0,1,0)")),
        ("2 axes in space are not read", with("sizes: 16 14 12", "sizes: 16 14")),
        (
            "4 layers of labels are not read",
            with("sizes: 16 14 12\nspace directions:", "sizes: 4 16 14 3\nspace directions: none"),
        ),
        (
            "byte 294: the transfer syntax 1.2.840.10008.1.2.5 is not read",
            dicom("1.2.840.10008.1.2.1\0", "1.2.840.10008.1.2.5\0"),
        ),
        ("a segmentation of the type BLURRY with 1 bits", dicom("BINARY", "BLURRY")),
        ("frames that are shifted, or unevenly apart", dicom("\\13.0", "\\13.9")),
        ("where numbers are expected: 3", dicom("\\13.0", "\\13.x")),
        ("two frames of one segment at one place", dicom("\\13.0", "\\15.0")),
        ("it has no voxels", dicom("\u{e0}\u{7f}\u{10}\0", "\u{e0}\u{7f}\u{11}\0")),
        ("read", with("sizes: 16 14 12\nspace directions:", "sizes: 1 16 14 12\nspace directions: none")),
        ("each side has from 1", with("16 14 12", "0 14 12")),
        ("more than 2147483648 bytes of voxels", with("16 14 12", "60000 60000 60000")),
    ] {
        assert!(message.contains(says), "{says}: {message}");
    }
    // The only label of a file need not be named, and another unit in the file is told.
    let one =
        Scan::of([9, 9, 9], DMat3::IDENTITY, DVec3::ZERO, |at| u8::from(at.distance(DVec3::splat(4.0)) < 3.0) * 5);
    let found = read("a.nii", &one.nifti(false), Unit::METRE, &|_| None, &ReadLimits::default()).unwrap();
    assert!(found.notes[0].contains("the label 5. Voxels: "), "{:?}", found.notes);
    assert!(found.notes[1].contains("in units of 0.001 m, not in m"), "{:?}", found.notes);
    // Without a unit, it is that of the file, or else mm.
    let mut file = one.nifti(false);
    for (code, metres) in [(0, 1e-3), (1, 1.0), (2, 1e-3), (3, 1e-6)] {
        file[123] = code;
        let found = read_label("a.nii", &file, 5, None, &ReadLimits::default()).unwrap();
        assert_eq!((found.unit.metres(), found.notes.len()), (metres, 1), "{code}: {:?}", found.notes);
        let ratio = report(&found.mesh).volume_m3.unwrap() / (one.volume(5) * metres.powi(3));
        assert!((ratio - 1.0).abs() < 1e-3, "{code}: {ratio}");
    }
}
