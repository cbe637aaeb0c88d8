/* Counts system services that ticks use: `counted RECORD`, a record as replay.c reads it. This program replaces the functions
 * that allocate memory, take locks and call the kernel, and counts the calls of the thread that ticks. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <palpate.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

static __thread int is_ticking = 0;
static __thread unsigned long memory = 0, locks = 0, calls = 0;

extern void *__libc_malloc(size_t);
extern void *__libc_calloc(size_t, size_t);
extern void *__libc_realloc(void *, size_t);
extern void *__libc_memalign(size_t, size_t);
extern void __libc_free(void *);

void *malloc(size_t size) {
    memory += is_ticking;
    return __libc_malloc(size);
}
void *calloc(size_t count, size_t size) {
    memory += is_ticking;
    return __libc_calloc(count, size);
}
void *realloc(void *place, size_t size) {
    memory += is_ticking;
    return __libc_realloc(place, size);
}
int posix_memalign(void **place, size_t alignment, size_t size) {
    memory += is_ticking;
    *place = __libc_memalign(alignment, size);
    return *place == NULL;
}
void free(void *place) {
    memory += is_ticking;
    __libc_free(place);
}
int pthread_mutex_lock(pthread_mutex_t *mutex) {
    static int (*next)(pthread_mutex_t *) = NULL;
    if (!next) *(void **)&next = dlsym(RTLD_NEXT, "pthread_mutex_lock");
    locks += is_ticking;
    return next(mutex);
}
/* Rust's locks use this to wait. */
long syscall(long number, ...) {
    static long (*next)(long, ...) = NULL;
    if (!next) *(void **)&next = dlsym(RTLD_NEXT, "syscall");
    va_list list;
    va_start(list, number);
    long a[6];
    for (int k = 0; k < 6; k++) a[k] = va_arg(list, long);
    va_end(list);
    calls += is_ticking;
    return next(number, a[0], a[1], a[2], a[3], a[4], a[5]);
}

int main(int count, char **arguments) {
    FILE *record = count == 2 ? fopen(arguments[1], "rb") : NULL;
    if (!record) return 2;
    palpate_touch_options options;
    palpate_touch_options_init(&options, sizeof options);
    options.in_tissue_frame = 1;
    options.up_deadband = 0.05;
    palpate_touch *touch = NULL;
    palpate_vector middle;
    if (fread(&middle, sizeof middle, 1, record) != 1) return 2;
    if (palpate_touch_begin_offline(&options, middle, &touch)) return 3;
    unsigned long ticks = 0;
    uint32_t kind;
    while (fread(&kind, sizeof kind, 1, record) == 1) {
        if (kind == 0) {
            uint32_t length;
            if (fread(&length, sizeof length, 1, record) != 1) return 2;
            uint8_t *bytes = malloc(length);
            if (fread(bytes, 1, length, record) != length) return 2;
            if (palpate_touch_arrive(touch, bytes, length)) return 4;
            free(bytes);
        } else {
            double tick[5];
            if (fread(tick, sizeof tick, 1, record) != 1) return 2;
            palpate_reading reading = {{tick[1], tick[2], tick[3]}, tick[4] != 0.0};
            palpate_felt felt;
            is_ticking = 1;
            palpate_result result = palpate_touch_tick(touch, &reading, tick[0], &felt);
            /* Invalid arguments use no services either. */
            if (ticks % 100 == 99) palpate_touch_tick(touch, NULL, tick[0], &felt);
            is_ticking = 0;
            if (result) return 5;
            ticks++;
        }
    }
    palpate_touch_end(touch);
    fclose(record);
    printf("{\"ticks\":%lu,\"memory\":%lu,\"locks\":%lu,\"system_calls\":%lu}\n", ticks, memory, locks, calls);
    return 0;
}
