//! Tests of the reaction around a place.
use super::*;
use crate::{Grasp, Model};

#[test]
fn the_reaction_around_a_place_changes_without_a_jump_as_the_place_moves() {
    let model = Model::paper(&[
        "sheet.points=[25, 25]",
        "stepping.precision=f64",
        "stepping.integrator=central",
        "stepping.substeps=1",
    ]);
    let mut sheet = TissueState::<f64>::new(&model);
    let (shape, edge_m) = (model.shape(), model.shape().edge_m());
    let middle_m = 12.0 * edge_m * DVec3::new(1.0, 1.0, 0.0);
    sheet.grasp(0, shape.nearest(middle_m), Grasp::Target(0.5 * edge_m * DVec3::Z));
    for _ in 0..5 {
        sheet.step().unwrap();
    }
    // One force that hardly falls off within the surroundings, and one that does.
    for falloff_per_m in [0.1 / edge_m, 2.0 / edge_m] {
        let reaction_n = |step: u32| {
            let centre_m = middle_m + f64::from(step) * 0.005 * edge_m * DVec3::new(0.8, 0.6, 0.0);
            let force_n = DVec3::Z;
            sheet.reaction_around_n(&Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 })
        };
        let along: Vec<DVec3> = (0..1200).map(reaction_n).collect();
        let largest_n = along.iter().map(|force_n| force_n.length()).fold(0.0, f64::max);
        let jump_n = along.windows(2).map(|pair| pair[0].distance(pair[1])).fold(0.0, f64::max);
        assert!(largest_n > 1e-3 && jump_n < 0.02 * largest_n, "{falloff_per_m}: {jump_n} of {largest_n} N");
    }
}
