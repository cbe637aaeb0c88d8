//! A fibrotic liver: nodules, tan to rust, in a network of pale scars with fine vessels. On a sheet of 75 mm a
//! nodule is 5 to 15 mm wide. Only colour: viewers add gloss and shading.

use super::colour::{self, Colour, mix, srgb};
use super::noise::{bits, fractal, mosaic, step, unit};
use super::vessels::{self, Habit};

const TAN: Colour = srgb(186, 120, 82);
const RUST: Colour = srgb(150, 80, 58);
/// Tan, stained with bile.
const OLIVE: Colour = srgb(170, 124, 74);
const SCAR: Colour = srgb(206, 164, 142);
const FLUSHED: Colour = srgb(176, 96, 84);
const ARTERY: Colour = srgb(140, 30, 32);
const VEIN: Colour = srgb(104, 50, 66);

/// Paints the image. Returns rows of `size` × `size` pixels, sRGB.
pub(super) fn paint(seed: u64, size: usize) -> Vec<u8> {
    let seed = colour::base(seed);
    let veins = Habit { trees: 5, radius: 0.0050, thinnest: 0.0014, taper: 1.2, branches: 9.0 };
    let arteries = Habit { trees: 10, radius: 0.0020, thinnest: 0.0005, taper: 1.4, branches: 20.0 };
    let veins = vessels::paint(seed + 1, size, veins);
    let arteries = vessels::paint(seed + 2, size, arteries);
    colour::image(size, |x, y, at| {
        let bend =
            |seed: u32| 0.026 * fractal(seed, 5.0 * x, 5.0 * y, 2) + 0.010 * fractal(seed + 2, 17.0 * x, 17.0 * y, 3);
        let (u, v) = (x + bend(seed + 60), y + bend(seed + 64));
        let nodule = mosaic(seed + 30, 8.0 * u, 8.0 * v, 0.8, 0.40);
        let [own, other] = [unit(nodule.name), unit(bits(nodule.name, 3, 5))];
        let mut colour = mix(TAN, RUST, 0.85 * own);
        colour = mix(colour, OLIVE, 0.65 * step(0.55, 0.95, other));
        // Remains of lobules, and blood in patches.
        let lobule = mosaic(seed + 36, 42.0 * u, 42.0 * v, 1.0, 0.5);
        colour = mix(colour, RUST, 0.16 * step(0.10, 0.45, lobule.middle));
        colour = mix(colour, RUST, 0.50 * step(-0.2, 0.9, fractal(seed + 50, 15.0 * x, 15.0 * y, 3)));
        let grain = 0.06 * fractal(seed + 88, 90.0 * x, 90.0 * y, 2);
        colour = colour.map(|c| c * (1.0 + grain));

        // Scar of uneven width fills the corners between round nodules, flushed in places.
        let wide = 0.12 + 0.05 * fractal(seed + 70, 6.0 * x, 6.0 * y, 2);
        let inside = nodule.edge.min(0.72 - nodule.middle);
        let scar = step(wide + 0.14, wide - 0.12, inside);
        let flushed = step(-0.5, 0.5, fractal(seed + 80, 7.0 * x, 7.0 * y, 3));
        let mut band = mix(SCAR, FLUSHED, 0.15 + 0.70 * flushed);
        let fibres = fractal(seed + 84, 60.0 * u, 60.0 * v, 3);
        band = band.map(|c| c * (1.0 + 0.08 * fibres));
        colour = mix(colour, band, 0.80 * scar);
        colour = mix(colour, VEIN, 0.30 * veins[at] * (0.3 + 0.7 * scar));
        mix(colour, ARTERY, 0.45 * arteries[at] * (0.35 + 0.65 * scar))
    })
}
