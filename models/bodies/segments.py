"""The published numbers that the built-in bodies are made of, for a man and for a woman.

Masses, centres of mass and radii of gyration are the regressions of

    Dumas, Chèze & Verriest 2007, "Adjustments to McConville et al. and Young et al. body segment inertial
    parameters", J Biomech 40:543-553, with its corrigendum (40:1651-1652), in the arrangement of Dumas & Wojtusch
    2018, "Estimation of the body segment inertial parameters for the rigid body biomechanical models used in motion
    analysis", Handbook of Human Motion, tables 1 to 10 (thorax and abdomen apart).

They were compared, entry by entry, with public transcriptions of these tables in three independent programs: masses,
centres of mass and radii of gyration agree, but for one obvious misprint over there. The papers themselves were not at
hand.

Segment frames: X forwards, Y up, Z to the right, origin at the proximal joint; percentages are of the segment's length.
A negative radius stands for the tables' imaginary one: the tensor's off-diagonal entry is then negative.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Segment:
    """One segment: share of the body's mass, length, centre of mass and radii of gyration (xx yy zz xy xz yz)."""

    mass_pct: float
    length_mm: float
    com_pct: tuple[float, float, float]
    gyration_pct: tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Person:
    """One set of segments with the people it was measured on."""

    mass_kg: float
    segments: dict[str, Segment]
    # Joint centres from the middle between the front iliac spines, as fractions of their distance (pelvis width):
    # Reed et al. 1999 (SAE 1999-01-0959) turned into the ISB pelvis frame in Dumas & Wojtusch 2018, read from one of
    # the public transcriptions above.
    hip_per_width: tuple[float, float, float]
    lumbar_per_width: tuple[float, float, float]


# Sample: McConville et al. 1980, 31 men of 27.5 years, 80.5 kg, 1.77 m. Lengths: mean lengths of Dumas et al. 2007,
# table 1. The thorax' 334 mm and the woman's 322 mm are of Dumas & Wojtusch 2018; the abdomen is what is left of the
# torso's 477 and 429 mm, which takes the three joints to be in one line (published abdomen length: not confirmed).
# One transcription has 278 mm for the man's head.
MAN = Person(
    mass_kg=80.5,
    segments={
        "head": Segment(6.7, 277, (2.0, 53.4, 0.1), (28, 21, 30, -7, -2, 3)),
        "thorax": Segment(30.4, 334, (0.0, -55.5, -0.4), (42, 33, 36, -11, 1, 3)),
        "abdomen": Segment(2.9, 143, (17.6, -36.1, -3.3), (54, 66, 40, 11, -6, -5)),
        "pelvis": Segment(14.2, 94, (-0.2, -28.2, -0.6), (102, 106, 96, -25, -12, -8)),
        "arm": Segment(2.4, 271, (1.8, -48.2, -3.1), (29, 13, 30, 5, 3, -13)),
        "forearm": Segment(1.7, 283, (-1.3, -41.7, 1.1), (28, 11, 28, 8, -1, 2)),
        "hand": Segment(0.6, 80, (8.2, -83.9, 7.5), (61, 38, 56, 22, 15, -20)),
        "thigh": Segment(12.3, 432, (-4.1, -42.9, 3.3), (29, 15, 30, 7, -2, -7)),
        "shank": Segment(4.8, 433, (-4.8, -41.0, 0.7), (28, 10, 28, -4, -2, 4)),
        "foot": Segment(1.2, 139, (50.2, -19.9, 3.4), (22, 49, 48, 17, -11, 0)),
    },
    hip_per_width=(-0.095, -0.370, 0.361),
    lumbar_per_width=(-0.335, -0.032, 0.0),
)

# Sample: Young et al. 1983, 46 women of 31.2 years, 63.9 kg, 1.61 m.
WOMAN = Person(
    mass_kg=63.9,
    segments={
        "head": Segment(6.7, 243, (0.8, 55.9, -0.1), (30, 24, 31, -5, 1, 0)),
        "thorax": Segment(26.3, 322, (1.5, -54.2, 0.1), (38, 32, 34, -12, -3, 1)),
        "abdomen": Segment(4.1, 107, (21.9, -41.0, 0.3), (65, 78, 52, 25, -3, -5)),
        "pelvis": Segment(14.7, 107, (-7.2, -22.8, 0.2), (95, 105, 82, -35, -3, -2)),
        "arm": Segment(2.3, 243, (-5.5, -50.0, -3.3), (30, 15, 30, -3, 5, 3)),
        "forearm": Segment(1.4, 247, (2.1, -41.1, 1.9), (27, 14, 25, 10, 3, -13)),
        "hand": Segment(0.5, 71, (7.7, -76.8, 4.8), (64, 43, 59, 29, 23, -28)),
        "thigh": Segment(14.6, 379, (-7.7, -37.7, 0.8), (31, 19, 32, -7, 2, -7)),
        "shank": Segment(4.5, 388, (-4.9, -40.4, 3.1), (28, 10, 28, 2, 1, 6)),
        "foot": Segment(1.0, 117, (38.2, -30.9, 5.5), (24, 50, 50, -15, 9, -5)),
    },
    hip_per_width=(-0.139, -0.336, 0.372),
    lumbar_per_width=(-0.340, 0.049, 0.0),
)

# Tibia against femur while the knee bends (rad, flexion positive here; m in a femur whose knee lies 395.85 mm below
# the hip): the planar knee of Yamaguchi & Zajac 1989 (J Biomech 22:1-10), with the knots of the OpenSim gait models
# 2354 and 2392 (Delp et al. 1990). Those count flexion as negative.
KNEE_FORWARD = (
    (
        -2.0944,
        -1.52146,
        -0.490178,
        -0.337395,
        -0.197344,
        0.174533,
        0.349066,
        0.698132,
        1.0472,
        1.39626,
        1.74533,
        2.0944,
    ),
    (-0.00525, -0.005435, -0.005574, -0.005435, -0.005227, -0.0031, -0.001, 0.00212, 0.0041, 0.00411, 0.00179, -0.0032),
)
KNEE_UP = (
    (-2.0944, -0.159149, 0.174533, 0.349066, 0.523599, 1.22173, 2.0944),
    (-0.396, -0.395264, -0.3966, -0.3976, -0.399, -0.4082, -0.4226),
)

# The foot of the same models (Delp et al. 1990; axes after Inman 1976): axes of the right foot, and where its joints
# lie. Their ankle-to-toe-joint distance of 138 mm scales to the person's foot length.
ANKLE_AXIS = (-0.10501355, -0.17402245, 0.97912632)
SUBTALAR_AXIS = (0.78717961, 0.60474746, -0.12094949)
TOE_AXIS = (-0.58095440, 0.0, 0.81393611)
HEEL_FROM_ANKLE_M = (-0.04877, -0.04195, 0.00792)
TOES_FROM_HEEL_M = (0.1788, -0.002, 0.00108)
TOES_SHARE = 0.2166 / (1.25 + 0.2166)  # of the foot's mass
TOES_COM_M = (0.0346, 0.006, -0.0175)
TOES_INERTIA_KGM2 = (0.0001, 0.0002, 0.0001)  # of 0.2166 kg

# Shoulder joint in the torso's frame, for a man, from the lumbar joint: rounded from the acromial joint of the full-body
# model of Rajagopal et al. 2016 (IEEE Trans Biomed Eng 63:2068-2079), read from a public model made from it. Scaling to a
# person's own shoulders replaces it.
SHOULDER_M = (0.003, 0.372, 0.170)
SHOULDER_TORSO_MM = 477.0

# Points of the face from the lower neck joint, for a man's head of 277 mm; right side. Estimates of ours, good to a
# centimetre or two and weighted accordingly: heights from the stature of eyes, ears and mouth in common anthropometry (not
# one table); depths from a craniovertebral angle of about 50°, which puts the ear 45 mm before the joint in an upright
# posture. The head's Y axis runs from that joint to the vertex and leans forwards by 8° then, so the points were turned
# by as much.
FACE_M = {
    "nose": (0.147, 0.137, 0.0),
    "eye": (0.113, 0.167, 0.033),
    "eye_inner": (0.118, 0.167, 0.017),
    "eye_outer": (0.105, 0.167, 0.047),
    "ear": (0.025, 0.150, 0.073),
    "mouth": (0.125, 0.095, 0.025),
    "vertex": (0.0, 0.277, 0.0),
}
FACE_HEAD_MM = 277.0
