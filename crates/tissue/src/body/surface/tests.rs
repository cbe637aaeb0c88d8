//! Tests of the kernel for meshes: forces, energies, motion, the order of points, and the bound of stability.
#![allow(unsafe_code, clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::needless_range_loop)]

use std::cell::RefCell;

use glam::DVec3;

use super::MeshTrial;
use super::mesh_calibration::FreeMotion;
use super::order::TILE_SLOTS;
use super::pack::{Arrangement, MeshSprings};
use super::slots::{MeshSlots, NO_VERTEX};
use super::sweep::{MeshGrid, MeshSweep, Snapshot, gather};
use crate::body::model::Model;
use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::lanes::{Vector, Width, available, run, shape};
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::kernel::springs::{SpringCoefficients, Springs};
use crate::kernel::stage::Stage;
use crate::scene::graph::{GraphFault, MeshGraph, MeshSpring};
use crate::scene::{self, Lanes};

const ALL_LANES: [Lanes; 4] = [Lanes::Plain, Lanes::Avx2, Lanes::Avx512, Lanes::Neon];

/// A stage that keeps the forces, and the energies of each column.
struct Keep<T, const ENERGY: bool> {
    layout: Layout,
    n: *mut T,
    energy: *mut T,
}

impl<T: Real, const ENERGY: bool> Stage<T> for Keep<T, ENERGY> {
    const ENERGY: bool = ENERGY;

    #[inline(always)]
    unsafe fn finish<V: Vector<Real = T>, const DUTY: u8>(
        &self,
        row: usize,
        at: usize,
        _: [V; 3],
        n: [V; 3],
        _: &mut [V; 2],
    ) {
        assert!(at / BLOCK == row && self.layout.holds(at, V::LANES));
        for c in 0..3 {
            unsafe { n[c].store(self.n.add(c * self.layout.plane + at)) };
        }
    }

    #[inline(always)]
    unsafe fn energy<V: Vector<Real = T>>(&self, column: usize, energy: V) {
        unsafe { V::load(self.energy.add(column)).add(energy).store(self.energy.add(column)) };
    }
}

/// Forces (three planes) and the energies of the columns.
type Swept<T> = (Field<T>, [T; BLOCK]);

/// Sweeps over the tiles `awake`.
fn sweep<T: Real, const ENERGY: bool>(
    slots: &MeshSlots,
    lanes: Lanes,
    [scale, pull]: [f64; 2],
    u: &Field<T>,
    awake: impl Iterator<Item = usize>,
) -> Swept<T> {
    let (layout, width) = (slots.layout::<T>(), Width::of(lanes));
    let (springs, unit) = (MeshSprings::new(slots, shape::<T>(width)), SpringCoefficients::new(scale, 1.0));
    let (snapshot, mut n) = (RefCell::new(Snapshot::of(slots)), Field::zero(&layout));
    // What is not copied must not matter.
    snapshot.borrow_mut().fill(T::of(f64::NAN));
    let mut energy = [T::default(); BLOCK];
    let mut region = Region::none(&layout);
    awake.for_each(|tile| _ = region.awake.add(tile));
    let grid = MeshGrid {
        layout,
        slots,
        springs: &springs,
        unit: &unit,
        pull: T::of(pull),
        push: (T::default(), std::ptr::null()),
        x: u.as_ptr(),
        snapshot: &snapshot,
    };
    let stage = Keep::<T, ENERGY> { layout, n: n.as_mut_ptr(), energy: energy.as_mut_ptr() };
    unsafe { run(width, &MeshSweep { grid, over: &region, stage }) };
    (n, energy)
}

fn sweep_all<T: Real, const ENERGY: bool>(slots: &MeshSlots, lanes: Lanes, u: &Field<T>) -> Swept<T> {
    sweep::<T, ENERGY>(slots, lanes, [SCALE, PULL], u, 0..slots.tiles())
}

const SCALE: f64 = 0.02;
const PULL: f64 = 0.01;

/// A mesh of `count` points near a sphere in which a point has up to `valence` springs to points near it in number and
/// to a few far away, of uneven masses and stiffnesses. One in seven points has none.
fn uneven(count: usize, valence: usize, dice: &mut fastrand::Rng) -> MeshGraph {
    let mut place = |_| DVec3::from_array(std::array::from_fn(|_| dice.f64() - 0.5)) * (count as f64).sqrt();
    let rest_m: Vec<DVec3> = (0..count).map(&mut place).collect();
    let mut springs = Vec::new();
    for a in 0..count {
        if a % 7 == 6 {
            continue;
        }
        for _ in 0..dice.usize(0..=valence / 2) {
            let far = dice.u8(..) < 8;
            let b = if far { dice.usize(0..count) } else { (a + dice.usize(1..=valence.max(2))) % count };
            let long = rest_m[a].distance(rest_m[b]) > 0.2;
            if a != b && b % 7 != 6 && long {
                let ends = [a as u32, b as u32];
                springs.push(MeshSpring { ends, stiffness_n_per_m: 0.5 + dice.f64() });
            }
        }
    }
    MeshGraph {
        relative_mass: (0..count).map(|_| 0.5 + dice.f64()).collect(),
        extra_anchor: (0..count).map(|n| if n % 3 == 0 { 2.0 * dice.f64() - 0.5 } else { 0.0 }).collect(),
        spacing_m: 0.7,
        rest_m,
        springs,
    }
}

/// Displacements of the slots, up to `most` in each component.
fn displaced<T: Real>(slots: &MeshSlots, most: f64, dice: &mut fastrand::Rng) -> Field<T> {
    let layout = slots.layout::<T>();
    let mut u = Field::zero(&layout);
    for slot in slots.slot_of() {
        for c in 0..3 {
            u[c * layout.plane + *slot as usize] = T::of(most * (2.0 * dice.f64() - 1.0));
        }
    }
    u
}

fn u_of<T: Real>(slots: &MeshSlots, u: &[T], vertex: u32) -> DVec3 {
    let (plane, slot) = (slots.layout::<T>().plane, slots.slot_of()[vertex as usize] as usize);
    DVec3::from_array(std::array::from_fn(|c| u[c * plane + slot].wide()))
}

/// Force on each vertex, the sum of the magnitudes that it is made of, and the energy of the springs, over `SCALE`.
fn reference<T: Real>(graph: &MeshGraph, slots: &MeshSlots, u: &Field<T>) -> (Vec<[DVec3; 2]>, f64) {
    let mut forces = vec![[DVec3::ZERO; 2]; graph.rest_m.len()];
    let mut energy = 0.0;
    for spring in &graph.springs {
        let [a, b] = spring.ends;
        let rest = graph.rest(a, b);
        let delta = u_of(slots, u, b) - u_of(slots, u, a);
        let length = (rest + delta).length();
        // (1 − L0/L) without cancellation.
        let excess = (2.0 * rest.dot(delta) + delta.length_squared()) / (length * (length + rest.length()));
        let force = spring.stiffness_n_per_m * excess * (rest + delta);
        // A rounding error of Δ is one of q.
        let rounded = spring.stiffness_n_per_m * (u_of(slots, u, a).abs() + u_of(slots, u, b).abs()).length();
        for (end, force) in [(a, force), (b, -force)] {
            forces[end as usize][0] += force / graph.mass(end);
            forces[end as usize][1] += (force.abs() + rounded) / graph.mass(end);
        }
        energy += 0.5 * spring.stiffness_n_per_m * (excess * length).powi(2);
    }
    for (vertex, force) in forces.iter_mut().enumerate() {
        let (vertex, extra) = (vertex as u32, graph.extra(vertex as u32) * PULL / SCALE);
        let displaced = u_of(slots, u, vertex);
        force[0] -= extra * displaced;
        force[1] += (extra * displaced).abs();
    }
    (forces, energy)
}

fn pulls_as_the_reference<T: Real>() {
    let mut dice = fastrand::Rng::with_seed(19);
    for (count, valence) in [(4, 2), (15, 3), (16, 6), (17, 20), (100, 12), (257, 6), (1000, 20), (1000, 8)] {
        let graph = uneven(count, valence, &mut dice);
        let slots = MeshSlots::new(&graph).unwrap();
        for strain in [1e-5, 0.01, 0.3] {
            let u = displaced::<T>(&slots, strain, &mut dice);
            let (forces, energy) = reference(&graph, &slots, &u);
            let (n, energies) = sweep_all::<T, true>(&slots, Lanes::Auto, &u);
            for (vertex, [force, magnitude]) in forces.into_iter().enumerate() {
                let found = u_of(&slots, &n, vertex as u32) / SCALE;
                let within = 8.0 * T::EPSILON * (magnitude + magnitude.max_element());
                let near = (found - force).abs().cmple(within).all();
                assert!(near, "{count} {valence} {strain} {vertex}: {found} {force} ± {within}");
                let slot = slots.slot_of()[vertex] as usize;
                let unit = SpringCoefficients::<T>::new(SCALE, 1.0);
                let alone = gather(&slots, &unit, (T::of(PULL), slots.extra_of(slot)), None, &u, slot, |_, _| 1.0);
                let swept = std::array::from_fn(|c| n[c * slots.layout::<T>().plane + slot]);
                assert_eq!(alone, swept, "{count} {valence} {strain} {vertex}");
            }
            let found: f64 = energies.iter().map(|energy| energy.wide()).sum::<f64>() / SCALE;
            let within = 1e3 * T::EPSILON * energy.abs();
            assert!((found - energy).abs() <= within, "{count} {valence} {strain}: {found} {energy}");
        }
    }
}

#[test]
fn springs_pull_as_a_scalar_reference_does() {
    pulls_as_the_reference::<f32>();
    pulls_as_the_reference::<f64>();
}

fn same_at_every_width<T: Real>() {
    let mut dice = fastrand::Rng::with_seed(7);
    let mut dense = uneven(600, 8, &mut dice);
    // A point with a thousand springs, some of them double.
    for n in 0..1000_u32 {
        dense.springs.push(MeshSpring { ends: [3, 8 + n * 31 % 590], stiffness_n_per_m: 0.01 });
    }
    for graph in [uneven(4, 2, &mut dice), uneven(300, 20, &mut dice), uneven(1000, 6, &mut dice), dense] {
        let slots = MeshSlots::new(&graph).unwrap();
        for strain in [1e-30, 1e-9, 0.02, 0.2] {
            let u = displaced::<T>(&slots, strain, &mut dice);
            let (plain, plain_energy) = sweep_all::<T, true>(&slots, Lanes::Plain, &u);
            assert!(plain.iter().any(|n| n.wide() != 0.0) || strain < 1e-20);
            for lanes in ALL_LANES.into_iter().filter(|lanes| available(*lanes).is_some()) {
                let (n, energy) = sweep_all::<T, true>(&slots, lanes, &u);
                assert!(n[..] == plain[..] && energy == plain_energy, "{lanes:?} {strain}");
                let (n, _) = sweep_all::<T, false>(&slots, lanes, &u);
                assert!(n[..] == plain[..], "{lanes:?} {strain}");
            }
        }
    }
}

#[test]
fn the_bits_are_the_same_at_every_width() {
    same_at_every_width::<f32>();
    same_at_every_width::<f64>();
}

/// A flat rectangle with the sheet's springs.
fn flat(springs: &scene::Springs, [rows, columns]: [usize; 2]) -> MeshGraph {
    let at = |i: usize, j: usize| (i * columns + j) as u32;
    let mut graph = MeshGraph { spacing_m: 0.01, ..MeshGraph::default() };
    for i in 0..rows {
        for j in 0..columns {
            graph.rest_m.push(0.01 * DVec3::new(i as f64, j as f64, 0.0));
            let mut join = |di: usize, dj: isize, stiffness_n_per_m: f64| {
                let (i1, j1) = (i + di, j.checked_add_signed(dj));
                if let Some(j1) = j1.filter(|j1| i1 < rows && *j1 < columns) {
                    graph.springs.push(MeshSpring { ends: [at(i, j), at(i1, j1)], stiffness_n_per_m });
                }
            };
            for (di, dj) in [(0, 1), (1, 0)] {
                join(di, dj, springs.stiffness_n_per_m);
                if springs.bending {
                    join(2 * di, 2 * dj, springs.stiffness_n_per_m);
                }
            }
            for dj in [-1, 1] {
                join(1, dj, springs.shear_stiffness_n_per_m);
            }
        }
    }
    graph
}

#[test]
fn a_flat_mesh_with_a_sheets_springs_pulls_as_the_sheet_does() {
    let mut dice = fastrand::Rng::with_seed(3);
    for bending in [false, true] {
        let springs =
            scene::Springs { stiffness_n_per_m: 3.0, shear_stiffness_n_per_m: 1.5, bending, pretension_n_per_m: 0.0 };
        let size @ [rows, columns] = [19, 33];
        let graph = flat(&springs, size);
        let slots = MeshSlots::new(&graph).unwrap();
        let sheet = Layout::new::<f32>(size);
        let sheets_springs = Springs::<f32>::new(&springs, 0.0, SCALE);
        for strain in [1e-6, 1e-3, 0.1] {
            let u = displaced::<f32>(&slots, strain, &mut dice);
            let mut sheets_u = Field::zero(&sheet);
            for index in 0..rows * columns {
                for (c, value) in u_of(&slots, &u, index as u32).to_array().into_iter().enumerate() {
                    sheets_u[c * sheet.plane + sheet.offset(index)] = value as f32;
                }
            }
            let (n, _) = sweep_all::<f32, false>(&slots, Lanes::Auto, &u);
            let most = n.iter().fold(0.0_f32, |most, n| most.max(n.abs()));
            for index in 0..rows * columns {
                let truth = sheets_springs.gather(&sheet, &sheets_u, [index / columns, index % columns], |_, _| 1.0);
                let found = u_of(&slots, &n, index as u32);
                let away = found.distance(DVec3::from_array(truth.map(f64::from)));
                assert!(away <= 1e-6 * f64::from(most), "{strain} {index}: {found} {truth:?}");
            }
        }
    }
}

#[test]
fn springs_change_no_momentum() {
    let mut dice = fastrand::Rng::with_seed(4);
    let mut graph = uneven(900, 12, &mut dice);
    graph.extra_anchor.clear();
    let slots = MeshSlots::new(&graph).unwrap();
    for strain in [1e-4, 0.2] {
        let u = displaced::<f32>(&slots, strain, &mut dice);
        let (n, _) = sweep_all::<f32, false>(&slots, Lanes::Auto, &u);
        let (mut sum, mut magnitude) = (DVec3::ZERO, DVec3::ZERO);
        for vertex in 0..900 {
            let force = graph.mass(vertex) * u_of(&slots, &n, vertex);
            (sum, magnitude) = (sum + force, magnitude + force.abs());
        }
        assert!(sum.abs().cmple(1e-6 * magnitude).all(), "{strain}: {sum} of {magnitude}");
    }
}

#[test]
fn awake_tiles_move_as_if_all_were_awake_and_sleeping_ones_stay() {
    let mut dice = fastrand::Rng::with_seed(5);
    let graph = uneven(2000, 6, &mut dice);
    let slots = MeshSlots::new(&graph).unwrap();
    assert_eq!(slots.tiles(), 8);
    let u = displaced::<f32>(&slots, 0.05, &mut dice);
    let (all, _) = sweep_all::<f32, false>(&slots, Lanes::Auto, &u);
    let plane = slots.layout::<f32>().plane;
    for awake in [vec![0], vec![7], vec![2, 3, 6], vec![0, 1, 4, 5, 7], vec![]] {
        for lanes in ALL_LANES {
            let (n, _) = sweep::<f32, false>(&slots, lanes, [SCALE, PULL], &u, awake.iter().copied());
            for slot in 0..slots.vertex_of().len() {
                for c in 0..3 {
                    let at = c * plane + slot;
                    let truth = if awake.contains(&(slot / TILE_SLOTS)) { all[at] } else { 0.0 };
                    assert!(n[at].to_bits() == truth.to_bits(), "{awake:?} {lanes:?} {slot}");
                }
            }
        }
    }
    let mut motion = FreeMotion::<f32>::new(slots, 0.1, SCALE, Lanes::Auto);
    motion.displace(|vertex| 0.01 * DVec3::splat((vertex as f64).sin()));
    let before = motion.state.u.to_vec();
    motion.region = Region::none(&motion.layout);
    [1, 4].into_iter().for_each(|tile| _ = motion.region.awake.add(tile));
    (0..3).for_each(|_| motion.step());
    for slot in 0..motion.slots.vertex_of().len() {
        let stays = (0..3).all(|c| motion.state.u[c * plane + slot] == before[c * plane + slot]);
        let moves = [1, 4].contains(&(slot / TILE_SLOTS));
        assert!(stays != moves || motion.slots.vertex_of()[slot] == NO_VERTEX, "{slot}");
    }
}

fn moves_alike_at_every_width<T: Real>() {
    let graph = uneven(300, 10, &mut fastrand::Rng::with_seed(6));
    let run = |lanes| {
        let mut motion = FreeMotion::<T>::new(MeshSlots::new(&graph).unwrap(), 0.1, SCALE, lanes);
        (0..3).for_each(|_| motion.step());
        assert!(motion.state.u.iter().all(|u| u.wide() == 0.0), "what is at rest stays there");
        motion.displace(|vertex| 0.02 * DVec3::new((vertex as f64).sin(), (vertex as f64 * 0.3).cos(), 0.5));
        (0..60).for_each(|_| motion.step());
        for (slot, _) in motion.slots.vertex_of().iter().enumerate().filter(|(_, vertex)| **vertex == NO_VERTEX) {
            assert!((0..3).all(|c| motion.state.u[c * motion.layout.plane + slot].wide() == 0.0), "{slot}");
        }
        motion.state.u.to_vec()
    };
    let plain = run(Lanes::Plain);
    assert!(plain.iter().all(|u| u.wide().abs() < 0.2) && plain.iter().any(|u| u.wide().abs() > 1e-3));
    for lanes in ALL_LANES.into_iter().filter(|lanes| available(*lanes).is_some()) {
        assert!(run(lanes) == plain, "{lanes:?}");
    }
}

#[test]
fn a_mesh_moves_alike_at_every_width() {
    moves_alike_at_every_width::<f32>();
    moves_alike_at_every_width::<f64>();
}

#[test]
fn a_trial_turns_as_its_anchor_springs_say() {
    // Two points without strain between them: u = cos(turn·n).
    let spring = MeshSpring { ends: [0, 1], stiffness_n_per_m: 5.0 };
    let graph =
        MeshGraph { rest_m: vec![DVec3::ZERO, DVec3::X], springs: vec![spring], spacing_m: 1.0, ..Default::default() };
    let mut trial = MeshTrial::new(&graph, 0.01, SCALE, Lanes::Auto).unwrap();
    trial.displace(|_| DVec3::new(0.5, 0.25, 0.0));
    trial.step(314);
    assert!((trial.displacement(1) + DVec3::new(0.5, 0.25, 0.0)).length() < 0.01, "{}", trial.displacement(1));
    // A spring twice as long as at rest pulls with its stiffness times the length that it gained.
    trial.displace(|vertex| if vertex == 1 { DVec3::X } else { DVec3::ZERO });
    assert!((trial.force(0) - DVec3::X * SCALE * 5.0).length() < 1e-6, "{}", trial.force(0));
}

/// A grid of triangles wound to a tube: all points within have six springs.
fn tube(around: usize, along: usize) -> MeshGraph {
    let at = |i: usize, j: usize| (j * around + i % around) as u32;
    let mut graph = MeshGraph { spacing_m: 1.0, ..MeshGraph::default() };
    for j in 0..along {
        for i in 0..around {
            let angle = (i as f64 + 0.5 * j as f64) / around as f64 * std::f64::consts::TAU;
            let radius = around as f64 / std::f64::consts::TAU;
            graph.rest_m.push(DVec3::new(radius * angle.cos(), radius * angle.sin(), 0.866 * j as f64));
            let mut ends = vec![at(i + 1, j)];
            if j + 1 < along {
                ends.extend([at(i, j + 1), at(i + around - 1, j + 1)]);
            }
            let springs = ends.into_iter().map(|end| MeshSpring { ends: [at(i, j), end], stiffness_n_per_m: 1.0 });
            graph.springs.extend(springs);
        }
    }
    graph
}

#[test]
fn neighbours_along_the_mesh_come_near_to_each_other() {
    let graph = tube(70, 90);
    let slots = MeshSlots::new(&graph).unwrap();
    let mut seen = vec![false; graph.rest_m.len()];
    for (slot, vertex) in slots.vertex_of().iter().enumerate() {
        if *vertex != NO_VERTEX {
            assert!(!std::mem::replace(&mut seen[*vertex as usize], true));
            assert_eq!(slots.slot_of()[*vertex as usize] as usize, slot);
        }
    }
    assert!(seen.into_iter().all(|seen| seen));
    let outside: Vec<usize> = (0..slots.blocks()).map(|block| slots.outside(block).len()).collect();
    let mean = outside.iter().sum::<usize>() as f64 / outside.len() as f64;
    assert!(mean < 24.0 && outside.iter().all(|count| *count <= 48), "{mean} {outside:?}");
    for tile in 0..slots.tiles() {
        let beside = slots.neighbours(tile);
        assert!(beside.is_sorted() && (2..=12).contains(&beside.len()), "{tile}: {beside:?}");
        assert!(beside.iter().all(|other| slots.neighbours(*other as usize).contains(&(tile as u32))));
    }
}

#[test]
fn few_lanes_of_a_halo_are_empty() {
    let graph = tube(70, 90);
    let slots = MeshSlots::new(&graph).unwrap();
    let shape = crate::kernel::lanes::LaneShape { lanes: BLOCK, picks: true };
    let MeshSprings { arrangement: Arrangement::Halo(halo), .. } = MeshSprings::<f32>::new(&slots, shape) else {
        panic!("of another kind");
    };
    let (rows, springs) = (halo.others.len() * BLOCK, 2 * graph.springs.len());
    assert!(rows as f64 <= 1.1 * springs as f64, "{rows} {springs}");
}

#[test]
fn a_graph_that_can_not_be_computed_is_refused() {
    let good = tube(5, 4);
    assert!(MeshSlots::new(&good).is_ok());
    let fault = |change: &dyn Fn(&mut MeshGraph)| {
        let mut graph = good.clone();
        change(&mut graph);
        MeshSlots::new(&graph).unwrap_err()
    };
    assert_eq!(fault(&|graph| graph.rest_m.clear()), GraphFault::Count(0));
    assert_eq!(fault(&|graph| graph.relative_mass = vec![1.0]), GraphFault::Length(1));
    assert_eq!(fault(&|graph| graph.spacing_m = 0.0), GraphFault::Spacing);
    assert_eq!(fault(&|graph| graph.spacing_m = f64::NAN), GraphFault::Spacing);
    assert_eq!(fault(&|graph| graph.rest_m[7].y = f64::INFINITY), GraphFault::Point(7));
    assert_eq!(fault(&|graph| graph.spacing_m = 1e-320), GraphFault::Point(0));
    let masses = |wrong: f64| (0..20).map(|n| if n == 3 { wrong } else { 1.0 }).collect::<Vec<_>>();
    assert_eq!(fault(&|graph| graph.relative_mass = masses(0.0)), GraphFault::Point(3));
    assert_eq!(fault(&|graph| graph.extra_anchor = masses(f64::NAN)), GraphFault::Point(3));
    assert_eq!(fault(&|graph| graph.springs[9].ends = [4, 4]), GraphFault::Ends(9));
    assert_eq!(fault(&|graph| graph.springs[9].ends = [4, 20]), GraphFault::Ends(9));
    assert_eq!(fault(&|graph| graph.springs[9].stiffness_n_per_m = -1.0), GraphFault::Stiffness(9));
    let [a, b] = good.springs[9].ends.map(|end| end as usize);
    let joins = |spring: &MeshSpring| spring.ends.contains(&(a as u32)) && spring.ends.contains(&(b as u32));
    let first = good.springs.iter().position(joins).unwrap();
    assert_eq!(fault(&|graph| graph.rest_m[a] = graph.rest_m[b]), GraphFault::Rest(first));
}

#[test]
fn a_spring_is_as_stiff_from_either_end_however_heavy_its_ends_are() {
    let model = Model::gallbladder(&[]);
    let graph = model.places.surface().unwrap();
    let (mut springs, mut uneven) = (0, 0);
    for slot in model.points().map(|point| graph.slot_of(point)) {
        for (other, rest, stiffness) in graph.joined(slot) {
            let back: Vec<_> = graph.joined(other).filter(|(to, ..)| *to == slot).collect();
            let [(_, back_rest, back_stiffness)] = back[..] else { panic!("{slot} and {other}: {back:?}") };
            assert_eq!(rest, -back_rest);
            assert!((stiffness / back_stiffness - 1.0).abs() < 1e-9, "{slot} {other}: {stiffness} {back_stiffness}");
            springs += 1;
            let [one, two] = [slot, other].map(|slot| model.relative_mass_at(slot));
            uneven += usize::from((one / two - 1.0).abs() > 0.05);
        }
    }
    assert!(springs > 1000 && uneven > springs / 10, "{uneven} of {springs}");
}
