"""What goes wrong between a person and a keypoint, each effect switchable; and the named mixtures.

Lengths are metres at the person, so that they mean the same to every camera: a keypoint network looks at the person in
a crop of fixed size. 10 mm are 4.2 px in the balancing recording (focal length 1680 px, 4 m away), and 1.1 px in the
default rig. Times are seconds.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gonio.kernel.virtual_lab.rig import CalibrationErrors, Clocks


@dataclass(frozen=True)
class Detector:
    """The scatter of a good keypoint, and how far the network knows it.

    Measured on the balancing recording (docs/validation/virtual-lab.md): the confidence lies about ``confidence`` (less at
    the feet) and wanders by ``confidence_sd``; the scatter per axis is ``sigma_m`` at that confidence and grows as its
    inverse; a share ``white`` of its variance is new in each frame, the rest dies away with ``correlation_s``. ``bias_m``
    is what each camera sees each keypoint displaced by for good.
    """

    sigma_m: float = 0.009
    confidence: float = 0.65
    confidence_sd: float = 0.08
    foot_confidence: float = 0.55
    white: float = 0.24
    correlation_s: float = 0.105
    bias_m: float = 0.004


@dataclass(frozen=True)
class Bursts:
    """A keypoint sits somewhere else for a while; in some cases the network is as sure as ever.

    5 to 20 frames at 60 Hz, 40 to 150 px in the balancing recording.
    """

    share: float = 0.13
    length_s: tuple[float, float] = (5 / 60, 20 / 60)
    size_m: tuple[float, float] = (0.095, 0.357)
    confident: float = 0.4


@dataclass(frozen=True)
class Swaps:
    """Left and right leg are taken for each other in one camera, for 2 to 6 frames at 60 Hz."""

    share: float = 0.02
    length_s: tuple[float, float] = (2 / 60, 6 / 60)


@dataclass(frozen=True)
class SelfOcclusion:
    """A keypoint behind another limb: less confidence, so more scatter; often it is seen on the near limb instead.

    A share ``pulled`` of the time it is drawn towards its counterpart of the other side, by 40 to 100 % of the way; the
    confidence then falls once more.
    """

    confidence: float = 0.6  # times
    pulled: float = 0.6
    pull: tuple[float, float] = (0.4, 1.0)
    pulled_confidence: float = 0.6  # times


@dataclass(frozen=True)
class Mismatch:
    """The person is not the model: where keypoints really sit.

    The knee bends about an axis that is tilted by ``knee_axis_rad`` in the frontal plane; keypoints of hip, knee and ankle
    slide over the skin by so much at the largest flexion; the trunk, which the model takes for rigid, bends.
    """

    knee_axis_rad: float = np.deg2rad(3.0)
    hip_slide_m: float = 0.020
    knee_slide_m: float = 0.012
    ankle_slide_m: float = 0.008
    trunk_m: float = 0.008


@dataclass(frozen=True)
class Effects:
    """Everything that goes wrong in a recording; None, or 0, is: nothing."""

    detector: Detector | None = None
    bursts: Bursts | None = None
    swaps: Swaps | None = None
    occlusion: SelfOcclusion | None = None
    mismatch: Mismatch | None = None
    dropouts: float = 0.0  # share of the observations
    calibration: CalibrationErrors = field(default_factory=CalibrationErrors)
    clocks: Clocks = field(default_factory=Clocks)


_PAPER = Effects(detector=Detector(), occlusion=SelfOcclusion(pulled_confidence=0.3), bursts=Bursts(confident=0.0))
_BURSTS = Effects(detector=Detector(sigma_m=0.012, white=1.0, bias_m=0.0), bursts=Bursts(), dropouts=0.03)
_OCCLUDED = replace(_BURSTS, occlusion=SelfOcclusion(), swaps=Swaps())

PRESETS: Mapping[str, Effects] = {
    "clean": Effects(),
    "paper": _PAPER,
    "bursts": _BURSTS,
    "occluded": _OCCLUDED,
    "mismatch": replace(
        _OCCLUDED,
        detector=Detector(sigma_m=0.009, white=0.0, correlation_s=0.075, bias_m=0.008),
        mismatch=Mismatch(),
        calibration=CalibrationErrors(rotation_rad=np.deg2rad(0.1), translation_m=0.004),
    ),
}
"""``clean``: exact projections. ``paper``: a good detector in the paper's rig, whose errors it knows of: without weights,
with confidences and with a robust loss the lengths of limbs come out as wrong as the paper has them. ``bursts``: outliers
as in the comparison of triangulators (docs/validation/virtual-lab.md), on noise that is new in every frame. ``occluded``: all
that goes wrong in pictures. ``mismatch``: that, with noise that lasts, and a person who is not the model."""
