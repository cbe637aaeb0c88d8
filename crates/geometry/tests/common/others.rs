//! The octahedron as other programs and people write it, and solids whose faces have more than three corners.

use std::fmt::Write;

use super::{
    MIDDLE, TRIANGLES, VERTICES, bytes, coordinates, glb_of, gltf_json, lines, obj, ply_header, stl_binary, stl_text,
};

/// An OBJ file of an old program: a byte order mark, lines that end in carriage returns alone, `$` for comments, NULs
/// at the end.
pub fn obj_of_old() -> Vec<u8> {
    let text = obj().replace("# an octahedron", "$ an octahedron\n# of \\").replace('\n', "\r");
    [b"\xef\xbb\xbf", text.as_bytes(), b"\0\0\x1a"].concat()
}

/// A text file of two solids, which end with a space.
pub fn stl_of_two() -> String {
    let text = stl_text().to_uppercase().replace("ENDSOLID", "END SOLID");
    let half = text.match_indices(" FACET").nth(4).unwrap().0;
    format!("\u{feff}{}END SOLID\r\nsolid\n{}", &text[..half], &text[half..])
}

/// A binary file that begins with "solid", and has bytes after the last triangle.
pub fn stl_with_more() -> Vec<u8> {
    [stl_binary(), b"made by hand\n".to_vec()].concat()
}

/// With columns that the header does not name, a list before the vertices, blank lines, and no line feeds at all.
pub fn ply_wide() -> String {
    let mut text =
        ply_header("ascii").replace("element face 8\n", "element face 8\nproperty list uchar float weights\n");
    for [x, y, z] in VERTICES {
        writeln!(text, "{x} {y} {z} 255 0.5 0.25").unwrap();
    }
    text += "\ncomment faces\n";
    for [a, b, c] in TRIANGLES {
        writeln!(text, "2 0.5 0.5 3 {a} {b} {c} 6 0.1 0.2 0.3 0.4 0.5 0.6").unwrap();
    }
    text.replace('\n', "\r")
}

/// Triangle strips, one after the other in one list.
pub fn ply_strips(is_binary: bool) -> Vec<u8> {
    let header = ply_header(if is_binary { "binary_big_endian" } else { "ascii" });
    let header = header.replace("element face 8", "element tristrips 1").replace("list uchar int", "list int int");
    let mut file = header.into_bytes();
    for at in VERTICES {
        if is_binary {
            file.extend(bytes(at.map(|part| (part as f32).to_be_bytes())));
            file.push(255);
        } else {
            file.extend(format!("{} {} {} 255\n", at[0], at[1], at[2]).bytes());
        }
    }
    let strips: Vec<i32> = TRIANGLES.iter().flat_map(|[a, b, c]| [*a as i32, *b as i32, *c as i32, -1]).collect();
    let numbers = std::iter::once(strips.len() as i32).chain(strips);
    if is_binary {
        file.extend(bytes(numbers.map(i32::to_be_bytes)));
    } else {
        numbers.for_each(|number| file.extend(format!("{number} ").bytes()));
    }
    file
}

/// Keywords in lower case, strips, and fields with strings, bits, and numbers of every type.
pub fn vtk_fields(is_binary: bool) -> Vec<u8> {
    let kind = if is_binary { "binary" } else { "ascii" };
    let mut file = format!("# vtk datafile version 4.2\n\n{kind}\nfield FieldData 5\n").into_bytes();
    let information = b"\nMETADATA\nINFORMATION 1\nNAME RANGE LOCATION vtkDataArray\nDATA 2 0 7\n\n";
    file.extend(b"SPACE 1 3 string\n");
    if is_binary {
        // Their lengths in one, one and two bytes.
        file.extend([b"\xc3LPS\xc0\x80\x50".as_slice(), &[b'x'; 80]].concat());
    } else {
        file.extend(b"LPS\n\nPOINTS%201%20float\n");
    }
    file.extend(b"\nbits 1 11 bit\n");
    file.extend(if is_binary { &b"\xa5\xe0"[..] } else { b"1 0 1 0 0 1 0 1 1 1 1" });
    file.extend(information);
    file.extend(b"ids 2 1 vtkIdType\n");
    file.extend(if is_binary { &b"\0\0\0\x01\0\0\0\x02"[..] } else { b"1 2" });
    file.extend(b"\nNULL_ARRAY\nletters 2 1 unsigned_char\n");
    file.extend(if is_binary { &b"\x01\xff"[..] } else { b"1 255" });
    file.extend(information);
    file.extend(b"dataset polydata\npoints 6 Double\n");
    let strips = TRIANGLES.iter().flat_map(|[a, b, c]| [3, *a, *b, *c]);
    if is_binary {
        file.extend(bytes(coordinates().map(f64::to_be_bytes)));
        file.extend(b"\nmetadata\ninformation 0\n\ntriangle_strips 8 32\n");
        file.extend(bytes(strips.map(u32::to_be_bytes)));
    } else {
        file.extend(lines(&VERTICES).bytes());
        file.extend(b"metadata\ninformation 0\n\ntriangle_strips 8 32\n");
        strips.for_each(|number| file.extend(format!("{number} ").bytes()));
    }
    file
}

/// Two pyramids with a common square, one of them with reversed orientation and written twice.
pub fn vtk_pyramids() -> String {
    format!(
        "# vtk DataFile Version 3.0\npyramids\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 6 float\n{}CELLS 3 18\n\
         5 0 2 1 3 4\n5 0 2 1 3 5\n5 1 2 0 3 5\nCELL_TYPES 3\n14 14 14\n",
        lines(&VERTICES)
    )
}

/// The tetrahedra around the middle of the octahedron, in both orientations, with vertices numbered from `first`.
fn tetrahedra(first: u32) -> impl Iterator<Item = [u32; 4]> {
    TRIANGLES.into_iter().zip(0..).map(move |([a, b, c], number)| {
        let corners = if number % 2 == 0 { [a, b, c, 6] } else { [b, a, c, 6] };
        corners.map(|corner| corner + first)
    })
}

/// MEDIT's text, with a comment and sections that are not read.
pub fn medit_text() -> String {
    let mut text = String::from("MeshVersionFormatted 2\nDimension\n3 # of space\nVertices\n7\n");
    for [x, y, z] in VERTICES.into_iter().chain([MIDDLE]) {
        writeln!(text, "{x} {y} {z} 1").unwrap();
    }
    text += "Edges 1\n1 2 0\nTriangles\n1\n1 3 5 4\nRequiredVertices\n2\n1\n2 # and\n# then\nTetrahedra\n8\n";
    for ([a, b, c, d], number) in tetrahedra(1).zip(0..) {
        writeln!(text, "{a} {b} {c} {d} {}", number / 4).unwrap();
    }
    text + "Normals\n1\n0 0 -1\nEnd\n"
}

/// MEDIT's binary format in version 2 or 4, which differ in the width of whole numbers and positions.
pub fn medit_binary(version: i32) -> Vec<u8> {
    let mut file = [1_i32.to_le_bytes(), version.to_le_bytes()].concat();
    let whole = |number: i64| -> Vec<u8> {
        if version == 4 { number.to_le_bytes().to_vec() } else { (number as i32).to_le_bytes().to_vec() }
    };
    let position = whole(0).len();
    let mut section = |code: i32, content: Vec<u8>| {
        file.extend(code.to_le_bytes());
        file.extend(whole((file.len() + position + content.len()) as i64));
        file.extend(content);
    };
    section(3, 3_i32.to_le_bytes().to_vec());
    let mut vertices = whole(7);
    for at in VERTICES.into_iter().chain([MIDDLE]) {
        vertices.extend(bytes(at.map(f64::to_le_bytes)));
        vertices.extend(whole(0));
    }
    section(4, vertices);
    // Normals, which are skipped.
    section(60, [whole(1), vec![0; 24]].concat());
    let mut elements = whole(8);
    for corners in tetrahedra(1) {
        corners.into_iter().chain([2]).for_each(|number| elements.extend(whole(i64::from(number))));
    }
    section(8, elements);
    file.extend([54_i32.to_le_bytes(), 0_i32.to_le_bytes()].concat());
    file
}

/// TetGen's files `.ele` and `.node`, with attributes, markers and comments, numbered from 0 or 1.
pub fn tetgen(first: u32) -> [String; 2] {
    let mut elements = String::from("# of TetGen\n8 4 1\n");
    for (corners, number) in tetrahedra(first).zip(first..) {
        let [a, b, c, d] = corners;
        writeln!(elements, "{number} {a} {b} {c} {d} {} # one", number % 2 + 1).unwrap();
    }
    let mut nodes = String::from("7  3 1  1\n");
    for ([x, y, z], number) in VERTICES.into_iter().chain([MIDDLE]).zip(first..) {
        writeln!(nodes, "   {number}  {x} {y}  {z} 0.5 {}", i32::from(z > 0.0)).unwrap();
    }
    [elements, nodes + "# Generated by tetgen\n"]
}

/// An input file of Abaqus with one part in an assembly, comments, continued lines and a reference point.
pub fn abaqus() -> String {
    let mut text = String::from("*Heading\n** of a part\n*Part, name=Organ\n*Node, nset=all,\n system=R\n");
    for ([x, y, z], number) in VERTICES.into_iter().chain([MIDDLE]).zip(1..) {
        writeln!(text, "{:5}, {x:?}, {y:?},{z:e}", 10 * number).unwrap();
    }
    text += "*Element, type=S3R, elset=skin\n90, 10, 30, 50\n*ELEMENT, TYPE=C3D4H, ELSET=Organ\n";
    for ([a, b, c, d], number) in tetrahedra(1).zip(1..) {
        writeln!(text, "{number}, {}, {},\n {}, {}", 10 * a, 10 * b, 10 * c, 10 * d).unwrap();
    }
    text += "*Elset, elset=half, generate\n1, 4, 1\n*End Part\n*Assembly, name=A\n*Instance, name=I, part=Organ\n";
    text + "*End Instance\n*Node\n10, 500., 0., 0.\n*Nset, nset=point\n10,\n*End Assembly\n*Material, name=m\n*Elastic\n8000., 0.45\n"
}

/// Requires texture extensions, and has NULs after the JSON.
pub fn glb_with_textures() -> Vec<u8> {
    let required = r#"{"extensionsRequired":["KHR_texture_transform","EXT_texture_webp","KHR_materials_unlit"],"#;
    let mut json = gltf_json("").replacen('{', required, 1).into_bytes();
    while !json.len().is_multiple_of(4) {
        json.push(0);
    }
    glb_of(&json)
}

/// A file of another solid.
pub struct VolumeMesh {
    pub name: &'static str,
    pub text: String,
    /// Number of vertices in triangles, and of triangles.
    pub counts: [usize; 2],
    /// cm² and ml, if lengths are mm.
    pub area_cm2: f64,
    pub volume_ml: f64,
}

/// Solids whose faces have more than three corners.
pub fn solids() -> Vec<VolumeMesh> {
    let solid = |name, text: &str, counts, area_cm2, volume_ml| VolumeMesh {
        name,
        text: text.to_owned(),
        counts,
        area_cm2,
        volume_ml,
    };
    vec![
        solid("hexahedron.vtk", include_str!("hexahedron.vtk"), [8, 12], 40.221, 14.512),
        solid("mixed.vtk", include_str!("mixed.vtk"), [11, 18], 36.868, 14.0),
        solid("mixed.vtu", include_str!("mixed.vtu"), [11, 18], 36.868, 14.0),
        solid("mixed.msh", include_str!("mixed.msh"), [11, 18], 36.868, 14.0),
        // A tetrahedron of ten nodes.
        solid(
            "ten.inp",
            "*NODE\n1,0,0,0\n2,10,0,0\n3,0,10,0\n4,0,0,10\n5,5,0,0\n6,5,5,0\n7,0,5,0\n8,0,0,5\n9,5,0,5\n10,0,5,5\n\
             *ELEMENT,TYPE=C3D10M,ELSET=all\n1,1,2,3,4,5,6,7,8,\n9,10\n",
            [10, 16],
            2.36603,
            0.166_667,
        ),
        solid("angle.obj", include_str!("angle.obj"), [12, 20], 14.0, 3.0),
        solid("star.ply", include_str!("star.ply"), [20, 36], 23.144, 4.114),
        solid("frame.obj", include_str!("frame.obj"), [16, 32], 12.0, 1.5),
    ]
}
