/* Connects a device of your own: `device URL SCENE SECONDS`. A device consists of the three functions below; here it is a
 * massless hand that moves up and down. Replace them with the calls of your device's SDK. Prints one line of JSON. */
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

/* State of the device. Until the loop ends, only the loop's thread uses it. */
struct device {
    unsigned long ticks;
    double force_max_n;
    palpate_vector force_n;
};

static int descriptor(void *user, palpate_limits *limits) {
    (void)user;
    /* Limits from the device's data sheet. */
    palpate_limits mine = {12.0, 12.0, 5000.0, 30.0, 0.075};
    *limits = mine;
    return 0;
}

static int read_device(void *user, palpate_reading *reading) {
    struct device *device = user;
    /* From the middle of the workspace, m: x right, y away, z up. From 4 mm above down to 3 mm below, and up, in 2 s. */
    double turn = 3.14159265358979 * (double)device->ticks++ / 1000.0;
    reading->position.z = 0.0005 + 0.0035 * cos(turn);
    /* The user enables forces with a button. It is pressed twice a second here, so also after a lost connection. */
    reading->enable = device->ticks % 500 < 250;
    return 0;
}

static int write_device(void *user, const palpate_vector *force_n) {
    struct device *device = user;
    device->force_n = *force_n;
    device->force_max_n = fmax(device->force_max_n, force_n->z);
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

    struct device mine = {0, 0.0, {0.0, 0.0, 0.0}};
    palpate_device device = {&mine, descriptor, read_device, write_device};
    palpate_touch_options options;
    palpate_touch_options_init(&options, sizeof options);
    options.warn = warn;
    palpate_bridge *bridge = NULL;
    if (status == 0 && palpate_bridge_begin(session, &device, &options, &bridge)) status = failed("device");
    /* The loop is running; this thread checks its state ten times a second. */
    for (int look = 0; status == 0 && look < (int)(10.0 * seconds); look++) {
        palpate_bridge_state state;
        palpate_bridge_look(bridge, &state);
        if (state.is_over) break;
        sleep_ms(100);
    }
    palpate_bridge_report report = {0};
    if (bridge && palpate_bridge_end(bridge, &report)) status = failed("device");
    const char *priorities[] = {"usual", "real time", "refused"};
    if (status == 0)
        printf("{\"ticks\":%llu,\"late_ticks\":%llu,\"samples\":%llu,\"force_max_n\":%.4f,\"force_at_end_n\":%.4f,"
               "\"priority\":\"%s\"}\n",
               (unsigned long long)report.ticks, (unsigned long long)report.late_ticks,
               (unsigned long long)report.samples, mine.force_max_n, mine.force_n.z, priorities[report.priority]);

    if (session) palpate_session_delete(session);
    palpate_session_free(session);
    palpate_server_free(server);
    return status;
}
