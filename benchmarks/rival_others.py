"""Other packages' total-variation denoising: not the same problem, but what one might reach for.

- OpenCV, `cv2.denoise_TVL1`: TV with an L1 data term, which ignores outliers and does not follow photon
  noise, on 8-bit images (so each is first scaled to 0 to 255, which is not timed), by Chambolle and Pock's
  primal-dual algorithm. As many iterations as faintspot's, and its default of 30, with which its
  documentation says to begin (https://docs.opencv.org/4.x/d1/d79/group__photo__denoise.html); lambda = 1,
  its default.
- prox_tv, `tv1_2d`: anisotropic TV, |horizontal| + |vertical| differences, with squared data term, in
  float64, by its default method (Douglas-Rachford splitting) and number of iterations (35), n_threads=1,
  called as in its README (https://github.com/albarji/proxTV), with the weight that faintspot's solution
  has.

Both take one image after the other. Theirs is the time to denoise alone, faintspot's is from frame to
slopes. Because the problems differ, so do the positions; by how much is told (rms), and is not an error of
either.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

OPENCV_ITERATIONS = (20, 30)
NOTES = (
    "OpenCV: L1 data term, 8-bit images, lambda = 1; prox_tv: anisotropic TV, float64, 35 iterations",
    "differs px: rms difference of the positions; it is no error, since the problems differ",
)


def eight_bit(images: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Scale each image so that its brightest pixel is 255; negative ones become 0."""
    brightest = images.max(axis=(1, 2), keepdims=True)
    scaled: NDArray[np.uint8] = np.rint(np.clip(images / brightest, 0.0, 1.0) * 255).astype(np.uint8)
    return scaled


def opencv_rival(images: NDArray[np.float32], iterations: int) -> Callable[[], NDArray[Any]]:
    """Return OpenCV's denoising of 8-bit images in a loop."""
    import cv2  # type: ignore[import-not-found, unused-ignore]

    cv2.setNumThreads(1)
    observed = eight_bit(images)
    denoised = np.zeros_like(observed)

    def run() -> NDArray[Any]:
        for image, result in zip(observed, denoised, strict=True):
            cv2.denoise_TVL1([image], result, 1.0, iterations)
        return denoised

    return run


def prox_tv_rival(images: NDArray[np.float32], weights: NDArray[Any]) -> Callable[[], NDArray[Any]]:
    """Return prox_tv's anisotropic denoising in a loop."""
    import prox_tv  # type: ignore[import-not-found, unused-ignore]

    observed = images.astype(np.float64)
    denoised = np.empty_like(observed)

    def run() -> NDArray[Any]:
        for index, (image, weight) in enumerate(zip(observed, weights, strict=True)):
            denoised[index] = prox_tv.tv1_2d(image, float(weight), n_threads=1)
        return denoised

    return run
