//! A maker's library, loaded at run time.
//!
//! A library stays loaded until the program ends: some have threads of their own, and crash when they are unloaded.

// Functions of a C library.
#![allow(unsafe_code)]

use std::ffi::{CStr, c_char};
use std::io;
use std::path::Path;

use libloading::Library;

/// A loaded library of a device's maker.
#[derive(Debug, Clone)]
pub(super) struct Loaded {
    library: &'static Library,
    name: String,
}

impl Loaded {
    /// Loads `given`, or the first of `names` that the system finds. `what` (the library) and `how` (to get it)
    /// appear in the error.
    ///
    /// # Errors
    /// Returns an error that lists what was tried and what to do.
    pub(super) fn find(given: Option<&Path>, names: &[&str], what: &str, how: &str) -> io::Result<Self> {
        let mut tried = Vec::new();
        let given = given.map(|path| path.display().to_string());
        let names: Vec<String> =
            given.map_or_else(|| names.iter().map(|&name| name.to_owned()).collect(), |name| vec![name]);
        for name in names {
            // SAFETY: loading runs the library's own initialisation, which is the user's choice, as it is with every driver.
            match unsafe { Library::new(&name) } {
                Ok(library) => return Ok(Loaded { library: Box::leak(Box::new(library)), name }),
                Err(error) => {
                    // The system's message names the file.
                    let words =
                        std::error::Error::source(&error).map_or_else(|| error.to_string(), ToString::to_string);
                    tried.push(words);
                }
            }
        }
        let message =
            format!("{what} can't be loaded: {}. {how}, or name the library with --library FILE", tried.join("; "));
        Err(io::Error::new(io::ErrorKind::NotFound, message))
    }

    /// Returns the name by which it was found.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Returns the function with that name.
    ///
    /// # Safety
    /// `F` must be a pointer to a function of the type that the maker's header declares for that name.
    ///
    /// # Errors
    /// Returns an error if the library has no such function.
    pub(super) unsafe fn function<F: Copy>(&self, symbol: &str) -> io::Result<F> {
        // SAFETY: the caller knows the type; the library is never unloaded, so that the pointer stays valid.
        unsafe { self.optional(symbol) }.ok_or_else(|| {
            let message =
                format!("{} has no function {symbol}: it is another library, or one of another version", self.name);
            io::Error::new(io::ErrorKind::Unsupported, message)
        })
    }

    /// Returns the function with that name; `None` if the library has none.
    ///
    /// # Safety
    /// The condition of [`Loaded::function`] applies.
    pub(super) unsafe fn optional<F: Copy>(&self, symbol: &str) -> Option<F> {
        // SAFETY: as above.
        unsafe { self.library.get::<F>(symbol.as_bytes()) }.ok().map(|function| *function)
    }
}

/// Copies a text of a library; `None` for a null pointer.
///
/// # Safety
/// `text` must be null, or point to a zero-terminated text that does not change during this call.
pub(super) unsafe fn text_of(text: *const c_char) -> Option<String> {
    // SAFETY: as the caller promises.
    (!text.is_null()).then(|| unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_is_named_with_what_to_do() {
        let error = Loaded::find(None, &["libno-such-maker.so.9"], "the kit", "Install it").err();
        let said = error.map(|error| error.to_string()).unwrap_or_default();
        for part in ["the kit can't be loaded", "libno-such-maker.so.9", "Install it", "--library FILE"] {
            assert!(said.contains(part), "{said}");
        }
    }
}
