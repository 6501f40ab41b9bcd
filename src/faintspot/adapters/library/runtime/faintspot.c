/* Runtime of the library: reads a bundle, fills the cells that kernels are called with, and calls them.
 * kernels/list.h lists the kernels that are linked: their fingerprint and the level of x86-64 that they need.
 * SPDX-License-Identifier: BSD-3-Clause */
#include "faintspot.h"
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef int (*kernel)(int64_t *);
#define KERNEL(key, level) int faintspot_kernel_##key(int64_t *);
#include "kernels/list.h"
#undef KERNEL
#define KERNEL(key, level) {0x##key##ull, level, faintspot_kernel_##key},
static const struct { uint64_t key; int level; kernel call; } KERNELS[] = {
#include "kernels/list.h"
};

/* The bundle, as `bundle.py` writes it: header, entries, variants with their lists, contents of arrays. */
typedef struct { char magic[4]; uint32_t format, checksum, unused; int64_t pool, total, variants; char version[24], fingerprint[24]; } header;
typedef struct { int64_t offset, size; } entry;
typedef struct {
    uint64_t measure, check;
    int32_t pixels, width, n, ny, nx, h, w, groups, rows, prior_row, scale_row, largest, parameters, cells, check_cells, arrays, named, unused;
} variant;
typedef struct { int64_t is_pointer, value; } cell;
typedef struct { int64_t owner, offset, bytes; } array;
typedef struct { char name[24]; int32_t row, whole; float low, high; } parameter;

enum { FORMAT = 1, CHECKED_FROM = 16, MOST = 1 << 24, MOST_LISTED = 1 << 16, MOST_BYTES = 1 << 28 };
enum { CONSTANT, INSTANCE, THREAD, FRAME }; /* owner of an array */
enum { FRAMES, CORNERS, SETTINGS, PRIOR, START, STOP, RESULT, RESULTS = 9, CHECKED = RESULT + RESULTS, NAMED };
enum { ITEMS = 2, DATA = 4 }; /* of an array's cells: owner, parent, items, bytes of one, data, shape, strides */

typedef struct { /* of one thread */
    int64_t *cells, *images, *corners; /* cells of frames; of images, with their corners and results behind them */
    char *memory, *results[RESULTS];
} worker;

struct faintspot {
    variant v;
    faintspot_sensor sensor;
    union { faintspot_slopes slopes; char *results[RESULTS]; };
    kernel measure, check;
    char *bundle, *memory, **places; /* a copy of the bundle; arrays of this object; where each array is */
    const parameter *parameters;
    const int32_t *named, *last_rows;
    float *settings, *prior;
    worker *workers;
    int threads;
};

static const size_t ITEM[RESULTS] = {4, 4, 4, 1, 4, 4, 4, 4, 4};

static size_t rounded(size_t bytes) { return (bytes + 63) / 64 * 64; }
static void *aligned(size_t bytes) {
    void *memory = aligned_alloc(64, rounded(bytes) + 64);
    return memory ? memset(memory, 0, rounded(bytes) + 64) : NULL;
}

static uint32_t checksum(const unsigned char *data, size_t size) { /* CRC-32 of zlib */
    uint32_t table[256], crc = 0xffffffffu;
    for (uint32_t k = 0; k < 256; k++) {
        table[k] = k;
        for (int bit = 0; bit < 8; bit++) table[k] = table[k] >> 1 ^ (table[k] & 1 ? 0xedb88320u : 0);
    }
    for (size_t k = 0; k < size; k++) crc = table[(crc ^ data[k]) & 255] ^ crc >> 8;
    return ~crc;
}

/* Level of x86-64 of this processor: 4 with AVX-512, 3 with AVX2 and FMA; 0: another one. */
static int processor_level(void) {
#if !defined(__x86_64__)
    return 0;
#else
    __builtin_cpu_init();
#define HAS(feature) (__builtin_cpu_supports(feature) != 0)
    if (!(HAS("avx2") && HAS("fma") && HAS("bmi") && HAS("bmi2") && HAS("popcnt"))) return 1;
    return HAS("avx512f") && HAS("avx512bw") && HAS("avx512cd") && HAS("avx512dq") && HAS("avx512vl") ? 4 : 3;
#endif
}

static kernel kernel_of(uint64_t key, int level, int *needs) {
    for (size_t k = 0; k < sizeof KERNELS / sizeof *KERNELS; k++)
        if (KERNELS[k].key == key && KERNELS[k].level <= level) return *needs = KERNELS[k].level, KERNELS[k].call;
    return NULL;
}

/* Whether all that the lists of a variant point to is within the bundle. */
static int is_whole(const header *h, const variant *v, const cell *cells, const array *arrays, const parameter *parameters, const int32_t *named) {
    for (int k = 0; k < v->cells + v->check_cells; k++)
        if (cells[k].is_pointer && (cells[k].value < 0 || cells[k].value >= v->arrays)) return 0;
    for (int k = 0; k < v->arrays; k++)
        if (arrays[k].owner < CONSTANT || arrays[k].owner > FRAME || arrays[k].bytes < 0 ||
            (arrays[k].offset < 0 && arrays[k].bytes > MOST_BYTES) ||
            arrays[k].offset > h->total - h->pool || (arrays[k].offset >= 0 && arrays[k].bytes > h->total - h->pool - arrays[k].offset)) return 0;
    for (int k = 0; k < v->parameters; k++)
        if (parameters[k].name[23] || parameters[k].row < 0 || parameters[k].row >= v->rows) return 0;
    for (int k = 0; k < NAMED; k++)
        if (named[k] < 0 || named[k] + (k == START || k == STOP ? 1 : 8) > v->cells + v->check_cells) return 0;
    return v->prior_row < v->rows && v->scale_row >= 0 && v->scale_row < v->rows;
}

static int is_sized(const variant *v, size_t size) {
    const int32_t *counts = &v->width, *lists = &v->parameters;
    for (int k = 0; k < 8; k++) /* width ... rows */
        if (counts[k] < 1 || counts[k] > MOST) return 0;
    for (int k = 0; k < 4; k++) /* parameters ... arrays */
        if (lists[k] < 0 || lists[k] > MOST_LISTED) return 0;
    size_t bytes = sizeof *v + ((size_t)v->cells + v->check_cells) * sizeof(cell) + v->arrays * sizeof(array) + v->parameters * sizeof(parameter) + 4 * ((size_t)NAMED + v->groups);
    return v->named == NAMED && v->groups == (v->n + v->width - 1) / v->width && bytes <= size;
}

static int prepare_images(faintspot *s, worker *w, size_t count) {
    size_t n = s->v.n, bytes = count * sizeof(int64_t), corners = 2 * n * sizeof(int64_t);
    char *next = aligned(rounded(bytes) + rounded(corners) + RESULTS * rounded(4 * n));
    if (!next) return 0;
    w->images = memcpy(next, w->cells, bytes), next += rounded(bytes);
    w->corners = (int64_t *)next, next += rounded(corners);
    w->images[s->named[CORNERS] + DATA] = (int64_t)w->corners;
    for (int k = 0; k < RESULTS; k++, next += rounded(4 * n)) w->images[s->named[RESULT + k] + DATA] = (int64_t)(w->results[k] = next);
    return 1;
}

/* Allocate the arrays of an owner, and set their places. */
static char *placed(faintspot *s, const array *arrays, int owner) {
    size_t bytes = 0;
    for (int k = 0; k < s->v.arrays; k++) bytes += arrays[k].owner == owner ? rounded(arrays[k].bytes) : 0;
    char *memory = aligned(bytes), *next = memory;
    for (int k = 0; memory && k < s->v.arrays; k++)
        if (arrays[k].owner == owner) s->places[k] = next, next += rounded(arrays[k].bytes);
    return memory;
}

static int prepare(faintspot *s, worker *w, const cell *cells, const array *arrays) {
    int count = s->v.cells + s->v.check_cells;
    if (!(w->memory = placed(s, arrays, THREAD)) || !(w->cells = aligned(count * sizeof(int64_t)))) return 0;
    for (int k = 0; k < count; k++) w->cells[k] = cells[k].is_pointer ? (int64_t)s->places[cells[k].value] : cells[k].value;
    return s->v.pixels != FAINTSPOT_IMAGES || prepare_images(s, w, count);
}

/* Fill an object for a variant that begins `offset` bytes after the beginning of its bundle. */
static const char *fill(faintspot *s, const header *h, int64_t offset, int threads) {
    const cell *cells = (const void *)(s->bundle + offset + sizeof s->v);
    const array *arrays = (const void *)(cells + s->v.cells + s->v.check_cells);
    s->parameters = (const void *)(arrays + s->v.arrays);
    s->named = (const void *)(s->parameters + s->v.parameters);
    s->last_rows = s->named + NAMED;
    if (!is_whole(h, &s->v, cells, arrays, s->parameters, s->named)) return "the bundle is damaged: lists";
    if (!(s->places = calloc(s->v.arrays + 1, sizeof *s->places)) || !(s->memory = placed(s, arrays, INSTANCE)) || !(s->workers = calloc(threads, sizeof *s->workers))) return "not enough memory";
    for (int k = 0; k < s->v.arrays; k++) {
        char *content = arrays[k].offset < 0 ? NULL : s->bundle + h->pool + arrays[k].offset;
        if (arrays[k].owner == CONSTANT) s->places[k] = content ? content : s->memory;
        if (arrays[k].owner == INSTANCE && content) memcpy(s->places[k], content, arrays[k].bytes);
    }
    s->threads = threads;
    for (int k = 0; k < threads; k++)
        if (!prepare(s, s->workers + k, cells, arrays)) return "not enough memory";
    const int64_t *first = s->workers[0].cells;
    for (int k = 0; k < RESULTS; k++) s->results[k] = (char *)first[s->named[RESULT + k] + DATA];
    s->settings = (float *)first[s->named[SETTINGS] + DATA];
    s->prior = (float *)first[s->named[PRIOR] + DATA];
    return NULL;
}

static const char *choose(faintspot *s, const char *bundle, size_t size, int pixels, int threads) {
    int level = processor_level(), needs = 0, there = 0;
    if (threads < 1 || threads > 4096) return "threads: expected 1 to 4096";
    if (size < sizeof(header)) return "the bundle is cut short";
    if (!(s->bundle = aligned(size))) return "not enough memory";
    const header *h = memcpy(s->bundle, bundle, size);
    if (memcmp(h->magic, "FSPT", 4)) return "not a bundle of faintspot";
    if (h->format != FORMAT) return "the bundle has another format than this library: export both again";
    if (h->total != (int64_t)size) return "the bundle is cut short, or too long";
    if (checksum((const unsigned char *)bundle + CHECKED_FROM, size - CHECKED_FROM) != h->checksum) return "the bundle is damaged: checksum";
    if (h->variants < 0 || h->variants > 99 || h->pool < 0 || h->pool > h->total || h->version[23] || h->fingerprint[23]) return "the bundle is damaged: header";
    if (sizeof *h + h->variants * sizeof(entry) > size) return "the bundle is damaged: header";
    for (int k = 0; k < h->variants; k++) {
        entry e = ((const entry *)(s->bundle + sizeof *h))[k];
        if (e.offset < 0 || e.size < (int64_t)sizeof s->v || e.offset % 8 || e.offset > h->pool || e.size > h->pool - e.offset) return "the bundle is damaged: variants";
        memcpy(&s->v, s->bundle + e.offset, sizeof s->v);
        if (!is_sized(&s->v, e.size)) return "the bundle is damaged: sizes";
        if (s->v.pixels != pixels) continue;
        there = 1;
        s->check = kernel_of(s->v.check, level, &needs);
        s->measure = kernel_of(s->v.measure, level, &needs);
        if (!s->measure || !s->check) continue;
        const variant *v = &s->v;
        s->sensor = (faintspot_sensor){v->n, v->ny, v->nx, v->h, v->w, v->width, v->groups, pixels, needs == 4 ? "x86-64-v4" : needs == 3 ? "x86-64-v3" : needs ? "x86-64" : "aarch64", h->version, h->fingerprint};
        return fill(s, h, e.offset, threads);
    }
    return there ? "this library has no kernels for the bundle on this processor: export it into the library's folder" : "the bundle has no tables for these pixels";
}

faintspot *faintspot_create(const void *bundle, size_t size, int pixels, int threads, const char **error) {
    faintspot *s = calloc(1, sizeof *s);
    const char *reason = !s ? "not enough memory" : !bundle ? "no bundle" : choose(s, bundle, size, pixels, threads);
    if (error) *error = reason;
    if (reason) faintspot_destroy(s);
    return reason ? NULL : s;
}

faintspot *faintspot_open(const char *path, int pixels, int threads, const char **error) {
    FILE *file = path ? fopen(path, "rb") : NULL;
    long size = file && !fseek(file, 0, SEEK_END) ? ftell(file) : -1;
    char *bundle = size >= 0 ? malloc(size + 1) : NULL;
    faintspot *s = NULL;
    if (error) *error = "the bundle cannot be read";
    if (bundle && !fseek(file, 0, SEEK_SET) && fread(bundle, 1, size, file) == (size_t)size) s = faintspot_create(bundle, size, pixels, threads, error);
    if (file) fclose(file);
    free(bundle);
    return s;
}

void faintspot_destroy(faintspot *s) {
    if (!s) return;
    for (int k = 0; k < s->threads; k++) {
        worker *w = s->workers + k;
        free(w->cells);
        free(w->images);
        free(w->memory);
    }
    free(s->workers);
    free(s->places);
    free(s->memory);
    free(s->bundle);
    free(s);
}

const faintspot_sensor *faintspot_describe(const faintspot *s) { return &s->sensor; }
const faintspot_slopes *faintspot_results(const faintspot *s) { return &s->slopes; }
int faintspot_rows(const faintspot *s, int group) { return group < 0 || group >= s->v.groups ? -1 : s->last_rows[group]; }

int faintspot_measure(faintspot *s, int thread, const void *frame, int first, int last) {
    if (thread < 0 || thread >= s->threads || first < 0 || last > s->v.groups) return -1;
    int64_t *cells = s->workers[thread].cells;
    cells[s->named[FRAMES] + DATA] = (int64_t)frame;
    cells[s->named[START]] = first;
    cells[s->named[STOP]] = last;
    return s->measure(cells) ? -1 : 0;
}

int faintspot_finish(faintspot *s, int thread, const void *frame) {
    if (thread < 0 || thread >= s->threads) return -1;
    int64_t *cells = s->workers[thread].cells;
    cells[s->named[CHECKED] + DATA] = (int64_t)frame;
    return s->check(cells + s->v.cells) ? -1 : 0;
}

int faintspot_images(faintspot *s, int thread, const float *images, size_t stride, int first, int count) {
    if (s->v.pixels != FAINTSPOT_IMAGES || thread < 0 || thread >= s->threads || first < 0 || count < 0 || count > s->v.n - first || stride < (size_t)s->v.ny * s->v.nx) return -1;
    worker *w = s->workers + thread;
    int64_t *cells = w->images;
    cells[s->named[FRAMES] + DATA] = (int64_t)images;
    cells[s->named[FRAMES] + ITEMS] = count ? (count - 1) * stride + (size_t)s->v.ny * s->v.nx : 0;
    for (int k = first, next; k < first + count; k = next) {
        int group = k / s->v.width, begin = group * s->v.width;
        next = begin + s->v.width < first + count ? begin + s->v.width : first + count;
        /* Sub-apertures of the group that are not among the images: one that is there takes their place. */
        for (int i = begin; i < begin + s->v.width && i < s->v.n; i++) w->corners[2 * i + 1] = (i < k || i >= next ? k - first : i - first) * (int64_t)stride;
        cells[s->named[START]] = group;
        cells[s->named[STOP]] = group + 1;
        if (s->measure(cells)) return -1;
        for (int i = 0; i < RESULTS; i++) memcpy(s->results[i] + k * ITEM[i], w->results[i] + k * ITEM[i], (next - k) * ITEM[i]);
    }
    return 0;
}

const char *faintspot_parameter(const faintspot *s, int index) { return index < 0 || index >= s->v.parameters ? NULL : s->parameters[index].name; }

int faintspot_set(faintspot *s, const char *name, const float *values) {
    for (int k = 0; k < s->v.parameters; k++) {
        const parameter *p = s->parameters + k;
        if (strcmp(p->name, name)) continue;
        for (int i = 0; i < s->v.n; i++)
            if (!(values[i] >= p->low && values[i] <= p->high) || (p->whole && values[i] != (float)(int64_t)values[i])) return -1;
        memcpy(s->settings + (size_t)p->row * s->v.n, values, s->v.n * sizeof(float));
        return 0;
    }
    return -1;
}

int faintspot_prior(faintspot *s, const float *x, const float *y, const float *std_px) {
    if (s->v.prior_row < 0) return -1;
    for (int i = 0; std_px && i < s->v.n; i++)
        if (!(std_px[i] >= 1e-6f && std_px[i] <= 1e4f)) return -1;
    const float *given[] = {x, y};
    for (int k = 0; k < 2 * s->v.n; k++) { /* values that no frame can have count as no prediction */
        float value = given[k / s->v.n] ? given[k / s->v.n][k % s->v.n] : 0;
        s->prior[k] = value >= -s->v.largest && value <= s->v.largest ? value : 0;
    }
    for (int i = 0; std_px && i < s->v.n; i++) s->settings[(size_t)s->v.prior_row * s->v.n + i] = (float)(1 / ((double)std_px[i] * std_px[i]));
    return 0;
}

void faintspot_dark(faintspot *s, const unsigned char *dark) {
    float *scale = s->settings + (size_t)s->v.scale_row * s->v.n;
    for (int i = 0; i < s->v.n; i++) scale[i] = (scale[i] < 0) != (dark[i] != 0) ? -scale[i] : scale[i];
}
