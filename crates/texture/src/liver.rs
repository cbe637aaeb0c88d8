//! The capsule of a liver: smooth and red-brown, with lobules as a faint mosaic beneath, and few vessels. On a
//! sheet of 75 mm a lobule is 1.5 mm wide. Only colour: viewers add gloss and shading.

use super::colour::{self, Colour, mix, srgb};
use super::noise::{fractal, gradient, mosaic, step, unit};
use super::vessels::{self, Habit};

const BROWN: Colour = srgb(142, 65, 51);
const MAROON: Colour = srgb(112, 42, 38);
const TAN: Colour = srgb(170, 98, 74);
/// Blood in the vein in a lobule's middle.
const CENTRE: Colour = srgb(92, 26, 28);
/// The tissue between lobules.
const PORTAL: Colour = srgb(184, 122, 98);
const VEIN: Colour = srgb(78, 32, 48);
const ARTERY: Colour = srgb(128, 22, 26);

/// Paints the image. Returns rows of `size` × `size` pixels, sRGB.
pub(super) fn paint(seed: u64, size: usize) -> Vec<u8> {
    let seed = colour::base(seed);
    let veins = Habit { trees: 4, radius: 0.0075, thinnest: 0.0020, taper: 1.2, branches: 7.0 };
    let arteries = Habit { trees: 7, radius: 0.0019, thinnest: 0.0005, taper: 1.5, branches: 16.0 };
    let veins = vessels::paint(seed + 1, size, veins);
    let arteries = vessels::paint(seed + 2, size, arteries);
    colour::image(size, |x, y, at| {
        let region = fractal(seed + 40, 2.1 * x, 2.1 * y, 4);
        let mut colour = mix(BROWN, MAROON, 0.85 * step(-0.6, 0.9, region));
        colour = mix(colour, TAN, 0.30 * step(0.0, 0.9, fractal(seed + 50, 3.3 * x, 3.3 * y, 4)));

        let bend = |seed: u32| 0.005 * fractal(seed, 11.0 * x, 11.0 * y, 2);
        let lobule = mosaic(seed + 30, 50.0 * (x + bend(seed + 60)), 50.0 * (y + bend(seed + 64)), 0.62, 0.12);
        // The mosaic shows more in some regions than in others.
        let clear = 0.45 + 0.55 * step(-0.4, 0.5, gradient(seed + 70, 4.0 * x, 4.0 * y));
        let own = unit(lobule.name);
        colour = if own < 0.5 { mix(colour, MAROON, 0.22 * (0.5 - own)) } else { mix(colour, TAN, 0.22 * (own - 0.5)) };
        colour = mix(colour, CENTRE, 0.20 * clear * step(0.36, 0.04, lobule.middle));
        colour = mix(colour, PORTAL, 0.15 * clear * step(0.20, 0.0, lobule.edge));

        // Vessels beneath the capsule, and grain.
        let thin = 0.3 + 0.7 * step(-0.2, 0.5, gradient(seed + 74, 3.0 * x, 3.0 * y));
        colour = mix(colour, VEIN, 0.34 * veins[at] * thin);
        colour = mix(colour, ARTERY, 0.42 * arteries[at] * thin);
        let grain = 0.05 * fractal(seed + 80, 130.0 * x, 130.0 * y, 2);
        colour.map(|c| c * (1.0 + grain))
    })
}
