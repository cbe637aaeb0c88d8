//! The octahedron as other programs and people write it, and solids whose faces have more than three corners.

use std::fmt::Write;

use super::{TRIANGLES, VERTICES, bytes, coordinates, glb_of, gltf_json, lines, obj, ply_header, stl_binary, stl_text};

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
        solid("angle.obj", include_str!("angle.obj"), [12, 20], 14.0, 3.0),
        solid("star.ply", include_str!("star.ply"), [20, 36], 23.144, 4.114),
        solid("frame.obj", include_str!("frame.obj"), [16, 32], 12.0, 1.5),
    ]
}
