//! Draws the tissue at one moment, as a textured surface or as a mesh.

use glam::{DVec2, DVec3, Vec3Swizzles};

use super::canvas::{Canvas, Corner, SAMPLES, colour, linear};
use super::drawn_surface::{DrawnSurface, Vertex};
use palpate_refusal::{Reason, Refusal, Result, number};
use palpate_session::surface::burns::VertexBurn;
use palpate_session::surface::{Refinement, Skin as Shown, Snapshot, Wound};
use palpate_texture::Image;
use palpate_tissue::shape::{PointId, PointName, RestShape};

/// A camera that looks at the middle of the tissue at rest. Parsed from `AZIMUTH,ELEVATION` or
/// `AZIMUTH,ELEVATION,DISTANCE`; only that checks the ranges. The default is `25,32,2`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Rotation of the eye about the tissue's z axis, from its front side (small y) towards its left (small x),
    /// degrees,
    /// -360 to 360.
    pub azimuth_deg: f64,
    /// Elevation above the tissue, degrees, 1 to 90; 90 is straight from above.
    pub elevation_deg: f64,
    /// Distance of the eye from the middle, as a multiple of the tissue's longest side, 0.3 to 20.
    pub distance: f64,
}

impl Default for Camera {
    fn default() -> Self {
        Camera { azimuth_deg: 25.0, elevation_deg: 32.0, distance: 2.0 }
    }
}

impl std::str::FromStr for Camera {
    type Err = Refusal;

    /// Parses `AZIMUTH,ELEVATION` or `AZIMUTH,ELEVATION,DISTANCE`. Refuses values out of range.
    fn from_str(text: &str) -> Result<Self> {
        let wrong = || {
            let message =
                format!("must be azimuth,elevation or azimuth,elevation,distance, as in 25,32,2, but is `{text}`");
            Refusal::new(Reason::WrongKind, "camera", message)
        };
        let numbers: Vec<f64> = text
            .split(',')
            .map(|part| part.trim().parse())
            .collect::<std::result::Result<_, _>>()
            .map_err(|_| wrong())?;
        let standard = Camera::default();
        let camera = match numbers[..] {
            [azimuth_deg, elevation_deg] => Camera { azimuth_deg, elevation_deg, ..standard },
            [azimuth_deg, elevation_deg, distance] => Camera { azimuth_deg, elevation_deg, distance },
            _ => return Err(wrong()),
        };
        number("camera azimuth", camera.azimuth_deg, "from -360 to 360", |v| (-360.0..=360.0).contains(&v))?;
        number("camera elevation", camera.elevation_deg, "from 1 to 90", |v| (1.0..=90.0).contains(&v))?;
        number("camera distance", camera.distance, "from 0.3 to 20 sides", |v| (0.3..=20.0).contains(&v))?;
        Ok(camera)
    }
}

/// How a picture is drawn: camera, size and surface.
#[derive(Debug, Clone)]
pub struct View {
    /// The camera through which the tissue is seen.
    pub camera: Camera,
    /// Width and height of the picture, pixels, at least 1 each; programs allow up to [`LARGEST_SIDE`].
    pub size: [usize; 2],
    /// Number of vertices drawn between neighbouring points; has no effect on a mesh.
    pub refinement: Refinement,
    /// Texture of the surface, on a dark background; `None` draws the lines of its mesh instead, on white.
    pub texture: Option<Image>,
}

/// Largest side of a picture that programs allow, pixels; [`picture`] does not check it.
pub const LARGEST_SIDE: usize = 1920;

/// A force drawn as an arrow in front of the tissue. Its length on the tissue is always the same.
#[derive(Debug, Clone, Copy)]
pub struct Arrow {
    /// The mass point of the model that its tip touches.
    pub point: PointId,
    /// Its direction in the tissue's frame; the length has no effect, but must not be zero.
    pub towards: DVec3,
}

/// Half the height of the field of view, at a distance of 1.
const HALF_VIEW: f64 = 0.30;

/// Length of an arrow, as a fraction of the tissue's longest side.
const ARROW: f64 = 0.16;

/// The tissue within a wound, and the edge of a lip, as a picture with texture and one of lines have them.
const WOUND: [[u8; 3]; 2] = [[96, 12, 14], [58, 8, 10]];
const PALE_WOUND: [[u8; 3]; 2] = [[176, 96, 92], [96, 36, 34]];

/// What the surface within a cut reflects of red, green and blue, beside the surface of the tissue.
const CUT_FACE: DVec3 = DVec3::new(0.60, 0.34, 0.32);

/// What tissue reflects that turned brown, and that is charred.
const CHAR: [DVec3; 2] = [DVec3::new(0.16, 0.055, 0.025), DVec3::new(0.012, 0.010, 0.009)];

/// Width of the line along a lip, as a fraction of the picture's width.
const LIP: f64 = 0.0016;

/// The eye and its projection to the picture.
struct Eye {
    at_m: DVec3,
    /// Unit vectors to the right, up and forward in the picture.
    axes: [DVec3; 3],
    middle: DVec2,
    /// Samples per unit of offset from the axis, at a distance of 1.
    scale: f64,
}

impl Eye {
    fn new(shape: &dyn RestShape, view: &View) -> Self {
        let Camera { azimuth_deg, elevation_deg, distance } = view.camera;
        let (azimuth, elevation) = (azimuth_deg.to_radians(), elevation_deg.to_radians());
        let across = libm::cos(elevation);
        let away = DVec3::new(-libm::sin(azimuth) * across, -libm::cos(azimuth) * across, libm::sin(elevation));
        let right = DVec3::new(libm::cos(azimuth), -libm::sin(azimuth), 0.0);
        let centre_m = shape.extent().middle_m();
        let [width, height] = view.size.map(|pixels| (pixels * SAMPLES) as f64);
        Eye {
            at_m: centre_m + distance * shape.longest_side_m() * away,
            axes: [right, right.cross(-away), -away],
            // Near parts take up more of the picture than far parts, so the middle of the sheet is drawn above the
            // picture's middle.
            middle: DVec2::new(0.48 * width, 0.44 * height),
            scale: width.min(height * 4.0 / 3.0) * 0.375 / HALF_VIEW,
        }
    }

    /// Projects a place. `None` if it is behind the eye or nearer than `nearest_m`.
    fn project(&self, at_m: DVec3, nearest_m: f64) -> Option<Corner> {
        let [x, y, forward] = self.axes.map(|axis| axis.dot(at_m - self.at_m));
        (forward > nearest_m)
            .then(|| Corner { at: self.middle + DVec2::new(x, -y) * (self.scale / forward), nearness: forward.recip() })
    }
}

/// Draws the tissue of rest shape `shape` in the state of `snapshot`, with `arrows`, as seen by `view`. `shown` is
/// the surface that frames show of a mesh; `None` for a sheet. `wound` and `burns` are those of the surface, at the view's refinement. Returns an image of [`View::size`], equal on any
/// machine. Parts nearer to the eye than a hundredth of the tissue's longest side are left out.
pub fn picture(
    shape: &dyn RestShape,
    shown: Option<&Shown>,
    snapshot: &Snapshot,
    wound: Option<&Wound>,
    burns: &[VertexBurn],
    arrows: &[Arrow],
    view: &View,
) -> Image {
    let surface = DrawnSurface::new(shape, shown, snapshot, (wound, burns), view.refinement);
    let eye = Eye::new(shape, view);
    let nearest_m = 0.01 * shape.longest_side_m();
    let background = if view.texture.is_some() { [20, 14, 13] } else { [255, 255, 255] };
    let mut canvas = Canvas::new(view.size, colour(background));
    let corners: Vec<Option<Corner>> =
        surface.vertices.iter().map(|vertex| eye.project(vertex.at_m, nearest_m)).collect();
    let skin = view.texture.as_ref().map(|image| Skin::new(image, &eye, shape));
    for triangle in &surface.triangles {
        let [Some(p), Some(q), Some(r)] = triangle.map(|index| corners[index]) else { continue };
        let vertices = triangle.map(|index| surface.vertices[index]);
        canvas.triangle([p, q, r], |shares| match &skin {
            Some(skin) => skin.shade(&between(&vertices, shares)),
            // Pale enough for lines to show, and opaque.
            None => {
                let Vertex { open, burn, .. } = between(&vertices, shares);
                DVec3::splat((0.80 + 0.18 * open) * (1.0 - 0.7 * burn))
            }
        });
    }
    if skin.is_none() {
        let ink = colour([96, 36, 34]);
        // Thinner where lines are dense.
        let width = (0.055 * view.size[0] as f64 / surface.along as f64).clamp(0.35, 1.1);
        for line in &surface.lines {
            if let [Some(from), Some(to)] = line.map(|index| corners[index]) {
                canvas.line(from, to, width, 2e-3, ink);
            }
        }
    }
    let [inside, lip] = if skin.is_some() { WOUND } else { PALE_WOUND }.map(colour);
    for corners in &surface.wound.bed_m {
        let corners = corners.map(|corner_m| eye.project(corner_m, nearest_m));
        if let [Some(p), Some(q), Some(r)] = corners {
            canvas.triangle([p, q, r], |_| inside);
        }
    }
    for vertices in &surface.wound.cut_surface {
        let corners = vertices.map(|vertex| eye.project(vertex.at_m, nearest_m));
        let [Some(p), Some(q), Some(r)] = corners else { continue };
        canvas.triangle([p, q, r], |shares| match &skin {
            Some(skin) => CUT_FACE * skin.shade(&between(vertices, shares)),
            None => inside,
        });
    }
    for side in &surface.wound.lips {
        if let [Some(from), Some(to)] = side.map(|index| corners[index]) {
            canvas.line(from, to, LIP * view.size[0] as f64, 2e-3, lip);
        }
    }
    for arrow in arrows {
        let vertex = match (shown, shape.name(arrow.point)) {
            (Some(shown), PointName::Vertex(vertex)) => shown.places()[vertex as usize] as usize,
            _ => view.refinement.vertex_at(arrow.point),
        };
        draw(&mut canvas, &eye, surface.vertices[vertex].at_m, arrow, view, shape, nearest_m);
    }
    canvas.image()
}

fn draw(
    canvas: &mut Canvas,
    eye: &Eye,
    tip_m: DVec3,
    arrow: &Arrow,
    view: &View,
    shape: &dyn RestShape,
    nearest_m: f64,
) {
    let tail_m = tip_m - ARROW * shape.longest_side_m() * arrow.towards.normalize_or_zero();
    let (Some(tip), Some(tail)) = (eye.project(tip_m, nearest_m), eye.project(tail_m, nearest_m)) else { return };
    let ink = colour(if view.texture.is_some() { [150, 205, 255] } else { [20, 80, 160] });
    // Drawn in front of everything: the arrow's target may be at the bottom of a dent.
    let [tip, tail] = [tip, tail].map(|corner| Corner { nearness: 2.0 / nearest_m, ..corner });
    let along = (tip.at - tail.at).normalize_or_zero();
    let head = 0.022 * (view.size[0] * SAMPLES) as f64;
    let base = Corner { at: tip.at - head * along, ..tip };
    let side = |by: f64| Corner { at: base.at + by * 0.42 * head * along.perp(), ..tip };
    canvas.line(tail, base, 0.0045 * view.size[0] as f64, 0.0, ink);
    canvas.triangle([tip, side(1.0), side(-1.0)], |_| ink);
}

fn between(vertices: &[Vertex; 3], shares: [f64; 3]) -> Vertex {
    let mut sum = Vertex::default();
    for (vertex, share) in vertices.iter().zip(shares) {
        sum.at_m += share * vertex.at_m;
        sum.normal += share * vertex.normal;
        sum.share += share * vertex.share;
        sum.rest += share * vertex.rest;
        sum.facing += share * vertex.facing;
        sum.open += share * vertex.open;
        sum.burn += share * vertex.burn;
    }
    sum
}

/// Shading of wet tissue under a lamp to the left of the eye, low enough to show relief. The light decreases with
/// distance.
struct Skin<'a> {
    image: &'a Image,
    /// Linear light of each byte value.
    linear: Vec<f64>,
    eye_m: DVec3,
    lamp_m: DVec3,
    /// Distance from the lamp to the middle, m.
    usual_m: f64,
}

impl<'a> Skin<'a> {
    fn new(image: &'a Image, eye: &Eye, shape: &dyn RestShape) -> Self {
        let centre_m = shape.extent().middle_m();
        let [right, up, _] = eye.axes;
        let away_m = eye.at_m.distance(centre_m);
        let lamp_m = eye.at_m + away_m * (0.10 * up - 1.05 * right);
        let linear = (0..=255).map(linear).collect();
        Skin { image, linear, eye_m: eye.at_m, lamp_m, usual_m: lamp_m.distance(centre_m) }
    }

    /// Returns the texture's colour, bilinearly interpolated. The centres of its corner pixels lie on the sheet's
    /// corners, so an image with as many pixels as the sheet has vertices puts one on each. Row 0 is at the far side
    /// (largest y). Beyond its sides the texture is mirrored.
    fn albedo(&self, share: DVec2) -> DVec3 {
        let Image { width, height, rgb } = self.image;
        let mirrored = |x: f64| if (0.0..=1.0).contains(&x) { x } else { 1.0 - (1.0 - x.rem_euclid(2.0)).abs() };
        let x = mirrored(share.x) * (width - 1) as f64;
        let y = (1.0 - mirrored(share.y)) * (height - 1) as f64;
        let (column, row) = (x as usize, y as usize);
        let at = |column: usize, row: usize| {
            let from = 3 * (row.min(height - 1) * width + column.min(width - 1));
            let light = |c: usize| self.linear[usize::from(rgb[from + c])];
            DVec3::new(light(0), light(1), light(2))
        };
        let (s, t) = (x - column as f64, y - row as f64);
        at(column, row).lerp(at(column + 1, row), s).lerp(at(column, row + 1).lerp(at(column + 1, row + 1), s), t)
    }

    /// Returns the texture's colour at a vertex. Without texture coordinates, it blends the texture projected along
    /// each axis, weighted by how far the surface faces that axis.
    fn albedo_at(&self, vertex: &Vertex) -> DVec3 {
        let Vertex { rest, facing, .. } = *vertex;
        let weights = facing * facing * facing * facing;
        let sum = weights.element_sum();
        if sum <= 0.0 {
            return self.albedo(vertex.share);
        }
        let seen = [(rest.yz(), weights.x), (rest.xz(), weights.y), (rest.xy(), weights.z)];
        seen.into_iter().filter(|(_, weight)| *weight > 0.01 * sum).map(|(share, w)| w / sum * self.albedo(share)).sum()
    }

    fn shade(&self, vertex: &Vertex) -> DVec3 {
        let to_eye = (self.eye_m - vertex.at_m).normalize_or_zero();
        let mut normal = vertex.normal.normalize_or_zero();
        if normal.dot(to_eye) < 0.0 {
            // The surface is seen from its underside.
            normal = -normal;
        }
        let to_lamp_m = self.lamp_m - vertex.at_m;
        let to_lamp = to_lamp_m.normalize_or_zero();
        let light = (self.usual_m * self.usual_m / to_lamp_m.length_squared()).min(2.0);
        // Light scatters a little way in tissue and emerges beyond the edge of a shadow.
        let diffuse = ((normal.dot(to_lamp) + 0.18) / 1.18).max(0.0);
        let around = DVec3::new(0.15, 0.10, 0.09) * normal.z.max(0.0);
        // Burnt tissue turns brown, then black, and is dry: it has no film.
        let [brown, black] = CHAR;
        let burn = |from: f64, to: f64| ((vertex.burn - from) / (to - from)).clamp(0.0, 1.0);
        let albedo = self.albedo_at(vertex).lerp(brown.lerp(black, burn(0.4, 1.0)), burn(0.0, 0.6));
        let mut colour = albedo * vertex.open * (around + DVec3::splat(2.3 * light * diffuse * diffuse));
        // The film of liquid: a broad sheen and a sharp glint, stronger at grazing angles (Schlick's approximation).
        let half = normal.dot((to_lamp + to_eye).normalize_or_zero()).max(0.0);
        let graze = 1.0 - normal.dot(to_eye).max(0.0);
        let mirrored = 0.25 + 0.75 * graze.powi(5);
        let power = |squarings: u32| (0..squarings).fold(half, |x, _| x * x);
        let film = 0.14 * power(4) + 1.1 * power(8);
        colour += DVec3::new(1.0, 0.97, 0.94) * (light * mirrored * film * (1.0 - burn(0.0, 0.5)));
        colour
    }
}
