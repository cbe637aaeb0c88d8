//! NIfTI-1 label maps, `.nii` and `.nii.gz`.
//!
//! No crate is used: `nifti` takes the memory that the header asks for, whatever the file has.

use glam::{DMat3, DVec3};

use super::label_map::LabelMap;
use super::source::{Order, Scalar};
use super::voxels::{Unpacked, Voxels};
use crate::{Element, MeshError, Problem, Unit};

/// Length of the header, which is also its first number.
const HEADER: usize = 348;

/// Returns the byte order of a file whose header begins `bytes`.
fn order(bytes: &[u8]) -> Option<Order> {
    let first = bytes.get(..4)?;
    [Order::Little, Order::Big].into_iter().find(|order| Scalar::I32.integer(first, *order) == HEADER as i64)
}

/// Returns whether the content is a NIfTI file that is not compressed.
pub(super) fn is_plain(bytes: &[u8]) -> bool {
    order(bytes).is_some() && bytes.get(344..347) == Some(b"n+1")
}

/// Returns whether the content is compressed by gzip.
pub(super) fn is_gzip(bytes: &[u8]) -> bool {
    bytes.starts_with(&[0x1f, 0x8b])
}

/// Reads the header.
pub(super) fn read<'a>(name: &str, bytes: &'a [u8]) -> Result<LabelMap<'a>, MeshError> {
    let fail = |problem| MeshError { file: name.to_owned(), element: Element::Whole, place_m: None, problem };
    let unsupported = |message: String| fail(Problem::Unsupported { message });
    let is_gzip = is_gzip(bytes);
    let mut header = [0; HEADER];
    let truncated = |_| fail(Problem::Truncated { missing: "the header of NIfTI-1".to_owned() });
    Unpacked::new(bytes, is_gzip).and_then(|mut source| source.fill(&mut header)).map_err(truncated)?;
    if Scalar::I32.integer(&header, Order::Little) == 540 || Scalar::I32.integer(&header, Order::Big) == 540 {
        return Err(unsupported("NIfTI-2 is not read: save the label map as NIfTI-1 or NRRD".to_owned()));
    }
    let order = order(&header).filter(|_| &header[344..347] == b"n+1");
    let Some(order) = order else {
        let message = "the content is no NIfTI-1 file in one part (.nii or .nii.gz)";
        return Err(fail(Problem::Syntax { message: message.to_owned() }));
    };
    let whole = |at: usize| Scalar::I16.integer(&header[at..], order);
    let real = |at: usize| Scalar::F32.real(&header[at..], order);
    let dimensions = whole(40);
    let side = |axis: usize| if axis as i64 <= dimensions { whole(40 + 2 * axis) } else { 1 };
    if !(1..=7).contains(&dimensions) || (4..8).any(|axis| side(axis) != 1) {
        let message = format!("{dimensions} dimensions are not read: save one label map of three");
        return Err(unsupported(message));
    }
    let code = whole(70);
    let scalar = match code {
        2 => Scalar::U8,
        4 => Scalar::I16,
        8 => Scalar::I32,
        16 => Scalar::F32,
        64 => Scalar::F64,
        256 => Scalar::I8,
        512 => Scalar::U16,
        768 => Scalar::U32,
        1024 => Scalar::I64,
        1280 => Scalar::U64,
        _ => return Err(unsupported(format!("voxels of the type {code} are not read: save labels as whole numbers"))),
    };
    let slope = real(112);
    let offset = real(108);
    if !(HEADER as f64..1e9).contains(&offset) {
        return Err(fail(Problem::Syntax { message: format!("voxels at byte {offset}, within the header") }));
    }
    let (axes, origin) = placement(&header, order);
    let voxels = Voxels {
        sides: [1, 2, 3].map(|axis| usize::try_from(side(axis)).unwrap_or(0)),
        scalar,
        order,
        scale: if slope == 0.0 { [1.0, 0.0] } else { [slope, real(116)] },
        bytes,
        is_gzip,
        skip: offset as usize,
    };
    let unit = match header[123] & 7 {
        1 => Some(Unit::METRE),
        2 => Some(Unit::MILLIMETRE),
        3 => Some(Unit::MICROMETRE),
        _ => None,
    };
    Ok(LabelMap { voxels: Box::new(voxels), axes, origin, unit })
}

/// Returns the step from a voxel to the next along each axis, and the middle of the first voxel: by the affine
/// transformation, else by the rotation, else by the sizes of voxels, as the standard says.
fn placement(header: &[u8; HEADER], order: Order) -> (DMat3, DVec3) {
    let real = |at: usize| Scalar::F32.real(&header[at..], order);
    let whole = |at: usize| Scalar::I16.integer(&header[at..], order);
    let sizes = DVec3::new(real(80), real(84), real(88));
    if whole(254) > 0 {
        let row = |at: usize| [0, 4, 8, 12].map(|column| real(at + column));
        let rows = [row(280), row(296), row(312)];
        let column = |at: usize| DVec3::from_array(rows.map(|row| row[at]));
        return (DMat3::from_cols(column(0), column(1), column(2)), column(3));
    }
    if whole(252) > 0 {
        let [b, c, d] = [real(256), real(260), real(264)];
        let a = (1.0 - (b * b + c * c + d * d)).max(0.0).sqrt();
        let sign = if real(76) < 0.0 { -1.0 } else { 1.0 };
        let turn = DMat3::from_cols(
            DVec3::new(a * a + b * b - c * c - d * d, 2.0 * (b * c + a * d), 2.0 * (b * d - a * c)),
            DVec3::new(2.0 * (b * c - a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d + a * b)),
            DVec3::new(2.0 * (b * d + a * c), 2.0 * (c * d - a * b), a * a + d * d - b * b - c * c),
        );
        return (
            turn * DMat3::from_diagonal(sizes * DVec3::new(1.0, 1.0, sign)),
            DVec3::new(real(268), real(272), real(276)),
        );
    }
    (DMat3::from_diagonal(sizes), DVec3::ZERO)
}
