//! Threads and clips of a session: laid, changed, cut and listed.

use palpate_proto::geometry::vector;
use palpate_proto::pb;
use pb::tie::Kind;

use crate::axes::{palpate_axes, palpate_vector};
use crate::error::{CodedError, PALPATE_BUFFER, at, at_mut, guard, palpate_result};
use crate::options::{Versioned, init, options_at};
use crate::server::palpate_session;

/// Options of `palpate_session_thread` and `palpate_session_clip`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_tie_options {
    /// Size of this structure, set by `palpate_tie_options_init`.
    pub size: usize,
    /// The tool that lays it; default 0. The session's handle acquires it, and holds it until `palpate_session_release` or
    /// `palpate_session_free`: choose one that none of your loops moves.
    pub tool: u32,
    /// Axes of the bites, one of `palpate_axes`; default `PALPATE_AXES_OWN`.
    pub axes: u32,
    /// The places at which it holds the tissue, in its frame, in their order: 2 to 16 for a thread, 2 for a clip. Each is the place of the
    /// surface at rest that is nearest. They are copied.
    pub bites: *const palpate_vector,
    /// Number of bites.
    pub bite_count: usize,
    /// Radius of the disc over which the force at a bite is spread, m; default 0.001.
    pub bite_radius_m: f64,
    /// Of a thread: its length from the first bite to the last, m. It is drawn in at its last bite, by at most 0.1 m/s.
    pub length_m: f64,
    /// Of a thread: coefficient of friction with the tissue, 0 (default) to 10.
    pub friction: f64,
    /// Tension at which a thread breaks, or force at which a clip opens, N; 0 (default): never.
    pub strength_n: f64,
}

/// A thread or clip of a session.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_tie {
    /// Its number.
    pub number: u32,
    /// 1 for a clip, 0 for a thread.
    pub is_clip: u32,
    /// Present length of the thread, m; of a clip how far it is from being closed.
    pub length_m: f64,
    /// Sum of the distances between successive bites, m.
    pub path_m: f64,
    /// The largest tension between two bites in the last step, N.
    pub tension_n: f64,
    /// 1 if it has broken and no longer holds anything, else 0.
    pub is_broken: u32,
}

/// Largest number of bites that are read.
const MAX_BITES: usize = 16;

// SAFETY: it begins with `size` and has no owner.
unsafe impl Versioned for palpate_tie_options {
    fn initial() -> Self {
        palpate_tie_options {
            size: size_of::<Self>(),
            tool: 0,
            axes: palpate_axes::default() as u32,
            bites: std::ptr::null(),
            bite_count: 0,
            bite_radius_m: 0.001,
            length_m: 0.0,
            friction: 0.0,
            strength_n: 0.0,
        }
    }
}

impl palpate_tie_options {
    /// # Safety
    /// `bites` must be null or valid for `bite_count` places.
    unsafe fn bites(&self) -> Result<Vec<pb::Bite>, CodedError> {
        if self.bites.is_null() || self.bite_count > MAX_BITES {
            let why = format!("bites is null, or bite_count is {}: must be at most {MAX_BITES}", self.bite_count);
            return Err(CodedError::argument(why));
        }
        let axes = palpate_axes::of(self.axes)?;
        // SAFETY: the caller's promise.
        let places = unsafe { std::slice::from_raw_parts(self.bites, self.bite_count) };
        let bite =
            |place: &palpate_vector| pb::Bite { place_m: vector(axes.to_m(*place)), radius_m: self.bite_radius_m };
        Ok(places.iter().map(bite).collect())
    }

    fn strength_n(&self) -> Option<f64> {
        (self.strength_n != 0.0).then_some(self.strength_n)
    }
}

/// Sets all options to their defaults; `size` is `sizeof *options`. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_tie_options_init(options: *mut palpate_tie_options, size: usize) -> palpate_result {
    // SAFETY: the caller's promise.
    unsafe { init(options, size) }
}

/// Lays thread `number`, a number below the server's limit of 64 that threads and clips of the session share; from the next step on. If a
/// thread with this number has these bites already, only its length, friction and strength change; else it is laid anew. It stays until it
/// is cut. Returns `PALPATE_REFUSED` also if another caller or a loop holds the tool. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_thread(
    session: *const palpate_session,
    number: u32,
    options: *const palpate_tie_options,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, options) = unsafe { (at(session, "session is null")?, options_at(options)?) };
        // SAFETY: the caller's promise.
        let bites = unsafe { options.bites() }?;
        let (length_m, friction, strength_n) = (options.length_m, options.friction, options.strength_n());
        let thread = pb::Thread { bites, length_m, friction, strength_n };
        session.shared.wait(session.tools.clone().thread(options.tool, number, thread))
    })
}

/// Closes clip `number` on two bites, and holds them together; otherwise as `palpate_session_thread`. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_clip(
    session: *const palpate_session,
    number: u32,
    options: *const palpate_tie_options,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, options) = unsafe { (at(session, "session is null")?, options_at(options)?) };
        // SAFETY: the caller's promise.
        let clip = pb::Clip { bites: unsafe { options.bites() }?, strength_n: options.strength_n() };
        session.shared.wait(session.tools.clone().clip(options.tool, number, clip))
    })
}

/// Cuts thread or clip `number` by a tool, and takes it out; without effect if there is none. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_untie(
    session: *const palpate_session,
    tool: u32,
    number: u32,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        let session = unsafe { at(session, "session is null") }?;
        session.shared.wait(session.tools.clone().untie(tool, number))
    })
}

/// Releases a tool that the session's handle holds; threads and clips stay. Without effect if it does not hold it. Any thread; waits for the
/// server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_release(session: *const palpate_session, tool: u32) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        let session = unsafe { at(session, "session is null") }?;
        session.shared.wait(session.tools.clone().release(tool))
    })
}

/// Writes the threads and clips of the session, of all its users, by ascending number, and into `count` how many there are. `ties` may be
/// null. Returns `PALPATE_BUFFER` if `capacity` of them are too few. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_ties(
    session: *const palpate_session,
    ties: *mut palpate_tie,
    capacity: usize,
    count: *mut usize,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, count) = unsafe { (at(session, "session is null")?, at_mut(count, "count is null")?) };
        let laid = session.get()?.ties;
        *count = laid.len();
        if ties.is_null() {
            return Ok(());
        }
        if laid.len() > capacity {
            return Err(CodedError::new(PALPATE_BUFFER, format!("there are {} threads and clips", laid.len())));
        }
        for (index, laid) in laid.into_iter().enumerate() {
            // SAFETY: the caller's promise; it fits.
            unsafe { ties.add(index).write(laid.into()) };
        }
        Ok(())
    })
}

impl From<pb::LaidTie> for palpate_tie {
    fn from(laid: pb::LaidTie) -> Self {
        let pb::LaidTie { tie, length_m, path_m, tension_n, broken } = laid;
        let tie = tie.unwrap_or_default();
        let is_clip = u32::from(matches!(tie.kind, Some(Kind::Clip(_))));
        palpate_tie { number: tie.number, is_clip, length_m, path_m, tension_n, is_broken: u32::from(broken) }
    }
}
