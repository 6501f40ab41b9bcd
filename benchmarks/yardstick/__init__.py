"""Every denoiser and estimator before one judge: which treatment of the image gives the best slope?

Spots of four origins (`spots.py`) have known displacements, 10 to 1,000 e- and 0.1 to 16 e- of read noise.
Settings, the centroid that follows a denoiser, and the gain (slope of estimates against truth) are found on
training spots; others score. Photon efficiency: the flux at which the Cramer-Rao bound equals the rms error,
over the flux used. Times: all in turns, on one processor. BM3D is for non-commercial use only:
install it yourself.
"""

from benchmarks.yardstick.judge import run as run
