# pyright: standard
# (PyAV's stubs leave much open: a stream's codec context, what an encoder gives.)
"""Small copies of a trial's videos that any browser plays, all on one clock.

Cameras record what browsers can't play (HEVC, MPEG-4 part 2), at rates and from moments of their own, and gigabytes of it. A
preview is VP8 in WebM (BSD licences, every browser), has a picture for each look of the analysis, and one clock with the
other cameras' previews: picture ``i`` of each is what the analysis saw in its look ``i``.
"""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from gonio.vision.frame import Frame

LONGEST_SIDE_PX = 640
KEY_FRAME_S = 0.5
"""A jump in the video decodes at most this much."""

OPTIONS = {"deadline": "realtime", "cpu-used": "16", "crf": "24", "b": "1500k"}
"""Constrained quality, fastest: 2 ms a picture on one core (shrinking it takes 2 more), some 9 MB a minute."""


class Preview:
    """Writes the preview of one camera; use it in a ``with`` block, or close it.

    Args:
        path: The file, ``*.webm``.
        rate_hz: Pictures a second.
    """

    def __init__(self, path: Path, rate_hz: float) -> None:
        self.path = path
        self._rate = Fraction(rate_hz).limit_denominator(1000)
        self._container = av.open(str(path), "w", format="webm")
        self._stream = None
        self._count = 0

    def add(self, frame: Frame) -> None:
        """Add the next picture. All of them have the first one's size."""
        planes = frame.small_planes(LONGEST_SIDE_PX)
        if self._stream is None:
            self._stream = self._container.add_stream("libvpx", rate=self._rate, options=OPTIONS)
            self._stream.height, self._stream.width = planes[0].shape
            self._stream.pix_fmt = "yuv420p"
            self._stream.codec_context.thread_count = 1
            self._stream.codec_context.gop_size = max(1, round(KEY_FRAME_S * float(self._rate)))
        stacked = np.concatenate([plane.ravel() for plane in planes]).reshape(-1, planes[0].shape[1])
        picture = av.VideoFrame.from_ndarray(stacked, format="yuv420p")
        picture.pts, picture.time_base = self._count, 1 / self._rate
        self._count += 1
        self._container.mux(self._stream.encode(picture))

    def close(self) -> None:
        """Write what is still in the encoder, and end the file."""
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        self._container.close()
