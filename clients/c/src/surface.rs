//! The newest surface of a session, written into the caller's buffers.

use std::sync::Arc;

use palpate_client::fleet;
use palpate_client::surface_view::ShownSurface;
use palpate_proto::pb;
use pb::session_service_client::SessionServiceClient;

use crate::axes::palpate_axes;
use crate::error::{CodedError, PALPATE_BUFFER, PALPATE_CONNECTION, at, at_mut, guard, palpate_result};
use crate::options::{options_at, palpate_surface_options};
use crate::server::{Connected, free, palpate_session};
use crate::touch::Exclusive;

/// The surface of a session, which follows its newest frame, from `palpate_surface_open` to `palpate_surface_free`.
pub struct palpate_surface {
    axes: palpate_axes,
    vertices: usize,
    seen: Exclusive<SurfaceObservation>,
    // Declared last: dropped after what runs on it.
    _shared: Arc<Connected>,
}

/// The state of the surface that the caller has read last.
struct SurfaceObservation {
    shown: ShownSurface,
    position_m: Vec<[f32; 3]>,
    normal: Vec<[f32; 3]>,
}

/// The size of a surface, for allocating its buffers. It never changes.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct palpate_surface_size {
    /// Number of vertices.
    pub vertices: usize,
    /// Number of indices: three per triangle.
    pub indices: usize,
    /// 1 if the vertices have texture coordinates, else 0.
    pub has_uv: u32,
}

/// The buffers to write a surface to.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct palpate_buffers {
    /// x, y, z of the first vertex; null: positions are not written.
    pub positions: *mut f32,
    /// Bytes from one vertex to the next: 12 or more.
    pub positions_stride: usize,
    /// x, y, z of the first vertex' normal; null: normals are not written.
    pub normals: *mut f32,
    /// Bytes from one normal to the next: 12 or more.
    pub normals_stride: usize,
    /// Number of vertices for which there is room.
    pub vertices: usize,
    /// 1: write every vertex; 0: only those that have changed since the last call, for buffers that keep the others.
    pub everything: u32,
}

/// The range of vertices that was written, and the moment that they show.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_dirty {
    /// Index of the first vertex that was written.
    pub first: usize,
    /// Number of vertices that were written; 0 if nothing has changed.
    pub count: usize,
    /// Number of frames received from the server; 0: the surface is at rest.
    pub frames: u64,
    /// Number of steps that the session had done.
    pub step: u64,
    /// Simulated time, s.
    pub simulation_time_s: f64,
}

/// Gets the surface of a session and starts to watch it. `options` may be null. Writes a handle for
/// `palpate_surface_free`, or null after an error. Once the connection breaks, the surface stays as it is: open
/// another. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_surface_open(
    session: *const palpate_session,
    options: *const palpate_surface_options,
    surface: *mut *mut palpate_surface,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, options, out) =
            unsafe { (at(session, "session is null")?, options_at(options)?, at_mut(surface, "surface is null")?) };
        *out = std::ptr::null_mut();
        let axes = palpate_axes::of(options.axes)?;
        if !(options.rate_hz > 0.0 && options.rate_hz.is_finite()) {
            return Err(CodedError::argument("rate_hz must be above 0"));
        }
        let shared = session.shared.clone();
        let opening = async {
            let request = pb::GetSessionRequest { session_id: session.session_id.clone() };
            // Another server of a fleet may have the session.
            let at = fleet::follow_from(&shared.server, shared.channel.clone(), |channel| {
                let request = request.clone();
                async move { SessionServiceClient::new(channel).get_session(request).await }
            });
            ShownSurface::open(at.await?.channel, &session.session_id, options.refinement, options.rate_hz).await
        };
        let shown = shared.wait(opening)?;
        let (position_m, normal) = shown.read(|moment| (moment.position_m.clone(), moment.normal.clone()));
        let vertices = position_m.len();
        let seen = Exclusive::new(SurfaceObservation { shown, position_m, normal });
        *out = Box::into_raw(Box::new(palpate_surface { axes, vertices, seen, _shared: shared }));
        Ok(())
    })
}

/// Writes the size of the surface. One thread at a time. Never waits.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_surface_size_of(
    surface: *const palpate_surface,
    size: *mut palpate_surface_size,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (surface, out) = unsafe { (at(surface, "surface is null")?, at_mut(size, "size is null")?) };
        *out = surface.seen.with(|seen| {
            let mesh = seen.shown.mesh();
            palpate_surface_size {
                vertices: mesh.rest_m.len(),
                indices: 3 * mesh.triangles.len(),
                has_uv: u32::from(!mesh.texture.is_empty()),
            }
        })?;
        Ok(())
    })
}

/// Writes all indices, three per triangle, in the order that the engine of these axes takes for the front. They
/// never change. Returns `PALPATE_BUFFER` if `capacity`, in indices, is below `palpate_surface_size.indices`. One
/// thread at a time. Never waits.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_surface_indices(
    surface: *const palpate_surface,
    indices: *mut u32,
    capacity: usize,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let surface = unsafe { at(surface, "surface is null") }?;
        // SAFETY: the caller's promises.
        unsafe { at(indices, "indices is null") }?;
        surface.seen.with(|seen| {
            let triangles = &seen.shown.mesh().triangles;
            if capacity < 3 * triangles.len() {
                return Err(CodedError::new(PALPATE_BUFFER, "there are more indices: see palpate_surface_size_of"));
            }
            for (k, [a, b, c]) in triangles.iter().copied().enumerate() {
                let corners = if surface.axes.is_clockwise() { [a, c, b] } else { [a, b, c] };
                // SAFETY: it fits.
                unsafe { indices.add(3 * k).cast::<[u32; 3]>().write_unaligned(corners) };
            }
            Ok(())
        })?
    })
}

/// Writes u and v of each vertex, `stride` bytes (8 or more) apart. They never change. Returns `PALPATE_ARGUMENT`
/// if the surface has none, and `PALPATE_BUFFER` if `vertices`, for which there is room, is below that of the
/// surface. One thread at a time. Never waits.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_surface_uv(
    surface: *const palpate_surface,
    uv: *mut f32,
    stride: usize,
    vertices: usize,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let surface = unsafe { at(surface, "surface is null") }?;
        // SAFETY: the caller's promises.
        unsafe { at(uv, "uv is null") }?;
        surface.seen.with(|seen| {
            let texture = &seen.shown.mesh().texture;
            if texture.is_empty() {
                return Err(CodedError::argument("the surface has no texture coordinates"));
            }
            if stride < 8 {
                return Err(CodedError::argument("stride must be 8 bytes or more"));
            }
            if vertices < texture.len() {
                return Err(CodedError::new(PALPATE_BUFFER, "there are more vertices: see palpate_surface_size_of"));
            }
            for (k, [u, v]) in texture.iter().copied().enumerate() {
                let v = if surface.axes.has_top_first() { 1.0 - v } else { v };
                // SAFETY: it fits.
                unsafe { uv.cast::<u8>().add(stride * k).cast::<[f32; 2]>().write_unaligned([u, v]) };
            }
            Ok(())
        })?
    })
}

/// Writes the newest positions and normals, and which vertices were written. Never waits, neither for the server nor
/// for another thread. Returns `PALPATE_CONNECTION` if no more will arrive: the last ones are written all the
/// same, and `palpate_last_error` describes why; `PALPATE_BUFFER` if `buffers` has room for fewer vertices than
/// the surface has; and `PALPATE_ARGUMENT` for a stride below 12. One thread at a time.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_surface_read(
    surface: *const palpate_surface,
    buffers: *const palpate_buffers,
    dirty: *mut palpate_dirty,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (surface, buffers, dirty) = unsafe {
            (at(surface, "surface is null")?, at(buffers, "buffers is null")?, at_mut(dirty, "dirty is null")?)
        };
        *dirty = palpate_dirty::default();
        for (buffer, stride) in
            [(buffers.positions, buffers.positions_stride), (buffers.normals, buffers.normals_stride)]
        {
            if !buffer.is_null() && stride < 12 {
                return Err(CodedError::argument("a stride must be 12 bytes or more"));
            }
        }
        if buffers.vertices < surface.vertices {
            return Err(CodedError::new(PALPATE_BUFFER, format!("the surface has {} vertices", surface.vertices)));
        }
        surface.seen.with(|seen| {
            *dirty = seen.take(buffers.everything != 0);
            for k in dirty.first..dirty.first + dirty.count {
                #[allow(clippy::cast_possible_truncation)]
                let units_per_m = surface.axes.units_per_m() as f32;
                let position = surface.axes.turn(seen.position_m[k]).map(|part| units_per_m * part);
                let normal = surface.axes.turn(seen.normal[k]);
                for (buffer, stride, value) in [
                    (buffers.positions, buffers.positions_stride, position),
                    (buffers.normals, buffers.normals_stride, normal),
                ] {
                    if !buffer.is_null() {
                        // SAFETY: it fits.
                        unsafe { buffer.cast::<u8>().add(stride * k).cast::<[f32; 3]>().write_unaligned(value) };
                    }
                }
            }
            seen.shown.lost().map_or(Ok(()), |why| Err(CodedError::new(PALPATE_CONNECTION, why.to_owned())))
        })?
    })
}

/// Writes how burnt each vertex is by cautery (`palpate_touch_options.burn_s`): the time of contact divided by that in which it burns through,
/// 0 to 1. The values are `stride` bytes (4 or more) apart. Writes into `version` the version of what is burnt: 0 before anything is, and
/// larger after each change; one of both pointers may be null. Burns come a round trip after the frame that shows the tissue of their moment. Returns
/// `PALPATE_BUFFER` if `vertices`, for which there is room, is below that of the surface. One thread at a time. Never waits.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_surface_burns(
    surface: *const palpate_surface,
    burns: *mut f32,
    stride: usize,
    vertices: usize,
    version: *mut u32,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let surface = unsafe { at(surface, "surface is null") }?;
        if burns.is_null() && version.is_null() {
            return Err(CodedError::argument("burns and version are null"));
        }
        if !burns.is_null() && stride < 4 {
            return Err(CodedError::argument("stride must be 4 bytes or more"));
        }
        if !burns.is_null() && vertices < surface.vertices {
            return Err(CodedError::new(PALPATE_BUFFER, format!("the surface has {} vertices", surface.vertices)));
        }
        surface.seen.with(|seen| {
            let newest = seen.shown.burns();
            if !version.is_null() {
                // SAFETY: the caller's promise.
                unsafe { version.write(newest.version) };
            }
            if !burns.is_null() {
                for (k, burn) in newest.burn.iter().enumerate() {
                    // SAFETY: it fits.
                    unsafe { burns.cast::<u8>().add(stride * k).cast::<f32>().write_unaligned(*burn) };
                }
            }
        })
    })
}

impl SurfaceObservation {
    /// Takes the newest moment; returns which vertices to write.
    fn take(&mut self, everything: bool) -> palpate_dirty {
        let is_new = self.shown.refresh();
        let SurfaceObservation { shown, position_m, normal, .. } = self;
        shown.read(|moment| {
            let (mut first, mut end) = (position_m.len(), 0);
            if is_new {
                for k in 0..position_m.len() {
                    if position_m[k] != moment.position_m[k] || normal[k] != moment.normal[k] {
                        (first, end) = (first.min(k), k + 1);
                        (position_m[k], normal[k]) = (moment.position_m[k], moment.normal[k]);
                    }
                }
            }
            if everything {
                (first, end) = (0, position_m.len());
            }
            palpate_dirty {
                first: first.min(end),
                count: end.saturating_sub(first),
                frames: moment.frames,
                step: moment.step,
                simulation_time_s: moment.simulation_time_s,
            }
        })
    }
}

/// Frees a handle. Null is allowed. Any thread, once, when no other thread is in a function of this handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_surface_free(surface: *mut palpate_surface) {
    // SAFETY: the caller's promise.
    guard(|| unsafe { free(surface) });
}
