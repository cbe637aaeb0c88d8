//! Colours, and images painted row by row.

use palpate_tissue::memory;

/// A colour in sRGB; each part is from 0 to 1.
pub(super) type Colour = [f32; 3];

pub(super) const fn srgb(r: u8, g: u8, b: u8) -> Colour {
    [r as f32 / 255.0, g as f32 / 255.0, b as f32 / 255.0]
}

pub(super) fn mix(a: Colour, b: Colour, t: f32) -> Colour {
    std::array::from_fn(|c| a[c] + (b[c] - a[c]) * t)
}

/// Returns the seed of an image's noises. The parts of an image add small numbers to it.
pub(super) fn base(seed: u64) -> u32 {
    let seed = (seed as u32) ^ (seed >> 32) as u32;
    super::noise::bits(seed, 1, 2) & 0xffff_ff00
}

/// Returns rows of `size` × `size` pixels, sRGB. `colour` gets the middle of a pixel, in sides of the image,
/// and its index.
pub(super) fn image(size: usize, colour: impl Fn(f32, f32, usize) -> Colour + Sync) -> Vec<u8> {
    let mut pixels = memory::zeroed(3 * size * size, "a texture");
    // Pixels are independent, so the result does not depend on which thread paints them.
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    let rows = size.div_ceil(workers);
    std::thread::scope(|scope| {
        for (part, pixels) in pixels.chunks_mut(3 * size * rows).enumerate() {
            let colour = &colour;
            scope.spawn(move || {
                let place = |index: usize| (index as f32 + 0.5) / size as f32;
                for (index, pixel) in pixels.chunks_exact_mut(3).enumerate() {
                    let at = part * size * rows + index;
                    let colour = colour(place(at % size), place(at / size), at);
                    for c in 0..3 {
                        pixel[c] = (255.0 * colour[c].clamp(0.0, 1.0) + 0.5) as u8;
                    }
                }
            });
        }
    });
    pixels
}
