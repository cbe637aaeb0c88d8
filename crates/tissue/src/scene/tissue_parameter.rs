//! The parameters of a tissue that measurements can tell: how stiff it is, and how its force depends on speed.

use super::named::Named;
use super::solid::{Branch, Branches, SolidMaterial};
use super::{Body, Scene, Springs};
use palpate_refusal::{Reason, Refusal, Result};

/// A number of a scene that a fit may change. Its name ([`Named`]) is its path in the scene's text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TissueParameter {
    /// Young's modulus of a solid, or of the capsule of a mesh.
    YoungsModulus,
    /// k of the springs, of a sheet or of a mesh without material. That of shear springs keeps its ratio.
    SpringStiffness,
    /// k″ of the foundation of a mesh of a material.
    Foundation,
    /// K″ of the anchor springs, of a sheet or of a mesh without material.
    AnchorStiffness,
    /// Poisson's ratio of a solid.
    PoissonsRatio,
    /// G of a branch of a solid, by its number.
    BranchModulus(u8),
    /// The time of a branch of a solid, by its number.
    BranchTime(u8),
    /// Viscosity of a solid.
    Viscosity,
    /// Damping ratio of a mesh of a material.
    DampingRatio,
    /// C, of a sheet or of a mesh without material.
    Damping,
}

use TissueParameter as P;

impl Named for TissueParameter {
    /// In the order in which data tell them: one that can't be told from those before it is left as it is.
    const NAMES: &'static [(&'static str, Self)] = &[
        ("material.youngs_modulus_pa", P::YoungsModulus),
        ("springs.stiffness_n_per_m", P::SpringStiffness),
        ("material.foundation_n_per_m3", P::Foundation),
        ("anchor_springs.stiffness_n_per_m", P::AnchorStiffness),
        ("material.poissons_ratio", P::PoissonsRatio),
        ("branch[0].shear_modulus_pa", P::BranchModulus(0)),
        ("branch[0].time_s", P::BranchTime(0)),
        ("branch[1].shear_modulus_pa", P::BranchModulus(1)),
        ("branch[1].time_s", P::BranchTime(1)),
        ("branch[2].shear_modulus_pa", P::BranchModulus(2)),
        ("branch[2].time_s", P::BranchTime(2)),
        ("material.viscosity_pa_s", P::Viscosity),
        ("material.damping_ratio", P::DampingRatio),
        ("damping.coefficient_n_s_per_m", P::Damping),
    ];
}

impl TissueParameter {
    /// Returns the parameters that a scene has, in the order of [`Named::NAMES`].
    pub fn of(scene: &Scene) -> Vec<Self> {
        Self::NAMES.iter().map(|entry| entry.1).filter(|parameter| parameter.value(scene).is_some()).collect()
    }

    /// Returns the value in a scene, in SI units; `None` if the scene's kind of tissue does not have it.
    pub fn value(self, scene: &Scene) -> Option<f64> {
        match (self, &scene.body, &scene.material) {
            (_, Body::Solid(solid), _) => {
                let material = &solid.material;
                let branch = |number: u8| material.branches.iter().nth(usize::from(number));
                match self {
                    P::YoungsModulus => Some(material.youngs_modulus_pa),
                    P::PoissonsRatio => Some(material.poissons_ratio),
                    P::Viscosity => Some(material.viscosity_pa_s),
                    P::BranchModulus(number) => branch(number).map(|branch| branch.shear_modulus_pa),
                    P::BranchTime(number) => branch(number).map(|branch| branch.time_s),
                    _ => None,
                }
            }
            (P::YoungsModulus, _, Some(material)) => Some(material.youngs_modulus_pa),
            (P::Foundation, _, Some(material)) => Some(material.foundation_n_per_m3),
            (P::DampingRatio, _, Some(material)) => Some(material.damping_ratio),
            (P::SpringStiffness, _, None) => Some(scene.springs.stiffness_n_per_m),
            (P::AnchorStiffness, _, None) => Some(scene.anchor_stiffness_n_per_m),
            (P::Damping, _, None) => Some(scene.damping_n_s_per_m),
            _ => None,
        }
    }

    /// Returns the scene with another value, in SI units; all else stays. On a mesh of a material the springs, anchor springs and
    /// damping follow as [`Material`](super::Material) says. Check the scene before you use it ([`Scene::check`]).
    ///
    /// # Errors
    /// Refuses a parameter that the scene does not have ([`Reason::WrongKind`]), one of a mesh of a material that is 0 there, and a
    /// value of a solid's material that is out of its range.
    pub fn set(self, scene: &Scene, value: f64) -> Result<Scene> {
        let before = self.value(scene).ok_or_else(|| self.refuse("is none of this tissue's"))?;
        let mut scene = scene.clone();
        if let Body::Solid(solid) = &scene.body {
            let material = self.in_solid(solid.material, value)?;
            material.check()?;
            let solid = solid.of_material(material);
            scene.springs = Springs::alike(solid.stiffness_n_per_m());
            scene.body = Body::Solid(solid);
            return Ok(scene);
        }
        let Some(material) = &mut scene.material else {
            match self {
                P::SpringStiffness if before > 0.0 => scene.springs.scale(value / before),
                P::SpringStiffness => scene.springs.stiffness_n_per_m = value,
                P::AnchorStiffness => scene.anchor_stiffness_n_per_m = value,
                _ => scene.damping_n_s_per_m = value,
            }
            return Ok(scene);
        };
        if before <= 0.0 {
            return Err(self.refuse("is 0, and coefficients in proportion to it stay 0"));
        }
        let ratio = value / before;
        match self {
            P::YoungsModulus => {
                material.youngs_modulus_pa = value;
                scene.springs.scale(ratio);
            }
            P::Foundation => {
                material.foundation_n_per_m3 = value;
                scene.anchor_stiffness_n_per_m *= ratio;
                scene.damping_n_s_per_m *= ratio.sqrt();
            }
            _ => {
                material.damping_ratio = value;
                scene.damping_n_s_per_m *= ratio;
            }
        }
        Ok(scene)
    }

    fn in_solid(self, material: SolidMaterial, value: f64) -> Result<SolidMaterial> {
        let branches = |change: &dyn Fn(&mut Branch), number: u8| {
            let mut list: Vec<Branch> = material.branches.iter().copied().collect();
            list.iter_mut().skip(usize::from(number)).take(1).for_each(change);
            Ok(SolidMaterial { branches: Branches::of(&list, "branch")?, ..material })
        };
        match self {
            P::PoissonsRatio => Ok(SolidMaterial { poissons_ratio: value, ..material }),
            P::Viscosity => Ok(SolidMaterial { viscosity_pa_s: value, ..material }),
            P::BranchModulus(number) => branches(&|branch| branch.shear_modulus_pa = value, number),
            P::BranchTime(number) => branches(&|branch| branch.time_s = value, number),
            _ => Ok(SolidMaterial { youngs_modulus_pa: value, ..material }),
        }
    }

    /// Returns the unit of the value; `1` for a ratio.
    pub fn unit(self) -> &'static str {
        match self {
            P::YoungsModulus | P::BranchModulus(_) => "Pa",
            P::PoissonsRatio | P::DampingRatio => "1",
            P::Viscosity => "Pa·s",
            P::BranchTime(_) => "s",
            P::Foundation => "N/m³",
            P::SpringStiffness | P::AnchorStiffness => "N/m",
            P::Damping => "N·s/m",
        }
    }

    /// Returns whether the force of a slow press grows in proportion if all of these do.
    pub fn is_stiffness(self) -> bool {
        matches!(self, P::YoungsModulus | P::SpringStiffness | P::Foundation | P::AnchorStiffness)
    }

    /// Returns whether the value adds a force in proportion to itself where the tissue moves, and none where it rests.
    pub fn adds_by_motion(self) -> bool {
        matches!(self, P::BranchModulus(_) | P::Viscosity | P::DampingRatio | P::Damping)
    }

    /// Returns what measurement tells the parameter, as the end of a sentence.
    pub fn told_by(self) -> &'static str {
        match self {
            P::YoungsModulus | P::AnchorStiffness => "presses deep enough that the force is well above the noise",
            P::SpringStiffness | P::Foundation => {
                "tips of at least two radii, or presses as deep as their tip is wide: then the springs along the surface and what \
                 holds it from below share the force differently"
            }
            P::PoissonsRatio => {
                "tips of at least two radii, of which one is as wide as the tissue is thick: beneath it the tissue can't give way to \
                 the sides"
            }
            P::BranchModulus(_) | P::BranchTime(_) => {
                "a press that is held for some times the time of the branch, or presses at speeds that differ by a factor of ten"
            }
            P::Viscosity | P::DampingRatio | P::Damping => {
                "presses at speeds that differ by a factor of ten, or a vibration of the tip of 5 Hz or more"
            }
        }
    }

    fn refuse(self, message: &str) -> Refusal {
        Refusal::new(Reason::WrongKind, self.name(), message)
    }
}

impl Springs {
    fn scale(&mut self, by: f64) {
        self.stiffness_n_per_m *= by;
        self.shear_stiffness_n_per_m *= by;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::limits::Limits;

    /// A scene whose value is set in place is the scene whose text has that value.
    #[test]
    fn a_set_value_is_that_of_the_text() {
        let solid = "[solid]\norgan = { name = \"gallbladder\", edge_m = 0.0035, seed = 1 }\ncell_m = 0.006\nfixed = \"none\"\n\
                     foundation_n_per_m3 = 2e4\n[material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = 0.4\nviscosity_pa_s = 0.1\n\
                     [[branch]]\nshear_modulus_pa = 1e3\ntime_s = 0.3\n";
        let mesh = "[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.0035 }\n[material]\nyoungs_modulus_pa = 2e4\n\
                    thickness_m = 0.003\nfoundation_n_per_m3 = 5e6\ndamping_ratio = 0.5\n";
        let sheet = "[sheet]\npoints = [5, 5]\nspacing_m = 0.01\npoint_mass_kg = 0.01\n[springs]\nstiffness_n_per_m = 10.0\n\
                     shear_stiffness_n_per_m = 5.0\n[anchor_springs]\nstiffness_n_per_m = 5.0\n[damping]\n\
                     coefficient_n_s_per_m = 0.5\n";
        for (text, count) in [(solid, 5), (mesh, 3), (sheet, 3)] {
            let limits = Limits::default();
            let parse = |sets: &[String]| Scene::parse("test", text, sets, &limits).unwrap();
            let scene = parse(&[]);
            let parameters = TissueParameter::of(&scene);
            assert_eq!(parameters.len(), count, "{parameters:?}");
            for parameter in parameters {
                let value = 1.1 * parameter.value(&scene).unwrap();
                let name = parameter.name();
                let set = parameter.set(&scene, value).unwrap();
                assert_eq!(parameter.value(&set), Some(value), "{name}");
                // An item of a list can't be set by `--set`.
                if name.contains('[') {
                    continue;
                }
                let mut sets = vec![format!("{name}={value:?}")];
                if parameter == TissueParameter::SpringStiffness {
                    sets.push(format!("springs.shear_stiffness_n_per_m={:?}", 0.5 * value));
                }
                let read = parse(&sets);
                let close = |a: f64, b: f64| (a - b).abs() <= 1e-9 * a.abs();
                assert!(close(set.springs.stiffness_n_per_m, read.springs.stiffness_n_per_m), "{name}");
                assert!(close(set.springs.shear_stiffness_n_per_m, read.springs.shear_stiffness_n_per_m), "{name}");
                assert!(close(set.anchor_stiffness_n_per_m, read.anchor_stiffness_n_per_m), "{name}");
                assert!(close(set.damping_n_s_per_m, read.damping_n_s_per_m), "{name}");
                if let Body::Solid(_) = set.body {
                    assert_eq!(set.body, read.body, "{name}");
                }
            }
        }
    }
}
