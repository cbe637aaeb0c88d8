/* libpalpate: touch soft tissue on a Palpate server, from C. Made by cbindgen from clients/c/src: change it there, then
 * `make header`.
 *
 * Rules that hold for every function:
 * - Most return a `palpate_result`: 0, or why they did nothing. `palpate_last_error` says it in words, for this thread.
 * - Texts are UTF-8 and end with a zero byte. Lengths are in metres and forces in newtons unless axes say otherwise.
 * - A handle may be used from any thread, also from several at once, unless the function says otherwise. After its `_free` or
 *   `_end` it must not be used. Handles keep alive what they were made from: free them in any order.
 * - Structures for options begin with their size: fill them by their `_init`, then change what you need. A later version of the
 *   library may add fields at their end.
 * - Nothing throws, unwinds or ends the program, whatever the arguments are; pointers must be null or valid. */

#ifndef PALPATE_H
#define PALPATE_H

#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

/**
 * The version of the interface. A change that breaks programs raises it, and the number in the library's file name.
 */
#define PALPATE_ABI 0

/**
 * Why a function did nothing.
 */
typedef enum palpate_result {
  /**
   * It did what it says.
   */
  PALPATE_OK = 0,
  /**
   * An argument is not valid: a null pointer, a number that is not finite or out of range, a text that is no UTF-8.
   */
  PALPATE_ARGUMENT = 1,
  /**
   * The server can't be reached, or the connection broke.
   */
  PALPATE_CONNECTION = 2,
  /**
   * The server refused the call: no such scene, no right to it, a value out of its range.
   */
  PALPATE_REFUSED = 3,
  /**
   * The device can't be read or written.
   */
  PALPATE_DEVICE = 4,
  /**
   * The buffer is too small.
   */
  PALPATE_BUFFER = 5,
  /**
   * Another thread is in a function that only one thread at a time may call.
   */
  PALPATE_BUSY = 6,
  /**
   * A fault of the library, or of the code that it called. The handle may be unusable from now on.
   */
  PALPATE_INTERNAL = 7,
} palpate_result;

/**
 * Axes and unit of positions, normals and forces.
 */
typedef enum palpate_axes {
  /**
   * Palpate's own: right-handed, x to the right, y away, z up; metres.
   */
  PALPATE_AXES_OWN = 0,
  /**
   * Unity's: left-handed, x to the right, y up, z away; metres. Triangles are clockwise from outside.
   */
  PALPATE_AXES_UNITY = 1,
  /**
   * Unreal's: left-handed, x away, y to the right, z up; centimetres. Textures begin at the top.
   */
  PALPATE_AXES_UNREAL = 2,
} palpate_axes;

/**
 * Whether forces are rendered.
 */
typedef enum palpate_state {
  /**
   * There was no connection yet.
   */
  PALPATE_STATE_WAITING = 0,
  /**
   * Nothing is rendered until `enable` goes from 0 to 1. Also if it has, until the first news of the tissue.
   */
  PALPATE_STATE_DISABLED = 1,
  /**
   * Rendering, or beginning to.
   */
  PALPATE_STATE_ENABLED = 2,
  /**
   * Nothing came from the server for too long, or no tick came. Nothing is rendered until `enable` goes from 0 to 1.
   */
  PALPATE_STATE_PAUSED = 3,
  /**
   * The tool was outside the workspace, or a number was not finite. Nothing is rendered until `enable` goes from 0 to 1.
   */
  PALPATE_STATE_FAULT = 4,
} palpate_state;

/**
 * With which priority the loop runs.
 */
typedef enum palpate_priority {
  /**
   * As all threads.
   */
  PALPATE_PRIORITY_USUAL = 0,
  /**
   * Before all that are not of real time.
   */
  PALPATE_PRIORITY_REAL_TIME = 1,
  /**
   * Real time was asked for and the system did not allow it; `warn` said why.
   */
  PALPATE_PRIORITY_REFUSED = 2,
} palpate_priority;

/**
 * The loop of a device.
 */
typedef struct palpate_bridge palpate_bridge;

/**
 * A connection to a server. Any thread, also several at once.
 */
typedef struct palpate_server palpate_server;

/**
 * A session: one tissue in use. Any thread, also several at once.
 */
typedef struct palpate_session palpate_session;

/**
 * The surface of a session.
 */
typedef struct palpate_surface palpate_surface;

/**
 * A tool that your loop leads.
 */
typedef struct palpate_touch palpate_touch;

/**
 * What a haptic device can bear. No force goes beyond it, nor beyond 3.3 N.
 */
typedef struct palpate_limits {
  /**
   * N.
   */
  double max_force_n;
  /**
   * For longer than 2 s, N.
   */
  double continuous_force_n;
  /**
   * N/m.
   */
  double max_stiffness_n_per_m;
  /**
   * N·s/m.
   */
  double max_damping_n_s_per_m;
  /**
   * Radius of the workspace around the middle of the tissue, m. Outside it nothing is rendered.
   */
  double workspace_radius_m;
} palpate_limits;

/**
 * Three components, in the axes that were asked for.
 */
typedef struct palpate_vector {
  /**
   * The first component.
   */
  double x;
  /**
   * The second.
   */
  double y;
  /**
   * The third.
   */
  double z;
} palpate_vector;

/**
 * What a device reports.
 */
typedef struct palpate_reading {
  /**
   * In the axes and frame of `palpate_touch_options`.
   */
  struct palpate_vector position;
  /**
   * The operator asks for forces, by a button or pedal. Only a change from 0 to another value enables them.
   */
  uint32_t enable;
} palpate_reading;

/**
 * A device of your own. The functions are called by one thread of the library, a thousand times a second: first `read`, then
 * `write`. Both must return within a fraction of a millisecond, and return 0, or anything else if the device fails, which
 * ends the loop. At its end, whatever the cause, `write` gets a force of zero.
 */
typedef struct palpate_device {
  /**
   * Is handed to the functions.
   */
  void *user;
  /**
   * Writes what the device can bear. Called once, before the loop begins, by the thread that begins it.
   */
  int32_t (*descriptor)(void *user, struct palpate_limits *limits);
  /**
   * Writes where the device is, in the axes of the options; its origin is the middle of its workspace.
   */
  int32_t (*read)(void *user, struct palpate_reading *reading);
  /**
   * Renders a force until the next tick, N, in the axes of the options.
   */
  int32_t (*write)(void *user, const struct palpate_vector *force_n);
} palpate_device;

/**
 * A function of the caller's that is shown texts for people.
 */
typedef void (*palpate_warn)(void *user, const char *message);

/**
 * How to touch.
 */
typedef struct palpate_touch_options {
  /**
   * Of this structure, as `palpate_touch_options_init` has set it.
   */
  size_t size;
  /**
   * The tool's number; 0.
   */
  uint32_t tool;
  /**
   * One of `palpate_axes`: of positions and forces.
   */
  uint32_t axes;
  /**
   * What positions mean. 0: they are in the device's frame, whose origin lies on the top of the tissue. 1: they are in the
   * tissue's frame, as positions of its surface are.
   */
  uint32_t in_tissue_frame;
  /**
   * The tip holds the tissue, pulling as well as pushing; 0: it touches.
   */
  uint32_t grasps;
  /**
   * Radius of the tip, m; 0.005.
   */
  double tip_radius_m;
  /**
   * Friction coefficient of the tip; 0.2.
   */
  double friction;
  /**
   * What the device can bear; 2 N.
   */
  struct palpate_limits limits;
  /**
   * A sample is sent only when the rendered force would be off by more than this fraction; 0: one per step.
   */
  double deadband;
  /**
   * A position is sent only when the server would be wrong by more than this fraction of the force; 0: one per tick.
   */
  double up_deadband;
  /**
   * Positions and samples go by datagram where the server has them; 1.
   */
  uint32_t datagrams;
  /**
   * Our loop asks the system for real-time priority; 1.
   */
  uint32_t real_time;
  /**
   * Your name, which other users of the server see; null: "libpalpate".
   */
  const char *holder;
  /**
   * Shows a text for people: a warning of the server, a connection that broke. From any thread of the library; it must not
   * wait. Null: nobody is told.
   */
  palpate_warn warn;
  /**
   * Is handed to `warn`.
   */
  void *warn_user;
  /**
   * Of which tissues to keep a copy, which is simulated here, so that forces come without the delay of the network; samples
   * correct them. 0: none; 1: meshes, over whose rims, folds and lumps nothing else knows what comes next; 2: any. A thread
   * of the library steps the copy; a tick takes what that found at the last one, and waits for nothing. 0.
   */
  uint32_t prediction;
} palpate_touch_options;

/**
 * How a loop stands.
 */
typedef struct palpate_bridge_state {
  /**
   * Ticks so far.
   */
  uint64_t ticks;
  /**
   * Where the tool was at the last tick, in the tissue's frame, in the axes of the options.
   */
  struct palpate_vector position;
  /**
   * The force that was rendered, N.
   */
  struct palpate_vector force_n;
  /**
   * One of `palpate_state`.
   */
  uint32_t state;
  /**
   * One of `palpate_priority`.
   */
  uint32_t priority;
  /**
   * 1 if the loop has ended: `palpate_bridge_end` says why.
   */
  uint32_t is_over;
} palpate_bridge_state;

/**
 * What a loop has done.
 */
typedef struct palpate_bridge_report {
  /**
   * Ticks.
   */
  uint64_t ticks;
  /**
   * Ticks that began more than a millisecond late.
   */
  uint64_t late_ticks;
  /**
   * Ticks that were left out.
   */
  uint64_t missed_ticks;
  /**
   * Connections that were opened.
   */
  uint64_t connections;
  /**
   * Samples that came.
   */
  uint64_t samples;
  /**
   * Positions that went.
   */
  uint64_t positions;
  /**
   * One of `palpate_priority`.
   */
  uint32_t priority;
  /**
   * Why it has ended, one of `palpate_result`: 0 if you have ended it.
   */
  uint32_t result;
} palpate_bridge_report;

/**
 * How to connect.
 */
typedef struct palpate_connect_options {
  /**
   * Of this structure, as `palpate_connect_options_init` has set it.
   */
  size_t size;
  /**
   * Your token, or null. It is sent only over TLS or to this machine.
   */
  const char *token;
  /**
   * Certificates (PEM) to trust in place of the system's, or null.
   */
  const char *ca_pem;
  /**
   * The name that the server's certificate must carry if it is not the URL's host, or null.
   */
  const char *tls_name;
  /**
   * Your certificate (PEM), or null.
   */
  const char *certificate_pem;
  /**
   * Its private key (PEM), or null.
   */
  const char *key_pem;
  /**
   * Time for each call, s; 60: a session of an organ takes the server some seconds. For the connection 10 at most.
   */
  double timeout_s;
} palpate_connect_options;

/**
 * Which surface to show.
 */
typedef struct palpate_surface_options {
  /**
   * Of this structure, as `palpate_surface_options_init` has set it.
   */
  size_t size;
  /**
   * One of `palpate_axes`.
   */
  uint32_t axes;
  /**
   * So many vertices are put between neighbouring points; 0 to 10; 0.
   */
  uint32_t refinement;
  /**
   * Frames a second; 60.
   */
  double rate_hz;
} palpate_surface_options;

/**
 * The box around a tissue at rest, in Palpate's own axes, m.
 */
typedef struct palpate_extent {
  /**
   * Its corner with the least coordinates.
   */
  struct palpate_vector least_m;
  /**
   * Its corner with the greatest.
   */
  struct palpate_vector most_m;
  /**
   * Its middle.
   */
  struct palpate_vector middle_m;
  /**
   * The highest place of the surface in line with its middle: positions of devices begin there.
   */
  struct palpate_vector top_m;
} palpate_extent;

/**
 * A change of the tissue under way. Not a number: it stays as it is.
 */
typedef struct palpate_change {
  /**
   * Of structural springs, N/m.
   */
  double stiffness_n_per_m;
  /**
   * N·s/m.
   */
  double damping_n_s_per_m;
  /**
   * Of anchor springs, N/m.
   */
  double anchor_stiffness_n_per_m;
  /**
   * Of the volume of a closed mesh, Pa.
   */
  double volume_stiffness_pa;
} palpate_change;

/**
 * How large a surface is.
 */
typedef struct palpate_surface_size {
  /**
   * Vertices; they never become others.
   */
  size_t vertices;
  /**
   * Indices: three for each triangle.
   */
  size_t indices;
  /**
   * 1 if the vertices have texture coordinates.
   */
  uint32_t has_uv;
} palpate_surface_size;

/**
 * Where to write a surface.
 */
typedef struct palpate_buffers {
  /**
   * x, y, z of the first vertex; null: they are not wanted.
   */
  float *positions;
  /**
   * Bytes from one vertex to the next: 12 or more.
   */
  size_t positions_stride;
  /**
   * x, y, z of the first vertex' normal; null: they are not wanted.
   */
  float *normals;
  /**
   * Bytes from one to the next: 12 or more.
   */
  size_t normals_stride;
  /**
   * For how many vertices there is room.
   */
  size_t vertices;
  /**
   * Write every vertex; 0: only those that have changed since the last time, for buffers that keep the others.
   */
  uint32_t everything;
} palpate_buffers;

/**
 * What was written.
 */
typedef struct palpate_dirty {
  /**
   * The first vertex that was written.
   */
  size_t first;
  /**
   * How many from there on; 0 if nothing has changed.
   */
  size_t count;
  /**
   * Frames that have come from the server; 0: the surface at rest.
   */
  uint64_t frames;
  /**
   * Steps that the session had done.
   */
  uint64_t step;
  /**
   * Its time, s.
   */
  double simulation_time_s;
} palpate_dirty;

/**
 * What a tick tells.
 */
typedef struct palpate_felt {
  /**
   * The force on the hand until the next tick, N.
   */
  struct palpate_vector force_n;
  /**
   * One of `palpate_state`.
   */
  uint32_t state;
  /**
   * 1 if the connection has ended for good.
   */
  uint32_t is_over;
  /**
   * How old the newest news of the tissue is, s; negative before the first.
   */
  double age_s;
} palpate_felt;

/**
 * What went over the network.
 */
typedef struct palpate_traffic {
  /**
   * Connections that were opened.
   */
  uint64_t connections;
  /**
   * Attempts that failed, and connections that broke.
   */
  uint64_t failed;
  /**
   * Samples that came.
   */
  uint64_t samples;
  /**
   * Positions that went.
   */
  uint64_t positions;
  /**
   * 1 while a connection stands.
   */
  uint32_t is_connected;
} palpate_traffic;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * Returns the version of the interface that this library has: `PALPATE_ABI` of the header it goes with. Any thread.
 */
uint32_t palpate_abi(void);

/**
 * Returns the version of the library, such as "0.1.0". The text is there for ever. Any thread.
 */
const char *palpate_version(void);

/**
 * Connects a device of your own to a session, on a thread of the library at 1 kHz, with real-time priority where the system
 * allows it. `options` may be null; its `limits` are not used: `descriptor` tells them. Waits for the first connection. Writes a
 * handle for `palpate_bridge_end`. What `device` points at is copied; its `user` must be valid until the end. Any thread;
 * waits for the server.
 */
enum palpate_result palpate_bridge_begin(const struct palpate_session *session,
                                         const struct palpate_device *device,
                                         const struct palpate_touch_options *options,
                                         struct palpate_bridge **bridge);

/**
 * Writes how the loop stands. Any thread.
 */
enum palpate_result palpate_bridge_look(const struct palpate_bridge *bridge, struct palpate_bridge_state *state);

/**
 * Stops rendering until `enable` of a reading goes from 0 to 1 again; the force falls within the next ticks. Any thread, also from
 * a function of the device.
 */
enum palpate_result palpate_bridge_disable(const struct palpate_bridge *bridge);

/**
 * Ends the loop, waits for that, and writes what it has done, also if it has failed; `report` may be null. `PALPATE_DEVICE` if the
 * device has failed: `palpate_last_error` tells how. The handle is given back in any case. Any thread, once; not from a function of the device.
 */
enum palpate_result palpate_bridge_end(struct palpate_bridge *bridge,
                                       struct palpate_bridge_report *report);

/**
 * Returns the words of this thread's last error; empty before the first. They stay until another call of this thread
 * fails.
 */
const char *palpate_last_error(void);

/**
 * Fills in what holds if you change nothing; `size` is `sizeof *options`. Any thread.
 */
enum palpate_result palpate_connect_options_init(struct palpate_connect_options *options, size_t size);

/**
 * Fills in what holds if you change nothing; `size` is `sizeof *options`. Any thread.
 */
enum palpate_result palpate_touch_options_init(struct palpate_touch_options *options, size_t size);

/**
 * Fills in what holds if you change nothing; `size` is `sizeof *options`. Any thread.
 */
enum palpate_result palpate_surface_options_init(struct palpate_surface_options *options, size_t size);

/**
 * Returns the limits of a device by its name: touch, omni, desktop, falcon, omega3, delta3, sigma7, lambda7, inverse3.
 * Any thread.
 */
enum palpate_result palpate_limits_of(const char *name, struct palpate_limits *limits);

/**
 * Connects to the server at `url`, such as "http://127.0.0.1:7117". `options` may be null. Waits for its first answer, for 10 s
 * at most. Writes a handle for `palpate_server_free`. Any thread.
 */
enum palpate_result palpate_connect(const char *url,
                                    const struct palpate_connect_options *options,
                                    struct palpate_server **server);

/**
 * Closes a connection when nothing that was made from it is left. Null is allowed. Any thread, once.
 */
void palpate_server_free(struct palpate_server *server);

/**
 * Writes the names of the server's scenes into `names`, a line each, and into `needed` how many bytes that takes; either may be
 * null. `PALPATE_BUFFER` if `capacity` bytes are too few. Any thread; waits for the server.
 */
enum palpate_result palpate_scenes(const struct palpate_server *server,
                                   char *names,
                                   size_t capacity,
                                   size_t *needed);

/**
 * Makes a session of a scene that the server has. It runs at once. Nobody deletes it but `palpate_session_delete`, and the
 * server when nobody has used it for long. Writes a handle for `palpate_session_free`. Any thread; waits for the server.
 */
enum palpate_result palpate_session_create(const struct palpate_server *server,
                                           const char *scene_name,
                                           struct palpate_session **session);

/**
 * Returns the same of a scene file of your own (TOML), by its path. The file of its mesh, if it names one, is read
 * where the scene file says, and sent to the server. Any thread; waits for the server.
 */
enum palpate_result palpate_session_create_from_file(const struct palpate_server *server,
                                                     const char *scene_file,
                                                     struct palpate_session **session);

/**
 * Returns the same of the text of a scene file and of a mesh in memory: the `byte_count` bytes of a file (OBJ, STL,
 * PLY, glTF, Gmsh or VTK) that `[mesh]` of the text calls `mesh_name`. The mesh is sent to the server. Any thread;
 * waits for the server.
 */
enum palpate_result palpate_session_create_from_mesh(const struct palpate_server *server,
                                                     const char *scene_text,
                                                     const char *mesh_name,
                                                     const uint8_t *mesh_bytes,
                                                     size_t byte_count,
                                                     struct palpate_session **session);

/**
 * Returns the same of the text of a scene file that names no other file: of a sheet, or of an organ that is generated.
 * Any thread; waits for the server.
 */
enum palpate_result palpate_session_create_from_text(const struct palpate_server *server,
                                                     const char *scene_text,
                                                     struct palpate_session **session);

/**
 * Returns a session that is there already, by its id. Writes a handle for `palpate_session_free`. Any thread; waits
 * for the server.
 */
enum palpate_result palpate_session_join(const struct palpate_server *server,
                                         const char *session_id,
                                         struct palpate_session **session);

/**
 * Writes the session's id, by which others join it, and how many bytes it takes, as `palpate_scenes` does. Any thread.
 */
enum palpate_result palpate_session_id(const struct palpate_session *session,
                                       char *id,
                                       size_t capacity,
                                       size_t *needed);

/**
 * Writes where the tissue rests. Any thread.
 */
enum palpate_result palpate_session_extent(const struct palpate_session *session, struct palpate_extent *extent);

/**
 * Returns a change that changes nothing. Any thread.
 */
enum palpate_result palpate_change_init(struct palpate_change *change);

/**
 * Changes the tissue from the next step on; whoever touches it feels the change. Any thread; waits for the server.
 */
enum palpate_result palpate_session_change(const struct palpate_session *session, const struct palpate_change *change);

/**
 * Deletes the session on the server, for everybody. The handle is still to be freed. Any thread; waits for the server.
 */
enum palpate_result palpate_session_delete(const struct palpate_session *session);

/**
 * Gives a handle back. The session goes on. Null is allowed. Any thread, once.
 */
void palpate_session_free(struct palpate_session *session);

/**
 * Gets the surface of a session and begins to watch it. `options` may be null. Writes a handle for `palpate_surface_free`.
 * Any thread; waits for the server.
 */
enum palpate_result palpate_surface_open(const struct palpate_session *session,
                                         const struct palpate_surface_options *options,
                                         struct palpate_surface **surface);

/**
 * Writes how large the surface is. One thread at a time. Never waits.
 */
enum palpate_result palpate_surface_size_of(const struct palpate_surface *surface, struct palpate_surface_size *size);

/**
 * Writes all indices, three for each triangle, in the order that the axes' engine takes for the front. They never change. One
 * thread at a time. Never waits.
 */
enum palpate_result palpate_surface_indices(const struct palpate_surface *surface,
                                            uint32_t *indices,
                                            size_t capacity);

/**
 * Writes u and v of each vertex, `stride` bytes (8 or more) from one to the next. They never change. `PALPATE_ARGUMENT` if the
 * surface has none. One thread at a time. Never waits.
 */
enum palpate_result palpate_surface_uv(const struct palpate_surface *surface,
                                       float *uv,
                                       size_t stride,
                                       size_t vertices);

/**
 * Writes the newest positions and normals that have come, and which vertices these are. Never waits: not for the server, nor for
 * another thread. `PALPATE_CONNECTION` if no more will come: the last are written all the same, and `palpate_last_error`
 * says why. One thread at a time.
 */
enum palpate_result palpate_surface_read(const struct palpate_surface *surface,
                                         const struct palpate_buffers *buffers,
                                         struct palpate_dirty *dirty);

/**
 * Gives a handle back. Null is allowed. Any thread, once, when no other is in a function of this handle.
 */
void palpate_surface_free(struct palpate_surface *surface);

/**
 * Takes a tool of a session for a loop of your own, such as that of an engine's haptic thread, and waits until it may be used.
 * `options` may be null. From then on call `palpate_touch_tick` a thousand times a second. When the connection breaks, the
 * library connects again. Writes a handle for `palpate_touch_end`. Any thread; waits for the server.
 */
enum palpate_result palpate_touch_begin(const struct palpate_session *session,
                                        const struct palpate_touch_options *options,
                                        struct palpate_touch **touch);

/**
 * Returns a loop over what was recorded, without a server: the same messages, positions and times give the same forces, bit by bit.
 * It has no copy of the tissue, whatever `prediction` says. `options` may be null; `middle_m` is where the middle of the
 * workspace is laid in the tissue (`palpate_extent.top_m`), in Palpate's own axes. Writes a handle for `palpate_touch_end`. Any thread.
 */
enum palpate_result palpate_touch_begin_offline(const struct palpate_touch_options *options,
                                                struct palpate_vector middle_m,
                                                struct palpate_touch **touch);

/**
 * Takes a recorded message, which arrives now: the bytes of a `palpate.v1.TouchResponse`. The next tick knows it. Only of a
 * handle of `palpate_touch_begin_offline`. One thread at a time; it may be another than that of the ticks.
 */
enum palpate_result palpate_touch_arrive(const struct palpate_touch *touch,
                                         const uint8_t *bytes,
                                         size_t count);

/**
 * Gives the force to render from now on, for a device that reports `reading` at `time_s`: seconds of any origin, by a clock that
 * goes on between ticks. Takes a bounded time: no lock, no call of the system, no memory asked for or given back. It may be
 * late, early or left out: forces then fade, and return within the safety envelope. After an error, `felt` has a force of zero.
 * One thread at a time.
 */
enum palpate_result palpate_touch_tick(const struct palpate_touch *touch,
                                       const struct palpate_reading *reading,
                                       double time_s,
                                       struct palpate_felt *felt);

/**
 * Stops rendering until `enable` goes from 0 to 1 again; the force falls within the next ticks. One thread at a time, as for
 * `palpate_touch_tick`.
 */
enum palpate_result palpate_touch_disable(const struct palpate_touch *touch);

/**
 * Writes what went over the network. `PALPATE_CONNECTION` while there is no connection: `palpate_last_error` says why. Any
 * thread; not for the thread of the ticks, as it takes a lock.
 */
enum palpate_result palpate_touch_traffic(const struct palpate_touch *touch,
                                          struct palpate_traffic *traffic);

/**
 * Gives the tool and the handle back. Null is allowed. Any thread, once, when no other is in a function of this handle.
 */
void palpate_touch_end(struct palpate_touch *touch);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* PALPATE_H */
