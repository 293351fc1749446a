"""One video frame as the decoder left it: three planes of YUV 4:2:0, never converted as a whole.

A 1080 × 1920 frame turned into RGB costs 1 to 2 ms and 6 MB; the networks only look at a square of 256 pixels. So the
square is cut out of each plane on its own and only then converted. Phones store how the picture has to be turned for
viewing; that rotation, too, is just one more factor of the crop's transform.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8


@dataclass(frozen=True, slots=True)
class Colour:
    """How a picture's YUV is meant: RGB in [0, 1] is ``matrix @ (yuv - black)``, for uint8 values of Y, U and V."""

    matrix: Float[np.ndarray, "3 3"]
    black: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, red: float, blue: float, *, full_range: bool) -> "Colour":
        """Derive the conversion from the weights of red and blue in the luma (ITU-T H.273, section 8.3).

        Args:
            red: Weight of red, K_R.
            blue: Weight of blue, K_B.
            full_range: Y, U and V use 0 to 255 instead of 16 to 235 (U, V: 16 to 240).
        """
        green = 1 - red - blue
        matrix = np.array(
            [
                [1.0, 0.0, 2 * (1 - red)],
                [1.0, -2 * blue * (1 - blue) / green, -2 * red * (1 - red) / green],
                [1.0, 2 * (1 - blue), 0.0],
            ]
        )
        matrix /= [255, 255, 255] if full_range else [219, 224, 224]
        return cls(matrix=matrix, black=np.array([0.0 if full_range else 16.0, 128.0, 128.0]))


BT601, BT709, BT2020 = (0.299, 0.114), (0.2126, 0.0722), (0.2627, 0.0593)
"""The weights of red and blue, by ITU-R recommendation."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame of a video.

    ``index`` counts from 0, ``time_s`` from the first frame. ``planes`` are Y, U and V (uint8, height × width, U and V
    of half the size, rounded up): views on the decoder's memory, as coded, that is before the rotation for viewing.
    ``rotation_deg`` is that rotation, clockwise: 0, 90, 180 or 270. Everywhere outside this class, pixels are those of
    the picture as it is viewed, and (0, 0) is the centre of its top-left pixel.
    """

    index: int
    time_s: float
    planes: tuple[np.ndarray, np.ndarray, np.ndarray]
    rotation_deg: int
    colour: Colour

    @property
    def image_size_px(self) -> tuple[int, int]:
        """Width and height of the picture as it is viewed."""
        height, width = self.planes[0].shape
        return (height, width) if self.rotation_deg in (90, 270) else (width, height)

    @property
    def T_coded_frame(self) -> Float[np.ndarray, "3 3"]:
        """Map the viewed picture's pixels to the coded picture's."""
        right, bottom = self.planes[0].shape[1] - 1, self.planes[0].shape[0] - 1
        rows = {
            0: [[1, 0, 0], [0, 1, 0]],
            90: [[0, 1, 0], [-1, 0, bottom]],
            180: [[-1, 0, right], [0, -1, bottom]],
            270: [[0, -1, right], [1, 0, 0]],
        }
        return np.array([*rows[self.rotation_deg], [0, 0, 1]], dtype=np.float64)

    def crop(
        self,
        T_frame_crop: Float[np.ndarray, "3 3"],
        size_px: int,
        value_range: tuple[float, float] = (0.0, 1.0),
        border: Literal["replicate", "black"] = "replicate",
    ) -> Float32[np.ndarray, "size size 3"]:
        """Cut out a square as RGB, by bilinear interpolation.

        Args:
            T_frame_crop: Affine transform from crop pixels to the viewed picture's pixels, both counted from the centre
                of the top-left pixel.
            size_px: The crop's width and height.
            value_range: What black and white become.
            border: What lies outside the picture: its last pixel, or black.
        """
        T_luma_crop = self.T_coded_frame @ T_frame_crop
        # Chroma sample j lies at luma pixel 2j across and halfway between 2j and 2j + 1 down (H.264's default).
        T_chroma_luma = np.array([[0.5, 0.0, 0.0], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]])
        T_chroma_crop = T_chroma_luma @ T_luma_crop
        mode = cv2.BORDER_REPLICATE if border == "replicate" else cv2.BORDER_CONSTANT
        warped = [
            cv2.warpAffine(
                plane,
                T[:2],
                (size_px, size_px),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=mode,
                borderValue=black,
            )
            for plane, T, black in zip(
                self.planes, (T_luma_crop, T_chroma_crop, T_chroma_crop), self.colour.black.tolist(), strict=True
            )
        ]
        return self._to_rgb(warped, value_range)

    def rgb(self, max_side_px: int | None = None) -> UInt8[np.ndarray, "height width 3"]:
        """Convert the whole picture, as it is viewed, shrunk so that no side is longer than ``max_side_px``.

        For thumbnails and drawings; the networks get :meth:`crop`.
        """
        height, width = self.planes[0].shape
        scale = min(1.0, (max_side_px or max(height, width)) / max(height, width))
        size = max(1, round(width * scale)), max(1, round(height * scale))
        planes = [cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in self.planes]
        rgb = self._to_rgb(planes, (0.0, 255.0))
        return np.rot90(np.rint(rgb).astype(np.uint8), -self.rotation_deg // 90).copy()

    def small_planes(self, max_side_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shrink the planes as they are, turned for viewing: for encoders, which want Y, U and V, not RGB.

        Luma has an even number of rows and columns, U and V half as many; values are those of video range (16 to 235). The
        weights of red and blue stay the recording's: a player that assumes others shows slightly different colours.
        """
        height, width = self.planes[0].shape
        scale = min(1.0, max_side_px / max(height, width))
        size = max(1, round(width * scale / 2)), max(1, round(height * scale / 2))
        sizes = ((2 * size[0], 2 * size[1]), size, size)
        small = [
            cv2.resize(plane, s, interpolation=cv2.INTER_AREA) for plane, s in zip(self.planes, sizes, strict=True)
        ]
        if self.colour.black[0] == 0.0:
            ramp = np.arange(256) / 255
            luma, chroma = np.rint(16 + 219 * ramp), np.rint(16 + 224 * ramp)
            small = [
                cv2.LUT(plane, table.astype(np.uint8))
                for plane, table in zip(small, (luma, chroma, chroma), strict=True)
            ]
        turned = [np.ascontiguousarray(np.rot90(plane, -self.rotation_deg // 90)) for plane in small]
        return turned[0], turned[1], turned[2]

    def luma(self) -> UInt8[np.ndarray, "height width"]:
        """Give the picture's luma as it is viewed: the grey picture that detectors of patterns work on."""
        return np.ascontiguousarray(np.rot90(self.planes[0], -self.rotation_deg // 90))

    def _to_rgb(
        self, planes: Sequence[np.ndarray], value_range: tuple[float, float]
    ) -> Float32[np.ndarray, "height width 3"]:
        """Convert three planes of one size to RGB."""
        low, high = value_range
        matrix = self.colour.matrix * (high - low)
        affine = np.column_stack([matrix, low - matrix @ self.colour.black]).astype(np.float32)
        # OpenCV's transform takes a tenth of the time of numpy's product for such thin matrices.
        rgb = np.asarray(cv2.transform(cv2.merge(list(planes)).astype(np.float32), affine))
        return np.clip(rgb, low, high, out=rgb)
