//! The parts of a solid that never move.

use glam::DVec3;
use palpate_geometry::fill::Lattice;

use crate::scene::toml_document::Item;
use palpate_refusal::{Reason, Refusal, Result, finite_vector, not_negative, positive};

/// A part of space whose points of a solid never move.
#[derive(Debug, Clone, PartialEq)]
pub enum FixedPart {
    /// The points within a distance of a plane. At least one layer of them: if the plane lies between points, those at
    /// either side.
    Plane {
        /// A place of the plane, m.
        plane_m: DVec3,
        /// Its unit normal.
        normal: DVec3,
        /// The distance, m.
        within_m: f64,
    },
    /// The points within a ball.
    Ball {
        /// Its centre, m.
        centre_m: DVec3,
        /// Its radius, m.
        radius_m: f64,
    },
    /// The points that move most with the vertices of the mesh's group with this name.
    Group(String),
}

impl FixedPart {
    /// Creates a plane from a direction of any length, m.
    ///
    /// # Errors
    /// Refuses numbers that are not finite, a direction of length 0 and a negative distance. Fields are `plane_m`,
    /// `normal` and `within_m`.
    pub fn plane(plane_m: DVec3, normal: DVec3, within_m: f64) -> Result<Self> {
        let plane_m = finite_vector("plane_m", plane_m)?;
        let unit = finite_vector("normal", normal)?.try_normalize();
        let normal = unit.ok_or_else(|| Refusal::new(Reason::OutOfRange, "normal", "has no direction"))?;
        Ok(FixedPart::Plane { plane_m, normal, within_m: not_negative("within_m", within_m)? })
    }

    /// Creates a ball, m.
    ///
    /// # Errors
    /// Refuses numbers that are not finite, and a radius that is not above 0. Fields are `centre_m` and `radius_m`.
    pub fn ball(centre_m: DVec3, radius_m: f64) -> Result<Self> {
        let centre_m = finite_vector("centre_m", centre_m)?;
        Ok(FixedPart::Ball { centre_m, radius_m: positive("radius_m", radius_m)? })
    }

    /// Reads `solid.fixed`, one part or a list of parts.
    ///
    /// # Errors
    /// Refuses a text, a part that is neither a plane nor a ball, and numbers out of their range.
    pub(super) fn read_list(item: &Item<'_>) -> Result<Vec<Self>> {
        if item.as_text().is_some() {
            return Err(item.wrong(
                "\"none\", or a list of planes { plane_m, normal, within_m }, balls { centre_m, radius_m } and groups { group }",
            ));
        }
        let Ok(items) = item.list() else { return Ok(vec![read_part(item)?]) };
        items.iter().map(read_part).collect()
    }

    /// Returns whether a point of a lattice is in the part; false for a group, which has points of its own.
    pub(super) fn holds(&self, lattice: &Lattice, place_m: DVec3) -> bool {
        match *self {
            FixedPart::Group(_) => false,
            FixedPart::Plane { plane_m, normal, within_m } => {
                // Half the extent of a cube along the normal; a rounding error more, for a plane half way.
                let layer_m = 0.5 * lattice.edge_m * normal.abs().element_sum() * (1.0 + 1e-9);
                let is_on_points = along_axis(normal).is_some_and(|axis| {
                    let at = lattice.from_m(plane_m)[axis];
                    (at - at.round()).abs() < 1e-6
                });
                let within_m = if is_on_points { within_m } else { within_m.max(layer_m) };
                (place_m - plane_m).dot(normal).abs() <= within_m + 1e-6 * lattice.edge_m
            }
            FixedPart::Ball { centre_m, radius_m } => place_m.distance(centre_m) <= radius_m,
        }
    }
}

/// Returns the axis that a unit vector is along, if it is along one.
pub(super) fn along_axis(normal: DVec3) -> Option<usize> {
    (0..3).find(|axis| normal[*axis].abs() > 1.0 - 1e-9)
}

fn read_part(item: &Item<'_>) -> Result<FixedPart> {
    item.table(|fields| {
        if let Some(name) = fields.text("group")? {
            return Ok(FixedPart::Group(name));
        }
        let part = match fields.item("centre_m") {
            Some(centre) => FixedPart::ball(centre.vector()?, fields.required_number("radius_m")?),
            None => {
                let (plane_m, normal) = (fields.required("plane_m")?.vector()?, fields.required("normal")?.vector()?);
                FixedPart::plane(plane_m, normal, fields.number("within_m")?.unwrap_or(0.0))
            }
        };
        part.map_err(|refusal| fields.refuse(refusal.reason, &refusal.field, refusal.message))
    })
}
