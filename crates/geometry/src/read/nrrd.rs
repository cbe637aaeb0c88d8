//! NRRD label maps (`.nrrd`, also `.seg.nrrd` of 3D Slicer), raw or compressed by gzip.
//!
//! No crate is used: there is none that is kept.

use glam::{DMat3, DVec3};

use super::label_map::LabelMap;
use super::source::{Order, Scalar, Source, parsed, shown};
use super::voxels::Voxels;
use crate::{MeshError, Problem, Unit};

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
    /// Signs that turn the space of directions and origin into left-posterior-superior, or another right-handed one.
    signs: Option<DVec3>,
    /// Whether vectors have a fourth number, of time.
    has_time: bool,
    unit: Option<Unit>,
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
    if scalar.size() > 1 && header.order.is_none() {
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
    // Without directions, the axes are not said to be those of the space.
    let signs = header.signs.filter(|_| header.directions.is_some()).unwrap_or(DVec3::ONE);
    let axes = DMat3::from_cols(step(x, DVec3::X), step(y, DVec3::Y), step(z, DVec3::Z));
    let axes = DMat3::from_diagonal(signs) * axes;
    Ok(LabelMap { voxels: Box::new(voxels), axes, origin: signs * header.origin, unit: header.unit })
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
            b"endian" => {
                self.order = Some(match &lower[..] {
                    b"little" => Order::Little,
                    b"big" => Order::Big,
                    _ => {
                        let message = format!("`{}` is no order of bytes: little or big", shown(text));
                        return Err(Problem::Syntax { message });
                    }
                });
            }
            b"space" => {
                let name = lower.strip_suffix(b"-time").unwrap_or(&lower);
                self.has_time =
                    name.len() < lower.len() || [b"rast", b"last", b"lpst"].iter().any(|short| name == *short);
                self.signs = Some(match name {
                    b"right-anterior-superior" | b"ras" | b"rast" => DVec3::new(-1.0, -1.0, 1.0),
                    b"left-anterior-superior" | b"las" | b"last" => DVec3::new(1.0, -1.0, 1.0),
                    b"left-posterior-superior" | b"lps" | b"lpst" | b"scanner-xyz" | b"3d-right-handed" => DVec3::ONE,
                    b"3d-left-handed" => DVec3::new(1.0, 1.0, -1.0),
                    _ => {
                        let space = shown(text);
                        return unsupported(format!(
                            "the space `{space}` is not read: save in left-posterior-superior"
                        ));
                    }
                });
            }
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
            b"space directions" => self.directions = Some(directions(text, self.has_time)?),
            b"spacings" => self.spacings = Some(numbers(text, "a spacing")?),
            b"space origin" => self.origin = vector(text, self.has_time)?,
            b"space units" => self.unit = unit(&lower),
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

/// Returns the directions of the axes: vectors in parentheses, or `none`. An axis of time alone is not in space.
fn directions(text: &[u8], has_time: bool) -> Result<Vec<Option<DVec3>>, Problem> {
    let mut found = Vec::new();
    let mut rest = text.trim_ascii_start();
    while !rest.is_empty() && found.len() < 16 {
        let end = if rest.starts_with(b"(") {
            let end = rest.iter().position(|byte| *byte == b')').map_or(rest.len(), |end| end + 1);
            let direction = vector(&rest[..end], has_time)?;
            found.push(Some(direction).filter(|direction| !has_time || *direction != DVec3::ZERO));
            end
        } else {
            found.push(None);
            rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len())
        };
        rest = rest[end..].trim_ascii_start();
    }
    Ok(found)
}

/// Returns a vector such as `(1,0,-0.5)`, without the number of time that may follow.
fn vector(text: &[u8], has_time: bool) -> Result<DVec3, Problem> {
    let inner = text.trim_ascii().strip_prefix(b"(").and_then(|text| text.strip_suffix(b")"));
    let parts = inner.into_iter().flat_map(|text| text.split(|byte| *byte == b','));
    let parts: Option<Vec<f64>> = parts.take(5).map(|part| parsed(part.trim_ascii())).collect();
    match parts.as_deref() {
        Some(&[x, y, z]) if !has_time => Ok(DVec3::new(x, y, z)),
        Some(&[x, y, z, _]) if has_time => Ok(DVec3::new(x, y, z)),
        _ => {
            let example = if has_time { "(1,0,0,0)" } else { "(1,0,0)" };
            Err(Problem::Syntax { message: format!("`{}` is not a vector such as {example}", shown(text)) })
        }
    }
}

/// Returns the unit of lengths, if it is one: the first word in quotes.
fn unit(text: &[u8]) -> Option<Unit> {
    match text.split(|byte| *byte == b'"').nth(1)? {
        b"um" | b"\xc2\xb5m" => Some(Unit::MICROMETRE),
        b"mm" => Some(Unit::MILLIMETRE),
        b"cm" => Some(Unit::CENTIMETRE),
        b"m" => Some(Unit::METRE),
        _ => None,
    }
}
