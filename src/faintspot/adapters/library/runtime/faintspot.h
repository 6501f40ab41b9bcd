/* Slopes of a Shack-Hartmann sensor from pixels: the compiled kernels of faintspot, without Python.
 *
 * An object holds the tables of one sensor and estimator, from a bundle that `faintspot export library` wrote.
 * Nothing is allocated, locked or printed between faintspot_create and faintspot_destroy. Several threads may
 * measure a frame together: each uses a number of its own, from 0, and groups of its own.
 *
 * A frame: faintspot_measure for all groups, in any order, each as soon as its rows are there; then, once,
 * faintspot_finish. Parameters, prior and dark sub-apertures may change between two frames.
 *
 * SPDX-License-Identifier: BSD-3-Clause */
#ifndef FAINTSPOT_H
#define FAINTSPOT_H
#include <stddef.h>
#ifdef __cplusplus
extern "C" {
#endif
#if defined(__GNUC__)
#pragma GCC visibility push(default)
#endif

typedef struct faintspot faintspot;

/* Kinds of pixels: frames (h, w) of uint16_t or float [ADU], or calibrated images (n, ny, nx) of float [e-]. */
enum { FAINTSPOT_UINT16, FAINTSPOT_FLOAT32, FAINTSPOT_IMAGES };

typedef struct {
    int subapertures, window_height, window_width;
    int frame_height, frame_width; /* of images: all windows, one above the other */
    int width, groups;             /* sub-apertures in a group, and groups in a frame */
    int pixels;
    const char *processor;    /* level of x86-64 that the kernels are compiled for */
    const char *version;      /* of faintspot that wrote the bundle */
    const char *fingerprint;  /* differs if slopes of the same frame may differ */
} faintspot_sensor;

typedef struct { /* one number for each sub-aperture; see faintspot.Slopes */
    const float *x, *y;        /* px from the reference positions */
    const float *flux;         /* e- */
    const unsigned char *flags; /* bits of faintspot.SubapertureFlag */
    const int *iterations, *bad_pixels;
    const float *standard_error_x, *standard_error_y, *covariance_xy;
} faintspot_slopes;

/* Read a bundle from memory or from a file, for `pixels`, to be measured by up to `threads` threads. Return NULL
 * when it cannot be used; `error`, if not NULL, then says why. */
faintspot *faintspot_create(const void *bundle, size_t size, int pixels, int threads, const char **error);
faintspot *faintspot_open(const char *path, int pixels, int threads, const char **error);
void faintspot_destroy(faintspot *);

const faintspot_sensor *faintspot_describe(const faintspot *);
const faintspot_slopes *faintspot_results(const faintspot *); /* of the last frame; always the same memory */
/* Number of rows of the frame that a group needs; -1 if there is no such group. */
int faintspot_rows(const faintspot *, int group);

/* Measure groups [first, last). Return 0, or -1 if the thread or a group does not exist. */
int faintspot_measure(faintspot *, int thread, const void *frame, int first, int last);
/* Set the flags that need whole frames. Return 0, or -1 if the thread does not exist. */
int faintspot_finish(faintspot *, int thread, const void *frame);
/* Measure images of sub-apertures first, first + 1 ..., `stride` floats apart, at least a window. It measures
 * whole groups: fastest if `first` and `count` are multiples of `width`. Only for FAINTSPOT_IMAGES. */
int faintspot_images(faintspot *, int thread, const float *images, size_t stride, int first, int count);

/* Name of the parameter number `index`, as in faintspot.toml; NULL if there are no more. */
const char *faintspot_parameter(const faintspot *, int index);
/* Set a parameter of every sub-aperture. Return 0, or -1, with nothing changed, if the estimator has no such
 * parameter or a value is out of range. */
int faintspot_set(faintspot *, const char *name, const float *values);
/* Set predicted slopes for the estimator "map", NULL: 0, and the standard deviations of the prior [px], NULL:
 * unchanged. Return -1 if the estimator has no prior or a standard deviation is not within 1e-6 to 1e4. */
int faintspot_prior(faintspot *, const float *x, const float *y, const float *std_px);
/* Set which sub-apertures are known to have no flux: their slopes are 0. */
void faintspot_dark(faintspot *, const unsigned char *dark);

#if defined(__GNUC__)
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif
#endif
