/* A slope module of DARC that measures with faintspot (https://github.com/agb32/darc).
 *
 * Parameters of DARC's buffer, all optional but the first one:
 *   slopeParams   path of a bundle that `faintspot export library` wrote; another one takes its place
 *   fsImages      int: 0: DARC's raw pixels (uint16); 1: images of the calibrate module
 *   fsStrength, fsTolerance (float), fsIterations (int): one number, or one for each sub-aperture in use;
 *                 `noise_std`, `tolerance` and `max_iterations` of the TV denoising
 *   refCentroids  subtracted
 * Flags go into the circular buffer rtcFlagBuf. With raw pixels, `pxlCnt` must be the same for all
 * sub-apertures of a group (`width` of the sensor), and DARC needs no calibrate module.
 *
 * This file is BSD-3-Clause like faintspot. It includes DARC's headers, which are AGPL-3.0: what you build from
 * both together is under the AGPL. */
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "darc.h"
#include "rtcslope.h"
#include "faintspot.h"

enum { IMAGES, ITERATIONS, STRENGTH, TOLERANCE, REFERENCE, PATH, USED, NAMES };

typedef struct {
    faintspot *sensor;
    const faintspot_sensor *size;
    arrayStruct *arrays;
    char *names, *path;
    circBuf *flags;
    unsigned int frame;
    double time;
    float *values;
    const float *reference;
    const int *used;
    int threads, images, align;
} Module;

/* Open a bundle, unless it is open already; return whether there is one. */
static int opened(Module *m, const char *text, int bytes, int images) {
    char *path = text ? strndup(text, bytes) : NULL;
    const char *error = "slopeParams is empty";
    if (path && m->path && m->sensor && !strcmp(path, m->path) && images == m->images) return free(path), 1;
    faintspot *made = path ? faintspot_open(path, images ? FAINTSPOT_IMAGES : FAINTSPOT_UINT16, m->threads, &error) : NULL;
    printf("faintspot: %s: %s\n", path ? path : "no bundle", made ? "opened" : error);
    free(m->path);
    faintspot_destroy(m->sensor);
    m->path = path, m->images = images;
    if (!(m->sensor = made)) return 0;
    m->size = faintspot_describe(made);
    m->align = (m->size->window_height * m->size->window_width * 4 + SUBAPALIGN - 1) / SUBAPALIGN * SUBAPALIGN / 4;
    m->values = realloc(m->values, sizeof(float) * m->size->subapertures);
    return m->values != NULL;
}

/* Set a parameter from one number or one for each sub-aperture; return whether it fits. */
static int set(Module *m, const char *name, const void *value, char kind, int bytes) {
    int n = m->size->subapertures;
    if (!value || bytes == 0) return 1; /* that of the bundle */
    if ((kind != 'f' && kind != 'i') || (bytes != 4 && bytes != 4 * n)) return 0;
    for (int k = 0; k < n; k++) {
        int at = bytes == 4 ? 0 : k;
        m->values[k] = kind == 'i' ? (float)((const int *)value)[at] : ((const float *)value)[at];
    }
    return faintspot_set(m->sensor, name, m->values) == 0;
}

int slopeNewParam(SLOPENEWPARAMARGS) {
    Module *m = slopeHandle;
    const int places[] = {ITERATIONS, STRENGTH, TOLERANCE};
    const char *options[] = {"max_iterations", "noise_std", "tolerance"};
    int index[NAMES], bytes[NAMES] = {0}, err = 0;
    void *values[NAMES] = {0};
    char kinds[NAMES];
    bufferGetIndex(pbuf, NAMES, m->names, index, values, kinds, bytes);
    int images = index[IMAGES] >= 0 && kinds[IMAGES] == 'i' && bytes[IMAGES] == 4 ? *(int *)values[IMAGES] : 0;
    if (index[USED] < 0 || index[PATH] < 0 || !opened(m, values[PATH], bytes[PATH], images)) return 1;
    if (totCents != 2 * m->size->subapertures) return printf("faintspot: the bundle has %d sub-apertures, DARC %d\n", m->size->subapertures, totCents / 2), 1;
    m->arrays = arr;
    m->used = values[USED];
    m->reference = index[REFERENCE] >= 0 && bytes[REFERENCE] == 4 * totCents ? values[REFERENCE] : NULL;
    for (int k = 0; k < 3; k++)
        if (index[places[k]] >= 0 && !set(m, options[k], values[places[k]], kinds[places[k]], bytes[places[k]])) {
            printf("faintspot: %.16s: expected a float (fsIterations: int) in range, or one for each sub-aperture, and an estimator that has it\n", m->names + 16 * places[k]);
            err = 1;
        }
    return err;
}

int slopeClose(SLOPECLOSEARGS) {
    Module *m = *slopeHandle;
    *slopeHandle = NULL;
    if (!m) return 0;
    faintspot_destroy(m->sensor);
    if (m->flags) circClose(m->flags);
    free(m->names);
    free(m->path);
    free(m->values);
    free(m);
    return 0;
}

int slopeOpen(SLOPEOPENARGS) {
    Module *m = *slopeHandle = calloc(1, sizeof *m);
    char *buffer = NULL;
    int subapertures = totCents / 2, err = 1;
    if (m && (m->names = bufferMakeNames(NAMES, "fsImages", "fsIterations", "fsStrength", "fsTolerance", "refCentroids", "slopeParams", "subapFlag"))) {
        m->threads = nthreads;
        err = slopeNewParam(m, pbuf, frameno, arr, totCents);
        if (!err && asprintf(&buffer, "/%srtcFlagBuf", prefix) > 0) m->flags = openCircBuf(buffer, 1, &subapertures, 'b', 100);
        free(buffer);
    }
    if (err) slopeClose(slopeHandle);
    return err;
}

int slopeNewFrameSync(SLOPENEWFRAMESYNCARGS) {
    Module *m = slopeHandle;
    m->frame = frameno;
    m->time = timestamp;
    return 0;
}

int slopeFrameFinishedSync(SLOPEFRAMEFINISHEDSYNCARGS) {
    Module *m = slopeHandle;
    if (!m->flags || err || !(forcewrite || (FREQ(m->flags) > 0 && m->frame % FREQ(m->flags) == 0))) return 0;
    if (!m->images) faintspot_finish(m->sensor, 0, m->arrays->pxlbufs);
    return circAddForce(m->flags, (void *)faintspot_results(m->sensor)->flags, m->time, m->frame);
}

int slopeCalcSlope(SLOPECALCSLOPEARGS) { /* curnpxlx: number of sub-apertures, used or not, from subindx */
    Module *m = slopeHandle;
    int first = slopeindx / 2, count = 0, width = m->size->width;
    const faintspot_slopes *slopes = faintspot_results(m->sensor);
    float *out = m->arrays->centroids + slopeindx;
    for (int k = 0; k < curnpxlx; k++) count += m->used[subindx + k] == 1;
    if (m->images) {
        if (!subap || faintspot_images(m->sensor, threadno, subap, m->align, first, count)) return 1;
    } else if (first % width || m->arrays->pxlbuftype != 'H' || faintspot_measure(m->sensor, threadno, m->arrays->pxlbufs, first / width, (first + count + width - 1) / width))
        return 1;
    memcpy(m->arrays->flux + first, slopes->flux + first, sizeof(float) * count);
    for (int k = 0; k < count; k++) {
        out[2 * k] = slopes->x[first + k] - (m->reference ? m->reference[slopeindx + 2 * k] : 0);
        out[2 * k + 1] = slopes->y[first + k] - (m->reference ? m->reference[slopeindx + 2 * k + 1] : 0);
    }
    return 0;
}
