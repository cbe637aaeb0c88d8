//! The sections `[[branch]]` of a scene: parts of a solid's stiffness that relax (a Prony series).

use crate::scene::action_check::physical;
use crate::scene::body::{MAX_BRANCHES, MaxwellBranch};
use crate::scene::toml_document::Item;
use palpate_refusal::{Reason, Refusal, Result, number, positive};

/// The times of a branch, s. Viscosity stands for shorter ones.
const TIMES_S: [f64; 2] = [1e-3, 1e4];

/// A part of a solid's stiffness that relaxes: a spring and a damper in series, beside the elastic law. Stress follows the
/// strain's change at once with the modulus of the branch too, and forgets its part of it with a time. The branch has the elastic
/// law, times its modulus divided by μ: what resists a change of volume relaxes as well, which an almost incompressible solid does not
/// show.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Branch {
    /// G of the branch, Pa; above 0.
    pub shear_modulus_pa: f64,
    /// The time in which a stress falls by a factor of e if nothing moves, 1e-3 to 1e4 s.
    pub time_s: f64,
}

/// The branches of a solid, at most [`MAX_BRANCHES`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Branches([Option<Branch>; MAX_BRANCHES]);

impl Branches {
    /// Message of the refusal of a branch of another tissue ([`Reason::WrongKind`]).
    pub const OF_A_SOLID: &str = "is for a solid: other tissues are elastic, with damping";

    /// Creates branches from a list.
    ///
    /// # Errors
    /// Refuses more than [`MAX_BRANCHES`], a modulus that is not above 0, and a time beyond 1e-3 to 1e4 s; `field` is the key of the
    /// list.
    pub fn of(list: &[Branch], field: &str) -> Result<Self> {
        if list.len() > MAX_BRANCHES {
            let message = format!("are {}, more than {MAX_BRANCHES}", list.len());
            return Err(Refusal::new(Reason::TooLarge, field, message));
        }
        for (index, Branch { shear_modulus_pa, time_s }) in list.iter().enumerate() {
            let of_modulus = format!("{field}[{index}].shear_modulus_pa");
            physical(&of_modulus, positive(&of_modulus, *shear_modulus_pa)?)?;
            let [least, most] = TIMES_S;
            let holds = |time_s| (least..=most).contains(&time_s);
            number(&format!("{field}[{index}].time_s"), *time_s, "from 1e-3 to 1e4 s", holds)?;
        }
        Ok(Branches(std::array::from_fn(|index| list.get(index).copied())))
    }

    pub(in crate::scene) fn read(item: &Item<'_>) -> Result<Self> {
        let branch = |item: &Item<'_>| {
            item.table(|fields| {
                Ok(Branch {
                    shear_modulus_pa: fields.required_number("shear_modulus_pa")?,
                    time_s: fields.required_number("time_s")?,
                })
            })
        };
        Branches::of(&item.tables()?.iter().map(branch).collect::<Result<Vec<_>>>()?, "branch")
    }

    /// Returns the branches in their order.
    pub fn iter(&self) -> impl Iterator<Item = &Branch> {
        self.0.iter().flatten()
    }

    /// Returns the branches of a solid whose elastic law has the shear modulus `shear_pa`, Pa.
    pub(super) fn relative_to(&self, shear_pa: f64) -> [MaxwellBranch; MAX_BRANCHES] {
        self.0.map(|branch| {
            branch.map_or_else(MaxwellBranch::default, |Branch { shear_modulus_pa, time_s }| MaxwellBranch {
                stiffness: shear_modulus_pa / shear_pa,
                time_s,
            })
        })
    }
}
