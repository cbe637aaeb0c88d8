//! Splits polygons into triangles: a fan from the first corner where this is correct, otherwise ear clipping in the
//! polygon's plane.
//!
//! A list of triangles whose sides add up to the border of a polygon covers it exactly once if the polygon does not
//! cross itself and all triangles have the same orientation: the number of triangles at a point, counted with their
//! sign, is the winding number of the border there, 1 inside and 0 outside. So only the orientation of each triangle
//! has to be checked.

use glam::{DVec2, DVec3};

/// Triangles whose height is below this fraction of their longest side are treated as degenerate, because of
/// rounding.
const ROUNDING: f64 = 1e-10;

/// How a polygon was split.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Split {
    /// As a fan from its first corner.
    Fan,
    /// By ear clipping, because it is concave.
    Ears,
    /// As a fan that may fold, because the polygon crosses itself, has no plane or is too large.
    Folded,
}

/// Orientation of a triangle in the plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Turn {
    Left,
    None,
    Right,
}

fn turn(a: DVec2, b: DVec2, c: DVec2) -> Turn {
    // Twice the area. Divided by the longest side, it is the height.
    let double = (b - a).perp_dot(c - a);
    let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
    match double {
        _ if double > ROUNDING * longest => Turn::Left,
        _ if double < -ROUNDING * longest => Turn::Right,
        _ => Turn::None,
    }
}

/// Projects the corners onto the plane that fits them best, counterclockwise. `None` if there is no such plane.
fn flattened(corners: &[DVec3]) -> Option<Vec<DVec2>> {
    let first = *corners.first()?;
    let size = corners.iter().map(|at| (*at - first).abs().max_element()).fold(0.0, f64::max);
    if !(size > 0.0 && size.is_finite()) {
        return None;
    }
    let scaled: Vec<DVec3> = corners.iter().map(|at| (*at - first) / size).collect();
    // Newell's normal: twice the area vector of the border.
    let normal: DVec3 = scaled.iter().zip(scaled.iter().cycle().skip(1)).map(|(a, b)| a.cross(*b)).sum();
    let normal = (normal.length() > ROUNDING).then(|| normal.normalize())?;
    let x = normal.any_orthonormal_vector();
    let y = normal.cross(x);
    Some(scaled.iter().map(|at| DVec2::new(at.dot(x), at.dot(y))).collect())
}

/// Returns the triangles of a polygon of at least three corners, as indices into `corners`, and how it was split.
/// `work` is the number of comparisons that may be made, and is reduced.
pub(super) fn triangles(corners: &[DVec3], work: &mut u64) -> (Vec<[usize; 3]>, Split) {
    let fan: Vec<[usize; 3]> = (2..corners.len()).map(|place| [0, place - 1, place]).collect();
    if fan.len() == 1 {
        return (fan, Split::Fan);
    }
    let Some(flat) = flattened(corners) else { return (fan, Split::Folded) };
    if fan.iter().all(|[a, b, c]| turn(flat[*a], flat[*b], flat[*c]) == Turn::Left) {
        return (fan, Split::Fan);
    }
    match ears(&flat, work) {
        Some(triangles) => (triangles, Split::Ears),
        None => (fan, Split::Folded),
    }
}

/// Cuts off ears one after the other: an ear is a corner whose triangle contains no other corner. A corner on a
/// straight line is cut off only if there is no ear. `None` if the polygon crosses itself, or if `work` is used up.
fn ears(flat: &[DVec2], work: &mut u64) -> Option<Vec<[usize; 3]>> {
    let mut ring: Vec<usize> = (0..flat.len()).collect();
    let mut triangles = Vec::with_capacity(flat.len());
    let mut start = 0;
    while ring.len() > 2 {
        let count = ring.len();
        let triangle = |place: usize| [ring[(place + count - 1) % count], ring[place], ring[(place + 1) % count]];
        let turn_at = |place: usize| {
            let [a, b, c] = triangle(place).map(|corner| flat[corner]);
            turn(a, b, c)
        };
        let turns: Vec<Turn> = (0..count).map(turn_at).collect();
        // If any corner is within a triangle, one of these is.
        let reflex: Vec<usize> =
            (0..count).filter(|place| turns[*place] != Turn::Left).map(|place| ring[place]).collect();
        *work = work.checked_sub(count as u64)?;
        let (mut ear, mut straight) = (None, None);
        for place in (start..count).chain(0..start) {
            if turns[place] == Turn::None && straight.is_none() {
                straight = Some(place);
            }
            if turns[place] != Turn::Left {
                continue;
            }
            *work = work.checked_sub(reflex.len() as u64)?;
            let own = triangle(place).map(|corner| flat[corner]);
            if !reflex.iter().any(|corner| is_within(flat[*corner], own)) {
                ear = Some(place);
                break;
            }
        }
        let place = ear.or(straight)?;
        triangles.push(triangle(place));
        ring.remove(place);
        // Continues with the next corner, so that the triangles are not all at one corner.
        start = place % ring.len();
    }
    Some(triangles)
}

/// Returns whether a point is in a triangle or on its border, excluding its corners.
fn is_within(place: DVec2, [a, b, c]: [DVec2; 3]) -> bool {
    ![a, b, c].contains(&place)
        && [(a, b), (b, c), (c, a)].into_iter().all(|(from, to)| turn(from, to, place) != Turn::Right)
}
