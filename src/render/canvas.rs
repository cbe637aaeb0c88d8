//! A canvas of samples with depth: draws triangles and lines, and resolves them to pixels. Works in linear light,
//! with several samples per pixel.

use glam::{DVec2, DVec3};

use palpate_texture::Image;

/// Samples along each side of a pixel.
pub(super) const SAMPLES: usize = 3;

/// A corner of a triangle on the canvas: its position in samples, and the inverse of its distance from the eye's
/// plane, 1/m.
#[derive(Debug, Clone, Copy)]
pub(super) struct Corner {
    pub(super) at: DVec2,
    pub(super) nearness: f64,
}

#[derive(Debug)]
pub(super) struct Canvas {
    size: [usize; 2],
    /// Linear red, green and blue, and inverse distance, of each sample, row by row.
    samples: Vec<[f32; 4]>,
}

/// Returns the linear light, 0 to 1, of an sRGB byte.
pub(super) fn linear(byte: u8) -> f64 {
    let value = f64::from(byte) / 255.0;
    if value <= 0.040_45 { value / 12.92 } else { libm::pow((value + 0.055) / 1.055, 2.4) }
}

/// Returns the sRGB byte of linear light; clamps values outside 0 to 1.
fn srgb(linear: f64) -> u8 {
    let value = linear.clamp(0.0, 1.0);
    let value = if value <= 0.003_130_8 { 12.92 * value } else { 1.055 * libm::pow(value, 1.0 / 2.4) - 0.055 };
    (255.0 * value + 0.5) as u8
}

/// Returns the linear light of an sRGB colour.
pub(super) fn colour([r, g, b]: [u8; 3]) -> DVec3 {
    DVec3::new(linear(r), linear(g), linear(b))
}

impl Canvas {
    /// Creates a canvas of `size` pixels. The background is farther away than everything else.
    pub(super) fn new(size: [usize; 2], background: DVec3) -> Self {
        let size = size.map(|pixels| pixels * SAMPLES);
        let [r, g, b] = background.as_vec3().to_array();
        Canvas { size, samples: vec![[r, g, b, 0.0]; size[0] * size[1]] }
    }

    /// Returns the range of samples along `axis` whose centres lie between the smallest and largest value, clipped to
    /// the canvas.
    fn span(&self, axis: usize, values: impl Iterator<Item = f64> + Clone) -> std::ops::Range<usize> {
        let low = values.clone().fold(f64::INFINITY, f64::min);
        let high = values.fold(f64::NEG_INFINITY, f64::max);
        let bound = self.size[axis] as f64;
        (low - 0.5).ceil().clamp(0.0, bound) as usize..((high - 0.5).floor() + 1.0).clamp(0.0, bound) as usize
    }

    fn put(&mut self, x: usize, y: usize, nearness: f64, colour: impl FnOnce() -> DVec3) {
        let sample = &mut self.samples[y * self.size[0] + x];
        if nearness as f32 > sample[3] {
            let [r, g, b] = colour().as_vec3().to_array();
            *sample = [r, g, b, nearness as f32];
        }
    }

    /// Draws a triangle. `shade` returns the colour for the perspective-correct weights of the corners.
    pub(super) fn triangle(&mut self, corners: [Corner; 3], shade: impl Fn([f64; 3]) -> DVec3) {
        let [a, b, c] = corners.map(|corner| corner.at);
        let area = (b - a).perp_dot(c - a);
        if area == 0.0 {
            return;
        }
        let rows = self.span(1, corners.iter().map(|corner| corner.at.y));
        let columns = self.span(0, corners.iter().map(|corner| corner.at.x));
        for y in rows {
            for x in columns.clone() {
                let at = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                let shares = [(c - b).perp_dot(at - b), (a - c).perp_dot(at - c), (b - a).perp_dot(at - a)];
                let shares = shares.map(|share| share / area);
                if shares.iter().any(|share| *share < 0.0) {
                    continue;
                }
                let near: [f64; 3] = std::array::from_fn(|k| shares[k] * corners[k].nearness);
                let nearness = near[0] + near[1] + near[2];
                self.put(x, y, nearness, || shade(near.map(|share| share / nearness)));
            }
        }
    }

    /// Draws a line `width` pixels wide. It also hides surfaces that are nearer by at most the fraction `bias` of its
    /// distance.
    pub(super) fn line(&mut self, from: Corner, to: Corner, width: f64, bias: f64, colour: DVec3) {
        let half = 0.5 * width * SAMPLES as f64;
        let along = to.at - from.at;
        let squared = along.length_squared().max(1e-12);
        let sides =
            |axis: usize| [from.at[axis], to.at[axis]].into_iter().flat_map(move |value| [value - half, value + half]);
        let (rows, columns) = (self.span(1, sides(1)), self.span(0, sides(0)));
        for y in rows {
            for x in columns.clone() {
                let at = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - from.at;
                let t = (at.dot(along) / squared).clamp(0.0, 1.0);
                if (at - t * along).length_squared() <= half * half {
                    let nearness = from.nearness + t * (to.nearness - from.nearness);
                    self.put(x, y, nearness * (1.0 + bias), || colour);
                }
            }
        }
    }

    /// Resolves the canvas to an image: each pixel is the mean of its samples.
    pub(super) fn image(&self) -> Image {
        let [width, height] = self.size.map(|samples| samples / SAMPLES);
        let mut rgb = Vec::with_capacity(3 * width * height);
        for y in 0..height {
            for x in 0..width {
                for c in 0..3 {
                    let mut sum = 0.0;
                    for row in y * SAMPLES..(y + 1) * SAMPLES {
                        let from = row * self.size[0] + x * SAMPLES;
                        // Values above white are clamped, so that one sample does not outshine a whole pixel.
                        sum += self.samples[from..from + SAMPLES].iter().map(|s| f64::from(s[c].min(1.0))).sum::<f64>();
                    }
                    rgb.push(srgb(sum / (SAMPLES * SAMPLES) as f64));
                }
            }
        }
        Image { width, height, rgb }
    }
}
