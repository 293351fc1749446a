"""The virtual laboratory: people, cameras and soles whose truth is known.

::

    walker = walk(grow(body, stature_m=1.70, mass_kg=65.0), speed_m_s=1.2)
    trial = film(walker, make_rig(), markerset, effects=PRESETS["occluded"], seed=1)
    soles = press(walker, errors=SOLES["realistic"], seed=1)

``trial.points``, ``trial.rig`` and ``soles.pressure`` are what a laboratory would have; the rest is the truth.
"""

from gonio.kernel.virtual_lab.boards import wave_board
from gonio.kernel.virtual_lab.effects import (
    PRESETS,
    Bursts,
    Detector,
    Effects,
    Mismatch,
    SelfOcclusion,
    Swaps,
)
from gonio.kernel.virtual_lab.film import film
from gonio.kernel.virtual_lab.rig import CalibrationErrors, Clocks, make_rig, miscalibrate
from gonio.kernel.virtual_lab.soles import SOLES, SoleErrors, press
from gonio.kernel.virtual_lab.steps import Limp
from gonio.kernel.virtual_lab.walker import grow, truth_at, walk

__all__ = [
    "PRESETS",
    "SOLES",
    "Bursts",
    "CalibrationErrors",
    "Clocks",
    "Detector",
    "Effects",
    "Limp",
    "Mismatch",
    "SelfOcclusion",
    "SoleErrors",
    "Swaps",
    "film",
    "grow",
    "make_rig",
    "miscalibrate",
    "press",
    "truth_at",
    "walk",
    "wave_board",
]
