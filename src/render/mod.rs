//! Pictures of a tissue without a screen: a software rasteriser that computes the same pixels on any machine. The
//! server does not use it.

mod canvas;
mod drawn_surface;
mod film;
mod picture;
mod pressed;
mod surface;
mod wound;

pub use film::{Film, Gif, Still, gif};
pub use picture::{Arrow, Camera, LARGEST_SIDE, View, picture};
pub use pressed::{MAP_COLOURS, STRONG, pressed_map};
