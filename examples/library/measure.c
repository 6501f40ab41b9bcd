/* Measure the slopes of raw frames of uint16 in a file, as they would arrive: group by group.
 *
 *     faintspot export library faintspot.toml -o library
 *     cc -O2 -Ilibrary -o measure measure.c -Llibrary -lfaintspot -Wl,-rpath,library
 *     ./measure library/faintspot.bundle frames.raw slopes.raw
 *
 * slopes.raw gets x and y of all sub-apertures for each frame, float32. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include "faintspot.h"

int main(int argc, char **argv) {
    if (argc != 4) return fprintf(stderr, "usage: measure BUNDLE FRAMES SLOPES\n"), 2;
    const char *error;
    faintspot *sensor = faintspot_open(argv[1], FAINTSPOT_UINT16, 1, &error);
    if (!sensor) return fprintf(stderr, "%s: %s\n", argv[1], error), 1;
    const faintspot_sensor *size = faintspot_describe(sensor);
    const faintspot_slopes *slopes = faintspot_results(sensor);
    FILE *frames = fopen(argv[2], "rb"), *out = fopen(argv[3], "wb");
    size_t row = size->frame_width, n = size->subapertures, count = 0;
    uint16_t *frame = malloc(row * size->frame_height * sizeof *frame);
    if (!frames || !out || !frame) return fprintf(stderr, "cannot open the files\n"), 1;
    for (;; count++) {
        int group = 0, rows = 0;
        for (; rows < size->frame_height && fread(frame + rows * row, sizeof *frame, row, frames) == row; rows++)
            while (group < size->groups && faintspot_rows(sensor, group) <= rows + 1) {
                faintspot_measure(sensor, 0, frame, group, group + 1);
                group++;
            }
        if (rows < size->frame_height) break;
        faintspot_finish(sensor, 0, frame);
        fwrite(slopes->x, sizeof *slopes->x, n, out);
        fwrite(slopes->y, sizeof *slopes->y, n, out);
    }
    printf("%zu frames, %zu sub-apertures, kernels for %s\n", count, n, size->processor);
    faintspot_destroy(sensor);
    fclose(frames);
    free(frame);
    return fclose(out) != 0;
}
