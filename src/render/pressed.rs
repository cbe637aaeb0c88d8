//! A map of a surface: where it was pressed, and how hard.

use glam::{DVec2, DVec3};
use palpate_exercise::coverage::SurfacePart;
use palpate_texture::Image;

use super::canvas::{Canvas, Corner, SAMPLES, colour};

/// The colours of a map, sRGB: not pressed; pressed too lightly, from hardly to almost enough; pressed enough, from just so
/// to [`STRONG`] times that.
pub const MAP_COLOURS: [[u8; 3]; 5] =
    [[214, 209, 202], [252, 226, 178], [240, 150, 40], [116, 169, 220], [16, 52, 128]];

/// The pressure from which the colour stays the darkest, in thresholds.
pub const STRONG: f64 = 5.0;

/// The part of the shorter side that stays empty around the surface.
const MARGIN: f64 = 0.04;

/// How far the eye is, in sizes of the surface: so far that nothing is nearer by perspective.
const EYE: f64 = 100.0;

/// Draws a surface at rest as seen along z, from above, or from below with x to the left. `enough_pa` is the pressure, Pa,
/// from which a place counts as pressed. The image is `width` pixels wide, and as high as the surface.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
pub fn pressed_map(parts: &[SurfacePart], enough_pa: f64, width: usize, from_below: bool) -> Image {
    let side = if from_below { DVec3::new(-1.0, 1.0, -1.0) } else { DVec3::ONE };
    let seen = |part: &SurfacePart| part.corners_m.map(|corner_m| side * corner_m);
    let corners = || parts.iter().flat_map(seen);
    let (least_m, most_m) =
        (corners().fold(DVec3::INFINITY, DVec3::min), corners().fold(DVec3::NEG_INFINITY, DVec3::max));
    let size_m = (most_m - least_m).max(DVec3::splat(1e-9));
    let margin_m = MARGIN * size_m.truncate().min_element();
    let scale = width as f64 / (size_m.x + 2.0 * margin_m);
    let height = ((size_m.y + 2.0 * margin_m) * scale).ceil().clamp(1.0, 4.0 * width as f64) as usize;
    let mut canvas = Canvas::new([width, height], colour([255; 3]));
    for part in parts {
        let [a, b, c] = seen(part);
        // Mirrored in two axes, a triangle keeps its sense.
        let Some(normal) = (b - a).cross(c - a).try_normalize().filter(|normal| normal.z > 0.0) else { continue };
        let shade = (0.55 + 0.45 * normal.z) * colour_of(part.peak_pa, enough_pa);
        let corner = |place_m: DVec3| Corner {
            at: SAMPLES as f64 * scale * DVec2::new(place_m.x - least_m.x + margin_m, most_m.y - place_m.y + margin_m),
            nearness: 1.0 / (EYE + (most_m.z - place_m.z) / size_m.max_element()),
        };
        canvas.triangle([corner(a), corner(b), corner(c)], |_| shade);
    }
    canvas.image()
}

/// Returns the colour of a pressure, in linear light.
fn colour_of(peak_pa: f64, enough_pa: f64) -> DVec3 {
    let [none, hardly, almost, enough, strong] = MAP_COLOURS.map(colour);
    let part = peak_pa / enough_pa;
    match part {
        0.0 => none,
        part if part < 1.0 => hardly.lerp(almost, part),
        part => enough.lerp(strong, ((part - 1.0) / (STRONG - 1.0)).min(1.0)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_shows_from_each_side_what_was_pressed_there() {
        // A square of 1 m above, pressed in its right half, and one below, not pressed.
        let at = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
        let part = |x: f64, peak_pa: f64| {
            [
                SurfacePart { corners_m: [at(x, 0.0, 0.1), at(x + 0.5, 0.0, 0.1), at(x + 0.5, 1.0, 0.1)], peak_pa },
                SurfacePart { corners_m: [at(x, 0.0, 0.1), at(x + 0.5, 1.0, 0.1), at(x, 1.0, 0.1)], peak_pa },
            ]
        };
        let above = [part(0.0, 0.0), part(0.5, 3.0)].concat();
        let below = [part(0.0, 0.0), part(0.5, 0.0)].concat().into_iter().map(
            |SurfacePart { corners_m: [a, b, c], peak_pa }| SurfacePart {
                corners_m: [a, c, b].map(|corner_m| corner_m - 0.1 * DVec3::Z),
                peak_pa,
            },
        );
        let parts: Vec<SurfacePart> = above.into_iter().chain(below).collect();
        let pixel = |image: &Image, x: usize| {
            let at = 3 * (image.height / 2 * image.width + x);
            [image.rgb[at], image.rgb[at + 1], image.rgb[at + 2]]
        };
        let (top, bottom) = (pressed_map(&parts, 3.0, 100, false), pressed_map(&parts, 3.0, 100, true));
        assert_eq!([pixel(&top, 25), pixel(&top, 75)], [MAP_COLOURS[0], MAP_COLOURS[3]]);
        assert_eq!([pixel(&bottom, 25), pixel(&bottom, 75)], [MAP_COLOURS[0]; 2]);
        assert_eq!(pixel(&top, 1), [255; 3]);
    }
}
