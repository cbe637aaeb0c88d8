/* Each wrong use results in an error with a message, and nothing worse: `errors URL`. */
#define _POSIX_C_SOURCE 200809L
#include <math.h>
#include <palpate.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static int failures = 0;

/* Checks that a call returned `code`, and that the error message contains `words`. */
static void expect(int line, palpate_result got, palpate_result code, const char *words) {
    const char *said = code == PALPATE_OK ? "" : palpate_last_error();
    if (got != code || (words && !strstr(said, words))) {
        fprintf(stderr, "line %d: code %d, not %d: %s\n", line, (int)got, (int)code, said);
        failures++;
    }
}
#define EXPECT(call, code, words) expect(__LINE__, call, code, words)

static int limits_ok(void *user, palpate_limits *limits) {
    (void)user, (void)limits;
    return 0;
}
static int limits_wrong(void *user, palpate_limits *limits) {
    (void)user;
    limits->max_force_n = NAN;
    return 0;
}
static int read_fails(void *user, palpate_reading *reading) {
    (void)reading;
    /* Fails after some time. */
    return ++*(int *)user > 2000 ? 7 : 0;
}
/* A device above the tissue. It requests forces repeatedly; with `holds`, always. */
static volatile int holds = 0;
static int read_asks(void *user, palpate_reading *reading) {
    reading->position.z = 0.01;
    reading->enable = holds || ++*(int *)user / 50 % 2;
    return 0;
}
static int zero_at_end = 0;
static int write_ok(void *user, const palpate_vector *force_n) {
    (void)user;
    zero_at_end = force_n->x == 0.0 && force_n->y == 0.0 && force_n->z == 0.0;
    return 0;
}

/* A device of six axes above the tissue. Its orientation becomes wrong after a while; with `holds` it does not. */
static int read_turned(void *user, palpate_instrument_reading *reading) {
    reading->position.z = 0.02;
    reading->enable = ++*(int *)user / 50 % 2;
    reading->jaw_rad = 0.5;
    if (!holds && *(int *)user > 2000) reading->orientation.w = 0.5;
    return 0;
}
static int write_turned(void *user, const palpate_vector *force_n, const palpate_vector *torque_n_m) {
    zero_at_end = torque_n_m->x == 0.0 && torque_n_m->y == 0.0 && torque_n_m->z == 0.0;
    int is_zero = zero_at_end;
    write_ok(user, force_n);
    zero_at_end = zero_at_end && is_zero;
    return 0;
}

/* Instruments and hands. */
static void try_instruments(const palpate_session *session, const palpate_session *other_session) {
    palpate_touch *touch = NULL, *second = NULL;
    palpate_bridge *bridge = NULL;
    palpate_touch_options options;
    uint32_t tools = 0;
    EXPECT(palpate_tool_count(NULL, NULL), PALPATE_ARGUMENT, "count is null");
    EXPECT(palpate_tool_count(NULL, &tools), PALPATE_OK, NULL);
    if (tools != 1) failures++, fprintf(stderr, "a single tip is %u tools\n", tools);

    /* Each value is named. */
    EXPECT(palpate_touch_options_init(&options, sizeof options), PALPATE_OK, NULL);
    options.has_port = 1;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "has_port");
    options.has_port = 0;
    options.jaws_m = -0.01;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "jaws_m");
    options.jaws_m = NAN;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "jaws_m");
    options.jaws_m = 0.015;
    options.shaft_m = INFINITY;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "shaft_m");
    options.shaft_m = 0.5;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "tips, above the limit of 64");
    options.shaft_m = 0.02;
    options.tip_radius_m = 0.003;
    options.has_port = 1;
    options.port = (palpate_vector){0.0, NAN, 0.1};
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "port must be finite");
    palpate_extent extent;
    EXPECT(palpate_session_extent(session, &extent), PALPATE_OK, NULL);
    options.port = (palpate_vector){extent.top_m.x, extent.top_m.y - 0.05, extent.top_m.z + 0.1};
    options.handle_m = 0.0;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "handle_m");
    options.handle_m = 0.33;
    options.max_torque_n_m = NAN;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "max_torque_n_m");
    options.max_torque_n_m = 0.4;
    options.grasps = 1;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "grasps");
    options.grasps = 0;
    options.deadband = 0.1;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_ARGUMENT, "deadband");
    options.deadband = 0.0;
    EXPECT(palpate_tool_count(&options, &tools), PALPATE_OK, NULL);
    if (tools < 8 || tools > 20) failures++, fprintf(stderr, "%u tools\n", tools);
    EXPECT(palpate_touch_begin_offline(&options, (palpate_vector){0}, &touch), PALPATE_ARGUMENT, "jaws_m");
    /* A structure of a header that knows no instruments has a single tip. */
    palpate_touch_options older = options;
    older.size = offsetof(palpate_touch_options, jaws_m);
    EXPECT(palpate_tool_count(&older, &tools), PALPATE_OK, NULL);
    if (tools != 1) failures++, fprintf(stderr, "an older structure has %u tools\n", tools);

    /* Hands. */
    palpate_hand *hands[2] = {NULL, NULL};
    EXPECT(palpate_two_hands(NULL, &hands[1]), PALPATE_ARGUMENT, "left is null");
    EXPECT(palpate_two_hands(&hands[0], NULL), PALPATE_ARGUMENT, "right is null");
    EXPECT(palpate_two_hands(&hands[0], &hands[0]), PALPATE_ARGUMENT, "two places");
    EXPECT(palpate_two_hands(&hands[0], &hands[1]), PALPATE_OK, NULL);
    palpate_touch_options single;
    EXPECT(palpate_touch_options_init(&single, sizeof single), PALPATE_OK, NULL);
    single.hand = hands[0];
    EXPECT(palpate_touch_begin_offline(&single, (palpate_vector){0}, &touch), PALPATE_ARGUMENT, "hand");
    options.hand = hands[0];
    options.in_tissue_frame = 1;
    options.limits.workspace_radius_m = 1.0;
    EXPECT(palpate_touch_begin(session, &options, &touch), PALPATE_OK, NULL);
    options.hand = hands[1];
    EXPECT(palpate_touch_begin(other_session, &options, &second), PALPATE_ARGUMENT, "another session");
    options.hand = hands[0];
    EXPECT(palpate_touch_begin(session, &options, &second), PALPATE_ARGUMENT, "used this hand");
    options.hand = NULL;
    EXPECT(palpate_touch_begin(session, &options, &second), PALPATE_REFUSED, NULL); /* The tools are held. */

    /* The shaft passes through the port, whatever the device's orientation. */
    palpate_instrument_reading reading = {{extent.top_m.x, extent.top_m.y, extent.top_m.z + 0.02}, {1.0, 0.0, 0.0, 0.0}, 0.5, 1};
    palpate_instrument_felt felt;
    EXPECT(palpate_touch_tick_instrument(touch, &reading, 0.0, NULL), PALPATE_ARGUMENT, "felt is null");
    EXPECT(palpate_touch_tick_instrument(touch, NULL, 0.0, &felt), PALPATE_ARGUMENT, "reading is null");
    EXPECT(palpate_touch_tick_instrument(touch, &reading, 0.001, &felt), PALPATE_OK, NULL);
    palpate_quaternion q = felt.orientation;
    double shaft[3] = {1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + q.w * q.z), 2.0 * (q.x * q.z - q.w * q.y)};
    double way[3] = {0.0, 0.05, -0.08}, size = sqrt(0.05 * 0.05 + 0.08 * 0.08);
    for (int k = 0; k < 3; k++)
        if (fabs(shaft[k] - way[k] / size) > 1e-9) failures++, fprintf(stderr, "the shaft misses the port: %g\n", shaft[k]);
    palpate_reading plain = {reading.position, 1};
    palpate_felt plain_felt;
    EXPECT(palpate_touch_tick(touch, &plain, 0.002, &plain_felt), PALPATE_OK, NULL);
    reading.orientation.w = 0.0;
    EXPECT(palpate_touch_tick_instrument(touch, &reading, 0.003, &felt), PALPATE_ARGUMENT, "orientation");
    if (felt.state != PALPATE_STATE_FAULT || felt.force_n.z != 0.0 || felt.torque_n_m.x != 0.0 || felt.orientation.w != 1.0)
        failures++, fprintf(stderr, "wrong orientation: state %u\n", felt.state);
    reading.orientation.w = NAN;
    EXPECT(palpate_touch_tick_instrument(touch, &reading, 0.004, &felt), PALPATE_ARGUMENT, "orientation");
    reading.orientation.w = 1.0;
    reading.jaw_rad = NAN;
    EXPECT(palpate_touch_tick_instrument(touch, &reading, 0.005, &felt), PALPATE_ARGUMENT, "jaw angle");
    reading.jaw_rad = -1.0;
    EXPECT(palpate_touch_tick_instrument(touch, &reading, NAN, &felt), PALPATE_ARGUMENT, "not finite");
    EXPECT(palpate_touch_tick_instrument(touch, &reading, 0.006, &felt), PALPATE_OK, NULL);
    palpate_touch_end(touch);
    EXPECT(palpate_touch_begin(session, &single, &touch), PALPATE_ARGUMENT, "used this hand");
    single.hand = NULL;
    EXPECT(palpate_touch_begin(session, &single, &touch), PALPATE_OK, NULL);
    EXPECT(palpate_touch_tick_instrument(touch, &reading, 0.0, &felt), PALPATE_ARGUMENT, "leads no instrument");
    palpate_touch_end(touch);

    /* Devices of six axes. */
    int reads = 0;
    palpate_instrument_device device = {&reads, limits_ok, read_turned, NULL};
    options.in_tissue_frame = 0;
    EXPECT(palpate_bridge_begin_instrument(session, NULL, &options, &bridge), PALPATE_ARGUMENT, "device is null");
    EXPECT(palpate_bridge_begin_instrument(session, &device, &options, &bridge), PALPATE_ARGUMENT, "all three");
    device.write = write_turned;
    EXPECT(palpate_bridge_begin_instrument(session, &device, &single, &bridge), PALPATE_ARGUMENT, "jaws_m");
    options.hand = hands[1];
    EXPECT(palpate_bridge_begin_instrument(session, &device, &options, &bridge), PALPATE_OK, NULL);
    palpate_hand_free(hands[0]);
    palpate_hand_free(hands[1]);
    palpate_hand_free(NULL);
    palpate_instrument_state state;
    EXPECT(palpate_bridge_look_instrument(NULL, &state), PALPATE_ARGUMENT, "bridge is null");
    do {
        nanosleep(&(struct timespec){0, 1000000}, NULL);
        EXPECT(palpate_bridge_look_instrument(bridge, &state), PALPATE_OK, NULL);
    } while (!state.is_over);
    if (state.ticks == 0 || state.jaw_rad != 0.5 || fabs(state.position.z - extent.top_m.z - 0.02) > 1e-9)
        failures++, fprintf(stderr, "jaws %g, z %g\n", state.jaw_rad, state.position.z);
    palpate_bridge_report report;
    EXPECT(palpate_bridge_end(bridge, &report), PALPATE_DEVICE, "length is not 1");
    if (!zero_at_end) failures++, fprintf(stderr, "a device of six axes is left with a force or torque\n");
    /* A device of three axes leads an instrument that is not turned. */
    palpate_device three = {&reads, limits_ok, read_asks, write_ok};
    options.hand = NULL;
    EXPECT(palpate_bridge_begin(session, &three, &options, &bridge), PALPATE_OK, NULL);
    EXPECT(palpate_bridge_look_instrument(bridge, &state), PALPATE_OK, NULL);
    EXPECT(palpate_bridge_end(bridge, NULL), PALPATE_OK, NULL);
    EXPECT(palpate_bridge_begin(session, &three, &single, &bridge), PALPATE_OK, NULL);
    EXPECT(palpate_bridge_look_instrument(bridge, &state), PALPATE_ARGUMENT, "leads no instrument");
    EXPECT(palpate_bridge_end(bridge, NULL), PALPATE_OK, NULL);
}

/* Lets the bridge's thread run first, for tools that run only one thread at a time. */
static void look_later(const palpate_bridge *bridge, palpate_bridge_state *state) {
    nanosleep(&(struct timespec){0, 1000000}, NULL);
    palpate_bridge_look(bridge, state);
}

int main(int count, char **arguments) {
    if (count != 2) return 2;
    const char *url = arguments[1];
    palpate_server *server = NULL;
    palpate_session *session = NULL;
    palpate_touch *touch = NULL;
    palpate_bridge *bridge = NULL;
    palpate_surface *surface = NULL;
    char text[256];
    size_t needed = 0;

    /* Null pointers. */
    EXPECT(palpate_connect(NULL, NULL, &server), PALPATE_ARGUMENT, "url is null");
    EXPECT(palpate_connect(url, NULL, NULL), PALPATE_ARGUMENT, "server is null");
    EXPECT(palpate_scenes(NULL, text, sizeof text, &needed), PALPATE_ARGUMENT, "server is null");
    EXPECT(palpate_session_create(NULL, "liver", &session), PALPATE_ARGUMENT, "server is null");
    EXPECT(palpate_session_delete(NULL), PALPATE_ARGUMENT, "session is null");
    EXPECT(palpate_session_extent(NULL, NULL), PALPATE_ARGUMENT, "session is null");
    EXPECT(palpate_session_change(NULL, NULL), PALPATE_ARGUMENT, "session is null");
    EXPECT(palpate_touch_begin(NULL, NULL, &touch), PALPATE_ARGUMENT, "session is null");
    EXPECT(palpate_touch_tick(NULL, NULL, 0.0, NULL), PALPATE_ARGUMENT, "felt is null");
    EXPECT(palpate_touch_disable(NULL), PALPATE_ARGUMENT, "touch is null");
    EXPECT(palpate_touch_arrive(NULL, NULL, 0), PALPATE_ARGUMENT, "touch is null");
    EXPECT(palpate_touch_traffic(NULL, NULL), PALPATE_ARGUMENT, "touch is null");
    EXPECT(palpate_bridge_begin(NULL, NULL, NULL, &bridge), PALPATE_ARGUMENT, "session is null");
    EXPECT(palpate_bridge_begin_instrument(NULL, NULL, NULL, &bridge), PALPATE_ARGUMENT, "session is null");
    EXPECT(palpate_touch_tick_instrument(NULL, NULL, 0.0, NULL), PALPATE_ARGUMENT, "felt is null");
    EXPECT(palpate_bridge_look(NULL, NULL), PALPATE_ARGUMENT, "bridge is null");
    EXPECT(palpate_bridge_end(NULL, NULL), PALPATE_ARGUMENT, "bridge is null");
    EXPECT(palpate_surface_open(NULL, NULL, &surface), PALPATE_ARGUMENT, "session is null");
    EXPECT(palpate_surface_read(NULL, NULL, NULL), PALPATE_ARGUMENT, "surface is null");
    EXPECT(palpate_surface_size_of(NULL, NULL), PALPATE_ARGUMENT, "surface is null");
    EXPECT(palpate_surface_indices(NULL, NULL, 0), PALPATE_ARGUMENT, "surface is null");
    EXPECT(palpate_surface_uv(NULL, NULL, 8, 0), PALPATE_ARGUMENT, "surface is null");
    EXPECT(palpate_surface_burns(NULL, NULL, 4, 0, NULL), PALPATE_ARGUMENT, "surface is null");
    EXPECT(palpate_session_severed_anchors(NULL, NULL), PALPATE_ARGUMENT, "session is null");
    EXPECT(palpate_touch_options_init(NULL, 8), PALPATE_ARGUMENT, "options is null");
    EXPECT(palpate_change_init(NULL), PALPATE_ARGUMENT, "change is null");
    palpate_touch_options unknown;
    EXPECT(palpate_touch_options_init(&unknown, sizeof unknown), PALPATE_OK, NULL);
    unknown.prediction = 3;
    EXPECT(palpate_touch_begin_offline(&unknown, (palpate_vector){0}, &touch), PALPATE_ARGUMENT, "prediction is 3");
    EXPECT(palpate_limits_of(NULL, NULL), PALPATE_ARGUMENT, "name is null");
    palpate_server_free(NULL);
    palpate_session_free(NULL);
    palpate_surface_free(NULL);
    palpate_touch_end(NULL);

    /* Addresses and texts. */
    EXPECT(palpate_connect("ftp://nowhere", NULL, &server), PALPATE_ARGUMENT, "must begin with http");
    EXPECT(palpate_connect("http://\xff", NULL, &server), PALPATE_ARGUMENT, "not UTF-8");
    EXPECT(palpate_connect("http://127.0.0.1:1", NULL, &server), PALPATE_CONNECTION, "can't reach");
    palpate_connect_options how;
    EXPECT(palpate_connect_options_init(&how, sizeof how), PALPATE_OK, NULL);
    how.token = "two words";
    EXPECT(palpate_connect(url, &how, &server), PALPATE_ARGUMENT, "no token");
    EXPECT(palpate_connect_options_init(&how, sizeof how), PALPATE_OK, NULL);
    how.key_pem = "alone";
    EXPECT(palpate_connect(url, &how, &server), PALPATE_ARGUMENT, "go together");
    EXPECT(palpate_connect_options_init(&how, sizeof how), PALPATE_OK, NULL);
    how.timeout_s = NAN;
    EXPECT(palpate_connect(url, &how, &server), PALPATE_ARGUMENT, "timeout_s");
    how.size = 0;
    EXPECT(palpate_connect(url, &how, &server), PALPATE_ARGUMENT, "_init");
    EXPECT(palpate_connect_options_init(&how, 10000), PALPATE_ARGUMENT, "another version");
    palpate_limits limits;
    EXPECT(palpate_limits_of("spoon", &limits), PALPATE_ARGUMENT, "spoon");

    /* Sessions. */
    EXPECT(palpate_connect(url, NULL, &server), PALPATE_OK, NULL);
    EXPECT(palpate_scenes(server, NULL, 0, NULL), PALPATE_ARGUMENT, "needed");
    EXPECT(palpate_scenes(server, text, 3, &needed), PALPATE_BUFFER, "bytes");
    EXPECT(palpate_scenes(server, NULL, 0, &needed), PALPATE_OK, NULL);
    char *names = malloc(needed);
    EXPECT(palpate_scenes(server, names, needed, &needed), PALPATE_OK, NULL);
    if (!strstr(names, "liver") || strlen(names) + 1 != needed) failures++, fprintf(stderr, "scenes: %s\n", names);
    free(names);
    EXPECT(palpate_session_create(server, "nowhere", &session), PALPATE_REFUSED, "nowhere");
    if (session) failures++;
    EXPECT(palpate_session_join(server, "00000000000000000000000000000000", &session), PALPATE_REFUSED, NULL);
    EXPECT(palpate_session_create_from_text(server, "sheet = 7", &session), PALPATE_ARGUMENT, "scene_text:1");
    EXPECT(palpate_session_create_from_text(server, "", &session), PALPATE_ARGUMENT, NULL);
    /* Local scenes with a mesh: generated, in memory, in a file. */
    const char *of_mesh = "[mesh]\nfile = \"ball.obj\"\nunit = \"mm\"\npoint_mass_kg = 0.01\n[springs]\nstiffness_n_per_m = 100.0\n"
                          "[anchor_springs]\nstiffness_n_per_m = 5.0\n[damping]\ncoefficient_n_s_per_m = 1.0\n";
    const char *ball = "v 50 0 0\nv -50 0 0\nv 0 50 0\nv 0 -50 0\nv 0 0 50\nv 0 0 -50\n"
                       "f 1 3 5\nf 3 2 5\nf 2 4 5\nf 4 1 5\nf 3 1 6\nf 2 3 6\nf 4 2 6\nf 1 4 6\n";
    const unsigned char *bytes = (const unsigned char *)ball;
    palpate_extent box;
    EXPECT(palpate_session_create_from_text(server, of_mesh, &session), PALPATE_ARGUMENT, "names a file");
    EXPECT(palpate_session_create_from_mesh(server, of_mesh, "ball.obj", NULL, 3, &session), PALPATE_ARGUMENT, "mesh_bytes");
    EXPECT(palpate_session_create_from_mesh(server, of_mesh, "cube.obj", bytes, strlen(ball), &session), PALPATE_ARGUMENT, "cube.obj");
    EXPECT(palpate_session_create_from_mesh(server, of_mesh, "ball.obj", bytes, 30, &session), PALPATE_ARGUMENT, NULL);
    if (session) failures++;
    EXPECT(palpate_session_create_from_mesh(server, of_mesh, "ball.obj", bytes, strlen(ball), &session), PALPATE_OK, NULL);
    EXPECT(palpate_session_extent(session, &box), PALPATE_OK, NULL);
    if (fabs(box.most_m.x - 0.05) > 1e-9) failures++, fprintf(stderr, "the ball reaches to %g m\n", box.most_m.x);
    EXPECT(palpate_session_delete(session), PALPATE_OK, NULL);
    palpate_session_free(session), session = NULL;
    EXPECT(palpate_session_create_from_file(server, "nowhere.toml", &session), PALPATE_ARGUMENT, "nowhere.toml");
    char folder[] = "/tmp/palpate-XXXXXX", path[64];
    if (!mkdtemp(folder)) return 2;
    const char *const written[2][2] = {{"ball.obj", ball}, {"ball.toml", of_mesh}};
    for (int k = 0; k < 2; k++) {
        snprintf(path, sizeof path, "%s/%s", folder, written[k][0]);
        FILE *file = fopen(path, "w");
        if (!file || fputs(written[k][1], file) < 0 || fclose(file)) return 2;
    }
    EXPECT(palpate_session_create_from_file(server, path, &session), PALPATE_OK, NULL);
    EXPECT(palpate_session_delete(session), PALPATE_OK, NULL);
    palpate_session_free(session), session = NULL;

    EXPECT(palpate_session_create(server, "liver", &session), PALPATE_OK, NULL);
    EXPECT(palpate_session_id(session, text, sizeof text, &needed), PALPATE_OK, NULL);
    palpate_session *same = NULL;
    EXPECT(palpate_session_join(server, text, &same), PALPATE_OK, NULL);
    palpate_change change;
    EXPECT(palpate_change_init(&change), PALPATE_OK, NULL);
    EXPECT(palpate_session_change(same, &change), PALPATE_REFUSED, NULL);
    change.stiffness_n_per_m = -1.0;
    EXPECT(palpate_session_change(same, &change), PALPATE_REFUSED, "stiffness");
    change.stiffness_n_per_m = INFINITY;
    EXPECT(palpate_session_change(same, &change), PALPATE_REFUSED, "stiffness");
    change.stiffness_n_per_m = 20.0;
    EXPECT(palpate_session_change(same, &change), PALPATE_OK, NULL);
    palpate_session_free(same);

    /* Threads and clips. */
    palpate_tie_options stitch;
    palpate_tie tie;
    size_t tied = 9;
    palpate_vector bites[2] = {{0.03, 0.03, 0.0}, {0.03, 0.035, 0.0}};
    EXPECT(palpate_tie_options_init(&stitch, sizeof stitch), PALPATE_OK, NULL);
    EXPECT(palpate_session_thread(NULL, 0, &stitch), PALPATE_ARGUMENT, "session is null");
    EXPECT(palpate_session_thread(session, 0, &stitch), PALPATE_ARGUMENT, "bites is null");
    stitch.bites = bites, stitch.bite_count = 17;
    EXPECT(palpate_session_clip(session, 0, &stitch), PALPATE_ARGUMENT, "17");
    stitch.bite_count = 2;
    EXPECT(palpate_session_thread(session, 0, &stitch), PALPATE_REFUSED, "length_m");
    stitch.length_m = 0.004;
    EXPECT(palpate_session_thread(session, 64, &stitch), PALPATE_REFUSED, "number");
    EXPECT(palpate_session_ties(session, NULL, 0, &tied), PALPATE_OK, NULL);
    if (tied != 0) failures++, fprintf(stderr, "%zu threads that were refused\n", tied);
    EXPECT(palpate_session_clip(session, 3, &stitch), PALPATE_OK, NULL);
    for (int look = 0; tied != 1 && look < 500; look++) {
        nanosleep(&(struct timespec){0, 10000000L}, NULL);
        EXPECT(palpate_session_ties(session, NULL, 0, &tied), PALPATE_OK, NULL);
    }
    EXPECT(palpate_session_ties(session, &tie, 0, &tied), PALPATE_BUFFER, "1 threads");
    EXPECT(palpate_session_ties(session, &tie, 1, &tied), PALPATE_OK, NULL);
    if (tie.number != 3 || !tie.is_clip) failures++, fprintf(stderr, "clip %u\n", tie.number);
    EXPECT(palpate_session_untie(session, 0, 3), PALPATE_OK, NULL);
    EXPECT(palpate_session_release(session, 0), PALPATE_OK, NULL);
    palpate_session_status status;
    EXPECT(palpate_session_status_of(session, &status), PALPATE_OK, NULL);
    if (status.pieces != 1 || status.severed != 0) failures++, fprintf(stderr, "%u pieces\n", status.pieces);
    EXPECT(palpate_session_severed_anchors(session, NULL), PALPATE_ARGUMENT, "count is null");
    uint32_t anchors = 9;
    EXPECT(palpate_session_severed_anchors(session, &anchors), PALPATE_OK, NULL);
    if (anchors != 0) failures++, fprintf(stderr, "%u anchors\n", anchors);

    /* Touch. */
    palpate_touch_options options;
    EXPECT(palpate_touch_options_init(&options, sizeof options), PALPATE_OK, NULL);
    options.axes = 9;
    EXPECT(palpate_touch_begin(session, &options, &touch), PALPATE_ARGUMENT, "axes");
    options.axes = PALPATE_AXES_UNITY;
    options.limits.max_force_n = -1.0;
    EXPECT(palpate_touch_begin(session, &options, &touch), PALPATE_ARGUMENT, "max_force_n");
    options.limits.max_force_n = 3.0;
    options.tip_radius_m = NAN;
    EXPECT(palpate_touch_begin(session, &options, &touch), PALPATE_ARGUMENT, "tip_radius_m");
    options.tip_radius_m = 0.005;
    options.tip_shape = PALPATE_TIP_BLADE;
    EXPECT(palpate_touch_begin(session, &options, &touch), PALPATE_ARGUMENT, "edge");
    options.tip_shape = PALPATE_TIP_DISC;
    options.edge.z = 0.01;
    EXPECT(palpate_touch_begin(session, &options, &touch), PALPATE_ARGUMENT, "edge");
    options.edge.z = 0.0;
    options.burn_s = -1.0;
    EXPECT(palpate_touch_begin(session, &options, &touch), PALPATE_ARGUMENT, "burn_s");
    options.burn_s = 0.0;
    options.tool = 1000000;
    EXPECT(palpate_touch_begin(session, &options, &touch), PALPATE_REFUSED, NULL);
    options.tool = 0;
    EXPECT(palpate_touch_begin(session, &options, &touch), PALPATE_OK, NULL);
    palpate_reading reading = {{0.0, 0.01, 0.0}, 1};
    palpate_felt felt;
    EXPECT(palpate_touch_tick(touch, NULL, 0.0, &felt), PALPATE_ARGUMENT, "reading is null");
    EXPECT(palpate_touch_tick(touch, &reading, 0.0, &felt), PALPATE_OK, NULL);
    /* Enabled as soon as there is data about the tissue, and not before. */
    for (int tick = 1; felt.state != PALPATE_STATE_ENABLED && !felt.is_over; tick++) {
        if (felt.state != PALPATE_STATE_DISABLED || felt.age_s >= 0.0) break;
        nanosleep(&(struct timespec){0, 1000000}, NULL);
        EXPECT(palpate_touch_tick(touch, &reading, tick * 0.001, &felt), PALPATE_OK, NULL);
    }
    if (felt.state != PALPATE_STATE_ENABLED || felt.age_s < 0.0 || felt.is_over)
        failures++, fprintf(stderr, "state %u, age %g s\n", felt.state, felt.age_s);
    reading.position.x = NAN;
    EXPECT(palpate_touch_tick(touch, &reading, 0.001, &felt), PALPATE_ARGUMENT, "not finite");
    if (felt.state != PALPATE_STATE_FAULT || felt.force_n.z != 0.0) failures++, fprintf(stderr, "fault %u\n", felt.state);
    reading.position.x = 0.0;
    EXPECT(palpate_touch_tick(touch, &reading, INFINITY, &felt), PALPATE_ARGUMENT, "not finite");
    EXPECT(palpate_touch_tick(touch, &reading, -5.0, &felt), PALPATE_OK, NULL);
    EXPECT(palpate_touch_arrive(touch, (const uint8_t *)"", 0), PALPATE_ARGUMENT, "has a server");
    palpate_traffic traffic;
    EXPECT(palpate_touch_traffic(touch, &traffic), PALPATE_OK, NULL);
    if (traffic.connections != 1 || !traffic.is_connected) failures++, fprintf(stderr, "traffic\n");

    /* The surface. */
    palpate_surface_options look;
    EXPECT(palpate_surface_options_init(&look, sizeof look), PALPATE_OK, NULL);
    look.rate_hz = 0.0;
    EXPECT(palpate_surface_open(session, &look, &surface), PALPATE_ARGUMENT, "rate_hz");
    look.rate_hz = 60.0;
    look.refinement = 99;
    EXPECT(palpate_surface_open(session, &look, &surface), PALPATE_REFUSED, "refinement");
    EXPECT(palpate_surface_open(session, NULL, &surface), PALPATE_OK, NULL);
    palpate_surface_size size;
    EXPECT(palpate_surface_size_of(surface, &size), PALPATE_OK, NULL);
    float *positions = calloc(3 * size.vertices, sizeof(float));
    uint32_t *indices = calloc(size.indices, sizeof(uint32_t));
    palpate_buffers buffers = {positions, 12, NULL, 0, size.vertices, 1};
    palpate_dirty dirty;
    buffers.positions_stride = 11;
    EXPECT(palpate_surface_read(surface, &buffers, &dirty), PALPATE_ARGUMENT, "stride");
    buffers.positions_stride = 12;
    buffers.vertices--;
    EXPECT(palpate_surface_read(surface, &buffers, &dirty), PALPATE_BUFFER, "vertices");
    buffers.vertices++;
    EXPECT(palpate_surface_read(surface, &buffers, &dirty), PALPATE_OK, NULL);
    if (dirty.first != 0 || dirty.count != size.vertices) failures++, fprintf(stderr, "dirty %zu\n", dirty.count);
    /* Nothing is burnt. */
    uint32_t burn_version = 9;
    float *burns = malloc(size.vertices * sizeof(float));
    for (size_t k = 0; k < size.vertices; k++) burns[k] = 9.0f;
    EXPECT(palpate_surface_burns(surface, NULL, 4, size.vertices, NULL), PALPATE_ARGUMENT, "null");
    EXPECT(palpate_surface_burns(surface, burns, 3, size.vertices, &burn_version), PALPATE_ARGUMENT, "stride");
    EXPECT(palpate_surface_burns(surface, burns, 4, size.vertices - 1, &burn_version), PALPATE_BUFFER, "vertices");
    if (burn_version != 9) failures++, fprintf(stderr, "a version of burns that were refused\n");
    EXPECT(palpate_surface_burns(surface, burns, 4, size.vertices, NULL), PALPATE_OK, NULL);
    EXPECT(palpate_surface_burns(surface, NULL, 0, 0, &burn_version), PALPATE_OK, NULL);
    for (size_t k = 0; k < size.vertices; k++) failures += burns[k] != 0.0f;
    if (burn_version != 0) failures++, fprintf(stderr, "burns of version %u\n", burn_version);
    free(burns);
    EXPECT(palpate_surface_indices(surface, indices, size.indices - 1), PALPATE_BUFFER, NULL);
    EXPECT(palpate_surface_indices(surface, indices, size.indices), PALPATE_OK, NULL);
    for (size_t k = 0; k < size.indices; k++) failures += indices[k] >= size.vertices;
    free(positions);
    free(indices);

    /* Devices. */
    int reads = 0;
    palpate_device device = {&reads, limits_ok, read_fails, NULL};
    EXPECT(palpate_bridge_begin(session, &device, NULL, &bridge), PALPATE_ARGUMENT, "all three");
    device.write = write_ok;
    device.descriptor = limits_wrong;
    EXPECT(palpate_bridge_begin(session, &device, NULL, &bridge), PALPATE_ARGUMENT, "max_force_n");
    device.descriptor = limits_ok;
    palpate_touch_end(touch);
    EXPECT(palpate_bridge_begin(session, &device, NULL, &bridge), PALPATE_OK, NULL);
    palpate_bridge_state state;
    do look_later(bridge, &state);
    while (!state.is_over);
    palpate_bridge_report report;
    EXPECT(palpate_bridge_end(bridge, &report), PALPATE_DEVICE, "`read` returned 7");
    if (!zero_at_end) failures++, fprintf(stderr, "a device that failed is left with a force\n");
    if (report.result != PALPATE_DEVICE || report.ticks == 0 || report.connections == 0)
        failures++, fprintf(stderr, "result %u, %u ticks\n", report.result, (unsigned)report.ticks);
    EXPECT(palpate_bridge_disable(NULL), PALPATE_ARGUMENT, "bridge is null");
    reads = 0;
    device.read = read_asks;
    EXPECT(palpate_bridge_begin(session, &device, NULL, &bridge), PALPATE_OK, NULL);
    do look_later(bridge, &state);
    while (state.state != PALPATE_STATE_ENABLED && !state.is_over);
    holds = 1;
    uint64_t from = state.ticks;
    do look_later(bridge, &state);
    while (state.ticks < from + 10 && !state.is_over);
    EXPECT(palpate_bridge_disable(bridge), PALPATE_OK, NULL);
    do look_later(bridge, &state);
    while (state.state != PALPATE_STATE_DISABLED && !state.is_over);
    from = state.ticks;
    do look_later(bridge, &state);
    while (state.state == PALPATE_STATE_DISABLED && state.ticks < from + 200 && !state.is_over);
    if (state.state != PALPATE_STATE_DISABLED) failures++, fprintf(stderr, "enabled by a button that was held\n");
    holds = 0;
    do look_later(bridge, &state);
    while (state.state != PALPATE_STATE_ENABLED && !state.is_over);
    EXPECT(palpate_bridge_end(bridge, &report), PALPATE_OK, NULL);
    if (report.result != PALPATE_OK) failures++, fprintf(stderr, "result %u\n", report.result);

    palpate_session *another = NULL;
    EXPECT(palpate_session_create(server, "paper", &another), PALPATE_OK, NULL);
    try_instruments(session, another);
    EXPECT(palpate_session_delete(another), PALPATE_OK, NULL);
    palpate_session_free(another);

    /* A deleted session no longer exists; handles remain usable, in any order. */
    EXPECT(palpate_session_delete(session), PALPATE_OK, NULL);
    EXPECT(palpate_session_delete(session), PALPATE_REFUSED, NULL);
    palpate_server_free(server);
    EXPECT(palpate_touch_begin(session, NULL, &touch), PALPATE_REFUSED, NULL);
    palpate_session_free(session);
    palpate_surface_free(surface);

    if (strcmp(palpate_version(), "0.1.0") != 0 || palpate_abi() != PALPATE_ABI) failures++;
    printf("%d failures\n", failures);
    return failures ? 1 : 0;
}
