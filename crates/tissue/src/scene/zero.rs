//! Zeros without a sign: what a scene and an action become where they enter a tissue and a session, whichever way they came.
//!
//! −0 and 0 are equal in all that they mean, but not in their bits, and the promise of a session is bits: its hashes, its journal and
//! its snapshots. Protobuf leaves out a field that equals 0, so that a journal gives 0 back for −0; a program that subtracts a depth
//! of 0 sends −0. So there is one zero on the inside: a model takes its scene, and a session its actions, by these functions. (What a
//! tissue computes may be −0 for all that: no snapshot writes it as anything else.)

use glam::DVec3;
use palpate_haptics::{Coupling, Tip};

use super::profile::Poke;
use super::script::Action;
use super::{Scene, Springs};
use palpate_refusal::unsigned_zero;

fn unsigned(v: DVec3) -> DVec3 {
    v + DVec3::ZERO
}

impl Scene {
    /// Returns the same scene, its zeros without a sign: of what must be above 0, there are none. Each field is named
    /// here, so that a new one is thought of.
    #[must_use]
    pub fn with_unsigned_zeros(self) -> Self {
        let Scene {
            name,
            body,
            material,
            inclusions,
            springs: Springs { stiffness_n_per_m, shear_stiffness_n_per_m, bending },
            anchor_stiffness_n_per_m,
            damping_n_s_per_m,
            volume_stiffness_pa,
            stepping,
            sleep_tolerance,
            appearance,
        } = self;
        Scene {
            name,
            body,
            material,
            inclusions,
            springs: Springs {
                stiffness_n_per_m: unsigned_zero(stiffness_n_per_m),
                shear_stiffness_n_per_m: unsigned_zero(shear_stiffness_n_per_m),
                bending,
            },
            anchor_stiffness_n_per_m: unsigned_zero(anchor_stiffness_n_per_m),
            damping_n_s_per_m: unsigned_zero(damping_n_s_per_m),
            volume_stiffness_pa: unsigned_zero(volume_stiffness_pa),
            stepping,
            sleep_tolerance: sleep_tolerance.map(unsigned_zero),
            appearance,
        }
    }
}

impl Action {
    /// Returns the same action, its zeros without a sign.
    #[must_use]
    pub fn with_unsigned_zeros(self) -> Self {
        match self {
            Action::Push(Poke { point, centre_m, force_n, falloff_per_m, falloff_offset }) => Action::Push(Poke {
                point,
                centre_m: unsigned(centre_m),
                force_n: unsigned(force_n),
                falloff_per_m: unsigned_zero(falloff_per_m),
                falloff_offset: unsigned_zero(falloff_offset),
            }),
            Action::Grasp { point, displacement_m } => {
                Action::Grasp { point, displacement_m: unsigned(displacement_m) }
            }
            Action::Pose { place_m, velocity_m_per_s, tip: Tip { radius_m, friction, grasps, coupling } } => {
                let coupling = match coupling {
                    Coupling::Constraint => Coupling::Constraint,
                    Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m } => Coupling::Spring {
                        stiffness_n_per_m: unsigned_zero(stiffness_n_per_m),
                        damping_n_s_per_m: unsigned_zero(damping_n_s_per_m),
                    },
                };
                let (radius_m, friction) = (unsigned_zero(radius_m), unsigned_zero(friction));
                let tip = Tip { radius_m, friction, grasps, coupling };
                let velocity_m_per_s = velocity_m_per_s.map(unsigned);
                Action::Pose { place_m: unsigned(place_m), velocity_m_per_s, tip }
            }
            Action::Release => Action::Release,
        }
    }
}
