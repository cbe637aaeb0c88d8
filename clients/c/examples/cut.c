/* Cuts a tissue, sews it and burns it: `cut URL SCENE`, for a sheet such as liver. A device of your own leads a blade; then a thread through
 * four places draws the lips of the cut together; then a hot tip is held on a place until that has burnt through. Prints one line of
 * JSON. */
#define _POSIX_C_SOURCE 200112L
#include <math.h>
#include <palpate.h>
#include <stdio.h>
#include <stdlib.h>
#ifdef _WIN32
#include <windows.h>
#else
#include <time.h>
#endif

static void sleep_ms(unsigned ms) {
#ifdef _WIN32
    Sleep(ms);
#else
    nanosleep(&(struct timespec){0, 1000000L * (long)ms}, NULL);
#endif
}

static int descriptor(void *ticks, palpate_limits *limits) {
    (void)ticks;
    return palpate_limits_of("omega3", limits) != PALPATE_OK;
}

/* The tip of the blade goes down to 6 mm below the surface, 30 mm ahead along y, and up again. */
static int read_device(void *ticks, palpate_reading *reading) {
    double time_s = 1e-3 * (double)(*(unsigned long *)ticks)++;
    double down = fmin(fmin(time_s / 0.5, 1.0), fmax(2.5 - time_s, 0.0) / 0.5);
    reading->position.x = -0.00125;
    reading->position.y = -0.015 + 0.03 * fmin(fmax(time_s - 0.5, 0.0) / 1.5, 1.0);
    reading->position.z = 0.004 - 0.010 * fmax(down, 0.0);
    reading->enable = 1;
    return 0;
}

/* A hot tip that stays 2 mm below the surface, beside the cut. */
static int read_hot_device(void *ticks, palpate_reading *reading) {
    double time_s = 1e-3 * (double)(*(unsigned long *)ticks)++;
    reading->position.x = 0.02;
    reading->position.y = 0.0;
    reading->position.z = 0.002 - 0.004 * fmin(time_s / 0.5, 1.0);
    reading->enable = 1;
    return 0;
}

static int write_device(void *ticks, const palpate_vector *force_n) {
    (void)ticks, (void)force_n;
    return 0;
}

static int failed(const char *what) {
    fprintf(stderr, "%s: %s\n", what, palpate_last_error());
    return 1;
}

/* Leads the blade once along its way. */
static int cut(const palpate_session *session) {
    unsigned long ticks = 0;
    palpate_device device = {&ticks, descriptor, read_device, write_device};
    palpate_touch_options options;
    palpate_touch_options_init(&options, sizeof options);
    options.tip_shape = PALPATE_TIP_BLADE;
    options.tip_radius_m = 0.001;
    options.edge.z = 0.02; /* upright */
    palpate_bridge *bridge = NULL;
    if (palpate_bridge_begin(session, &device, &options, &bridge)) return failed("blade");
    palpate_bridge_state state;
    do {
        sleep_ms(10);
        palpate_bridge_look(bridge, &state);
    } while (!state.is_over && state.ticks < 2600);
    return palpate_bridge_end(bridge, NULL) ? failed("blade") : 0;
}

/* Sews the cut by a thread that is shorter than the way between its bites. */
static int sew(const palpate_session *session, palpate_tie *tie) {
    palpate_extent extent;
    palpate_session_extent(session, &extent);
    const double sides[4][2] = {{-0.004, -0.006}, {0.004, -0.002}, {-0.004, 0.002}, {0.004, 0.006}};
    palpate_vector bites[4];
    for (int bite = 0; bite < 4; bite++) {
        bites[bite] = extent.top_m;
        bites[bite].x += sides[bite][0] - 0.00125;
        bites[bite].y += sides[bite][1];
    }
    palpate_tie_options options;
    palpate_tie_options_init(&options, sizeof options);
    options.bites = bites;
    options.bite_count = 4;
    options.length_m = 0.02;
    if (palpate_session_thread(session, 0, &options)) return failed("thread");
    size_t count = 0;
    for (int look = 0; look < 1000; look++) {
        if (palpate_session_ties(session, tie, 1, &count)) return failed("ties");
        if (count == 1 && tie->tension_n > 0.0 && tie->path_m < 1.05 * options.length_m) return 0;
        sleep_ms(50);
    }
    return 0;
}

/* Burns a place through, and counts the vertices of the surface that have burnt through. */
static int burn(const palpate_session *session, size_t *burnt) {
    palpate_surface *surface = NULL;
    if (palpate_surface_open(session, NULL, &surface)) return failed("surface");
    palpate_surface_size size;
    palpate_surface_size_of(surface, &size);
    float *burns = malloc(size.vertices * sizeof *burns);
    unsigned long ticks = 0;
    palpate_device device = {&ticks, descriptor, read_hot_device, write_device};
    palpate_touch_options options;
    palpate_touch_options_init(&options, sizeof options);
    options.tip_radius_m = 0.003;
    options.burn_s = 0.3;
    options.tool = 1; /* the thread is by tool 0 */
    palpate_bridge *bridge = NULL;
    int status = burns == NULL || palpate_bridge_begin(session, &device, &options, &bridge) ? failed("hot tip") : 0;
    for (int look = 0; status == 0 && *burnt == 0 && look < 6000; look++) {
        sleep_ms(10);
        if (palpate_surface_burns(surface, burns, sizeof *burns, size.vertices, NULL)) status = failed("burns");
        for (size_t vertex = 0; status == 0 && vertex < size.vertices; vertex++) *burnt += burns[vertex] >= 1.0f;
    }
    if (bridge != NULL && palpate_bridge_end(bridge, NULL)) status = failed("hot tip");
    palpate_surface_free(surface);
    free(burns);
    return status;
}

int main(int count, char **arguments) {
    if (count != 3) {
        fprintf(stderr, "usage: %s URL SCENE\n", arguments[0]);
        return 2;
    }
    palpate_server *server = NULL;
    if (palpate_connect(arguments[1], NULL, &server)) return failed("connect");
    palpate_session *session = NULL;
    int status = palpate_session_create(server, arguments[2], &session) ? failed("session") : 0;
    palpate_tie tie = {0};
    if (status == 0) status = cut(session);
    if (status == 0) status = sew(session, &tie);
    palpate_session_status state = {0};
    if (status == 0 && palpate_session_status_of(session, &state)) status = failed("status");
    if (status == 0 && palpate_session_untie(session, 0, 0)) status = failed("untie");
    size_t burnt = 0;
    if (status == 0) status = burn(session, &burnt);
    uint32_t anchors = 0;
    if (status == 0 && palpate_session_severed_anchors(session, &anchors)) status = failed("anchors");
    if (status == 0)
        printf("{\"severed\":%u,\"pieces\":%u,\"version\":%u,\"thread_m\":%.5f,\"tension_n\":%.4f,\"burnt\":%zu,\"anchors\":%u}\n",
               state.severed, state.pieces, state.topology_version, tie.path_m, tie.tension_n, burnt, anchors);

    if (session) palpate_session_delete(session);
    palpate_session_free(session);
    palpate_server_free(server);
    return status;
}
