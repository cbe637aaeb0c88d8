/* Two hands with a grasper each: `hands URL SCENE SECONDS`. Both devices have six axes; here they are simulated: a hand leads
 * its device by a spring and a damper along a way into the tissue, and closes the jaws there. Replace the three functions
 * with the calls of your device's SDK. Ends when both hands have felt the tissue twice, or after SECONDS. Prints one line of
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

/* A simulated hand and its device. Until the loop ends, only the loop's thread uses it. */
struct device {
    palpate_quaternion orientation;
    double x_m; /* Where it goes down, from the top of the tissue. */
    unsigned long ticks;
    palpate_vector position_m, force_n, torque_n_m;
    double force_max_n, torque_max_n_m;
};

static int descriptor(void *user, palpate_limits *limits) {
    (void)user;
    palpate_limits mine = {12.0, 12.0, 4000.0, 30.0, 0.1125};
    *limits = mine;
    return 0;
}

/* The device moves as fast as the hand's spring of 300 N/m, the force of the tissue and the damping of 5.5 N·s/m let it. */
static double moved(double from_m, double goal_m, double force_n) {
    return from_m + 1e-3 * (300.0 * (goal_m - from_m) + force_n) / 5.5;
}

static int read_device(void *user, palpate_instrument_reading *reading) {
    struct device *device = user;
    /* From 6 mm above the tissue down to 3 mm below, and up, in 2 s. */
    double part = cos(3.14159265358979 * (double)device->ticks++ / 1000.0);
    device->position_m.x = moved(device->position_m.x, device->x_m, device->force_n.x);
    device->position_m.y = moved(device->position_m.y, 0.0, device->force_n.y);
    device->position_m.z = moved(device->position_m.z, 0.0015 + 0.0045 * part, device->force_n.z);
    reading->position = device->position_m;
    reading->orientation = device->orientation;
    /* Open above the tissue, closed in it. */
    reading->jaw_rad = 0.3 + 0.25 * part;
    reading->enable = device->ticks % 500 < 250;
    return 0;
}

static double length(const palpate_vector *v) { return sqrt(v->x * v->x + v->y * v->y + v->z * v->z); }

static int write_device(void *user, const palpate_vector *force_n, const palpate_vector *torque_n_m) {
    struct device *device = user;
    device->force_n = *force_n;
    device->torque_n_m = *torque_n_m;
    device->force_max_n = fmax(device->force_max_n, length(force_n));
    device->torque_max_n_m = fmax(device->torque_max_n_m, length(torque_n_m));
    return 0;
}

static int failed(const char *what) {
    fprintf(stderr, "%s: %s\n", what, palpate_last_error());
    return 1;
}

static void warn(void *user, const char *message) {
    (void)user;
    fprintf(stderr, "%s\n", message);
}

int main(int count, char **arguments) {
    double seconds = count == 4 ? strtod(arguments[3], NULL) : 0.0;
    if (!(seconds > 0.0 && seconds < 1e6)) {
        fprintf(stderr, "usage: %s URL SCENE SECONDS\n", arguments[0]);
        return 2;
    }
    palpate_server *server = NULL;
    if (palpate_connect(arguments[1], NULL, &server)) return failed("connect");
    palpate_session *session = NULL;
    int status = palpate_session_create(server, arguments[2], &session) ? failed("session") : 0;

    palpate_touch_options options;
    palpate_touch_options_init(&options, sizeof options);
    options.warn = warn;
    options.jaws_m = 0.015;
    options.shaft_m = 0.02;
    options.tip_radius_m = 0.003;
    options.max_torque_n_m = 0.4;
    /* The tips of the left grasper are the first tools, those of the right one the next. */
    uint32_t tools = 0;
    if (status == 0 && palpate_tool_count(&options, &tools)) status = failed("options");
    palpate_hand *hands[2] = {NULL, NULL};
    if (status == 0 && palpate_two_hands(&hands[0], &hands[1])) status = failed("hands");

    /* 10° downwards; the left one towards x, the right one, turned by 180° about z, towards it. */
    struct device mine[2] = {{.orientation = {0.9961946980917455, 0.0, 0.08715574274765817, 0.0}, .x_m = -0.006},
                             {.orientation = {0.0, -0.08715574274765817, 0.0, 0.9961946980917455}, .x_m = 0.006}};
    palpate_bridge *bridges[2] = {NULL, NULL};
    for (int hand = 0; status == 0 && hand < 2; hand++) {
        mine[hand].position_m.z = 0.006;
        palpate_instrument_device device = {&mine[hand], descriptor, read_device, write_device};
        options.tool = (uint32_t)hand * tools;
        options.hand = hands[hand];
        if (palpate_bridge_begin_instrument(session, &device, &options, &bridges[hand])) status = failed("device");
    }
    /* The loops are running; this thread checks their states ten times a second. */
    int felt[2] = {0, 0};
    for (int look = 0; status == 0 && look < (int)(10.0 * seconds) && (felt[0] < 2 || felt[1] < 2); look++) {
        for (int hand = 0; hand < 2; hand++) {
            palpate_instrument_state state;
            palpate_bridge_look_instrument(bridges[hand], &state);
            if (state.is_over) look = (int)(10.0 * seconds);
            felt[hand] += length(&state.force_n) > 0.05;
        }
        sleep_ms(100);
    }
    for (int hand = 0; hand < 2; hand++) {
        if (bridges[hand] && palpate_bridge_end(bridges[hand], NULL)) status = failed("device");
        palpate_hand_free(hands[hand]);
    }
    if (status == 0)
        printf("{\"tools\":%u,\"force_max_n\":[%.4f,%.4f],\"torque_max_n_m\":[%.5f,%.5f],\"force_at_end_n\":[%.4f,%.4f]}\n",
               tools, mine[0].force_max_n, mine[1].force_max_n, mine[0].torque_max_n_m, mine[1].torque_max_n_m,
               length(&mine[0].force_n), length(&mine[1].force_n));

    if (session) palpate_session_delete(session);
    palpate_session_free(session);
    palpate_server_free(server);
    return status;
}
