//! The outside of a gallbladder: bile shines grey-green through a thin wall, which is yellower where fat lies
//! on it. Fine arteries branch over it. Only colour: viewers add gloss and shading.

use super::colour::{self, Colour, mix, srgb};
use super::noise::{fractal, gradient, step};
use super::vessels::{self, Habit};

const GREEN: Colour = srgb(104, 124, 98);
const BILE: Colour = srgb(72, 98, 80);
const GREY: Colour = srgb(140, 148, 130);
const FAT: Colour = srgb(182, 168, 112);
const VEIN: Colour = srgb(66, 66, 82);
const ARTERY: Colour = srgb(140, 60, 52);

/// Paints the image. Returns rows of `size` × `size` pixels, sRGB.
pub(super) fn paint(seed: u64, size: usize) -> Vec<u8> {
    let seed = colour::base(seed);
    let veins = Habit { trees: 4, radius: 0.0070, thinnest: 0.0020, taper: 1.2, branches: 7.0 };
    let arteries = Habit { trees: 8, radius: 0.0030, thinnest: 0.0006, taper: 1.3, branches: 18.0 };
    let veins = vessels::paint(seed + 1, size, veins);
    let arteries = vessels::paint(seed + 2, size, arteries);
    colour::image(size, |x, y, at| {
        let region = fractal(seed + 40, 2.2 * x, 2.2 * y, 4);
        let mut colour = mix(GREEN, BILE, 0.9 * step(-0.4, 0.7, region));
        colour = mix(colour, GREY, 0.55 * step(-0.1, 0.8, fractal(seed + 50, 3.1 * x, 3.1 * y, 4)));
        colour = mix(colour, FAT, 0.32 * step(0.20, 0.75, fractal(seed + 60, 5.0 * x, 5.0 * y, 4)));

        // Vessels shine through where the wall is thin.
        let thin = 0.35 + 0.65 * step(-0.3, 0.4, gradient(seed + 70, 3.0 * x, 3.0 * y));
        colour = mix(colour, VEIN, 0.36 * veins[at] * thin);
        colour = mix(colour, ARTERY, 0.62 * arteries[at] * thin);
        let fibres = 0.02 * fractal(seed + 80, 26.0 * x, 120.0 * y, 2);
        colour.map(|c| c * (1.0 + fibres))
    })
}
