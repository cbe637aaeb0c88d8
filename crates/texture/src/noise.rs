//! Noise over the plane: values that look random but are functions of a place and a seed. All operations are
//! arithmetic that IEEE 754 rounds exactly, so the values are the same on every machine.

/// Hashes a lattice point by multiplying and mixing (the finalizer of MurmurHash3).
pub(super) fn bits(seed: u32, x: i32, y: i32) -> u32 {
    let mut h = seed ^ (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77).rotate_left(16);
    h ^= h >> 16;
    h = h.wrapping_mul(0x85eb_ca6b);
    h ^= h >> 13;
    h = h.wrapping_mul(0xc2b2_ae35);
    h ^ h >> 16
}

/// Returns a number from 0 to 1 from hash bits.
pub(super) fn unit(bits: u32) -> f32 {
    (bits >> 8) as f32 / (1 << 24) as f32
}

/// Returns 0 up to `from`, 1 beyond `to`, and a smooth value between; `to` may be below `from`.
pub(super) fn step(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Returns gradient noise (Perlin noise), from −1 to 1: smooth, and 0 at integers.
pub(super) fn gradient(seed: u32, x: f32, y: f32) -> f32 {
    let (left, top) = (x.floor(), y.floor());
    let (i, j) = (left as i32, top as i32);
    let (x, y) = (x - left, y - top);
    let corner = |di: i32, dj: i32| {
        let bits = bits(seed, i + di, j + dj);
        let along = |part: u32| (part & 0xffff) as f32 / 32768.0 - 1.0;
        along(bits) * (x - di as f32) + along(bits >> 16) * (y - dj as f32)
    };
    let fade = |t: f32| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
    let (u, v) = (fade(x), fade(y));
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    1.4 * mix(mix(corner(0, 0), corner(1, 0), u), mix(corner(0, 1), corner(1, 1), u), v)
}

/// Returns gradient noise in `octaves` of twice the frequency and half the amplitude each.
pub(super) fn fractal(seed: u32, x: f32, y: f32, octaves: u32) -> f32 {
    let (mut sum, mut scale, mut height) = (0.0, 1.0, 1.0);
    for octave in 0..octaves {
        // Rotated, so that the lattices don't show.
        let (a, b) = (scale * (0.8 * x - 0.6 * y), scale * (0.6 * x + 0.8 * y));
        sum += height
            * if octave % 2 == 0 {
                gradient(seed + octave, x * scale, y * scale)
            } else {
                gradient(seed + octave, a, b)
            };
        (scale, height) = (2.0 * scale, 0.5 * height);
    }
    sum
}

/// Returns the distances to the nearest and the second nearest of scattered points, one in each square of side
/// 1 (Worley noise).
pub(super) fn cells(seed: u32, x: f32, y: f32) -> [f32; 2] {
    let (i, j) = (x.floor() as i32, y.floor() as i32);
    let mut nearest = [f32::MAX; 2];
    for di in -1..=1 {
        for dj in -1..=1 {
            let bits = bits(seed, i + di, j + dj);
            let at = |cell: i32, part: u32| cell as f32 + (part & 0xffff) as f32 / 65536.0;
            let (dx, dy) = (at(i + di, bits) - x, at(j + dj, bits >> 16) - y);
            let squared = dx * dx + dy * dy;
            if squared < nearest[0] {
                nearest = [squared, nearest[0]];
            } else if squared < nearest[1] {
                nearest[1] = squared;
            }
        }
    }
    nearest.map(f32::sqrt)
}

/// A tile of a mosaic.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tile {
    /// Distance to the tile's middle.
    pub(super) middle: f32,
    /// How much farther the next tile's middle is: 0 on the edge.
    pub(super) edge: f32,
    /// Hash bits of this tile.
    pub(super) name: u32,
}

/// Returns the tile at a place of a mosaic of hexagons with middles 1 apart. `disorder` moves the middles by up
/// to half of itself along each axis; `spread` varies the size of tiles.
pub(super) fn mosaic(seed: u32, x: f32, y: f32, disorder: f32, spread: f32) -> Tile {
    /// Distance of two rows: half the square root of 3.
    const ROW: f32 = 0.866_025_4;
    let j = (y / ROW + 0.5).floor() as i32;
    let mut nearest = Tile { middle: f32::MAX, edge: f32::MAX, name: 0 };
    let (mut first, mut second) = (f32::MAX, f32::MAX);
    for row in j - 2..=j + 2 {
        let shift = if row % 2 == 0 { 0.0 } else { 0.5 };
        let i = (x - shift + 0.5).floor() as i32;
        for column in i - 2..=i + 2 {
            let bits = bits(seed, column, row);
            let off = |part: u32| disorder * ((part & 0xffff) as f32 / 65536.0 - 0.5);
            let dx = column as f32 + shift + off(bits) - x;
            let dy = row as f32 * ROW + off(bits >> 16) - y;
            let away = (dx * dx + dy * dy).sqrt();
            let reach = away - spread * unit(bits.wrapping_mul(0x9e37_79b1));
            if reach < first {
                second = first;
                first = reach;
                nearest = Tile { middle: away, edge: 0.0, name: bits };
            } else if reach < second {
                second = reach;
            }
        }
    }
    Tile { edge: second - first, ..nearest }
}
