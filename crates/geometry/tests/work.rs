//! Meshes that were designed to take very long: each is processed within a number of operations that corresponds to a
//! few passes over it, or cancelled.
#![allow(clippy::unwrap_used, clippy::disallowed_methods)]

use std::f64::consts::{PI, TAU};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use glam::DVec3;
use palpate_geometry::decimate::decimate;
use palpate_geometry::work::{GivenUp, within};
use palpate_geometry::{Group, Prepared, TriangleMesh, prepare};

/// Runs `act` with a limit of operations for each triangle of a mesh.
fn bounded<T>(mesh: &TriangleMesh, for_each: u64, act: impl FnOnce() -> T) -> T {
    let most = for_each * mesh.triangles.len() as u64;
    within(&Arc::new(AtomicBool::new(false)), most, act).unwrap()
}

fn prepared(mesh: &TriangleMesh, for_each: u64) -> Prepared {
    bounded(mesh, for_each, || prepare(mesh.clone()))
}

/// Two cones on a common circle of `around` vertices: each tip is in half of all triangles.
fn two_hubs(around: u32) -> TriangleMesh {
    let mut vertices_m = vec![DVec3::new(0.0, 0.0, 0.05), DVec3::new(0.0, 0.0, -0.05)];
    vertices_m.extend((0..around).map(|k| {
        let angle = TAU * f64::from(k) / f64::from(around);
        DVec3::new(0.1 * angle.cos(), 0.1 * angle.sin(), 0.0)
    }));
    let triangles = (0..around).flat_map(|k| {
        let (a, b) = (2 + k, 2 + (k + 1) % around);
        [[0, a, b], [1, b, a]]
    });
    TriangleMesh { vertices_m, triangles: triangles.collect(), ..Default::default() }
}

/// A sphere without its poles.
fn sphere(rings: u32) -> TriangleMesh {
    let at = |i: u32, j: u32| {
        let (down, around) = (PI * (f64::from(i) + 0.5) / f64::from(rings + 1), TAU * f64::from(j) / f64::from(rings));
        0.1 * DVec3::new(down.sin() * around.cos(), down.sin() * around.sin(), down.cos())
    };
    let vertices_m = (0..=rings).flat_map(|i| (0..rings).map(move |j| at(i, j))).collect();
    let number = |i: u32, j: u32| i * rings + j % rings;
    let cells = (0..rings).flat_map(|i| (0..rings).map(move |j| (i, j)));
    let of = |(i, j): (u32, u32)| {
        let [a, b, c, d] = [number(i, j), number(i + 1, j), number(i, j + 1), number(i + 1, j + 1)];
        [[a, b, c], [b, d, c]]
    };
    TriangleMesh { vertices_m, triangles: cells.flat_map(of).collect(), ..Default::default() }
}

#[test]
fn a_vertex_with_very_many_edges_takes_no_longer_than_as_many_vertices() {
    let mesh = two_hubs(10_000);
    let found = prepared(&mesh, 400);
    assert!(bounded(&mesh, 1000, || found.report()).refusal().is_none());
    // Nothing collapses beside such a vertex.
    assert_eq!(bounded(&mesh, 200, || decimate(&mesh, 1000)).mesh.triangles.len(), mesh.triangles.len());
}

#[test]
fn vertices_without_triangles_in_the_middle_of_a_sphere_get_a_near_one() {
    let mut mesh = sphere(60);
    let count = mesh.vertices_m.len();
    mesh.vertices_m.extend((0..20_000).map(|k| DVec3::splat(1e-9 * f64::from(k))));
    // In addition, a vertex that is near another one.
    mesh.vertices_m.insert(count, 1.01 * mesh.vertices_m[7]);
    let found = prepared(&mesh, 3000);
    let file = found.file.unwrap();
    assert_eq!(file.vertex_of[count], file.vertex_of[7]);
    assert_eq!(file.vertex_of.len(), mesh.vertices_m.len());
}

#[test]
fn surfaces_within_surfaces_are_looked_at_by_what_is_around_them_in_order() {
    let (mut mesh, count) = (TriangleMesh::default(), 1500_u32);
    for k in 0..count {
        let size = 0.1 * (1.0 + f64::from(k) / f64::from(count));
        let corners = [[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, -1.0, -1.0]];
        mesh.vertices_m.extend(corners.map(|corner| size * DVec3::from(corner)));
        mesh.triangles.extend([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|of| of.map(|corner| 4 * k + corner)));
    }
    let found = prepared(&mesh, 5000);
    // Every second surface is the wall of a cavity, and is turned.
    assert!(found.notes.iter().any(|note| note.contains("cavities")), "{:?}", found.notes);
}

#[test]
fn what_a_vertex_became_is_found_at_once_however_often_it_was_replaced() {
    let mut mesh = sphere(60);
    let all: Vec<u32> = (0..).take(mesh.vertices_m.len()).collect();
    mesh.groups = vec![Group { name: "all".to_owned(), vertices: all.clone() }; 50];
    mesh.groups.push(Group { name: "one".to_owned(), vertices: vec![all[1234]] });
    let coarse = bounded(&mesh, 3000, || decimate(&mesh, 40)).mesh;
    assert!(coarse.groups[..50].iter().all(|group| group.vertices.len() == coarse.vertices_m.len()));
    assert_eq!(coarse.groups[50].vertices.len(), 1);
}

#[test]
fn what_nobody_waits_for_is_given_up() {
    let (mesh, stop) = (sphere(60), Arc::new(AtomicBool::new(true)));
    assert_eq!(within(&stop, u64::MAX, || prepare(mesh.clone())).map(|_| ()), Err(GivenUp::Stopped));
    let too_little = within(&Arc::default(), 1000, || prepare(mesh).report());
    assert_eq!(too_little.map(|_| ()), Err(GivenUp::TooMuch(1000)));
}
