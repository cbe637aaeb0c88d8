/* Watches a tissue: `look URL SCENE SECONDS`. Prints one line: vertices, triangles, frames and the height of the surface. */
#define _POSIX_C_SOURCE 200112L
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

static int failed(const char *what) {
    fprintf(stderr, "%s: %s\n", what, palpate_last_error());
    return 1;
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
    palpate_surface *surface = NULL;
    palpate_surface_size size = {0, 0, 0};
    int status = palpate_session_create(server, arguments[2], &session) ? failed("session") : 0;
    if (status == 0 && palpate_surface_open(session, NULL, &surface)) status = failed("surface");
    if (status == 0) palpate_surface_size_of(surface, &size);

    /* Position and normal of a vertex next to each other, as in many engines. */
    float *vertices = calloc(size.vertices + 1, 6 * sizeof(float));
    palpate_buffers buffers = {vertices, 6 * sizeof(float), vertices + 3, 6 * sizeof(float), size.vertices, 0};
    palpate_dirty dirty = {0, 0, 0, 0, 0.0};
    /* Everything once, then the changes, sixty times a second. */
    buffers.everything = 1;
    for (int frame = 0; status == 0 && frame < (int)(60.0 * seconds); frame++) {
        if (palpate_surface_read(surface, &buffers, &dirty)) status = failed("read");
        buffers.everything = 0;
        sleep_ms(16);
    }
    float least_m = 1e9f, most_m = -1e9f;
    for (size_t k = 0; k < size.vertices; k++) {
        float z_m = vertices[6 * k + 2];
        least_m = z_m < least_m ? z_m : least_m;
        most_m = z_m > most_m ? z_m : most_m;
    }
    if (status == 0)
        printf("{\"vertices\":%zu,\"triangles\":%zu,\"frames\":%llu,\"step\":%llu,\"z_m\":[%.6f,%.6f]}\n", size.vertices,
               size.indices / 3, (unsigned long long)dirty.frames, (unsigned long long)dirty.step, least_m, most_m);

    free(vertices);
    palpate_surface_free(surface);
    if (session) palpate_session_delete(session);
    palpate_session_free(session);
    palpate_server_free(server);
    return status;
}
