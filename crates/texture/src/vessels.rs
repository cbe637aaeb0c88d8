//! Vessels: trees of strokes that meander, taper and branch.

use super::noise::{bits, gradient, unit};
use palpate_tissue::memory;

/// A piece of a vessel. Lengths are in sides of the image.
#[derive(Debug, Clone, Copy)]
struct Stroke {
    from: [f32; 2],
    to: [f32; 2],
    radius: [f32; 2],
}

/// A stream of pseudo-random numbers from 0 to 1.
struct Numbers {
    seed: u32,
    count: i32,
}

impl Numbers {
    fn next(&mut self) -> f32 {
        self.count += 1;
        unit(bits(self.seed, self.count, 0))
    }

    fn between(&mut self, from: f32, to: f32) -> f32 {
        from + (to - from) * self.next()
    }
}

/// How a tree of vessels grows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Habit {
    pub(super) trees: u32,
    /// Radius of a trunk, in sides.
    pub(super) radius: f32,
    /// Radius below which growth stops.
    pub(super) thinnest: f32,
    /// Decrease of radius over a length of 1.
    pub(super) taper: f32,
    /// Number of branches over a length of 1.
    pub(super) branches: f32,
}

/// Paints vessels. Returns the coverage of each pixel, 0 to 1: `size` × `size` values, by rows.
pub(super) fn paint(seed: u32, size: usize, habit: Habit) -> Vec<f32> {
    let mut map = memory::zeroed(size * size, "a texture");
    for stroke in grow(seed, habit) {
        draw(&mut map, size, &stroke);
    }
    map
}

/// Largest number of strokes of all trees together.
const MAX_SEGMENTS: usize = 40_000;

/// Length of a stroke, in sides of the image.
const PIECE: f32 = 0.006;

fn grow(seed: u32, habit: Habit) -> Vec<Stroke> {
    let mut numbers = Numbers { seed, count: 0 };
    let mut strokes = Vec::new();
    // Place, direction, radius.
    let mut tips: Vec<([f32; 2], [f32; 2], f32)> = Vec::new();
    for tree in 0..habit.trees {
        // From the edge inwards, all around.
        let along = (tree as f32 + numbers.next()) / habit.trees as f32 * 4.0;
        let t = along.fract();
        let (place, inwards) = match along as u32 {
            0 => ([t, -0.03], [0.0, 1.0]),
            1 => ([1.03, t], [-1.0, 0.0]),
            2 => ([1.0 - t, 1.03], [0.0, -1.0]),
            _ => ([-0.03, 1.0 - t], [1.0, 0.0]),
        };
        tips.push((place, turned(inwards, numbers.between(-0.7, 0.7)), habit.radius * numbers.between(0.7, 1.2)));
    }
    while let Some((mut place, mut towards, mut radius)) = tips.pop() {
        while radius > habit.thinnest && strokes.len() < MAX_SEGMENTS {
            // A slow meander that neighbours share, and a tremor of its own.
            let meander = 1.2 * gradient(seed ^ 0x51, 6.0 * place[0], 6.0 * place[1]);
            towards = turned(towards, PIECE * 14.0 * meander + numbers.between(-0.16, 0.16));
            let to = [place[0] + PIECE * towards[0], place[1] + PIECE * towards[1]];
            let thinner = radius * (1.0 - PIECE * habit.taper);
            strokes.push(Stroke { from: place, to, radius: [radius, thinner] });
            (place, radius) = (to, thinner);
            if place.iter().any(|x| !(-0.06..=1.06).contains(x)) {
                break;
            }
            if numbers.next() < PIECE * habit.branches {
                let side = if numbers.next() < 0.5 { -1.0 } else { 1.0 };
                // A branch takes its share of the cross section.
                let share = numbers.between(0.25, 0.6);
                tips.push((place, turned(towards, side * numbers.between(0.5, 1.1)), radius * share.sqrt()));
                radius *= (1.0 - 0.5 * share).sqrt();
                towards = turned(towards, -side * 0.25 * share);
            }
        }
    }
    strokes
}

fn turned([x, y]: [f32; 2], by: f32) -> [f32; 2] {
    // A turn by less than a right angle, without sine and cosine: by twice the angle whose tangent is nearly by/2.
    let t = 0.5 * by;
    let (cos, sin) = ((1.0 - t * t) / (1.0 + t * t), 2.0 * t / (1.0 + t * t));
    [x * cos - y * sin, x * sin + y * cos]
}

fn draw(map: &mut [f32], size: usize, stroke: &Stroke) {
    let pixels = size as f32;
    let Stroke { from, to, radius } = *stroke;
    // A vessel is never drawn thinner than a pixel can show: it gets paler instead.
    let least = 0.55 / pixels;
    let reach = radius[0].max(least) + 1.0 / pixels;
    let range = |axis: usize| {
        let (low, high) = (from[axis].min(to[axis]) - reach, from[axis].max(to[axis]) + reach);
        let pixel = |x: f32| (x * pixels).clamp(0.0, pixels) as usize;
        pixel(low)..pixel(high + 1.0 / pixels)
    };
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    let squared = (dx * dx + dy * dy).max(1e-12);
    for row in range(1) {
        for column in range(0) {
            let (x, y) = ((column as f32 + 0.5) / pixels - from[0], (row as f32 + 0.5) / pixels - from[1]);
            let t = ((x * dx + y * dy) / squared).clamp(0.0, 1.0);
            let away = ((x - t * dx) * (x - t * dx) + (y - t * dy) * (y - t * dy)).sqrt();
            let own = radius[0] + (radius[1] - radius[0]) * t;
            let shown = own.max(least);
            // Rounder than a tube: with soft sides, as under tissue.
            let inside = (1.0 - away / (shown + 0.5 / pixels)).clamp(0.0, 1.0);
            let amount = (inside * (2.0 - inside)).min(1.0) * (own / shown);
            let at = &mut map[row * size + column];
            *at = at.max(amount);
        }
    }
}
