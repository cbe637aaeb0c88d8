/* Renders a recording: `replay RECORD FORCES`. The record is a sequence of entries, little-endian: 0, a length and as many
 * bytes of a TouchResponse; or 1, a time, a position and whether forces are requested, as doubles. */
#include <palpate.h>
#include <stdio.h>
#include <stdlib.h>

int main(int count, char **arguments) {
    FILE *record = count == 3 ? fopen(arguments[1], "rb") : NULL;
    FILE *forces = count == 3 ? fopen(arguments[2], "wb") : NULL;
    if (!record || !forces) return 2;
    palpate_touch_options options;
    palpate_touch_options_init(&options, sizeof options);
    palpate_limits_of("omega3", &options.limits);
    options.in_tissue_frame = 1;
    palpate_touch *touch = NULL;
    palpate_vector middle = {0.0, 0.0, 0.0};
    if (fread(&middle, sizeof middle, 1, record) != 1) return 2;
    if (palpate_touch_begin_offline(&options, middle, &touch)) return 3;
    uint32_t kind;
    while (fread(&kind, sizeof kind, 1, record) == 1) {
        if (kind == 0) {
            uint32_t length;
            if (fread(&length, sizeof length, 1, record) != 1) return 2;
            uint8_t *bytes = malloc(length);
            if (fread(bytes, 1, length, record) != length) return 2;
            if (palpate_touch_arrive(touch, bytes, length)) return fprintf(stderr, "%s\n", palpate_last_error()), 4;
            free(bytes);
        } else {
            double tick[5];
            if (fread(tick, sizeof tick, 1, record) != 1) return 2;
            palpate_reading reading = {{tick[1], tick[2], tick[3]}, tick[4] != 0.0};
            palpate_felt felt;
            if (palpate_touch_tick(touch, &reading, tick[0], &felt)) return 5;
            fwrite(&felt.force_n, sizeof felt.force_n, 1, forces);
        }
    }
    palpate_touch_end(touch);
    fclose(record);
    return fclose(forces) ? 6 : 0;
}
