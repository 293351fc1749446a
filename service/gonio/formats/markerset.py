"""Marker-set cards (``models/markersets/*.toml``): how keypoints are fixed to a body model.

::

    name = "blazepose33"
    model = "fullbody"                     # the built-in models, or the file that the card is for
    marker_sd_mm = 20.0
    [keypoints]
    left_knee = {marker = "knee_l", weight = 3.0}                    # a marker of the model, or
    left_hip = {joint = "hip_l", weight = 2.0}                       # the centre of a joint, or
    left_heel = {body = "calcn_l", location_mm = [0, 10, 0], weight = 1.0}
    [priors]
    subtalar_angle_l = {value_deg = 0.0, sd_deg = 5.0}               # value_mm, sd_mm for a slide
    [[measurements]]
    name = "thigh"
    pairs = [["left_hip", "left_knee"]]
    bodies = ["femur_l"]
    axes = "XYZ"
"""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from gonio.errors import InputError
from gonio.records import CoordinatePrior, MarkerSet, Measurement


def read_markerset(path: Path) -> MarkerSet:
    """Read a marker-set card; millimetres and degrees become metres and radians.

    Raises:
        InputError: the file can't be read, or an entry is missing or of the wrong kind; the message names it.
    """
    try:
        card = tomllib.loads(path.read_text(encoding="utf-8"))
        keypoints: dict[str, dict[str, Any]] = card["keypoints"]
        return MarkerSet(
            name=str(card["name"]),
            keypoint_names=tuple(keypoints),
            markers=tuple(str(entry.get("marker", "")) for entry in keypoints.values()),
            joints=tuple(str(entry.get("joint", "")) for entry in keypoints.values()),
            bodies=tuple(str(entry.get("body", "")) for entry in keypoints.values()),
            location_body_m=np.array([entry.get("location_mm", (0, 0, 0)) for entry in keypoints.values()]) / 1000.0,
            weights=np.array([float(entry["weight"]) for entry in keypoints.values()]),
            marker_sd_m=float(card["marker_sd_mm"]) / 1000.0,
            priors=tuple(_read_prior(name, entry) for name, entry in card.get("priors", {}).items()),
            measurements=tuple(_read_measurement(entry) for entry in card.get("measurements", [])),
        )
    except OSError as error:
        raise InputError(f"{path.name} can't be read: {error.strerror}.", hint="Check the path.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path.name} is not valid TOML: {error}.", hint="Mend the line it names.") from error
    except KeyError as error:
        raise InputError(f"{path.name} lacks the entry {error}.", hint="See the cards in models/markersets.") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path.name} has an entry of the wrong kind: {error}.", hint="See the cards in models/markersets."
        ) from error


def _read_prior(name: str, entry: dict[str, Any]) -> CoordinatePrior:
    if "sd_mm" in entry:
        return CoordinatePrior(coordinate=name, value=entry["value_mm"] / 1000.0, sd=entry["sd_mm"] / 1000.0)
    value, sd = np.deg2rad(entry["value_deg"]), np.deg2rad(entry["sd_deg"])
    return CoordinatePrior(coordinate=name, value=float(value), sd=float(sd))


def _read_measurement(entry: dict[str, Any]) -> Measurement:
    return Measurement(
        name=entry["name"],
        pairs=tuple((str(first), str(second)) for first, second in entry["pairs"]),
        bodies=tuple(entry["bodies"]),
        axes=entry.get("axes", "XYZ"),
        weight=float(entry.get("weight", 1.0)),
    )
