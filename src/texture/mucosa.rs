//! The lining of a stomach seen through an endoscope. It has broad folds, a relief of small fields, vessels at two depths,
//! capillaries around the fields, redder and paler regions, and a wet film with glints.
//!
//! Everything is a function of place (in sides of the image), so another size shows the same picture at another
//! resolution.

use super::noise::{cells, fractal, gradient, step};
use super::vessels::{self, Habit};
use crate::memory;

type Colour = [f32; 3];

/// sRGB, 0 to 1.
const fn srgb(r: u8, g: u8, b: u8) -> Colour {
    [r as f32 / 255.0, g as f32 / 255.0, b as f32 / 255.0]
}

const PINK: Colour = srgb(226, 134, 112);
const RED: Colour = srgb(196, 84, 70);
const PALE: Colour = srgb(242, 182, 152);
const GROOVE: Colour = srgb(128, 34, 34);
const VEIN: Colour = srgb(126, 52, 76);
const ARTERY: Colour = srgb(158, 30, 34);
const WET: Colour = srgb(255, 246, 238);

fn mix(a: Colour, b: Colour, t: f32) -> Colour {
    std::array::from_fn(|c| a[c] + (b[c] - a[c]) * t)
}

/// From 0 in a groove to 1 on a fold's back.
fn fold(seed: u32, x: f32, y: f32) -> f32 {
    let bent = 0.5 * fractal(seed + 10, 1.7 * x, 1.7 * y, 2) + 0.10 * fractal(seed + 14, 6.0 * x, 6.0 * y, 2);
    let across = 3.1 * (0.86 * x + 0.5 * y) + bent;
    let from_groove = 1.0 - (2.0 * (across - across.floor()) - 1.0).abs();
    // Broad backs, narrow grooves.
    let back = 1.0 - (1.0 - from_groove) * (1.0 - from_groove) * (1.0 - from_groove);
    // Grooves have ends.
    let depth = step(-0.35, 0.25, gradient(seed + 18, 2.2 * x + 5.0, 2.2 * y));
    1.0 - depth * (1.0 - back)
}

/// Height of the surface, and the distances to the middle of this field and of the next one.
fn relief(seed: u32, x: f32, y: f32) -> (f32, [f32; 2]) {
    let swell = fractal(seed + 20, 7.0 * x, 7.0 * y, 3);
    let (a, b) = (0.012 * fractal(seed + 24, 14.0 * x, 14.0 * y, 2), 0.012 * fractal(seed + 27, 14.0 * x, 14.0 * y, 2));
    let field = cells(seed + 30, 44.0 * (x + a), 44.0 * (y + b));
    let dome = 1.0 - field[0] * field[0];
    let grain = fractal(seed + 34, 120.0 * x, 120.0 * y, 2);
    (0.040 * fold(seed, x, y) + 0.012 * swell + 0.0026 * dome + 0.0004 * grain, field)
}

/// Rows of `size` × `size` pixels, sRGB.
pub(super) fn paint(seed: u64, size: usize) -> Vec<u8> {
    let seed = (seed as u32) ^ (seed >> 32) as u32;
    let seed = super::noise::bits(seed, 1, 2) & 0xffff_ff00;
    let veins = Habit { trees: 6, radius: 0.0095, thinnest: 0.0022, taper: 1.0, branches: 9.0 };
    let arteries = Habit { trees: 10, radius: 0.0036, thinnest: 0.0006, taper: 1.3, branches: 22.0 };
    let veins = vessels::paint(seed + 1, size, veins);
    let arteries = vessels::paint(seed + 2, size, arteries);
    let mut pixels = memory::zeroed(3 * size * size, "a texture");
    // Rows are independent, so the result does not depend on which thread paints them.
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    let rows = size.div_ceil(workers);
    std::thread::scope(|scope| {
        for (part, pixels) in pixels.chunks_mut(3 * size * rows).enumerate() {
            let (veins, arteries) = (&veins, &arteries);
            scope.spawn(move || paint_rows(seed, size, part * rows, veins, arteries, pixels));
        }
    });
    pixels
}

fn paint_rows(seed: u32, size: usize, first: usize, veins: &[f32], arteries: &[f32], pixels: &mut [u8]) {
    let place = |index: usize| (index as f32 + 0.5) / size as f32;
    let rows = pixels.len() / (3 * size);
    let of_row = |row: usize| -> Vec<(f32, [f32; 2])> {
        (0..=size).map(|column| relief(seed, place(column), place(row))).collect()
    };
    let mut here = of_row(first);
    for row in 0..rows {
        let below = of_row(first + row + 1);
        for column in 0..size {
            let (x, y) = (place(column), place(first + row));
            let (height, field) = here[column];
            let slope = [(here[column + 1].0 - height) * size as f32, (below[column].0 - height) * size as f32];
            let at = (first + row) * size + column;
            let colour = shade(seed, x, y, slope, field, veins[at], arteries[at]);
            for c in 0..3 {
                pixels[3 * (row * size + column) + c] = (255.0 * colour[c].clamp(0.0, 1.0) + 0.5) as u8;
            }
        }
        here = below;
    }
}

fn shade(seed: u32, x: f32, y: f32, slope: [f32; 2], field: [f32; 2], vein: f32, artery: f32) -> Colour {
    let back = fold(seed, x, y);
    let region = fractal(seed + 40, 2.3 * x, 2.3 * y, 4);
    let mut colour = mix(PINK, RED, step(-0.5, 0.7, region));
    colour = mix(colour, PALE, 0.55 * step(0.0, 0.9, fractal(seed + 50, 3.1 * x, 3.1 * y, 4)) * back);
    // Blood in patches of some millimetres.
    colour = mix(colour, RED, 0.35 * step(0.15, 0.75, fractal(seed + 60, 16.0 * x, 16.0 * y, 3)));
    colour = mix(colour, GROOVE, 0.75 * (1.0 - back) * (1.0 - back));

    // Vessels shine through where the lining is thin.
    let thin = 0.35 + 0.65 * step(-0.3, 0.4, gradient(seed + 70, 3.0 * x, 3.0 * y));
    colour = mix(colour, VEIN, 0.42 * vein * thin * (0.4 + 0.6 * back));
    colour = mix(colour, ARTERY, 0.62 * artery * thin);
    let net = step(0.20, 0.02, field[1] - field[0]);
    let flushed = step(-0.25, 0.55, fractal(seed + 80, 8.0 * x, 8.0 * y, 2));
    colour = mix(colour, ARTERY, 0.30 * net * (0.25 + 0.75 * flushed));

    // Light from above left, near the axis.
    let length = (1.0 + slope[0] * slope[0] + slope[1] * slope[1]).sqrt();
    let normal = [-slope[0] / length, -slope[1] / length, 1.0 / length];
    let dot = |v: [f32; 3]| normal[0] * v[0] + normal[1] * v[1] + normal[2] * v[2];
    let lit = 0.52 + 0.50 * dot([-0.424, -0.424, 0.8]).max(0.0) / 0.8;
    colour = colour.map(|c| c * lit);
    // The film: a sheen on the slopes that face the light, and glints where it is thick.
    let half = dot([-0.225, -0.225, 0.948]).max(0.0);
    let power = |x: f32, times: u32| (0..times).fold(x, |x, _| x * x);
    let film = step(-0.05, 0.45, fractal(seed + 90, 11.0 * x, 11.0 * y, 3));
    let glint = power(half, 8) * film;
    mix(colour, WET, (0.10 * power(half, 4) + 0.8 * step(0.25, 0.85, glint)).min(0.92))
}
