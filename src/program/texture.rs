//! `palpate texture`: paints an image for a tissue's surface.

use std::path::PathBuf;

use palpate_texture as texture;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{Named, PaintedSurface};

use super::{Failure, write_file};

#[derive(clap::Args)]
pub(crate) struct TextureArguments {
    /// Kind of surface: mucosa, liver, nodular or serosa (a gallbladder)
    #[arg(long, value_name = "NAME", default_value = "mucosa")]
    surface: String,
    /// Seed of the texture, an integer
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Pixels along each side
    #[arg(long, value_name = "PIXELS", default_value_t = 1024)]
    size: u32,
    /// The PNG file to write
    #[arg(short, long, value_name = "FILE.png")]
    output: PathBuf,
}

/// Paints a texture.
pub(crate) fn make_texture(arguments: &TextureArguments) -> Result<(), Failure> {
    let surface = PaintedSurface::named("surface", &arguments.surface)?;
    let image = texture::painted(surface, arguments.seed, arguments.size, &Limits::default())?;
    write_file(&arguments.output, &image.png()?)
}
