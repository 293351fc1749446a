"""How a set of keypoints or markers is fixed to a body model, weighed and used for scaling."""

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.records.record import record


@record
class Measurement:
    """Distances between pairs of markers that scale some bodies along some of their axes (a subset of ``XYZ``).

    Measurements of one name, such as those of the left and the right thigh, may be pooled. ``weight`` counts in least
    squares only.
    """

    name: str
    pairs: tuple[tuple[str, str], ...]
    bodies: tuple[str, ...]
    axes: str = "XYZ"
    weight: float = 1.0

    def __post_init__(self) -> None:
        if not self.pairs or not self.axes or not set(self.axes) <= set("XYZ"):
            raise InputError(
                f"The measurement {self.name} has {len(self.pairs)} pairs and the axes {self.axes!r}.",
                hint="Give at least one pair of markers, and axes out of X, Y, Z.",
            )


@record
class CoordinatePrior:
    """What is believed of a coordinate before anything is seen: a value and its standard deviation, rad or m."""

    coordinate: str
    value: float
    sd: float


@record
class MarkerSet:
    """A card that fixes keypoints in a body model.

    Keypoint ``i`` is the model's own marker ``markers[i]`` or the centre of its joint ``joints[i]``, where these are not
    empty, else the point ``location_body_m[i]`` of ``bodies[i]``. ``weights`` are those of inverse kinematics, 0 for a
    keypoint that is not used. ``marker_sd_m`` is the standard deviation of a keypoint of weight 1: it makes the priors'
    standard deviations commensurable with distances.
    """

    name: str
    keypoint_names: tuple[str, ...]
    markers: tuple[str, ...]
    joints: tuple[str, ...]
    bodies: tuple[str, ...]
    location_body_m: Float[np.ndarray, "keypoint 3"]
    weights: Float[np.ndarray, " keypoint"]
    marker_sd_m: float
    priors: tuple[CoordinatePrior, ...]
    measurements: tuple[Measurement, ...]

    def __post_init__(self) -> None:
        if (
            not len(self.keypoint_names)
            == len(self.markers)
            == len(self.joints)
            == len(self.bodies)
            == len(self.weights)
        ):
            raise InputError(
                f"The marker set {self.name} does not place each of its keypoints.",
                hint="Give each a marker or a joint of the model, or a body and a location; and a weight.",
            )
