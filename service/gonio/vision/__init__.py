"""Pixels in: video, ONNX models, person tracking. The only place of cv2, av and onnxruntime."""

import os

MAX_PIXELS = 100_000_000
"""The largest photograph that is read."""

# Before cv2 is loaded, which looks but once: a picture of a few bytes can say that it has a thousand million pixels, and
# would be unpacked before anybody could measure it.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))
