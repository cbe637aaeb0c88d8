//! Textures by name: those of sessions, of scenes, and the default one.

use std::sync::{Arc, Mutex};

use axum::extract::Path;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use tonic::Status;

use super::workshop::Workshop;
use super::{House, page};
use crate::budget::{Purpose, Resource, Taken};
use crate::limits::Limits;
use crate::lock::lock;
use crate::memory;
use crate::refusal::Refusal;
use crate::scene::Appearance;
use crate::texture::{Texture, texture};

/// The account on which they are made and kept: what is kept serves whoever asks next.
const EVERYBODY: &str = "textures";

/// Textures that a server keeps.
const MOST_KEPT: usize = 8;

/// While it is painted.
const BYTES_PER_PIXEL: u64 = 16;

/// The textures last asked for, the newest last.
#[derive(Clone)]
pub(crate) struct Textures {
    kept: Arc<Mutex<Vec<(Appearance, Texture, Taken)>>>,
    /// Of their own: a texture may take a second, and nobody who wants a session waits for that.
    workshop: Workshop,
}

impl Textures {
    pub(super) fn new(limits: &Limits) -> std::io::Result<Self> {
        Ok(Textures { kept: Arc::default(), workshop: Workshop::open("textures", limits)? })
    }
}

/// `NAME.png` for a browser, which draws a picture of its own where there is none.
pub(super) async fn file(house: House, Path(file): Path<String>, headers: HeaderMap) -> Response {
    match house.texture(file.strip_suffix(".png").unwrap_or(&file)).await {
        // A scene's own image may be another one soon.
        Ok(texture) => page::cached(texture.png, texture.etag, "image/png", "no-cache", &headers),
        // Not an error, of which a browser would tell.
        Err(_) => StatusCode::NO_CONTENT.into_response(),
    }
}

impl House {
    /// The texture of a session by its id, of a scene that the server has by its name, or the `default` one. Made or read
    /// once, and kept: a second or so for who asks first.
    pub(crate) async fn texture(&self, name: &str) -> Result<Texture, Status> {
        let (house, name) = (self.clone(), name.to_owned());
        // One at a time: the next may be the same.
        let everybody = self.pacer.budget.account(EVERYBODY);
        Ok(self.textures.workshop.work(&everybody, move |_| house.find_texture(&name)).await??)
    }

    fn find_texture(&self, name: &str) -> Result<Texture, Refusal> {
        let limits = &self.config.limits;
        let appearance = match (name, self.pacer.get(name)) {
            ("default", _) => Appearance::default(),
            (_, Ok(live)) => live.model.scene.appearance.clone(),
            _ => self.catalog.load(name, &[], limits)?.appearance,
        };
        let mut kept = lock(&self.textures.kept);
        if let Some((_, texture, _)) = kept.iter().find(|entry| entry.0 == appearance) {
            return Ok(texture.clone());
        }
        // What is kept serves whoever asks next: nobody pays for it alone.
        let account = self.pacer.budget.account(EVERYBODY);
        let side = u64::from(appearance.texture_size);
        if kept.len() == MOST_KEPT {
            kept.remove(0);
        }
        let mut taken =
            account.take(Resource::Memory(Purpose::Textures), side * side * BYTES_PER_PIXEL, "texture_size")?;
        let texture = memory::attempt("texture_size", || texture(&appearance, limits))?;
        taken.shrink_to(texture.png.len() as u64);
        kept.push((appearance, texture.clone(), taken));
        Ok(texture)
    }
}
