//! The coordinate frames of engines: directions of their axes, and length of their units.

use glam::DVec3;

use crate::error::CodedError;

/// The directions of axes, and the unit of positions.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum palpate_axes {
    /// Palpate's own axes: right-handed, x to the right, y away, z up; metres.
    #[default]
    PALPATE_AXES_OWN = 0,
    /// Unity's axes: left-handed, x to the right, y up, z away; metres. Triangles are clockwise from outside.
    PALPATE_AXES_UNITY = 1,
    /// Unreal's axes: left-handed, x away, y to the right, z up; centimetres. Textures start at the top.
    PALPATE_AXES_UNREAL = 2,
}

pub use palpate_axes::*;

/// A vector in the axes of the options.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_vector {
    /// The component along x.
    pub x: f64,
    /// The component along y.
    pub y: f64,
    /// The component along z.
    pub z: f64,
}

impl palpate_vector {
    pub(crate) fn own(v: DVec3) -> Self {
        palpate_vector { x: v.x, y: v.y, z: v.z }
    }

    pub(crate) fn vector(self) -> DVec3 {
        DVec3::new(self.x, self.y, self.z)
    }
}

impl palpate_axes {
    /// Returns the axes with this number; refuses an unknown one.
    pub(crate) fn of(number: u32) -> Result<Self, CodedError> {
        match number {
            0 => Ok(PALPATE_AXES_OWN),
            1 => Ok(PALPATE_AXES_UNITY),
            2 => Ok(PALPATE_AXES_UNREAL),
            _ => Err(CodedError::argument("axes: must be one of palpate_axes")),
        }
    }

    /// Converts a direction to these axes. Each conversion is its own inverse.
    pub(crate) fn turn<T>(self, [x, y, z]: [T; 3]) -> [T; 3] {
        match self {
            PALPATE_AXES_OWN => [x, y, z],
            PALPATE_AXES_UNITY => [x, z, y],
            PALPATE_AXES_UNREAL => [y, x, z],
        }
    }

    fn turned(self, v: DVec3) -> DVec3 {
        self.turn(v.to_array()).into()
    }

    /// Returns the number of units per metre.
    pub(crate) fn units_per_m(self) -> f64 {
        if self == PALPATE_AXES_UNREAL { 100.0 } else { 1.0 }
    }

    /// Converts a position, m, to these axes.
    pub(crate) fn position(self, place_m: DVec3) -> palpate_vector {
        palpate_vector::own(self.units_per_m() * self.turned(place_m))
    }

    /// Converts a position in these axes to metres.
    pub(crate) fn to_m(self, place: palpate_vector) -> DVec3 {
        self.turned(place.vector()) / self.units_per_m()
    }

    /// Converts a force, N, to these axes.
    pub(crate) fn force(self, force_n: DVec3) -> palpate_vector {
        palpate_vector::own(self.turned(force_n))
    }

    /// Returns whether triangles have their corners in clockwise order.
    pub(crate) fn is_clockwise(self) -> bool {
        self == PALPATE_AXES_UNITY
    }

    /// Returns whether the texture coordinate v starts at the top.
    pub(crate) fn has_top_first(self) -> bool {
        self == PALPATE_AXES_UNREAL
    }
}
