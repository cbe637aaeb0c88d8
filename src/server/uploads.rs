//! Files that clients send in parts: kept in memory for a limited time, each for the caller that sent it.

use std::sync::{Arc, Mutex};

use palpate_realtime::clock::now_ns;
use palpate_realtime::ids::random_id;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::budget::{Account, Purpose, Resource, Taken};
use palpate_tissue::lock::lock;

/// The properties of one kind of upload: its names in refusals, and its limits.
pub(super) struct UploadKind {
    /// Its name, singular and plural.
    pub(super) names: [&'static str; 2],
    /// The field of requests that contains its id.
    pub(super) id: &'static str,
    /// The reason of the refusal if there is none with that id.
    pub(super) unknown: Reason,
    pub(super) purpose: Purpose,
    /// Maximum number of bytes, and the configuration key of that limit.
    pub(super) most_bytes: (u64, &'static str),
    /// Maximum number per caller, and the configuration key of that limit.
    pub(super) most_each: (usize, &'static str),
    /// Time after its last use for which it is kept, s.
    pub(super) kept_s: f64,
}

/// One part of an uploaded file.
pub(super) struct FilePart<'p> {
    /// The file's id; empty in its first part.
    pub(super) id: &'p str,
    /// Position of the part in the file, bytes.
    pub(super) offset: u64,
    pub(super) bytes: &'p [u8],
    /// Whether this is the last part.
    pub(super) last: bool,
}

/// A file that a client is sending or has sent.
struct Upload<T> {
    id: String,
    state: UploadState<T>,
    /// When its last part arrived or it was last used, ns.
    touched_ns: u64,
    taken: Taken,
}

enum UploadState<T> {
    /// The bytes received so far.
    Receiving(Vec<u8>),
    /// A job is reading the file.
    Reading,
    /// The value read from the file, ready for use.
    Ready(Arc<T>),
}

struct UploadShared<T> {
    kind: UploadKind,
    uploads: Mutex<Vec<Upload<T>>>,
}

/// The uploads of one kind from all clients; each complete file is read as a `T`.
pub(super) struct Uploads<T>(Arc<UploadShared<T>>);

impl<T> Clone for Uploads<T> {
    fn clone(&self) -> Self {
        Uploads(self.0.clone())
    }
}

impl<T> Uploads<T> {
    /// Creates the store, without uploads.
    pub(super) fn new(kind: UploadKind) -> Self {
        Uploads(Arc::new(UploadShared { kind, uploads: Mutex::default() }))
    }

    pub(super) fn kind(&self) -> &UploadKind {
        &self.0.kind
    }

    /// Adds a part to a file, or starts a new file if the part has no id. Returns the file's id and the number of
    /// bytes received.
    ///
    /// # Errors
    /// Refuses a part that does not follow the bytes received so far, a file that this caller is not sending, and
    /// more than the limits or the caller's share of the memory allow.
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
                // The client does not know the id of a file whose first part was refused.
                if part.id.is_empty() || refusal.reason == Reason::TooLarge {
                    uploads.swap_remove(index);
                }
                Err(refusal)
            }
        }
    }

    /// Makes room for another file of a caller by removing its oldest complete one.
    ///
    /// # Errors
    /// Refuses if the caller is at its limit and has no complete file.
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

    /// Takes a completely received file, to read it. Dropping the result before [`Received::finish`] deletes the
    /// file.
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

    /// Returns the value of a file that this caller has sent, and extends the time for which it is kept.
    ///
    /// # Errors
    /// Refuses a file that this caller has not sent, that is incomplete, or that has expired.
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

    /// Removes the files that were last used too long ago.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(super) fn forget_expired(&self, now_ns: u64) {
        let kept_ns = (self.kind().kept_s * 1e9) as u64;
        lock(&self.0.uploads).retain(|upload| now_ns.saturating_sub(upload.touched_ns) < kept_ns);
    }

    /// Returns the index of the upload with that id of this caller.
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

    /// Appends a part; returns the number of bytes received.
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
        // A growing vector may take twice its length.
        self.taken.grow_to(2 * sum, "part")?;
        if bytes.try_reserve(part.bytes.len()).is_err() {
            return Err(Refusal::new(Reason::Overloaded, "part", "the system has no memory for it"));
        }
        bytes.extend_from_slice(part.bytes);
        Ok(sum)
    }
}

/// A completely received file that is being read.
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
    /// Sets the memory that is charged for the file to `bytes`.
    ///
    /// # Errors
    /// Refuses more than the caller may use, and a file that was removed.
    pub(super) fn charge(&self, bytes: u64) -> Result<()> {
        match lock(&self.uploads.0.uploads).iter_mut().find(|upload| upload.id == self.id) {
            Some(upload) => {
                upload.taken.shrink_to(bytes);
                upload.taken.grow_to(bytes, "part")
            }
            None => Err(unknown(self.uploads.kind())),
        }
    }

    /// Stores the value read from the file, of `bytes` bytes: it can be used from now on.
    ///
    /// # Errors
    /// Returns the errors of [`Received::charge`].
    pub(super) fn finish(&self, value: T, bytes: u64) -> Result<()> {
        self.charge(bytes)?;
        if let Some(upload) = lock(&self.uploads.0.uploads).iter_mut().find(|upload| upload.id == self.id) {
            upload.state = UploadState::Ready(Arc::new(value));
            upload.touched_ns = now_ns();
        }
        Ok(())
    }
}
