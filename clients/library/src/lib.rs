//! Clients of a Palpate server.
//!
//! - [`connect`]: connections, plain or TLS, with the caller's credentials, time limits, and errors in words.
//! - [`fleet`]: finds the server of a fleet that has a session; [`followed`]: follows one session from server to
//!   server.
//! - [`held_tools`]: tools that are held by calls, by which threads and clips are laid.
//! - [`touch`]: the haptic stream, for programs that send commands and render forces themselves.
//! - [`datagrams`]: the datagrams of such a stream, where one lost packet does not delay the next.
//! - [`device`] and [`bridge`]: the trait of haptic devices, and the loop that connects one to a server at 1 kHz.
//! - [`devices`]: devices of several makers, loaded at run time, and the placement of their workspace over the
//!   tissue.
//! - [`snapshot`]: receives snapshots of sessions; [`upload`]: sends meshes and journals.
//! - [`surface_view`]: the surface of a session as an engine shows it: positions, normals, triangles, burns.
//! - [`os`]: what depends on the operating system.
//! - [`watch`]: the samples of a session, without a tool.
//! - [`view`]: the frames of a session: how its surface moves.
//!
//! The messages are those of the crate `palpate-proto`, which also has clients for the calls that need no help: they
//! take a [`Channel`]. Rendering of forces and its safety limits are in the crate `palpate-haptics`.
//!
//! # Example
//!
//! Touches a new session of the scene `liver` with a device, until the program is interrupted:
//!
//! ```no_run
//! use palpate_client::bridge::{Options, SessionChoice, Target};
//! use palpate_client::{Credentials, HapticDevice, Server};
//! use palpate_haptics::Tip;
//!
//! async fn touch(device: impl HapticDevice + 'static) -> Result<(), palpate_client::Error> {
//!     let target = Target {
//!         server: Server::new("https://server.example:7117", &Credentials::default())?,
//!         session: SessionChoice::New { scene: "liver".to_owned() },
//!         tool: 0,
//!         tip: Tip::default(),
//!         deadband: 0.0,
//!         up_deadband: 0.0,
//!         datagrams: true,
//!         holder: "my program".to_owned(),
//!     };
//!     let (_device, report) = palpate_client::bridge::run(device, target, Options::default(), std::future::pending()).await?;
//!     println!("{} connections, {} late ticks", report.traffic.connections, report.late_ticks);
//!     Ok(())
//! }
//! ```

// Clients live in real time; the rule is for what a server computes.
#![allow(clippy::disallowed_methods)]

pub mod bridge;
pub mod connect;
pub mod datagrams;
pub mod device;
pub mod devices;
mod exchange;
pub mod fleet;
pub mod followed;
pub mod held_tools;
pub mod os;
pub mod snapshot;
mod surface_burns;
pub mod surface_view;
pub mod touch;
pub mod upload;
pub mod view;
pub mod watch;

pub use connect::{Channel, Credentials, Server, Token, describe};
pub use device::{HapticDevice, Reading};
pub use followed::Followed;
pub use held_tools::HeldTools;
pub use touch::Touch;

use palpate_refusal::printable::printable;

/// An error of this library. Its text is one line without control characters, whatever a server has put into it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// An argument is not valid. Nothing was sent.
    #[error("{}", printable(.0))]
    Argument(String),
    /// The server can't be reached in time, the connection broke, or the server violates the protocol.
    #[error("{}", printable(.0))]
    Connection(String),
    /// The server refused a call, or the connection broke during it: the status then has a source.
    #[error("{}", describe(.0))]
    Call(#[from] tonic::Status),
    /// The device can't be opened, read or written, or no thread can be started for it.
    #[error("the device: {}", printable(.0))]
    Device(#[from] std::io::Error),
    /// A panic in this library or in the device's code.
    #[error("internal error ({})", printable(.0))]
    Internal(String),
}

impl Error {
    /// Returns whether the server rejects the caller's credentials or role.
    pub(crate) fn is_denied(&self) -> bool {
        use tonic::Code::{PermissionDenied, Unauthenticated};
        matches!(self, Error::Call(status) if [Unauthenticated, PermissionDenied].contains(&status.code()))
    }

    /// Returns whether an input was refused, by this library ([`Error::Argument`]) or by the server
    /// (`INVALID_ARGUMENT`, `NOT_FOUND`): an equal call would be refused again. Missing rights are no refusal in this
    /// sense.
    pub fn is_refusal(&self) -> bool {
        match self {
            Error::Argument(_) => true,
            Error::Call(status) => matches!(status.code(), tonic::Code::InvalidArgument | tonic::Code::NotFound),
            Error::Connection(_) | Error::Device(_) | Error::Internal(_) => false,
        }
    }
}
