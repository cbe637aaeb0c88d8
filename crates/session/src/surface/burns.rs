//! What tips have burnt, at the vertices that frames show: that of the points, and between these interpolated as displacements are. In a
//! solid a point is as burnt as the most burnt cell around it: a vertex in a cell that has burnt through has burnt through, and beside it
//! the burn fades over a cell.

use palpate_tissue::memory;
use palpate_tissue::{Burns, BurntPoint, Model};

use super::refine::Refinement;
use super::skin::Skin;

/// Name of the tables in messages.
const TABLES: &str = "what is burnt of a surface";

/// How burnt a vertex is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VertexBurn {
    /// The vertex, as in a frame.
    pub vertex: u32,
    /// Time of contact divided by that in which it burns through, 0 to 1.
    pub burn: f32,
}

/// Returns the burn of the vertices of frames of `refinement` that may have changed after version `since` of the burns (0: of all that are
/// burnt), by ascending vertex. `skin` is that of the model.
pub fn vertex_burns(
    model: &Model,
    burns: &Burns,
    skin: Option<&Skin>,
    refinement: Refinement,
    since: u32,
) -> Vec<VertexBurn> {
    let is_new = |version: u32| since == 0 || version > since;
    let points: Vec<BurntPoint> = burns.points(model).collect();
    if !points.iter().any(|burnt| is_new(burnt.version)) {
        return Vec::new();
    }
    // The burn of each place in memory, and whether it is new.
    let place = |index: usize| model.shown_order().map_or(index, |[_, places]| places[index] as usize);
    let places = model.shown_order().map_or(model.len(), |[order, _]| order.len());
    let mut of_places: Vec<(f32, bool)> = memory::filled(places, (0.0, false), TABLES);
    for burnt in points {
        #[allow(clippy::cast_possible_truncation)]
        if let Some(of_place) = of_places.get_mut(place(burnt.point.index())) {
            *of_place = (burnt.burn as f32, is_new(burnt.version));
        }
    }
    match skin {
        None => of_grid(&of_places, refinement),
        Some(skin) if skin.is_bound() => {
            let in_triangles =
                skin.bound_places().map(|(corners, weights)| between(&of_places, &corners, weights.map(f64::from)));
            let in_cells = skin.cell_places().iter().map(|cell| between(&of_places, &cell.points, cell.weights));
            // One of both is empty.
            new_of(in_triangles.chain(in_cells).enumerate().map(|(vertex, (burn, is_new))| (vertex, burn, is_new)))
        }
        Some(_) => new_of(of_places.into_iter().enumerate().map(|(place, (burn, is_new))| (place, burn, is_new))),
    }
}

/// Returns the burn between some places, and whether any of them is new.
fn between<const N: usize>(of_places: &[(f32, bool)], corners: &[u32; N], weights: [f64; N]) -> (f32, bool) {
    let corners = corners.map(|place| of_places.get(place as usize).copied().unwrap_or_default());
    let burn: f64 = corners.iter().zip(weights).map(|((burn, _), weight)| weight * f64::from(*burn)).sum();
    #[allow(clippy::cast_possible_truncation)]
    (burn.clamp(0.0, 1.0) as f32, corners.iter().any(|(_, is_new)| *is_new))
}

/// Returns those vertices, with their burns, that are new.
#[allow(clippy::cast_possible_truncation)]
fn new_of(all: impl Iterator<Item = (usize, f32, bool)>) -> Vec<VertexBurn> {
    let new = all.filter(|(.., is_new)| *is_new);
    new.map(|(vertex, burn, _)| VertexBurn { vertex: vertex as u32, burn }).collect()
}

/// Interpolates between the points of a sheet.
#[allow(clippy::cast_precision_loss)]
fn of_grid(of_points: &[(f32, bool)], refinement: Refinement) -> Vec<VertexBurn> {
    let ([nx, ny], [_, across]) = (refinement.points, refinement.vertices());
    let part = refinement.between() + 1;
    // Most rows are far from what is new.
    let rows = |new: Option<usize>| new.map_or(0, |point| point / ny);
    let is_new = |(_, is_new): &(f32, bool)| *is_new;
    let [first, last] = [of_points.iter().position(is_new), of_points.iter().rposition(is_new)].map(rows);
    let vertices = first.saturating_sub(1) * part * across..((last + 1) * part * across).min(refinement.vertex_count());
    new_of(vertices.map(|vertex| {
        let [a, b] = [vertex / across, vertex % across];
        let ([i, j], [s, t]) = ([a / part, b / part], [a % part, b % part]);
        let (mut burn, mut is_new) = (0.0, false);
        for (row, along) in [(i, part - s), (i + 1, s)] {
            for (column, beside) in [(j, part - t), (j + 1, t)] {
                if along * beside > 0 && row < nx && column < ny {
                    let (of_point, is_new_point) = of_points[row * ny + column];
                    burn += (along * beside) as f32 / (part * part) as f32 * of_point;
                    is_new |= is_new_point;
                }
            }
        }
        (vertex, burn.clamp(0.0, 1.0), is_new)
    }))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::sync::Arc;

    use glam::DVec3;
    use palpate_haptics::Tip;
    use palpate_tissue::limits::Limits;
    use palpate_tissue::scene::PAPER;
    use palpate_tissue::shape::PointId;
    use palpate_tissue::{Tissue, at_rest};

    use super::*;

    /// Burns a place of a sheet for some steps of the 50 in which it burns through, and lets it come to rest.
    fn burn(tissue: &mut dyn Tissue, place_m: DVec3, steps: u32) {
        let tip = Tip { radius_m: 0.006, grasps: true, burn_s: 0.05, ..Tip::default() };
        for _ in 0..steps {
            tissue.pose(0, place_m - 0.001 * DVec3::Z, tip);
            tissue.step().unwrap();
        }
        tissue.release(0);
        (0..50).for_each(|_| tissue.step().unwrap());
    }

    fn sheet() -> (Arc<Model>, Box<dyn Tissue>) {
        let model = Model::parse("sheet", PAPER, &["sheet.points=[9, 7]", "sheet.spacing_m=0.005"]).unwrap();
        let tissue = at_rest(&model);
        (model, tissue)
    }

    fn burn_of(burns: &[VertexBurn], vertex: usize) -> f32 {
        burns.iter().find(|of| of.vertex as usize == vertex).map_or(0.0, |of| of.burn)
    }

    #[test]
    fn a_point_is_as_burnt_as_its_time_of_contact_says_and_a_vertex_between_two_as_their_mean() {
        let (model, mut tissue) = sheet();
        let middle = PointId::new(4 * 7 + 3);
        burn(&mut *tissue, model.shape().rest_m(middle), 20);
        let grid = |n: u32| Refinement::new(&model.scene, n, &Limits::default()).unwrap();
        let all = |n: u32| vertex_burns(&model, &tissue.burns(), None, grid(n), 0);
        let coarse = all(0);
        let near = |burn: f32, to: f32| (burn - to).abs() < 0.03;
        assert!(near(burn_of(&coarse, middle.index()), 0.4), "{coarse:?}");
        assert_eq!(burn_of(&coarse, 0), 0.0);
        let fine = all(1);
        for of in &coarse {
            assert_eq!(burn_of(&fine, grid(1).vertex_at(PointId::new(of.vertex as usize))), of.burn);
        }
        let edge = coarse.iter().find(|of| burn_of(&coarse, of.vertex as usize + 1) == 0.0).unwrap();
        let between = grid(1).vertex_at(PointId::new(edge.vertex as usize)) + 1;
        assert!((burn_of(&fine, between) - 0.5 * edge.burn).abs() < 1e-6, "{edge:?}");
        assert!(fine.iter().all(|of| (0.0..=1.0).contains(&of.burn)));
    }

    #[test]
    fn vertices_of_a_mesh_are_burnt_under_the_tip_also_where_fewer_points_are_simulated() {
        for (sets, is_bound) in [(&[][..], false), (&["mesh.vertices=400"], true)] {
            let model = Model::parse("gallbladder", crate::GALLBLADDER, sets).unwrap();
            let (skin, mut tissue) = (Skin::of(&model).unwrap(), at_rest(&model));
            assert_eq!(skin.is_bound(), is_bound);
            let extent = model.shape().extent();
            let top = model.shape().nearest(extent.middle_m().with_z(extent.most_m.z));
            let place_m = model.shape().rest_m(top);
            burn(&mut *tissue, place_m, 20);
            let grid = Refinement::new(&model.scene, 0, &Limits::default()).unwrap();
            let burns = vertex_burns(&model, &tissue.burns(), Some(&skin), grid, 0);
            let most = burns.iter().map(|of| of.burn).fold(0.0, f32::max);
            assert!(burns.len() > 3 && most > 0.3 && most < 0.4 + 1e-6, "{is_bound}: {} up to {most}", burns.len());
            for VertexBurn { vertex, burn } in burns {
                let far_m = skin.rest_m(skin.vertices()[vertex as usize]).distance(place_m);
                assert!(
                    burn == 0.0 || far_m < 0.006 + 4.0 * model.shape().edge_m(),
                    "{is_bound}: {burn} {far_m} m away"
                );
            }
        }
    }

    /// A block of 100 × 100 × 40 mm, of cells of 5 mm.
    const BLOCK: &str = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.005\n\
                         fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                         [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\ndensity_kg_per_m3 = 980\n\
                         damping_per_s = 60\n[stepping]\nsubsteps = 8\n";

    #[test]
    fn vertices_of_a_solid_in_cells_that_have_burnt_through_have_too_and_the_burn_fades_over_a_cell() {
        let model = Model::parse("block", BLOCK, &[]).unwrap();
        let (skin, mut tissue) = (Skin::of(&model).unwrap(), at_rest(&model));
        let top_m = DVec3::new(0.0, 0.0, 0.04);
        burn(&mut *tissue, top_m, 20);
        let grid = Refinement::new(&model.scene, 0, &Limits::default()).unwrap();
        let all = |tissue: &dyn Tissue, since: u32| vertex_burns(&model, &tissue.burns(), Some(&skin), grid, since);
        let far_m = |vertex: usize| skin.rest_m(skin.vertices()[vertex]).distance(top_m);
        let most = all(&*tissue, 0).iter().map(|of| of.burn).fold(0.0, f32::max);
        assert!((most - 0.4).abs() < 1e-6 && tissue.cuts().is_empty(), "{most}");
        burn(&mut *tissue, top_m, 30);
        assert!(!tissue.cuts().is_empty());
        let burns = all(&*tissue, 0);
        for vertex in 0..skin.vertices().len() {
            let burn = burn_of(&burns, vertex);
            // The tip has a radius of 6 mm: cells to 10 mm from its middle lie under it, and it fades to 15 mm.
            assert!(if far_m(vertex) < 0.005 { burn == 1.0 } else { (0.0..=1.0).contains(&burn) }, "{burn}");
            assert!(far_m(vertex) < 0.0213 || burn == 0.0, "{burn} {} m away", far_m(vertex));
        }
        assert!(burns.iter().filter(|of| far_m(of.vertex as usize) < 0.005).count() > 5);
        assert!(all(&*tissue, tissue.burns().version()).is_empty());
    }

    #[test]
    fn what_is_new_since_any_version_completes_what_a_viewer_had_then() {
        let (model, mut tissue) = sheet();
        let grid = Refinement::new(&model.scene, 2, &Limits::default()).unwrap();
        let mut known = vec![(0, vec![0.0_f32; grid.vertex_count()])];
        for (place_m, steps) in
            [(DVec3::new(0.02, 0.015, 0.0), 7), (DVec3::new(0.03, 0.01, 0.0), 60), (DVec3::new(0.02, 0.015, 0.0), 5)]
        {
            burn(&mut *tissue, place_m, steps);
            let burns = tissue.burns();
            assert!(burns.version() > known.last().unwrap().0);
            let mut whole = vec![0.0; grid.vertex_count()];
            for of in vertex_burns(&model, &burns, None, grid, 0) {
                whole[of.vertex as usize] = of.burn;
            }
            for (version, had) in &mut known {
                assert!(burns.continues(*version));
                for of in vertex_burns(&model, &burns, None, grid, *version) {
                    had[of.vertex as usize] = of.burn;
                }
                // Burns that a viewer can't tell apart are not sent.
                assert!(had.iter().zip(&whole).all(|(had, now)| (had - now).abs() <= 1.0 / 255.0), "since {version}");
                *version = burns.version();
            }
            known.push((0, vec![0.0; grid.vertex_count()]));
            assert!(vertex_burns(&model, &burns, None, grid, burns.version()).is_empty());
        }
    }
}
