//! NRRD label maps (`.nrrd`, also `.seg.nrrd` of 3D Slicer), raw or compressed by gzip.
//!
//! No crate is used: there is none that is kept.

use glam::{DMat3, DVec3};

use super::label_map::LabelMap;
use super::source::{Order, Scalar, Source, parsed, shown};
use super::voxels::Voxels;
use crate::{MeshError, Problem};

/// The fields of a header that matter.
#[derive(Default)]
struct Header {
    scalar: Option<Scalar>,
    order: Option<Order>,
    sizes: Vec<usize>,
    is_gzip: Option<bool>,
    /// For each axis its direction; `None` for one that is not in space.
    directions: Option<Vec<Option<DVec3>>>,
    spacings: Option<Vec<f64>>,
    origin: DVec3,
    unit_m: Option<f64>,
    skip: usize,
}

/// Reads the header.
pub(super) fn read<'a>(mut source: Source<'a>) -> Result<LabelMap<'a>, MeshError> {
    source.line();
    let mut header = Header::default();
    loop {
        let line = source.line().ok_or_else(|| source.truncated("the empty line after the header"))?;
        if line.is_empty() {
            break;
        }
        let at = line.windows(2).position(|two| two == b": ");
        if let Some(at) = at.filter(|_| !line.starts_with(b"#")) {
            let name = line[..at].to_ascii_lowercase();
            header.field(&name, line[at + 2..].trim_ascii()).map_err(|problem| source.fail(problem))?;
        }
    }
    let missing = |what: &str| source.syntax(format!("the header has no `{what}`"));
    let scalar = header.scalar.ok_or_else(|| missing("type"))?;
    let is_gzip = header.is_gzip.ok_or_else(|| missing("encoding"))?;
    if scalar.size() > 1 && header.order.is_none() && !is_gzip {
        return Err(missing("endian"));
    }
    // An axis that is not in space, such as that of layers, is left out if it has one entry.
    let is_in_space = |axis: &usize| match &header.directions {
        Some(directions) => directions.get(*axis).is_some_and(Option::is_some),
        None => header.sizes.len() <= 3 || header.sizes[*axis] != 1,
    };
    let axes: Vec<usize> = (0..header.sizes.len()).filter(is_in_space).collect();
    let others = (0..header.sizes.len()).filter(|axis| !axes.contains(axis));
    let [x, y, z] = axes[..] else {
        let message = format!("{} axes in space are not read: save one label map of three", axes.len());
        return Err(source.fail(Problem::Unsupported { message }));
    };
    for axis in others {
        if header.sizes[axis] != 1 {
            let layers = header.sizes[axis];
            let message =
                format!("{layers} layers of labels are not read: save segments that do not overlap as one layer");
            return Err(source.fail(Problem::Unsupported { message }));
        }
    }
    let step = |axis: usize, unit: DVec3| match (&header.directions, &header.spacings) {
        (Some(directions), _) => directions[axis].unwrap_or(unit),
        (None, Some(spacings)) => unit * spacings.get(axis).copied().unwrap_or(1.0),
        (None, None) => unit,
    };
    let bytes = source.rest();
    let voxels = Voxels {
        sides: [x, y, z].map(|axis| header.sizes[axis]),
        scalar,
        order: header.order.unwrap_or(Order::Little),
        scale: [1.0, 0.0],
        bytes,
        is_gzip,
        skip: header.skip,
    };
    let axes = DMat3::from_cols(step(x, DVec3::X), step(y, DVec3::Y), step(z, DVec3::Z));
    Ok(LabelMap { voxels: Box::new(voxels), axes, origin: header.origin, unit_m: header.unit_m })
}

impl Header {
    /// Takes a field, whose name is in lower case.
    fn field(&mut self, name: &[u8], text: &[u8]) -> Result<(), Problem> {
        let unsupported = |message: String| Err(Problem::Unsupported { message });
        let lower = text.to_ascii_lowercase();
        match name {
            b"type" => {
                self.scalar = Some(match &lower[..] {
                    b"signed char" | b"int8" | b"int8_t" => Scalar::I8,
                    b"uchar" | b"unsigned char" | b"uint8" | b"uint8_t" => Scalar::U8,
                    b"short" | b"short int" | b"signed short" | b"signed short int" | b"int16" | b"int16_t" => {
                        Scalar::I16
                    }
                    b"ushort" | b"unsigned short" | b"unsigned short int" | b"uint16" | b"uint16_t" => Scalar::U16,
                    b"int" | b"signed int" | b"int32" | b"int32_t" => Scalar::I32,
                    b"uint" | b"unsigned int" | b"uint32" | b"uint32_t" => Scalar::U32,
                    b"longlong" | b"long long" | b"long long int" | b"int64" | b"int64_t" => Scalar::I64,
                    b"ulonglong" | b"unsigned long long" | b"uint64" | b"uint64_t" => Scalar::U64,
                    b"float" => Scalar::F32,
                    b"double" => Scalar::F64,
                    _ => return unsupported(format!("voxels of the type `{}` are not read", shown(text))),
                });
            }
            b"sizes" => self.sizes = numbers(text, "a size")?,
            b"endian" => self.order = Some(if lower == b"big" { Order::Big } else { Order::Little }),
            b"encoding" => {
                self.is_gzip = Some(match &lower[..] {
                    b"raw" => false,
                    b"gzip" | b"gz" => true,
                    _ => {
                        return unsupported(format!("the encoding `{}` is not read: save as raw or gzip", shown(text)));
                    }
                });
            }
            b"data file" | b"datafile" => {
                return unsupported("voxels in another file are not read: save one .nrrd file".to_owned());
            }
            b"space directions" => self.directions = Some(directions(text)?),
            b"spacings" => self.spacings = Some(numbers(text, "a spacing")?),
            b"space origin" => self.origin = vector(text)?,
            b"space units" => self.unit_m = unit_m(&lower),
            b"byte skip" | b"byteskip" => {
                self.skip = parsed(text).ok_or_else(|| super::source::no_number(text, "a count of bytes to skip"))?;
            }
            b"line skip" | b"lineskip" if text != b"0" => {
                return unsupported("`line skip` is not read: save again without it".to_owned());
            }
            _ => {}
        }
        Ok(())
    }
}

fn numbers<T: std::str::FromStr>(text: &[u8], what: &str) -> Result<Vec<T>, Problem> {
    let number = |word| parsed(word).ok_or_else(|| super::source::no_number(word, what));
    super::source::words(text).take(16).map(number).collect()
}

/// Returns the directions of the axes: vectors in parentheses, or `none`.
fn directions(text: &[u8]) -> Result<Vec<Option<DVec3>>, Problem> {
    let mut found = Vec::new();
    let mut rest = text.trim_ascii_start();
    while !rest.is_empty() && found.len() < 16 {
        let end = if rest.starts_with(b"(") {
            let end = rest.iter().position(|byte| *byte == b')').map_or(rest.len(), |end| end + 1);
            found.push(Some(vector(&rest[..end])?));
            end
        } else {
            found.push(None);
            rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len())
        };
        rest = rest[end..].trim_ascii_start();
    }
    Ok(found)
}

/// Returns a vector such as `(1,0,-0.5)`.
fn vector(text: &[u8]) -> Result<DVec3, Problem> {
    let inner = text.trim_ascii().strip_prefix(b"(").and_then(|text| text.strip_suffix(b")"));
    let parts: Vec<f64> = inner
        .into_iter()
        .flat_map(|text| text.split(|byte| *byte == b','))
        .filter_map(|part| parsed(part.trim_ascii()))
        .collect();
    let vector = <[f64; 3]>::try_from(parts).map(DVec3::from_array);
    vector.map_err(|_| Problem::Syntax { message: format!("`{}` is not a vector such as (1,0,0)", shown(text)) })
}

/// Returns the unit of lengths in metres, if it is one: the first word in quotes.
fn unit_m(text: &[u8]) -> Option<f64> {
    match text.split(|byte| *byte == b'"').nth(1)? {
        b"mm" => Some(1e-3),
        b"cm" => Some(1e-2),
        b"m" => Some(1.0),
        _ => None,
    }
}
