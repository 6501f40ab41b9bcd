/* Measure frames, count allocations while they are measured, and open bundles that are damaged: for sanitizers.
 * Usage: library_harness BUNDLE PIXELS FRAMES TRIALS; linked with --wrap for the allocations. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "faintspot.h"

static long allocations;
void *__real_malloc(size_t), *__real_calloc(size_t, size_t), *__real_aligned_alloc(size_t, size_t);
void *__wrap_malloc(size_t n) { return allocations++, __real_malloc(n); }
void *__wrap_calloc(size_t n, size_t m) { return allocations++, __real_calloc(n, m); }
void *__wrap_aligned_alloc(size_t n, size_t m) { return allocations++, __real_aligned_alloc(n, m); }

static char *load(const char *path, size_t *size) {
    FILE *file = fopen(path, "rb");
    if (!file || fseek(file, 0, SEEK_END)) exit(3);
    *size = ftell(file);
    rewind(file);
    char *data = malloc(*size + 1);
    if (fread(data, 1, *size, file) != *size) exit(3);
    fclose(file);
    return data;
}

static uint32_t checksum(const unsigned char *data, size_t size) {
    uint32_t crc = ~0u;
    for (size_t k = 0; k < size; k++) {
        crc ^= data[k];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xedb88320u : 0);
    }
    return ~crc;
}

int main(int argc, char **argv) {
    size_t size, bytes;
    if (argc != 5) return 2;
    int pixels = atoi(argv[2]), trials = atoi(argv[4]), opened = 0;
    char *bundle = load(argv[1], &size), *frames = load(argv[3], &bytes);
    const char *error = NULL;
    faintspot *s = faintspot_create(bundle, size, pixels, 2, &error);
    if (!s) return printf("%s\n", error), 1;
    const faintspot_sensor *d = faintspot_describe(s);
    size_t frame = (size_t)d->frame_height * d->frame_width * (pixels == FAINTSPOT_UINT16 ? 2 : 4), n = d->subapertures;
    float *values = calloc(n, sizeof *values);
    unsigned char *dark = calloc(n, 1);
    double sum = 0;
    allocations = 0;
    for (size_t at = 0; at + frame <= bytes; at += frame) {
        for (int k = 0; faintspot_parameter(s, k); k++) faintspot_set(s, faintspot_parameter(s, k), values);
        faintspot_prior(s, values, values, NULL);
        faintspot_dark(s, dark);
        for (int group = 0; group < d->groups; group++) faintspot_measure(s, group % 2, frames + at, group, group + 1);
        faintspot_finish(s, 1, frames + at);
        if (pixels == FAINTSPOT_IMAGES)
            for (size_t k = 0; k + 3 <= n; k += 3) faintspot_images(s, 0, (float *)(frames + at), (size_t)d->window_height * d->window_width, k, 3);
        for (size_t k = 0; k < n; k++) sum += faintspot_results(s)->x[k];
    }
    printf("allocations in frames: %ld\n", allocations);
    if (faintspot_measure(s, 2, frames, 0, 1) != -1 || faintspot_measure(s, 0, frames, 0, d->groups + 1) != -1 || faintspot_finish(s, -1, frames) != -1) return 4;
    if (faintspot_rows(s, -1) != -1 || faintspot_rows(s, d->groups) != -1 || faintspot_set(s, "nonsense", values) != -1) return 4;
    faintspot_destroy(s);
    srand(1);
    size_t lists = size < 20000 ? size : 20000; /* where header and lists are */
    for (int trial = 0; trial < trials; trial++) {
        size_t kept = trial % 3 ? size : (size_t)rand() % (size + 1);
        char *copy = malloc(kept ? kept : 1); /* of this very size, for the sanitizer to see what is read beyond */
        memcpy(copy, bundle, kept);
        for (int k = 0; k <= trial % 4 && kept > 200; k++) copy[16 + rand() % ((lists < kept ? lists : kept) - 16)] = rand() % 5 ? rand() : 0xff;
        if (trial % 2 && kept > 16) { /* damage that has the right checksum and length */
            int64_t total = kept;
            if (kept > 40) memcpy(copy + 24, &total, sizeof total);
            uint32_t crc = checksum((unsigned char *)copy + 16, kept - 16);
            memcpy(copy + 8, &crc, sizeof crc);
        }
        faintspot *made = faintspot_create(copy, kept, pixels, 1 + trial % 3, &error);
        if (!made && !error) return 5;
        opened += made != NULL;
        faintspot_destroy(made);
        free(copy);
    }
    printf("damaged bundles opened: %d of %d, mean %g\n", opened, trials, sum);
    free(bundle), free(frames), free(values), free(dark);
    return allocations < 0;
}
