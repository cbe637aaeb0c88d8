//! Errors: codes for programs, messages for people, and the guard around every function.

use std::borrow::Cow;
use std::cell::Cell;
use std::ffi::{CStr, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};

use palpate_client::Error;

/// The result of a function: success, or the reason why it did nothing.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum palpate_result {
    /// The function succeeded.
    PALPATE_OK = 0,
    /// An argument is not valid: a null pointer, a number that is not finite or out of range, a text that is not
    /// UTF-8.
    PALPATE_ARGUMENT = 1,
    /// The server can't be reached, or the connection broke.
    PALPATE_CONNECTION = 2,
    /// The server refused the call: an unknown scene, a missing permission, a value out of its range.
    PALPATE_REFUSED = 3,
    /// The device can't be read or written.
    PALPATE_DEVICE = 4,
    /// The buffer is too small.
    PALPATE_BUFFER = 5,
    /// Another thread is in a function that only one thread at a time may call.
    PALPATE_BUSY = 6,
    /// A bug in the library, or in code that it called. The handle may be unusable from now on.
    PALPATE_INTERNAL = 7,
}

pub use palpate_result::*;

/// Maximum length of a message in bytes, with the zero at its end.
const LONGEST: usize = 1024;

thread_local! {
    /// The message of the thread's last error. In place, without allocating memory: ticks fail too.
    static WORDS: Cell<[u8; LONGEST]> = const { Cell::new([0; LONGEST]) };
}

/// Stores the message of an error for this thread, truncated to what fits.
fn keep(text: &str) {
    WORDS.with(|words| {
        let mut end = text.len().min(LONGEST - 1);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        // SAFETY: only this thread has this place, and nothing reads it during the call.
        let words = unsafe { &mut *words.as_ptr() };
        words[..end].copy_from_slice(&text.as_bytes()[..end]);
        words[end] = 0;
    });
}

/// Returns the message of this thread's last error; empty before the first. It stays valid until another call of this
/// thread fails.
#[unsafe(no_mangle)]
pub extern "C" fn palpate_last_error() -> *const c_char {
    WORDS.try_with(|words| words.as_ptr().cast_const().cast()).unwrap_or(c"".as_ptr())
}

/// An error with a code and a message.
pub(crate) struct CodedError {
    code: palpate_result,
    /// The message; for errors of ticks a constant, so that a tick allocates no memory.
    words: Cow<'static, str>,
}

impl CodedError {
    pub(crate) fn argument(words: impl Into<Cow<'static, str>>) -> Self {
        CodedError::new(PALPATE_ARGUMENT, words)
    }

    pub(crate) fn code(&self) -> palpate_result {
        self.code
    }

    pub(crate) fn new(code: palpate_result, words: impl Into<Cow<'static, str>>) -> Self {
        CodedError { code, words: words.into() }
    }
}

impl From<Error> for CodedError {
    fn from(error: Error) -> Self {
        let code = match &error {
            Error::Argument(_) => PALPATE_ARGUMENT,
            Error::Connection(_) => PALPATE_CONNECTION,
            Error::Call(status) if std::error::Error::source(status).is_some() => PALPATE_CONNECTION,
            Error::Call(_) => PALPATE_REFUSED,
            Error::Device(_) => PALPATE_DEVICE,
            Error::Internal(_) => PALPATE_INTERNAL,
        };
        CodedError::new(code, error.to_string())
    }
}

impl From<tonic::Status> for CodedError {
    fn from(status: tonic::Status) -> Self {
        Error::from(status).into()
    }
}

/// Runs the body of a function: stores the message of its error, and catches panics. Allocates no memory itself.
pub(crate) fn guard(entry: impl FnOnce() -> Result<(), CodedError>) -> palpate_result {
    match catch_unwind(AssertUnwindSafe(entry)) {
        Ok(Ok(())) => PALPATE_OK,
        Ok(Err(CodedError { code, words })) => {
            keep(&words);
            code
        }
        Err(_) => {
            keep("a fault of the library (its words are on the standard error)");
            PALPATE_INTERNAL
        }
    }
}

/// Returns the value that a pointer points at; an error if it is null.
///
/// # Safety
/// The pointer must be null or valid.
pub(crate) unsafe fn at<'a, T>(pointer: *const T, words: &'static str) -> Result<&'a T, CodedError> {
    // SAFETY: the caller's promise.
    unsafe { pointer.as_ref() }.ok_or_else(|| CodedError::argument(words))
}

/// Returns the value that a pointer points at, to be written; an error if it is null.
///
/// # Safety
/// The pointer must be null or valid, and nothing else may use the value during its lifetime.
pub(crate) unsafe fn at_mut<'a, T>(pointer: *mut T, words: &'static str) -> Result<&'a mut T, CodedError> {
    // SAFETY: the caller's promise.
    unsafe { pointer.as_mut() }.ok_or_else(|| CodedError::argument(words))
}

/// Returns the text that a pointer points at; an error if it is null or not UTF-8.
///
/// # Safety
/// The pointer must be null or point to a zero-terminated text.
pub(crate) unsafe fn text<'a>(pointer: *const c_char, name: &'static str) -> Result<&'a str, CodedError> {
    // SAFETY: the caller's promise.
    unsafe { optional_text(pointer, name) }?.ok_or_else(|| CodedError::argument(format!("{name} is null")))
}

/// Returns the text that a pointer points at; `None` if it is null, an error if it is not UTF-8.
///
/// # Safety
/// The pointer must be null or point to a zero-terminated text.
pub(crate) unsafe fn optional_text<'a>(
    pointer: *const c_char,
    name: &'static str,
) -> Result<Option<&'a str>, CodedError> {
    if pointer.is_null() {
        return Ok(None);
    }
    // SAFETY: the caller's promise.
    let text = unsafe { CStr::from_ptr(pointer) };
    text.to_str().map(Some).map_err(|_| CodedError::argument(format!("{name} is not UTF-8")))
}

/// Writes a text with a zero byte into the caller's buffer, and the number of bytes it takes. Either may be null, but
/// not both.
///
/// # Safety
/// The pointers must be null or valid, `buffer` for `capacity` bytes.
pub(crate) unsafe fn write_text(
    text: &str,
    buffer: *mut c_char,
    capacity: usize,
    needed: *mut usize,
) -> Result<(), CodedError> {
    // SAFETY: the caller's promise.
    if let Some(needed) = unsafe { needed.as_mut() } {
        *needed = text.len() + 1;
    }
    if buffer.is_null() {
        return if needed.is_null() { Err(CodedError::argument("both `text` and `needed` are null")) } else { Ok(()) };
    }
    if capacity <= text.len() {
        return Err(CodedError::new(PALPATE_BUFFER, format!("the text takes {} bytes", text.len() + 1)));
    }
    // SAFETY: the caller's promise; it fits.
    unsafe {
        std::ptr::copy_nonoverlapping(text.as_ptr(), buffer.cast(), text.len());
        *buffer.add(text.len()) = 0;
    }
    Ok(())
}
