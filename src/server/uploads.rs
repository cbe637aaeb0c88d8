//! Files that clients send in parts: kept in memory for a while, each for the caller who has sent it.

use std::sync::{Arc, Mutex};

use palpate_realtime::clock::now_ns;
use palpate_realtime::ids::random_id;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::budget::{Account, Purpose, Resource, Taken};
use palpate_tissue::lock::lock;

/// What is sent: how refusals name it, and its bounds.
pub(super) struct UploadKind {
    /// One of it, and several.
    pub(super) names: [&'static str; 2],
    /// The field of requests that names it.
    pub(super) id: &'static str,
    /// The reason of a refusal if there is none of that name.
    pub(super) unknown: Reason,
    pub(super) purpose: Purpose,
    /// The most bytes, and the key of the configuration that says so.
    pub(super) most_bytes: (u64, &'static str),
    /// The most of one caller, and the key of the configuration that says so.
    pub(super) most_each: (usize, &'static str),
    /// So long it is kept after it was last used, s.
    pub(super) kept_s: f64,
}

/// A part of a file.
pub(super) struct FilePart<'p> {
    /// Names the file; empty with its first part.
    pub(super) id: &'p str,
    /// So many bytes of the file come before it.
    pub(super) offset: u64,
    pub(super) bytes: &'p [u8],
    /// No other part follows.
    pub(super) last: bool,
}

/// A file that a client is sending or has sent.
struct Upload<T> {
    id: String,
    state: UploadState<T>,
    /// When the last part came, or it was used last.
    touched_ns: u64,
    taken: Taken,
}

enum UploadState<T> {
    /// What has come so far.
    Receiving(Vec<u8>),
    /// A job reads it.
    Reading,
    /// It can be used.
    Ready(Arc<T>),
}

struct UploadShared<T> {
    kind: UploadKind,
    uploads: Mutex<Vec<Upload<T>>>,
}

/// The files of one kind of all clients, each read as a `T` when it has come in full.
pub(super) struct Uploads<T>(Arc<UploadShared<T>>);

impl<T> Clone for Uploads<T> {
    fn clone(&self) -> Self {
        Uploads(self.0.clone())
    }
}

impl<T> Uploads<T> {
    /// None yet.
    pub(super) fn new(kind: UploadKind) -> Self {
        Uploads(Arc::new(UploadShared { kind, uploads: Mutex::default() }))
    }

    pub(super) fn kind(&self) -> &UploadKind {
        &self.0.kind
    }

    /// Adds a part of a file, the first of a new one if it names none. Returns the file's id, and how many bytes have come.
    ///
    /// # Errors
    /// Refuses a part that does not follow what has come before, a file that this caller is not sending, and more than the
    /// limits or the caller's part of the memory allow.
    pub(super) fn add(&self, part: &FilePart<'_>, account: &Account) -> Result<(String, u64)> {
        let (now, kind) = (now_ns(), self.kind());
        self.forget_expired(now);
        let mut uploads = lock(&self.0.uploads);
        let index = if part.id.is_empty() {
            self.make_room(&mut uploads, account)?;
            let taken = account.take(Resource::Memory(kind.purpose), 0, "part")?;
            uploads.push(Upload {
                id: random_id()?,
                state: UploadState::Receiving(Vec::new()),
                touched_ns: now,
                taken,
            });
            uploads.len() - 1
        } else {
            self.find(&uploads, part.id, account)?
        };
        let upload = &mut uploads[index];
        let added = upload.add(part, kind);
        upload.touched_ns = now;
        match added {
            Ok(received_bytes) => Ok((upload.id.clone(), received_bytes)),
            Err(refusal) => {
                // One that has not begun well can't be named by its client.
                if part.id.is_empty() || refusal.reason == Reason::TooLarge {
                    uploads.swap_remove(index);
                }
                Err(refusal)
            }
        }
    }

    /// Makes room for a further file of a caller: the oldest one that has come in full gives way.
    fn make_room(&self, uploads: &mut Vec<Upload<T>>, account: &Account) -> Result<()> {
        let UploadKind { names: [_, names], most_each: (most, key), .. } = self.kind();
        let of_caller = || uploads.iter().enumerate().filter(|(_, upload)| upload.is_of(account));
        if of_caller().count() < *most {
            return Ok(());
        }
        let ready = of_caller().filter(|(_, upload)| matches!(upload.state, UploadState::Ready(_)));
        let Some((oldest, _)) = ready.min_by_key(|(_, upload)| upload.touched_ns) else {
            let message = format!(
                "this caller is sending {most} {names} already ({key}); finish one, or wait until one has expired"
            );
            return Err(Refusal::new(Reason::TooMany, "", message));
        };
        uploads.swap_remove(oldest);
        Ok(())
    }

    /// Takes a file that has come in full, to read it. If what this returns is dropped before it is finished, the file is gone.
    ///
    /// # Errors
    /// Refuses a file that this caller is not sending.
    pub(super) fn take(&self, id: &str, account: &Account) -> Result<Received<T>> {
        let mut uploads = lock(&self.0.uploads);
        let index = self.find(&uploads, id, account)?;
        let upload = &mut uploads[index];
        match std::mem::replace(&mut upload.state, UploadState::Reading) {
            UploadState::Receiving(bytes) => Ok(Received { uploads: self.clone(), id: id.to_owned(), bytes }),
            state => {
                upload.state = state;
                Err(complete(self.kind()))
            }
        }
    }

    /// What this caller has sent.
    ///
    /// # Errors
    /// Refuses what this caller has not sent, or not in full, and what has expired.
    pub(super) fn get(&self, id: &str, account: &Account) -> Result<Arc<T>> {
        self.forget_expired(now_ns());
        let mut uploads = lock(&self.0.uploads);
        let index = self.find(&uploads, id, account)?;
        uploads[index].touched_ns = now_ns();
        match &uploads[index].state {
            UploadState::Ready(value) => Ok(value.clone()),
            UploadState::Receiving(_) | UploadState::Reading => {
                let message = "has not come in full: its last part is missing, or is being read";
                Err(Refusal::new(Reason::OutOfTurn, self.kind().id, message))
            }
        }
    }

    /// Forgets the files whose last part came too long ago.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(super) fn forget_expired(&self, now_ns: u64) {
        let kept_ns = (self.kind().kept_s * 1e9) as u64;
        lock(&self.0.uploads).retain(|upload| now_ns.saturating_sub(upload.touched_ns) < kept_ns);
    }

    /// The upload of that id and caller.
    fn find(&self, uploads: &[Upload<T>], id: &str, account: &Account) -> Result<usize> {
        let found = uploads.iter().position(|upload| upload.id == id && upload.is_of(account));
        found.ok_or_else(|| unknown(self.kind()))
    }
}

fn unknown(kind: &UploadKind) -> Refusal {
    let name = kind.names[0];
    let message = format!(
        "names no {name} that this caller has sent, or it has expired: send the {name} again, from its first part"
    );
    Refusal::new(kind.unknown, kind.id, message)
}

fn complete(kind: &UploadKind) -> Refusal {
    Refusal::new(Reason::OutOfTurn, kind.id, "has come in full already: no further part follows")
}

impl<T> Upload<T> {
    fn is_of(&self, account: &Account) -> bool {
        self.taken.account().number() == account.number()
    }

    /// Adds a part; returns how many bytes there are now.
    fn add(&mut self, part: &FilePart<'_>, kind: &UploadKind) -> Result<u64> {
        let UploadState::Receiving(bytes) = &mut self.state else { return Err(complete(kind)) };
        let length = bytes.len() as u64;
        if part.offset != length {
            let message = format!("must be {length}, the bytes that have come so far, but is {}", part.offset);
            return Err(Refusal::new(Reason::OutOfTurn, "offset", message));
        }
        let (sum, (most, key)) = (length + part.bytes.len() as u64, kind.most_bytes);
        if sum > most {
            let message = format!("makes {sum} bytes, above the limit of {most} ({key})");
            return Err(Refusal::new(Reason::TooLarge, "part", message));
        }
        if part.bytes.is_empty() && !part.last {
            return Err(Refusal::new(Reason::Missing, "part", "is empty, and is not the last"));
        }
        // What a vector takes that grows.
        self.taken.grow_to(2 * sum, "part")?;
        if bytes.try_reserve(part.bytes.len()).is_err() {
            return Err(Refusal::new(Reason::Overloaded, "part", "the system has no memory for it"));
        }
        bytes.extend_from_slice(part.bytes);
        Ok(sum)
    }
}

/// A file that has come in full and is being read.
pub(super) struct Received<T> {
    uploads: Uploads<T>,
    id: String,
    pub(super) bytes: Vec<u8>,
}

impl<T> Drop for Received<T> {
    fn drop(&mut self) {
        let is_given_up = |upload: &Upload<T>| upload.id == self.id && matches!(upload.state, UploadState::Reading);
        lock(&self.uploads.0.uploads).retain(|upload| !is_given_up(upload));
    }
}

impl<T> Received<T> {
    /// Takes as much memory as this for it, or gives some back.
    ///
    /// # Errors
    /// Refuses more than the caller may take, and a file that is forgotten.
    pub(super) fn charge(&self, bytes: u64) -> Result<()> {
        match lock(&self.uploads.0.uploads).iter_mut().find(|upload| upload.id == self.id) {
            Some(upload) => {
                upload.taken.shrink_to(bytes);
                upload.taken.grow_to(bytes, "part")
            }
            None => Err(unknown(self.uploads.kind())),
        }
    }

    /// It can be used from now on.
    ///
    /// # Errors
    /// As [`Received::charge`] does, for what it takes from now on.
    pub(super) fn finish(&self, value: T, bytes: u64) -> Result<()> {
        self.charge(bytes)?;
        if let Some(upload) = lock(&self.uploads.0.uploads).iter_mut().find(|upload| upload.id == self.id) {
            upload.state = UploadState::Ready(Arc::new(value));
            upload.touched_ns = now_ns();
        }
        Ok(())
    }
}
