//! Changes distances on a grid so that the surface between its negative and positive points is a manifold.

/// Distance set at a grid point that is filled.
const FILLED: f32 = -1e-3;

/// Corners 0 to 7 of a cell have x, y and z in bits 0 to 2. The two diagonals of each of its six faces, as sets of
/// corners.
const FACES: [[u8; 2]; 6] = [
    [0b0000_1001, 0b0000_0110],
    [0b1001_0000, 0b0110_0000],
    [0b0010_0001, 0b0001_0010],
    [0b1000_0100, 0b0100_1000],
    [0b0100_0001, 0b0001_0100],
    [0b1000_0010, 0b0010_1000],
];

/// The four diagonals through a cell, as sets of corners.
const THROUGH: [u8; 4] = [0b1000_0001, 0b0100_0010, 0b0010_0100, 0b0001_1000];

/// Makes points of a grid of `points` along each axis negative until the surface between negative and positive ones is a manifold: it is not if the
/// signs at a face alternate, or two opposite corners of a cell differ from all others (Latecki, Eckhardt and
/// Rosenfeld, "Well-composed sets", 1995). That happens where a surface grazes the grid. Points are only ever filled,
/// so this ends.
pub(crate) fn fill_ambiguous(distances: &mut [f32], points: [usize; 3]) {
    let strides = [1, points[0], points[0] * points[1]];
    let corner = |origin: usize, corner: usize| {
        origin + (0..3).filter(|axis| corner >> axis & 1 == 1).map(|axis| strides[axis]).sum::<usize>()
    };
    loop {
        let mut is_manifold = true;
        for cell in 0..(points[0] - 1) * (points[1] - 1) * (points[2] - 1) {
            let (row, x) = (cell / (points[0] - 1), cell % (points[0] - 1));
            let origin = x + row % (points[1] - 1) * strides[1] + row / (points[1] - 1) * strides[2];
            let inside = (0..8).fold(0, |set, i| set | u8::from(distances[corner(origin, i)] < 0.0) << i);
            if inside == 0 || inside == u8::MAX {
                continue;
            }
            let face = FACES.iter().find_map(|&[one, other]| match (inside & one, inside & other) {
                (0, within) if within == other => Some(one),
                (within, 0) if within == one => Some(other),
                _ => None,
            });
            let is_through = THROUGH.contains(&inside) || THROUGH.contains(&!inside);
            let Some(outside) = face.or(is_through.then_some(!inside)) else { continue };
            let candidates = (0..8).filter(|i| outside >> i & 1 == 1).map(|i| corner(origin, i));
            // The candidate nearest to the surface.
            if let Some(nearest) = candidates.min_by(|&one, &other| distances[one].total_cmp(&distances[other])) {
                distances[nearest] = FILLED;
                is_manifold = false;
            }
        }
        if is_manifold {
            return;
        }
    }
}
