/* Presses the middle of a tissue: `touch URL SCENE SECONDS`. This thread is the loop, a thousand times a second.
 * Prints one line: {"ticks":…,"force_max_n":…} */
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

static int failed(const char *what) {
    fprintf(stderr, "%s: %s\n", what, palpate_last_error());
    return 1;
}

#ifdef _WIN32
/* Seconds of a monotonic clock. */
static double now_s(void) {
    LARGE_INTEGER now, per_s;
    QueryPerformanceCounter(&now);
    QueryPerformanceFrequency(&per_s);
    return (double)now.QuadPart / (double)per_s.QuadPart;
}

/* Sleep() would wait for up to 15.6 ms. 2 is CREATE_WAITABLE_TIMER_HIGH_RESOLUTION, which older headers lack. */
static void sleep_until(double time_s) {
    static HANDLE timer;
    if (!timer) timer = CreateWaitableTimerExW(NULL, NULL, 2, TIMER_ALL_ACCESS);
    LARGE_INTEGER in = {.QuadPart = (LONGLONG)(-1e7 * (time_s - now_s()))};
    if (in.QuadPart < 0 && SetWaitableTimer(timer, &in, 0, NULL, NULL, FALSE)) WaitForSingleObject(timer, INFINITE);
}
#else
/* Seconds of a monotonic clock. */
static double now_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void sleep_until(double time_s) {
    struct timespec at = {(time_t)time_s, (long)(1e9 * (time_s - floor(time_s)))};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
}
#endif

int main(int count, char **arguments) {
    double seconds = count == 4 ? strtod(arguments[3], NULL) : 0.0;
    if (!(seconds > 0.0 && seconds < 1e6)) {
        fprintf(stderr, "usage: %s URL SCENE SECONDS\n", arguments[0]);
        return 2;
    }
    palpate_server *server = NULL;
    if (palpate_connect(arguments[1], NULL, &server)) return failed("connect");
    palpate_session *session = NULL;
    if (palpate_session_create(server, arguments[2], &session)) {
        palpate_server_free(server);
        return failed("session");
    }

    palpate_touch_options options;
    palpate_touch_options_init(&options, sizeof options);
    palpate_limits_of("omega3", &options.limits);
    /* Positions are in the frame of the tissue, wherever that is; its middle may be far from its surface. */
    options.in_tissue_frame = 1;
    options.limits.workspace_radius_m = 1.0;
    palpate_touch *touch = NULL;
    int status = palpate_touch_begin(session, &options, &touch) ? failed("touch") : 0;

    /* Down from 5 mm above the middle until there is a force, then 3 mm further. */
    palpate_extent extent;
    palpate_session_extent(session, &extent);
    palpate_reading reading = {{extent.middle_m.x, extent.middle_m.y, extent.most_m.z + 0.005}, 1};
    double lowest_m = extent.least_m.z - 0.02, most_n = 0.0, begin_s = now_s();
    unsigned long ticks = 0, all = (unsigned long)(1000.0 * seconds);
    for (; status == 0 && ticks < all; ticks++) {
        palpate_felt felt;
        if (palpate_touch_tick(touch, &reading, now_s(), &felt)) status = failed("tick");
        double force_n = sqrt(felt.force_n.x * felt.force_n.x + felt.force_n.y * felt.force_n.y +
                              felt.force_n.z * felt.force_n.z);
        if (most_n < 0.02 && force_n >= 0.02) lowest_m = reading.position.z - 0.003;
        most_n = fmax(most_n, force_n);
        if (reading.position.z > lowest_m) reading.position.z -= 20e-6; /* 20 mm/s */
        sleep_until(begin_s + 1e-3 * (double)(ticks + 1));
    }
    if (status == 0) printf("{\"ticks\":%lu,\"force_max_n\":%.4f}\n", ticks, most_n);

    palpate_touch_end(touch);
    palpate_session_delete(session);
    palpate_session_free(session);
    palpate_server_free(server);
    return status;
}
