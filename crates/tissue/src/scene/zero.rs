//! Removes the sign of zeros where a scene enters a model or an action enters a session, whatever its origin.
//!
//! −0 and 0 are equal as values, but not as bits, and a session guarantees bits: its hashes, its journal and
//! its snapshots. Protobuf leaves out a field that equals 0, so that a journal returns 0 for −0; and a program
//! that subtracts a depth of 0 sends −0. So there is only one zero inside: models take their scene, and
//! sessions their actions, through these functions. (A value that a tissue computes may still be −0: snapshots
//! keep its bits.)

use glam::DVec3;
use palpate_haptics::{Coupling, Tip};

use super::action::PlaceMark;
use super::profile::Poke;
use super::script::Action;
use super::tie::{Bite, Tie, TieKind};
use super::{Scene, Springs};
use palpate_refusal::unsigned_zero;

fn unsigned(v: DVec3) -> DVec3 {
    v + DVec3::ZERO
}

/// Returns a thread or clip with every −0 replaced by 0. Its radii, length and strength are above 0.
fn unsigned_tie(tie: Tie) -> Tie {
    let Tie { bites, kind, strength_n } = tie;
    let bites = bites.into_iter().map(|bite| Bite { place_m: unsigned(bite.place_m), ..bite });
    let kind = match kind {
        TieKind::Thread { length_m, friction } => TieKind::Thread { length_m, friction: unsigned_zero(friction) },
        TieKind::Clip => TieKind::Clip,
    };
    Tie { bites: bites.collect(), kind, strength_n }
}

impl Scene {
    /// Returns the scene with every −0 among its coefficients and tolerances replaced by 0. Values that must be
    /// above 0 need no replacement; those of body, material, inclusions and lumps stay. Each field is named here, so
    /// that a new field can't be forgotten.
    #[must_use]
    pub fn with_unsigned_zeros(self) -> Self {
        let Scene {
            name,
            body,
            material,
            inclusions,
            added_lumps,
            springs: Springs { stiffness_n_per_m, shear_stiffness_n_per_m, bending, pretension_n_per_m },
            anchor_stiffness_n_per_m,
            damping_n_s_per_m,
            volume_stiffness_pa,
            stepping,
            sleep_tolerance,
            appearance,
            cutting,
        } = self;
        Scene {
            name,
            body,
            material,
            inclusions,
            added_lumps,
            springs: Springs {
                stiffness_n_per_m: unsigned_zero(stiffness_n_per_m),
                shear_stiffness_n_per_m: unsigned_zero(shear_stiffness_n_per_m),
                bending,
                pretension_n_per_m: unsigned_zero(pretension_n_per_m),
            },
            anchor_stiffness_n_per_m: unsigned_zero(anchor_stiffness_n_per_m),
            damping_n_s_per_m: unsigned_zero(damping_n_s_per_m),
            volume_stiffness_pa: unsigned_zero(volume_stiffness_pa),
            stepping,
            sleep_tolerance: sleep_tolerance.map(unsigned_zero),
            appearance,
            cutting: cutting.with_unsigned_zeros(),
        }
    }
}

impl Action {
    /// Returns the action with every −0 among its numbers, vectors' components included, replaced by 0.
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
            Action::Pose { place_m, velocity_m_per_s, tip } => {
                let coupling = match tip.coupling {
                    Coupling::Constraint => Coupling::Constraint,
                    Coupling::Spring { stiffness_n_per_m, damping_n_s_per_m } => Coupling::Spring {
                        stiffness_n_per_m: unsigned_zero(stiffness_n_per_m),
                        damping_n_s_per_m: unsigned_zero(damping_n_s_per_m),
                    },
                };
                let [radius_m, friction, burn_s] = [tip.radius_m, tip.friction, tip.burn_s].map(unsigned_zero);
                let tip = Tip { radius_m, friction, coupling, edge_m: unsigned(tip.edge_m), burn_s, ..tip };
                let velocity_m_per_s = velocity_m_per_s.map(unsigned);
                Action::Pose { place_m: unsigned(place_m), velocity_m_per_s, tip }
            }
            Action::Tie { number, tie } => Action::Tie { number, tie: tie.map(unsigned_tie) },
            Action::Mark(mark) => Action::Mark(PlaceMark { place_m: unsigned(mark.place_m), ..mark }),
            Action::Release => Action::Release,
        }
    }
}
