//! The appearance of a tissue: an image of its surface, painted from a seed or supplied by the user. The same
//! seed and size give the same bytes on any machine. A painted image has only colour, no relief and no light:
//! viewers shade the surface by its true shape.

mod colour;
mod liver;
mod mucosa;
mod nodular;
mod noise;
mod serosa;
mod vessels;

use std::io::Cursor;
use std::path::Path;

use bytes::Bytes;

use palpate_refusal::{Reason, Refusal, Result, number};
use palpate_tissue::files;
use palpate_tissue::limits::Limits;
use palpate_tissue::memory;
use palpate_tissue::scene::{Appearance, PaintedSurface, SMALLEST_TEXTURE};

/// An image: rows of pixels from the top, each from the left, in sRGB. [`painted`] and [`image`] create one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    /// Pixels per row, from the left.
    pub width: usize,
    /// Number of rows, from the top.
    pub height: usize,
    /// Red, green and blue of each pixel, one byte each: 3·`width`·`height` bytes, row by row.
    pub rgb: Vec<u8>,
}

/// An image as a PNG file, in the form that the server sends; from [`texture()`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Texture {
    /// The bytes of the PNG file.
    pub png: Bytes,
    /// The ETag for HTTP: 32 hexadecimal digits (XXH3-128 of `png`) in quotation marks, so that different files
    /// have different ones.
    pub etag: String,
}

/// Paints an image of a surface, `size` × `size` pixels. Another `seed` gives another pattern; another size
/// shows the same pattern at another resolution. It paints with all processors, and blocks meanwhile.
///
/// The same seed and size give the same bytes on any machine:
///
/// ```
/// use palpate_tissue::limits::Limits;
/// use palpate_tissue::scene::PaintedSurface;
/// use palpate_texture::painted;
///
/// let limits = Limits::default();
/// let image = painted(PaintedSurface::Liver, 1, 32, &limits)?;
/// assert_eq!((image.width, image.height, image.rgb.len()), (32, 32, 3 * 32 * 32));
/// assert_eq!(image, painted(PaintedSurface::Liver, 1, 32, &limits)?);
/// assert!(image.png()?.starts_with(b"\x89PNG"));
/// # Ok::<(), palpate_refusal::Refusal>(())
/// ```
///
/// # Errors
/// Refuses a size below 16 ([`SMALLEST_TEXTURE`]) or above the limit `texture_side`. Without memory for the
/// image it unwinds with a refusal, which [`memory::attempt`] returns.
pub fn painted(surface: PaintedSurface, seed: u64, size: u32, limits: &Limits) -> Result<Image> {
    let range = format!("from {SMALLEST_TEXTURE} to {} pixels", limits.texture_side);
    let holds = |v| v >= f64::from(SMALLEST_TEXTURE) && v <= f64::from(limits.texture_side);
    number("texture_size", f64::from(size), &range, holds)?;
    let side = size as usize;
    let rgb = match surface {
        PaintedSurface::Mucosa => mucosa::paint(seed, side),
        PaintedSurface::Liver => liver::paint(seed, side),
        PaintedSurface::Nodular => nodular::paint(seed, side),
        PaintedSurface::Serosa => serosa::paint(seed, side),
    };
    Ok(Image { width: side, height: side, rgb })
}

/// Returns the image of a scene's tissue: the user's file decoded (transparency is ignored, 16-bit colours
/// become 8-bit), or a painted one.
///
/// # Errors
/// Refuses a size of a painted image beyond the limits, as [`painted`] does; a file that is not a regular file,
/// can't be read or is not a PNG image ([`Reason::Unreadable`]); and one with more than `file_bytes` bytes or a
/// side above `texture_side` ([`Reason::TooLarge`]). Without memory for the image it unwinds with a refusal.
pub fn image(appearance: &Appearance, limits: &Limits) -> Result<Image> {
    match &appearance.texture {
        Some(path) => Image::decode(path, &read(path, limits)?, limits),
        None => painted(appearance.surface, appearance.texture_seed, appearance.texture_size, limits),
    }
}

/// Returns the image of a scene's tissue as a PNG file. A user's own file is decoded to check it, and passed on
/// unchanged.
///
/// # Errors
/// Refuses and unwinds as [`image`] does.
pub fn texture(appearance: &Appearance, limits: &Limits) -> Result<Texture> {
    let png = match &appearance.texture {
        Some(path) => {
            let bytes = read(path, limits)?;
            Image::decode(path, &bytes, limits)?;
            bytes
        }
        None => image(appearance, limits)?.png()?,
    };
    let etag = format!("\"{:032x}\"", xxhash_rust::xxh3::xxh3_128(&png));
    Ok(Texture { png: png.into(), etag })
}

fn refuse(path: &Path, reason: Reason, message: String) -> Refusal {
    let place = Some(path.display().to_string());
    Refusal { place, ..Refusal::new(reason, "appearance.texture", message) }
}

fn read(path: &Path, limits: &Limits) -> Result<Vec<u8>> {
    files::read_regular(path, limits.file_bytes).map_err(|found| refuse(path, found.reason, found.message))
}

impl Image {
    /// Reads a PNG file of any colour type. Transparency is ignored.
    fn decode(path: &Path, bytes: &[u8], limits: &Limits) -> Result<Self> {
        let wrong = |e: png::DecodingError| refuse(path, Reason::Unreadable, format!("is not a PNG image: {e}"));
        let mut decoder = png::Decoder::new(Cursor::new(bytes));
        decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
        let mut reader = decoder.read_info().map_err(wrong)?;
        let (width, height, most) = (reader.info().width, reader.info().height, limits.texture_side);
        if width.max(height) > most {
            let message = format!("is {width} × {height} pixels, above the limit of {most} a side");
            return Err(refuse(path, Reason::TooLarge, message));
        }
        // The pixels as they are read, and as RGB.
        memory::require(u64::from(width) * u64::from(height) * 8, "a texture");
        let mut pixels = memory::zeroed(reader.output_buffer_size().unwrap_or(0), "a texture");
        let frame = reader.next_frame(&mut pixels).map_err(wrong)?;
        pixels.truncate(frame.buffer_size());
        let rgb = match frame.color_type {
            png::ColorType::Grayscale => pixels.iter().flat_map(|grey| [*grey; 3]).collect(),
            png::ColorType::GrayscaleAlpha => pixels.chunks_exact(2).flat_map(|pixel| [pixel[0]; 3]).collect(),
            png::ColorType::Rgba => pixels.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect(),
            png::ColorType::Rgb | png::ColorType::Indexed => pixels,
        };
        Ok(Image { width: width as usize, height: height as usize, rgb })
    }

    /// Returns the image as a PNG file, 8 bits per colour.
    ///
    /// # Errors
    /// Refuses an image that the encoder rejects: a side of 0, or a length of `rgb` other than
    /// 3·`width`·`height`.
    pub fn png(&self) -> Result<Vec<u8>> {
        let mut file = Vec::new();
        #[allow(clippy::cast_possible_truncation)]
        let mut encoder = png::Encoder::new(&mut file, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let written = encoder.write_header().and_then(|mut writer| writer.write_image_data(&self.rgb));
        written.map_err(|e| Refusal::new(Reason::TooLarge, "", format!("can't be written as a PNG image: {e}")))?;
        Ok(file)
    }
}
