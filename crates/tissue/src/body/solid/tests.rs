//! Tests of the cube's law against derivatives and closed forms, and of the sweep against single points.
#![allow(unsafe_code, clippy::unwrap_used, clippy::needless_range_loop)]

use std::cell::UnsafeCell;
use std::sync::Arc;

use glam::{DMat3, DVec3};

use super::linear_cells::{LinearCells, resisting};
use super::neo_hookean::{NeoHookean, Patterns};
use crate::body::Places;
use crate::body::model::{Model, Plan};
use crate::body::severed::SeveredSpring;
use crate::body::tables::{SweepTables, springs_of};
use crate::kernel::field::{Field, Layout};
use crate::kernel::lanes::{self, Scalar, Vector};
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::kernel::stage::Stage;
use crate::limits::Limits;
use crate::scene::{Integrator, Lanes, Precision, Scene};
use crate::scheme::Oscillator;

const SHEAR: f64 = 0.35;
const LAME: f64 = 2.1;

/// Displacements of the corners of a cube, x before y before z.
type Corners = [DVec3; 8];

fn patterns(corners: &Corners) -> Patterns<Scalar<f64>> {
    Patterns::of_corners(&corners.map(|corner| corner.to_array().map(Scalar)))
}

fn forces(corners: &Corners) -> Corners {
    let stress = NeoHookean::new(1.0, SHEAR, LAME).stress(Scalar(0.7), &patterns(corners));
    resisting(&stress).map(|outward| -outward)
}

fn energy(corners: &Corners) -> f64 {
    NeoHookean::new(1.0, SHEAR, LAME).energy(Scalar(0.7), &patterns(corners)).0
}

/// The corners at rest, in edges.
fn at_rest() -> Corners {
    std::array::from_fn(|n| DVec3::new((n & 1) as f64, (n >> 1 & 1) as f64, (n >> 2) as f64))
}

fn some(size: f64) -> Corners {
    std::array::from_fn(|n| {
        let n = n as f64;
        size * DVec3::new((1.7 * n).sin(), (2.3 * n + 1.0).cos(), (0.9 * n * n).sin())
    })
}

#[test]
fn a_cube_pulls_with_the_derivative_of_its_energy_also_within_the_limits() {
    // In the last three ψ is reduced, and in some the pressure is the largest.
    for size in [0.02, 0.3, 1.0, 3.0] {
        let corners = some(size);
        let found = forces(&corners);
        let largest = found.iter().map(|force| force.length()).fold(0.0, f64::max);
        for corner in 0..8 {
            for c in 0..3 {
                let by = 1e-5 * size;
                let [ahead, behind] = [by, -by].map(|by| {
                    let mut moved = corners;
                    moved[corner][c] += by;
                    energy(&moved)
                });
                let expected = -(ahead - behind) / (2.0 * by);
                let error = (found[corner][c] - expected).abs() / largest;
                assert!(error < 1e-7, "{size} {corner} {c}: {} {expected}", found[corner][c]);
            }
        }
    }
}

/// A jump would be a change that is much larger than those before and after it.
#[test]
fn the_force_of_a_cube_that_is_strained_more_and_more_has_no_jump() {
    let towards = some(1.0);
    let courses: Vec<Corners> =
        (0..20_000).map(|step| forces(&towards.map(|of| 1e-4 * f64::from(step) * of))).collect();
    let change = |a: &Corners, b: &Corners| a.iter().zip(b).map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
    let changes: Vec<f64> = courses.windows(2).map(|pair| change(&pair[0], &pair[1])).collect();
    for (step, near) in changes.windows(3).enumerate() {
        assert!(near[1] < 2.0 * near[0].max(near[2]), "{step}: {near:?}");
    }
}

#[test]
fn a_strained_cube_has_the_stress_of_hookes_law() {
    let strain =
        1e-6 * DMat3::from_cols(DVec3::new(1.0, 0.3, -0.2), DVec3::new(0.3, -0.5, 0.4), DVec3::new(-0.2, 0.4, 0.7));
    let found = forces(&at_rest().map(|place| strain * place));
    let stress = 2.0 * SHEAR * strain
        + DMat3::from_diagonal(DVec3::splat(LAME * (strain.x_axis.x + strain.y_axis.y + strain.z_axis.z)));
    for (corner, found) in found.iter().enumerate() {
        // A quarter of the stress on each of the three faces at the corner.
        let outward = 2.0 * at_rest()[corner] - 1.0;
        let expected = -0.25 * 0.7 * (stress * outward);
        assert!(found.distance(expected) < 1e-5 * 1e-6, "{corner}: {found} {expected}");
    }
}

#[test]
fn a_cube_that_is_turned_feels_nothing() {
    let turn = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 1.2);
    let found = forces(&at_rest().map(|place| turn * place - place));
    assert!(found.iter().all(|force| force.length() < 1e-14), "{found:?}");
}

#[test]
fn a_cube_that_is_turned_inside_out_is_pushed_back_and_not_too_hard() {
    for size in [0.3, 0.8, 3.0, 50.0] {
        let corners = some(size);
        let hardest = forces(&corners).iter().map(|force| force.length()).fold(0.0, f64::max);
        // In proportion to the distance, with the square of it at most in the shape's own part.
        assert!(hardest.is_finite() && hardest < 40.0 * (size + size * size), "{size}: {hardest}");
    }
}

/// An organ of cubes, of which some are filled in part, with a stiffer lump.
fn organ(lanes: Lanes) -> Model {
    let text = "[solid]\norgan = { name = \"gallbladder\", edge_m = 0.0035 }\ncell_m = 0.006\n\
                fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1] }]\n\
                [material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = 0.45\n\
                [[inclusion]]\ncentre_m = [0.0, 0.0, 0.0]\nradius_m = 0.01\nstiffness_factor = 5\n";
    let scene = Scene::parse("organ", text, &[], &Limits::default()).unwrap();
    // Without a rehearsal, which takes long where nothing is optimized.
    let plan = Plan::new(Integrator::Central, 8, scene.stepping.rate_hz.recip(), &Oscillator::of(&scene));
    Model::planned(scene, plan, Precision::F32, lanes).unwrap()
}

/// Keeps the forces on all places.
struct Kept<'a, T> {
    plane: usize,
    forces: &'a UnsafeCell<Field<T>>,
}

impl<T: Real> Stage<T> for Kept<'_, T> {
    #[inline(always)]
    unsafe fn finish<V: Vector<Real = T>, const DUTY: u8>(
        &self,
        _: usize,
        at: usize,
        _: [V; 3],
        n: [V; 3],
        _: &mut [V; 2],
    ) {
        // SAFETY: the field has the layout's planes.
        unsafe {
            let forces = (*self.forces.get()).as_mut_ptr();
            (0..3).for_each(|c| n[c].store(forces.add(c * self.plane + at)));
        }
    }
}

/// Severs faces of a solid at random. Returns how many.
fn sever_some<T: Real>(model: &Model, tables: &mut SweepTables<T>, count: usize) -> usize {
    let mut random = fastrand::Rng::with_seed(7);
    let mut severed = 0;
    for version in 1..=count {
        let places = model.places.solid().unwrap();
        let (cube, axis) = (random.usize(..places.count()), random.usize(..3));
        let Some(other) = places.cube_across(cube, axis, true).filter(|_| tables.severed.has_room(model)) else {
            continue;
        };
        let [cube, other, number] = [cube, other, 2 * axis].map(|of| of as u32);
        let face = SeveredSpring { ends: [cube, other], number, part: 0.5, version: version as u32 };
        severed += usize::from(tables.sever(model, face).is_some());
    }
    severed
}

fn a_point_has_the_bits_of_a_sweep<T: Real>(cuts: usize) {
    let mut of_widths = Vec::new();
    for lanes in [Lanes::Plain, Lanes::Avx2, Lanes::Avx512, Lanes::Neon].into_iter().filter_map(lanes::available) {
        let model = organ(lanes);
        let layout = Layout::new::<T>(model.points);
        let springs = springs_of::<T>(&model, &model.plan);
        let mut tables = SweepTables::new(&model, layout, springs.clone());
        let severed = sever_some(&model, &mut tables, cuts);
        assert!(severed >= cuts / 8, "{severed}");
        let mut u = Field::<T>::zero(&layout);
        let copies: Vec<usize> = tables.severed.copies().map_or(Vec::new(), |copies| copies.places().collect());
        assert!(copies.len() >= cuts / 40, "{}", copies.len());
        let places: Vec<usize> = model.points().map(|point| model.place_of(point)).chain(copies).collect();
        for at in &places {
            let corner = tables.severed.copies().map_or(*at, |copies| copies.corner_of(*at));
            let place = model.shape().rest_m(model.point_at(corner)) / model.unit_m;
            for c in 0..3 {
                u[c * layout.plane + layout.offset(*at)] =
                    T::of(0.2 * (place.dot(DVec3::new(1.3, 0.7, -1.1)) + c as f64 + 1e-3 * *at as f64).sin());
            }
        }
        let mut region = Region::none(&layout);
        (0..region.awake.has.len()).for_each(|tile| _ = region.awake.add(tile));
        region.cover(&layout, 1);
        let forces = UnsafeCell::new(Field::<T>::zero(&layout));
        // SAFETY: all fields have the layout.
        unsafe { tables.survey(u.as_ptr(), &region, Kept { plane: layout.plane, forces: &forces }) };
        let forces = forces.into_inner();
        let mut largest: f64 = 0.0;
        let mut mass = 0.0;
        for place in places.iter().copied() {
            mass += tables.relative_mass_at(&model, place);
            let one = springs.gather(&tables.severed, &layout, &u, 0.0, model.point_of(place));
            for c in 0..3 {
                let of_sweep = forces[c * layout.plane + layout.offset(place)].wide();
                assert_eq!(
                    one[c].wide().to_bits(),
                    of_sweep.to_bits(),
                    "{lanes:?} {place} {c}: {} {of_sweep}",
                    one[c].wide()
                );
                largest = largest.max(of_sweep.abs());
            }
        }
        assert!(largest > 0.0);
        let whole: f64 = model.points().map(|point| model.scene.relative_mass(point)).sum();
        assert!((mass / whole - 1.0).abs() < 1e-12, "{mass} of {whole}");
        of_widths.push(forces.iter().map(|force| force.wide().to_bits()).collect::<Vec<_>>());
    }
    if cuts > 0 {
        let at = |lanes: &Vec<u64>| lanes.iter().copied().fold(0_u64, |sum, bits| sum.rotate_left(1) ^ bits);
        let mut sums: Vec<u64> = of_widths.iter().map(at).collect();
        sums.dedup();
        assert_eq!(sums.len(), 1);
    }
}

#[test]
fn a_point_has_the_bits_of_a_sweep_at_every_width_also_beside_cuts() {
    for cuts in [0, 200] {
        a_point_has_the_bits_of_a_sweep::<f32>(cuts);
        a_point_has_the_bits_of_a_sweep::<f64>(cuts);
    }
}

#[test]
fn the_state_has_the_same_bits_at_every_width() {
    let hash = |lanes: Lanes| {
        let model = Arc::new(organ(lanes));
        let mut tissue = crate::at_rest(&model);
        let top_m = model.shape().top_m();
        let force_n = DVec3::new(0.02, -0.01, -0.05);
        let poke = crate::scene::profile::Poke {
            point: None,
            centre_m: top_m,
            force_n,
            falloff_per_m: 150.0,
            falloff_offset: 0.0,
        };
        tissue.push(0, Some(crate::Push::Constant(poke)));
        (0..60).for_each(|_| tissue.step().unwrap());
        assert!(tissue.largest_displacement_m() > 1e-4, "{}", tissue.largest_displacement_m());
        tissue.state_hash()
    };
    let mut hashes: Vec<u128> = [Lanes::Plain, Lanes::Avx2, Lanes::Avx512, Lanes::Neon]
        .into_iter()
        .filter_map(lanes::available)
        .map(hash)
        .collect();
    hashes.dedup();
    assert_eq!(hashes.len(), 1);
}

#[test]
fn linearised_cubes_resist_with_the_derivative_of_their_force() {
    let model = organ(Lanes::Plain);
    let Places::Solid(places) = &model.places else { panic!("of another kind") };
    let part: Vec<usize> = model.points().map(|point| model.place_of(point)).collect();
    let turn = DMat3::from_axis_angle(DVec3::new(0.3, -1.0, 0.5).normalize(), 0.7);
    let mut cells = LinearCells::of(places, None, &part, model.scene.springs.stiffness_n_per_m, model.unit_m, &turn);
    let field = |size: f64, phase: f64| -> Vec<DVec3> {
        let of = |n: usize| DVec3::new((1.7 * n as f64 + phase).sin(), (2.3 * n as f64).cos(), (0.9 * n as f64).sin());
        (0..part.len()).map(|n| size * model.unit_m * of(n)).collect()
    };
    let (at, by) = (field(0.01, 0.0), field(1.0, 1.0));
    let mut forces = |moved: f64| -> Vec<DVec3> {
        let at: Vec<DVec3> = at.iter().zip(&by).map(|(at, by)| *at + moved * *by).collect();
        cells.linearise(&at, &mut vec![DMat3::ZERO; part.len()]);
        let mut found = vec![DVec3::ZERO; part.len()];
        cells.forces(|point, force_n| found[point] += force_n);
        found
    };
    let (ahead, behind) = (forces(1e-6), forces(-1e-6));
    forces(0.0);
    let mut product = vec![[DVec3::ZERO; 1]; part.len()];
    cells.times(&by.iter().map(|by| [*by]).collect::<Vec<_>>(), &mut product);
    let largest = product.iter().map(|[force]| force.length()).fold(0.0, f64::max);
    for (point, [product]) in product.iter().enumerate() {
        let change = (behind[point] - ahead[point]) / 2e-6;
        assert!(product.distance(change) < 1e-6 * largest, "{point}: {product} {change}");
    }
}
