//! libpalpate: the client library of Palpate for C. `include/palpate.h` is generated from the functions here.
//!
//! Every function catches panics, checks its pointers and turns errors into codes; `error` keeps their messages per
//! thread.

// The interface is that of C: names, pointers and promises of callers.
#![allow(unsafe_code, non_camel_case_types, clippy::missing_safety_doc, clippy::not_unsafe_ptr_arg_deref)]
// Clients live in real time; the rule is for what a server computes.
#![allow(clippy::disallowed_methods)]

mod axes;
mod bridge;
mod error;
mod hand;
mod instrument;
mod options;
mod os;
mod server;
mod surface;
mod tie;
mod touch;

use std::ffi::{CStr, c_char};

pub use axes::*;
pub use bridge::*;
pub use error::*;
pub use hand::*;
pub use instrument::*;
pub use options::*;
pub use server::*;
pub use surface::*;
pub use tie::*;
pub use touch::*;

/// The version of the interface. A change that breaks programs increases it, and the number in the library's file
/// name.
pub const PALPATE_ABI: u32 = 0;

/// Returns the version of the library's interface; compare it with `PALPATE_ABI` of the header. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn palpate_abi() -> u32 {
    PALPATE_ABI
}

/// Returns the version of the library, such as "0.1.0". The text stays valid until the program ends. Any thread.
#[unsafe(no_mangle)]
pub extern "C" fn palpate_version() -> *const c_char {
    const VERSION: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
        Ok(version) => version,
        Err(_) => c"",
    };
    VERSION.as_ptr()
}
