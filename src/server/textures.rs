//! Textures by name: of sessions, of scenes, and the default one.

use std::sync::{Arc, Mutex};

use axum::extract::Path;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use tonic::Status;

use super::catalog::Catalog;
use super::config::Config;
use super::job_pool::JobPool;
use super::page;
use palpate_realtime::Pacer;
use palpate_refusal::Refusal;
use palpate_session::budget::{Purpose, Resource, Taken};
use palpate_texture::{Texture, texture};
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::scene::Appearance;

/// The account that textures are charged to. No caller pays for them: a kept texture serves later callers too.
const ACCOUNT: &str = "textures";

/// Number of textures that a server keeps; the oldest is dropped first.
const MAX_KEPT: usize = 8;

/// Memory for painting a texture, bytes per pixel.
const BYTES_PER_PIXEL: u64 = 16;

/// The textures that were created last, the newest last, and the threads that paint them.
#[derive(Clone)]
pub(crate) struct Textures {
    kept: Arc<Mutex<Vec<(Appearance, Texture, Taken)>>>,
    /// Separate threads: a texture may take a second, and sessions must not wait for it.
    job_pool: JobPool,
    config: Arc<Config>,
    catalog: Catalog,
    pacer: Arc<Pacer>,
}

/// Answers a browser's request for `NAME.png`. Responds without content if there is no such texture: the page then
/// paints its own.
pub(super) async fn file(textures: Textures, Path(file): Path<String>, headers: HeaderMap) -> Response {
    match textures.texture(file.strip_suffix(".png").unwrap_or(&file)).await {
        // A scene's image may change.
        Ok(texture) => page::cached(texture.png, texture.etag, "image/png", "no-cache", &headers),
        // Not an error status: a browser would log one.
        Err(_) => StatusCode::NO_CONTENT.into_response(),
    }
}

impl Textures {
    /// Starts the threads that make textures.
    ///
    /// # Errors
    /// Returns an error if a thread can't be started.
    pub(super) fn open(
        config: &Arc<Config>,
        catalog: &Catalog,
        pacer: &Arc<Pacer>,
        limits: &Limits,
    ) -> std::io::Result<Self> {
        Ok(Textures {
            kept: Arc::default(),
            job_pool: JobPool::open("textures", limits)?,
            config: config.clone(),
            catalog: catalog.clone(),
            pacer: pacer.clone(),
        })
    }

    /// Returns the texture of a session by its ID, of a scene by its name, or the one named `default`. It is painted
    /// or read once and then kept; the first request takes about a second.
    ///
    /// # Errors
    /// Returns an error if there is no such session or scene, if its image is invalid, or if the server is overloaded.
    pub(crate) async fn texture(&self, name: &str) -> Result<Texture, Status> {
        let (textures, name) = (self.clone(), name.to_owned());
        // One account, so one texture at a time: the next request may be for the one being painted.
        let account = self.pacer.budget.account(ACCOUNT);
        Ok(self.job_pool.work(&account, move |_| textures.find(&name)).await??)
    }

    fn find(&self, name: &str) -> Result<Texture, Refusal> {
        let limits = &self.config.limits;
        // The image of a tissue shows nothing that an exercise hides.
        let session = self.pacer.get_for_trainee(name).unwrap_or_else(|| self.pacer.get(name));
        let appearance = match (name, session) {
            ("default", _) => Appearance::default(),
            (_, Ok(handle)) => handle.model.scene.appearance.clone(),
            _ => self.catalog.load(name, &[], limits)?.appearance,
        };
        let mut kept = lock(&self.kept);
        if let Some((_, texture, _)) = kept.iter().find(|entry| entry.0 == appearance) {
            return Ok(texture.clone());
        }
        let account = self.pacer.budget.account(ACCOUNT);
        let side = u64::from(appearance.texture_size);
        if kept.len() == MAX_KEPT {
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
