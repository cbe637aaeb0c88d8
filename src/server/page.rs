//! The page for browsers: the files of the built viewer, on the port that serves gRPC.
//!
//! The server looks for a file when it is requested: first in the configured folder, then within the program (feature
//! `viewer`). Without either, `/` shows what is missing. A file is read and hashed once until it changes, and all
//! responses share its bytes, so a response that nobody reads takes no memory of its own.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::io::Read;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;
use std::time::SystemTime;

use axum::body::Body;
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use tracing::warn;
use xxhash_rust::xxh3::xxh3_128;

/// What a browser allows the page: nothing from other sites, and no script but its own.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'";

/// Headers of all responses: the policy, and no referrer, so that the session's name is not sent to other sites.
const GUARDS: [(header::HeaderName, &str); 3] = [
    (header::CONTENT_SECURITY_POLICY, POLICY),
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
];

/// The text that `/` shows if there is no page.
const MISSING: &str = include_str!("missing.html");

#[cfg(feature = "viewer")]
#[derive(rust_embed::RustEmbed)]
#[folder = "clients/viewer/dist"]
struct Embedded;

/// Returns the content type of a file of the build, by the ending of its name.
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

/// Limit on the bytes of all cached files. A larger file is not served.
const MAX_BYTES: usize = 64 << 20;

/// Limit on the number of cached files.
const MAX_FILES: usize = 256;

/// Length and modification time of a file of the folder; `None` for a file within the program.
type Stamp = Option<(u64, Option<SystemTime>)>;

/// A file of the page.
#[derive(Debug, Clone)]
struct PageFile {
    stamp: Stamp,
    bytes: Bytes,
    /// The value of `ETag`.
    tag: String,
}

/// The page's folder, and a cache of the files that were requested.
#[derive(Debug)]
pub(super) struct Page {
    folder: PathBuf,
    kept: Arc<tokio::sync::Mutex<PageFiles>>,
    policy: HeaderValue,
}

/// The cached files by their paths.
#[derive(Debug, Default)]
struct PageFiles(BTreeMap<String, PageFile>);

impl Page {
    /// Creates the page of a folder. It may open datagrams at its own port; `datagrams` is HOST:PORT of another one
    /// that it may use.
    pub(super) fn of(folder: PathBuf, datagrams: Option<&str>) -> Arc<Self> {
        let connects = datagrams.map(|at| format!("connect-src 'self' https://{at}"));
        let policy = connects.and_then(|connects| POLICY.replace("connect-src 'self'", &connects).try_into().ok());
        Arc::new(Page { folder, kept: Arc::default(), policy: policy.unwrap_or(HeaderValue::from_static(POLICY)) })
    }

    /// Replaces the policy of a response by the page's own.
    fn guarded(&self, mut answer: Response) -> Response {
        answer.headers_mut().insert(header::CONTENT_SECURITY_POLICY, self.policy.clone());
        answer
    }

    /// Returns the file at `path`, if there is one. Files are looked up one at a time, so requests occupy one thread
    /// for files, and none reads what another is reading.
    async fn file(self: &Arc<Self>, path: &str) -> Option<PageFile> {
        let inside = PathBuf::from(path);
        // Refuses paths that could lead out of the folder.
        if !inside.components().all(|part| matches!(part, Component::Normal(_))) {
            return None;
        }
        let (file, path) = (self.folder.join(inside), path.to_owned());
        let mut kept = self.kept.clone().lock_owned().await;
        tokio::task::spawn_blocking(move || kept.find(&file, path)).await.ok().flatten()
    }
}

impl PageFiles {
    /// Returns the file at `path`, read again if it has changed. Empties the cache when it exceeds its limits.
    fn find(&mut self, file: &Path, path: String) -> Option<PageFile> {
        let stamp = match std::fs::metadata(file) {
            Ok(data) => data.is_file().then(|| (data.len(), data.modified().ok())),
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => None,
            Err(e) => {
                warn!("{}: can't be read: {e}", file.display());
                None
            }
        };
        if let Some(known) = self.0.get(&path).filter(|known| known.stamp == stamp) {
            return Some(known.clone());
        }
        self.0.remove(&path);
        let (stamp, bytes) = match stamp.and_then(|_| read(file)) {
            Some(bytes) => (stamp, bytes),
            None => (None, embedded(&path)?),
        };
        let all = self.0.values().map(|file| file.bytes.len()).sum::<usize>() + bytes.len();
        if all > MAX_BYTES || self.0.len() == MAX_FILES {
            self.0.clear();
        }
        let file = PageFile { stamp, tag: format!("\"{:032x}\"", xxh3_128(&bytes)), bytes };
        self.0.insert(path, file.clone());
        Some(file)
    }
}

/// Reads a whole file of the folder. `None`, with a warning in the log, if it is too large or can't be read.
fn read(file: &Path) -> Option<Bytes> {
    let mut bytes = Vec::new();
    let read = std::fs::File::open(file).and_then(|file| file.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes));
    match read {
        Ok(_) if bytes.len() <= MAX_BYTES => return Some(bytes.into()),
        Ok(_) => warn!("{}: is larger than {MAX_BYTES} bytes", file.display()),
        Err(e) => warn!("{}: can't be read: {e}", file.display()),
    }
    None
}

/// Returns a file within the program.
fn embedded(path: &str) -> Option<Bytes> {
    #[cfg(feature = "viewer")]
    let found = Embedded::get(path).map(|file| match file.data {
        std::borrow::Cow::Borrowed(bytes) => Bytes::from_static(bytes),
        std::borrow::Cow::Owned(bytes) => bytes.into(),
    });
    #[cfg(not(feature = "viewer"))]
    let (found, _) = (None, path);
    found
}

/// Returns a response that a browser may cache and validate by its `ETag` (304 if it is unchanged).
pub(super) fn cached(
    bytes: Bytes,
    tag: String,
    content_type: &'static str,
    control: &'static str,
    asked: &HeaderMap,
) -> Response {
    let known = asked.get_all(header::IF_NONE_MATCH).iter().filter_map(|value| value.to_str().ok());
    let known = known.flat_map(|tags| tags.split(',')).any(|known| known.trim().trim_start_matches("W/") == tag);
    let headers = [(header::ETAG, tag), (header::CACHE_CONTROL, control.to_owned())];
    if known {
        return (StatusCode::NOT_MODIFIED, GUARDS, headers).into_response();
    }
    (GUARDS, headers, [(header::CONTENT_TYPE, content_type)], bytes).into_response()
}

/// Answers every request that belongs to no service.
pub(super) async fn page(page: Arc<Page>, request: Request) -> Response {
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
    match page.file(&path).await {
        // Names in assets/ contain a hash of their contents.
        Some(PageFile { bytes, tag, .. }) if path.starts_with("assets/") => {
            page.guarded(cached(bytes, tag, content_type(&path), "public, max-age=31536000, immutable", headers))
        }
        Some(PageFile { bytes, tag, .. }) => page.guarded(cached(bytes, tag, content_type(&path), "no-cache", headers)),
        None if path == "index.html" => {
            let html = [(header::CONTENT_TYPE, content_type(&path)), (header::CACHE_CONTROL, "no-store")];
            // The page's own policy would block the few style rules of this text.
            let style =
                [(header::CONTENT_SECURITY_POLICY, "default-src 'none'; style-src 'unsafe-inline'; img-src data:")];
            let page = MISSING.replace("FOLDER", &escaped(&page.folder.display().to_string()));
            (StatusCode::NOT_FOUND, GUARDS, style, html, page).into_response()
        }
        None => (StatusCode::NOT_FOUND, GUARDS, format!("there is no {path} here\n")).into_response(),
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn page() -> (Arc<Page>, tempfile::TempDir) {
        let folder = tempfile::tempdir().unwrap();
        (Page::of(folder.path().to_owned(), None), folder)
    }

    #[test]
    fn the_page_may_open_datagrams_where_they_are_advertised() {
        let policy = |datagrams| Page::of(PathBuf::new(), datagrams).policy.clone();
        assert_eq!(policy(None), POLICY);
        let advertised = policy(Some("udp.example:7117"));
        assert!(advertised.to_str().unwrap().contains("; connect-src 'self' https://udp.example:7117; base-uri"));
    }

    #[tokio::test]
    async fn all_answers_share_the_bytes_of_a_file_until_it_changes() {
        let (page, folder) = page();
        std::fs::write(folder.path().join("a.js"), "one").unwrap();
        let asked = (0..50).map(|_| page.file("a.js"));
        let files: Vec<_> = futures_util::future::join_all(asked).await.into_iter().flatten().collect();
        assert_eq!(files.len(), 50);
        assert!(files.iter().all(|file| file.bytes.as_ptr() == files[0].bytes.as_ptr() && file.tag == files[0].tag));
        std::fs::write(folder.path().join("a.js"), "another").unwrap();
        let changed = page.file("a.js").await.unwrap();
        assert_eq!((&*changed.bytes, changed.tag == files[0].tag), (&b"another"[..], false));
        std::fs::remove_file(folder.path().join("a.js")).unwrap();
        assert!(page.file("a.js").await.is_none() && page.kept.lock().await.0.is_empty());
    }

    #[tokio::test]
    async fn what_is_kept_is_bounded() {
        let (page, folder) = page();
        for name in 0..MAX_FILES + 10 {
            std::fs::write(folder.path().join(name.to_string()), name.to_string()).unwrap();
            assert_eq!(page.file(&name.to_string()).await.unwrap().bytes, name.to_string());
            assert!(page.kept.lock().await.0.len() <= MAX_FILES);
        }
        // Sparse files: they take no space on the disk.
        for (name, bytes) in [("half", MAX_BYTES / 2), ("more", MAX_BYTES / 2 + 1), ("huge", MAX_BYTES + 1)] {
            std::fs::File::create(folder.path().join(name)).unwrap().set_len(bytes as u64).unwrap();
            assert_eq!(page.file(name).await.map(|file| file.bytes.len()), (bytes <= MAX_BYTES).then_some(bytes));
            let kept: usize = page.kept.lock().await.0.values().map(|file| file.bytes.len()).sum();
            assert!(kept <= MAX_BYTES, "{kept}");
        }
    }
}
