//! The page that a browser shows: files of the built viewer, on the port that serves gRPC.
//!
//! They are looked up when they are asked for: in the folder of the configuration, then within the program (feature
//! `viewer`). Without either, `/` says what is missing.

use std::io::ErrorKind;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use axum::body::Body;
use axum::extract::Request;
use axum::http::{HeaderMap, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use tracing::warn;
use xxhash_rust::xxh3::xxh3_128;

/// What a browser may do with the page: nothing from elsewhere, no script but its own, and no word of the session's
/// name to other sites.
const GUARDS: [(header::HeaderName, &str); 3] = [
    (
        header::CONTENT_SECURITY_POLICY,
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'self'",
    ),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
];

/// What `/` shows where there is no page.
const MISSING: &str = include_str!("missing.html");

#[cfg(feature = "viewer")]
#[derive(rust_embed::RustEmbed)]
#[folder = "clients/viewer/dist"]
struct Embedded;

/// Content types of what a build makes, by the ends of names.
fn content_type(path: &str) -> &'static str {
    match path.rsplit_once('.').map_or("", |(_, end)| end) {
        "html" => "text/html; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "json" | "map" => "application/json",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "ico" => "image/x-icon",
        "txt" => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

/// A file of the page.
fn read(folder: &Path, path: &str) -> Option<Bytes> {
    let inside = Path::new(path);
    // Nothing that could lead out of the folder.
    if !inside.components().all(|part| matches!(part, Component::Normal(_))) {
        return None;
    }
    let file = folder.join(inside);
    match std::fs::read(&file) {
        Ok(bytes) => return Some(bytes.into()),
        Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory | ErrorKind::IsADirectory) => {}
        Err(e) => warn!("{}: can't be read: {e}", file.display()),
    }
    #[cfg(feature = "viewer")]
    if let Some(file) = Embedded::get(path) {
        return Some(match file.data {
            std::borrow::Cow::Borrowed(bytes) => Bytes::from_static(bytes),
            std::borrow::Cow::Owned(bytes) => bytes.into(),
        });
    }
    None
}

/// Bytes that a browser keeps and asks for again by their hash.
pub(super) fn cached(bytes: Bytes, content_type: &'static str, control: &'static str, asked: &HeaderMap) -> Response {
    let tag = format!("\"{:032x}\"", xxh3_128(&bytes));
    let known = asked.get_all(header::IF_NONE_MATCH).iter().filter_map(|value| value.to_str().ok());
    let known = known.flat_map(|tags| tags.split(',')).any(|known| known.trim().trim_start_matches("W/") == tag);
    let headers = [(header::ETAG, tag), (header::CACHE_CONTROL, control.to_owned())];
    if known {
        return (StatusCode::NOT_MODIFIED, GUARDS, headers).into_response();
    }
    (GUARDS, headers, [(header::CONTENT_TYPE, content_type)], bytes).into_response()
}

/// Answers whatever no service does.
pub(super) async fn page(folder: Arc<PathBuf>, request: Request) -> Response {
    let headers = request.headers();
    let is_grpc = |value: &header::HeaderValue| value.as_bytes().starts_with(b"application/grpc");
    if headers.get(header::CONTENT_TYPE).is_some_and(is_grpc) {
        let status = tonic::Status::unimplemented(format!("there is no service at {}", request.uri().path()));
        return status.into_http::<Body>();
    }
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        let message = "a page is asked for by GET; gRPC has a content type of application/grpc\n";
        return (StatusCode::METHOD_NOT_ALLOWED, GUARDS, [(header::ALLOW, "GET, HEAD")], message).into_response();
    }
    let path = match request.uri().path().trim_start_matches('/') {
        "" => "index.html",
        path => path,
    }
    .to_owned();
    let (asked, name) = (folder.clone(), path.clone());
    let found = tokio::task::spawn_blocking(move || read(&asked, &name)).await.ok().flatten();
    match found {
        // Names in assets/ have a hash of what is in them.
        Some(bytes) if path.starts_with("assets/") => {
            cached(bytes, content_type(&path), "public, max-age=31536000, immutable", headers)
        }
        Some(bytes) => cached(bytes, content_type(&path), "no-cache", headers),
        None if path == "index.html" => {
            let html = [(header::CONTENT_TYPE, content_type(&path)), (header::CACHE_CONTROL, "no-store")];
            // Without this the policy would keep the page's own few rules out.
            let style =
                [(header::CONTENT_SECURITY_POLICY, "default-src 'none'; style-src 'unsafe-inline'; img-src data:")];
            let page = MISSING.replace("FOLDER", &escaped(&folder.display().to_string()));
            (StatusCode::NOT_FOUND, GUARDS, style, html, page).into_response()
        }
        None => (StatusCode::NOT_FOUND, GUARDS, format!("there is no {path} here\n")).into_response(),
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}
