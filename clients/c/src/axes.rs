//! The coordinate frames of engines: directions of their axes, and length of their units.

use glam::{DQuat, DVec3};

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

/// An orientation in the axes of the options: it turns vectors of a device's frame into the frame around it, by the
/// formula that engines and textbooks use. Its length is 1.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct palpate_quaternion {
    /// The cosine of half of the angle.
    pub w: f64,
    /// The axis times the sine of half of the angle: its component along x.
    pub x: f64,
    /// The component along y.
    pub y: f64,
    /// The component along z.
    pub z: f64,
}

impl Default for palpate_quaternion {
    /// Returns the orientation that is not turned.
    fn default() -> Self {
        palpate_quaternion { w: 1.0, x: 0.0, y: 0.0, z: 0.0 }
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

    /// Converts a torque, N·m, to these axes. In left-handed axes its direction is opposite: a × b is, too.
    pub(crate) fn torque(self, torque_n_m: DVec3) -> palpate_vector {
        palpate_vector::own(self.axial(torque_n_m))
    }

    /// Converts an orientation to these axes: vectors of the device's frame are converted too.
    pub(crate) fn rotation(self, orientation: DQuat) -> palpate_quaternion {
        let [x, y, z] = self.axial(orientation.xyz()).to_array();
        palpate_quaternion { w: orientation.w, x, y, z }
    }

    /// Converts an orientation in these axes to Palpate's own.
    pub(crate) fn to_rotation(self, orientation: palpate_quaternion) -> DQuat {
        let palpate_quaternion { w, x, y, z } = orientation;
        let DVec3 { x, y, z } = self.axial(DVec3::new(x, y, z));
        DQuat::from_xyzw(x, y, z, w)
    }

    /// Converts the axis of a rotation, which is its own inverse. Exchanging two axes reverses the sense of each rotation.
    fn axial(self, v: DVec3) -> DVec3 {
        if self == PALPATE_AXES_OWN { v } else { -self.turned(v) }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rotation_turns_what_an_engine_sees_as_it_turns_the_tissue() {
        let (v, force_n) = (DVec3::new(0.3, -0.7, 0.2), DVec3::new(-1.0, 0.4, 2.0));
        let turn = DQuat::from_rotation_x(0.4) * DQuat::from_rotation_z(-1.1);
        for axes in [PALPATE_AXES_OWN, PALPATE_AXES_UNITY, PALPATE_AXES_UNREAL] {
            let palpate_quaternion { w, x, y, z } = axes.rotation(turn);
            let seen = DQuat::from_xyzw(x, y, z, w) * axes.turned(v);
            assert!((seen - axes.turned(turn * v)).length() < 1e-15, "{axes:?}");
            assert!(axes.to_rotation(axes.rotation(turn)).angle_between(turn) < 1e-7, "{axes:?}");
            // An engine's cross product gives the torque in its axes.
            let torque_n_m = axes.turned(v).cross(axes.turned(force_n));
            assert!((axes.torque(v.cross(force_n)).vector() - torque_n_m).length() < 1e-15, "{axes:?}");
        }
    }
}
