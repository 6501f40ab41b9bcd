"""Simulated images with known spot positions: spots, detectors and whole sensors."""

from faintspot.camera.detector import Detector
from faintspot.simulate.frames import sensor_frames, subapertures
from faintspot.simulate.photometry import Photometry
from faintspot.spots.shapes import spots
from faintspot.spots.speckled import speckled_spots

__all__ = ["Detector", "Photometry", "sensor_frames", "speckled_spots", "spots", "subapertures"]
