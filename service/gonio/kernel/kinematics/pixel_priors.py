"""What is believed of a trial before its pixels are looked at: smoothness, posture, ranges, the subject's geometry.

The numbers are standard deviations, measured on marker data of normal walking and on public keypoint detectors.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from gonio.kernel.body.forward import couple, marker_positions
from gonio.kernel.geometry.cameras import focal_lengths_px
from gonio.records import GROUND, BodyModel, MarkerSet, Motion, Rig

JERK_PER_ACCELERATION = 31.4  # 1/s: a motion of 5 Hz has 2π · 5 times as much jerk as acceleration
STIFFNESS = 0.65
"""How much of that jerk is expected. 0.5 to 1 is best on known walks and flat around it; too stiff is worse than too loose,
and not only for fast movements: the subject's lengths give way to keep the jerk low."""

ACCELERATIONS: dict[str, float] = {
    # Typical accelerations, rad/s² (pelvis translation: m/s²), by the stem of the coordinate's name.
    "pelvis_t": 4.0,
    "pelvis": 12.0,
    "lumbar": 20.0,
    "neck": 20.0,
    "hip_flexion": 40.0,
    "hip_adduction": 25.0,
    "hip_rotation": 40.0,
    "knee": 80.0,
    "ankle": 80.0,
    "subtalar": 60.0,
    "arm": 60.0,
    "elbow": 80.0,
    "pro_sup": 80.0,
    "wrist": 80.0,
}
OTHER_ACCELERATION = 60.0

POSTURES_DEG: dict[str, float] = {
    # Standard deviation of a coordinate's mean over the trial about its default: what so few keypoints hardly see.
    "hip_rotation": 20.0,
    "hip_adduction": 20.0,
    "lumbar": 20.0,
}
MOMENTS_DEG: dict[str, float] = {
    # Standard deviation of a coordinate about its default at any moment: what is at times not seen at all, like the turn of a
    # straight arm about itself, and what hardly moves in anybody.
    "subtalar": 8.0,
    "mtp": 12.0,
    "neck": 25.0,
    "arm_rot": 40.0,
    "pro_sup": 40.0,
    "wrist": 15.0,
}
ANCHORS_DEG: dict[str, float] = {
    # Standard deviation of a coordinate's mean over the trial about that of the frame by frame solution, which knows the
    # subject's geometry no better but can't bend it to the pixels: tilt and back would drift apart by 10° and more.
    "pelvis_tilt": 5.0,
    "lumbar_extension": 5.0,
}
MOMENT_S = 0.25
"""How long a moment is: beliefs about neighbouring frames are one belief."""

LIMIT_DEG = 1.5
"""How far a coordinate may go beyond its range, one standard deviation."""

LIMB_SCALE, TRUNK_SCALE, MIRROR_SCALE = 0.05, 0.01, 0.01
"""A segment's length against the measured one; pelvis and trunk, whose size so few keypoints can't tell; left against right."""

FOOT_OFFSET_M, KNEE_OFFSET_M, LOOSE_OFFSET_M, TRUNK_OFFSET_M, MIRROR_OFFSET_M = 0.012, 0.006, 0.025, 0.004, 0.006
"""A keypoint's place in its segment, against the marker set's: detectors differ, most of all at head and arms; the trunk's
are held (see TRUNK_SCALE). In the one recording of a real detector that could be asked, the knees were 2 to 7 mm off, ankles
and toes 12 to 20."""

BIAS_M = 0.008
"""A camera's constant error for a keypoint, at the subject: the detector's habit from that side, and the calibration's rest."""

TRUNK_BODIES = {"pelvis", "torso"}
HEAD_AND_ARMS = {"head", *(f"{part}_{side}" for part in ("humerus", "ulna", "radius", "hand") for side in "rl")}


@dataclass(frozen=True)
class TrialPriors:
    """The priors of one trial, as arrays over coordinates, scale groups, markers and cameras."""

    held: Bool[np.ndarray, " coordinate"]  # stays where the start has it
    jerk_sd: Float[np.ndarray, " coordinate"]  # of the third difference over frames, rad or m
    posture: Float[np.ndarray, " coordinate"]
    posture_sd: Float[np.ndarray, " coordinate"]  # of the mean over the trial; infinite where nothing is believed
    moment_sd: Float[np.ndarray, " coordinate"]  # of a single frame, weakened by how many frames are one moment
    lower: Float[np.ndarray, " coordinate"]
    upper: Float[np.ndarray, " coordinate"]
    limit_sd: float
    body_group: Int[np.ndarray, " body"]  # −1: not scaled
    group_sd: Float[np.ndarray, " group"]
    mirrored_groups: tuple[tuple[int, int], ...]
    offset_sd_m: Float[np.ndarray, " marker"]
    mirrored_markers: tuple[tuple[int, int], ...]
    bias_sd_px: Float[np.ndarray, " camera"]
    noise_px: float = 0.0  # an observation is worth no more than one with this error, new in every frame


def make_priors(
    model: BodyModel, markerset: MarkerSet, rig: Rig, rate_hz: float, distance_m: Float[np.ndarray, " camera"]
) -> TrialPriors:
    """Collect the priors for a model with a marker set's keypoints, filmed by cameras about ``distance_m`` away.

    The scale groups are the marker set's measurements that scale a body along all its axes; those of one name are left and
    right of each other.
    """
    names, coordinates = model.coordinates.names, model.coordinates
    acceleration = np.array([_by_stem(name, ACCELERATIONS, OTHER_ACCELERATION) for name in names])
    # Variance times rate is held: the same motion filmed faster has the same prior.
    jerk_sd = STIFFNESS * JERK_PER_ACCELERATION * acceleration * np.sqrt(rate_hz / 60.0) / rate_hz**3
    targets = {prior.coordinate: prior.value for prior in markerset.priors}
    posture = np.array([targets.get(name, value) for name, value in zip(names, coordinates.default, strict=True)])
    body_group, groups = _scale_groups(model, markerset)
    on_trunk = np.array([body != GROUND and model.bodies.names[body] in TRUNK_BODIES for body in model.markers.body])
    loose = np.array([body != GROUND and model.bodies.names[body] in HEAD_AND_ARMS for body in model.markers.body])
    hips, knees = (np.array([joint in name for name in model.markers.names]) for joint in ("hip", "knee"))
    return TrialPriors(
        held=~_seen_by_markers(model),
        jerk_sd=jerk_sd,
        posture=posture,
        posture_sd=np.deg2rad([_by_stem(name, POSTURES_DEG, np.inf) for name in names]),
        moment_sd=np.deg2rad([_by_stem(name, MOMENTS_DEG, np.inf) for name in names])
        * np.sqrt(max(MOMENT_S * rate_hz, 1.0)),
        lower=np.where(coordinates.clamped, coordinates.range[:, 0], -np.inf),
        upper=np.where(coordinates.clamped, coordinates.range[:, 1], np.inf),
        limit_sd=float(np.deg2rad(LIMIT_DEG)),
        body_group=body_group,
        group_sd=np.array(
            [TRUNK_SCALE if set(bodies) & (TRUNK_BODIES | {"head"}) else LIMB_SCALE for _, bodies in groups]
        ),
        mirrored_groups=_pairs([name for name, _ in groups]),
        offset_sd_m=np.select(
            [on_trunk | hips, loose, knees], [TRUNK_OFFSET_M, LOOSE_OFFSET_M, KNEE_OFFSET_M], FOOT_OFFSET_M
        ),
        mirrored_markers=_mirrored(model.markers.names),
        bias_sd_px=BIAS_M * focal_lengths_px(rig) / distance_m,
    )


def anchor(priors: TrialPriors, motion: Motion) -> TrialPriors:
    """Hold the mean of what the pixels hardly tell (see :data:`ANCHORS_DEG`) near that of a motion found another way."""
    posture, posture_sd = priors.posture.copy(), priors.posture_sd.copy()
    for name, sd_deg in ANCHORS_DEG.items():
        if name in motion.coordinate_names and np.isfinite(motion.of(name)).any():
            index = motion.coordinate_names.index(name)
            posture[index], posture_sd[index] = np.nanmean(motion.values[:, index]), np.deg2rad(sd_deg)
    return replace(priors, posture=posture, posture_sd=posture_sd)


def _seen_by_markers(model: BodyModel) -> Bool[np.ndarray, " coordinate"]:
    """Tell which coordinates move any marker, in a pose in which nothing is straight."""
    count = len(model.coordinates.names)
    q = model.coordinates.default + np.where(model.coordinates.rotational, 0.3, 0.0)
    nudged = q + np.vstack([np.zeros(count), 1e-4 * np.eye(count)])
    xyz = marker_positions(model, couple(model, nudged))
    return np.linalg.norm(xyz[1:] - xyz[0], axis=-1).max(axis=1, initial=0.0) > 1e-4 * 0.01


def _by_stem(name: str, table: dict[str, float], default: float) -> float:
    """Look a coordinate up by the longest stem that its name starts with."""
    stems = [stem for stem in table if name.startswith(stem)]
    return table[max(stems, key=len)] if stems else default


def _scale_groups(
    model: BodyModel, markerset: MarkerSet
) -> tuple[Int[np.ndarray, " body"], list[tuple[str, tuple[str, ...]]]]:
    groups = [(m.name, m.bodies) for m in markerset.measurements if set(m.axes) == set("XYZ")]
    body_group = np.full(len(model.bodies.names), -1)
    for number, (_, bodies) in enumerate(groups):
        for body in bodies:
            body_group[model.bodies.index(body)] = number
    return body_group, groups


def _pairs(names: list[str]) -> tuple[tuple[int, int], ...]:
    """Pair the positions of equal names."""
    places: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        places.setdefault(name, []).append(number)
    return tuple((both[0], both[1]) for both in places.values() if len(both) == 2)


def _mirrored(names: tuple[str, ...]) -> tuple[tuple[int, int], ...]:
    """Pair the right and the left marker of the same name."""
    return tuple(
        (number, names.index(name.replace("right", "left")))
        for number, name in enumerate(names)
        if "right" in name and name.replace("right", "left") in names
    )
