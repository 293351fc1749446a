"""What a worker can compute, by the kind of session."""

from collections.abc import Mapping
from types import MappingProxyType

from gonio.pipeline.articulated_session import OBJECT_SHARES, analyse_object
from gonio.pipeline.calibration import CALIBRATION_SHARES, calibrate
from gonio.pipeline.monocular import MONOCULAR_SHARES, analyse_one_camera
from gonio.pipeline.multicamera import analyse
from gonio.pipeline.run import STAGE_SHARES, River

RIVERS: Mapping[str, River] = MappingProxyType(
    {
        "human_multicamera": River(analyse, STAGE_SHARES),
        "human_monocular": River(analyse_one_camera, MONOCULAR_SHARES),
        "articulated_object": River(analyse_object, OBJECT_SHARES),
        "calibration": River(calibrate, CALIBRATION_SHARES),
    }
)
