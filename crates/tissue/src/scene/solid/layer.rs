//! The sections `[[layer]]` of a scene: layers beneath the surface of a solid that are stiffer or softer, as skin and
//! capsules are.

use glam::DVec3;
use palpate_geometry::fill::Lattice;
use palpate_geometry::surface::Surface;

use super::shape::{SolidShape, places_in_cube};
use crate::scene::toml_document::Item;
use palpate_refusal::{Reason, Refusal, Result, number, positive};

/// Largest number of layers of a scene.
const MAX_LAYERS: usize = 8;

/// Places along each side of a cube at which the layer is looked up.
const LOOKS: usize = 8;

/// A layer of a solid. The first of a scene begins at the surface, and each other one beneath the one before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layer {
    /// Thickness, m; above 0.
    pub thickness_m: f64,
    /// E of the layer divided by E of the material, 0.01 to 100.
    pub stiffness_factor: f64,
}

impl Layer {
    /// Message of the refusal of a layer of another tissue ([`Reason::WrongKind`]).
    pub const OF_A_SOLID: &str = "is for a solid: other tissues have no inside";

    pub(in crate::scene) fn read(item: &Item<'_>) -> Result<Self> {
        item.table(|fields| {
            Ok(Layer {
                thickness_m: fields.required_number("thickness_m")?,
                stiffness_factor: fields.required_number("stiffness_factor")?,
            })
        })
    }

    /// Returns the factor of E of each cube, 1 where there is no layer.
    ///
    /// # Errors
    /// Refuses more than 8 layers, a thickness that is not above 0 and a factor beyond 0.01 to 100. `field` is the key of the
    /// list.
    pub(super) fn factors(layers: &[Layer], field: &str, shape: &SolidShape) -> Result<Vec<f64>> {
        if layers.len() > MAX_LAYERS {
            let message = format!("are {}, more than {MAX_LAYERS}", layers.len());
            return Err(Refusal::new(Reason::TooLarge, field, message));
        }
        for (index, layer) in layers.iter().enumerate() {
            positive(&format!("{field}[{index}].thickness_m"), layer.thickness_m)?;
            let field = format!("{field}[{index}].stiffness_factor");
            number(&field, layer.stiffness_factor, "from 0.01 to 100", |v| (0.01..=100.0).contains(&v))?;
        }
        let mut factors = vec![1.0; shape.parts().len()];
        if layers.is_empty() {
            return Ok(factors);
        }
        let lattice = shape.lattice();
        let deepest_m = layers.iter().map(|layer| layer.thickness_m).sum::<f64>() + lattice.edge_m * 3.0_f64.sqrt();
        for cell in shape.cells() {
            let at = lattice.index(cell);
            if shape.parts()[at] == 0.0 {
                continue;
            }
            if let Some((depth_m, outward)) = beneath(shape.surface().surface(), lattice.middle_m(cell))
                && depth_m < deepest_m
            {
                factors[at] = mean_factor(layers, lattice, depth_m, outward);
            }
        }
        Ok(factors)
    }
}

/// Returns how deep a place is beneath a surface, m, negative outside, and the direction outward.
fn beneath(surface: &Surface, place_m: DVec3) -> Option<(f64, DVec3)> {
    let nearest = surface.nearest(place_m)?;
    let outward = nearest.frame[0].cross(nearest.frame[1]);
    let away_m = place_m - surface.at_m(&nearest);
    let depth_m = if away_m.dot(outward) > 0.0 { -away_m.length() } else { away_m.length() };
    // From an edge or a corner of the surface, the direction is that to the place.
    Some((depth_m, (away_m * -depth_m.signum()).try_normalize().unwrap_or(outward)))
}

/// Returns the factor of a cube whose middle is `depth_m` beneath the surface: the harmonic mean over its inside, because a
/// tool presses layers in a row. (Layers of 1 and 2 mm, 0.2 and 10 times as stiff, under a disc of 5 mm, full cells of 2.5 to
/// 5 mm: −9 to +9 % of the stiffness with cells of 1 mm; with the geometric mean to +28 %, with the arithmetic one to +71 %.)
/// The surface counts as flat across the cube.
fn mean_factor(layers: &[Layer], lattice: &Lattice, depth_m: f64, outward: DVec3) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for away_m in places_in_cube(DVec3::ZERO, lattice.edge_m, LOOKS) {
        let mut left_m = depth_m - away_m.dot(outward);
        if left_m < 0.0 {
            continue;
        }
        let mut factor = 1.0;
        for layer in layers {
            if left_m < layer.thickness_m {
                factor = layer.stiffness_factor;
                break;
            }
            left_m -= layer.thickness_m;
        }
        sum += 1.0 / factor;
        count += 1;
    }
    // A sliver, no place of which was looked at, is of the outermost layer.
    if count > 0 { f64::from(count) / sum } else { layers[0].stiffness_factor }
}
