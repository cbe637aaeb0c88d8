//! The lining of a stomach seen through an endoscope: small fields, vessels at two depths, capillaries around the
//! fields, redder and paler regions.
//!
//! Everything is a function of place (in sides of the image), so another size shows the same picture at another
//! resolution.

use super::colour::{self, Colour, mix, srgb};
use super::noise::{cells, fractal, gradient, step};
use super::vessels::{self, Habit};

const PINK: Colour = srgb(226, 134, 112);
const RED: Colour = srgb(196, 84, 70);
const PALE: Colour = srgb(242, 182, 152);
const VEIN: Colour = srgb(126, 52, 76);
const ARTERY: Colour = srgb(158, 30, 34);

/// Paints the image. Returns rows of `size` × `size` pixels, sRGB.
pub(super) fn paint(seed: u64, size: usize) -> Vec<u8> {
    let seed = colour::base(seed);
    let veins = Habit { trees: 6, radius: 0.0095, thinnest: 0.0022, taper: 1.0, branches: 9.0 };
    let arteries = Habit { trees: 10, radius: 0.0036, thinnest: 0.0006, taper: 1.3, branches: 22.0 };
    let veins = vessels::paint(seed + 1, size, veins);
    let arteries = vessels::paint(seed + 2, size, arteries);
    colour::image(size, |x, y, at| {
        let region = fractal(seed + 40, 2.3 * x, 2.3 * y, 4);
        let mut colour = mix(PINK, RED, step(-0.5, 0.7, region));
        colour = mix(colour, PALE, 0.55 * step(0.0, 0.9, fractal(seed + 50, 3.1 * x, 3.1 * y, 4)));
        // Blood in patches of some millimetres.
        colour = mix(colour, RED, 0.35 * step(0.15, 0.75, fractal(seed + 60, 16.0 * x, 16.0 * y, 3)));

        // Vessels shine through where the lining is thin.
        let thin = 0.35 + 0.65 * step(-0.3, 0.4, gradient(seed + 70, 3.0 * x, 3.0 * y));
        colour = mix(colour, VEIN, 0.42 * veins[at] * thin);
        colour = mix(colour, ARTERY, 0.62 * arteries[at] * thin);
        let bend = |seed: u32| 0.012 * fractal(seed, 14.0 * x, 14.0 * y, 2);
        let field = cells(seed + 30, 44.0 * (x + bend(seed + 24)), 44.0 * (y + bend(seed + 27)));
        // A field is a little paler in its middle.
        colour = mix(colour, PALE, 0.16 * step(0.6, 0.0, field[0]));
        let net = step(0.26, 0.0, field[1] - field[0]);
        let flushed = step(-0.25, 0.55, fractal(seed + 80, 8.0 * x, 8.0 * y, 2));
        mix(colour, ARTERY, 0.24 * net * (0.25 + 0.75 * flushed))
    })
}
