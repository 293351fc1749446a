"""The body as the solvers see it: a tree of elementary joints, and the motion that they found.

A model of any make (an OpenSim file, our own) is taken apart into *nodes*. A node has one parent and at most one
degree of freedom, a turn about or a slide along one fixed axis, so that a knee whose shin slides while it bends is
four nodes that
follow one coordinate. Two maps describe every model::

    value of a node      = f(coordinate)                    the coupling q_full = f(q)
    pose of a node       = pose of its parent · T_parent_node · (turn or slide by its value)

Every f is one piecewise polynomial, whatever its file called it (constant, linear, spline), so that a compiled solver
sees nothing but plain arrays.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from gonio.errors import InputError
from gonio.records.record import record

FIXED, REVOLUTE, PRISMATIC = 0, 1, 2
"""What a node does: nothing, turn about its axis (value in rad), or slide along it (value in m)."""

GROUND = -1
"""The parent of the first nodes, and the body of what is fixed in the lab."""

SOLVED, PARTIAL, NOT_CONVERGED, TOO_FEW_MARKERS = 0, 1, 2, 3
"""The values of ``Motion.status``: all known; some NaN for want of markers; the iteration limit struck; all NaN."""


@record
class Functions:
    """Scalar functions of one variable, each a row of polynomial pieces.

    Function ``i`` owns the pieces ``first_piece[i]`` to ``first_piece[i + 1]``. A piece holds from ``piece_from`` (the
    first of each function from minus infinity) to where the next one starts, and its value at x is
    Σₖ ``coefficients[piece, k] (x − origin)ᵏ``. Extrapolation is the matter of the first and the last piece.
    """

    first_piece: Int[np.ndarray, " functions_and_1"]
    piece_from: Float[np.ndarray, " piece"]
    origin: Float[np.ndarray, " piece"]
    coefficients: Float[np.ndarray, "piece power"]

    def pieces_of(self, function: int) -> slice:
        """Give where a function's pieces are."""
        return slice(int(self.first_piece[function]), int(self.first_piece[function + 1]))


@record
class JointTree:
    """The nodes, parents first.

    ``axis`` is a unit vector in the node's own frame. ``T_parent_node`` is the pose, at value 0, in the parent node's
    frame (metres). ``function`` and ``coordinate`` say that the node's value is function(coordinate); both are −1 for
    a fixed node, ``coordinate`` alone for a constant. ``parent_body`` is the body that the joint hangs on: its scale
    factors scale the placement and the slides.
    """

    names: tuple[str, ...]
    parent: Int[np.ndarray, " node"]
    kind: Int[np.ndarray, " node"]
    axis: Float[np.ndarray, "node 3"]
    T_parent_node: Float[np.ndarray, "node 4 4"]
    function: Int[np.ndarray, " node"]
    coordinate: Int[np.ndarray, " node"]
    parent_body: Int[np.ndarray, " node"]

    def __post_init__(self) -> None:
        if len(self.names) != len(self.parent) or np.any(self.parent >= np.arange(len(self.parent))):
            raise InputError(
                "A node of the joint tree comes before its parent.", hint="List each body after the one it hangs on."
            )


@record
class Coordinates:
    """The generalized coordinates: rad where ``rotational``, else m.

    A coordinate with ``coupled_to`` ≥ 0 depends on another one: its value is ``coupling_function`` of it. ``range``
    binds the solvers only where ``clamped``; a ``locked`` coordinate keeps its ``default``.
    """

    names: tuple[str, ...]
    rotational: Bool[np.ndarray, " coordinate"]
    default: Float[np.ndarray, " coordinate"]
    range: Float[np.ndarray, "coordinate 2"]
    clamped: Bool[np.ndarray, " coordinate"]
    locked: Bool[np.ndarray, " coordinate"]
    coupled_to: Int[np.ndarray, " coordinate"]
    coupling_function: Int[np.ndarray, " coordinate"]

    def index(self, name: str) -> int:
        """Give the position of a coordinate by name."""
        return _index_of(name, self.names, "coordinate")


@record
class Bodies:
    """The rigid bodies: ``T_node_body`` places each in the frame of its node; inertia is about the centre of mass."""

    names: tuple[str, ...]
    node: Int[np.ndarray, " body"]
    T_node_body: Float[np.ndarray, "body 4 4"]
    mass_kg: Float[np.ndarray, " body"]
    com_body_m: Float[np.ndarray, "body 3"]
    inertia_body_kgm2: Float[np.ndarray, "body 3 3"]

    def index(self, name: str) -> int:
        """Give the position of a body by name."""
        return _index_of(name, self.names, "body")


@record
class Markers:
    """Named points on bodies (``body`` −1: in the lab): what is seen of the model.

    A ``fixed`` one keeps its place in the body when markers are moved to where a static trial saw them.
    """

    names: tuple[str, ...]
    body: Int[np.ndarray, " marker"]
    location_body_m: Float[np.ndarray, "marker 3"]
    fixed: Bool[np.ndarray, " marker"]

    def index(self, name: str) -> int:
        """Give the position of a marker by name."""
        return _index_of(name, self.names, "marker")


@record
class BodyModel:
    """An articulated body: joints, coupling, coordinates, masses, markers. Lab frame Y up, SI units.

    ``source`` names the file that the model came from, for error messages and reports.
    """

    name: str
    source: str
    joints: JointTree
    functions: Functions
    coordinates: Coordinates
    bodies: Bodies
    markers: Markers
    gravity_m_s2: Float[np.ndarray, "3"]

    @property
    def mass_kg(self) -> float:
        """The mass of all bodies."""
        return float(self.bodies.mass_kg.sum())

    @property
    def weight_n(self) -> float:
        """The weight of all bodies."""
        return self.mass_kg * float(np.linalg.norm(self.gravity_m_s2))


@record
class Tasks:
    """What inverse kinematics weighs: Σ w |marker − observed|² / (2 Σ w) + Σ w (coordinate − target)² / 2.

    The first sum runs over the markers that are observed in the frame, metres; the second over the coordinates, rad
    and m. That is OpenSim's cost function, with its normalisation. A weight of 0 leaves a marker or coordinate out.
    ``target_sd`` is how far from its target a coordinate may really be: error bars count it; 0 takes it as exact.
    """

    marker_weights: Float[np.ndarray, " marker"]
    coordinate_weights: Float[np.ndarray, " coordinate"]
    coordinate_targets: Float[np.ndarray, " coordinate"]
    target_sd: Float[np.ndarray, " coordinate"]

    def __post_init__(self) -> None:
        for weights in (self.marker_weights, self.coordinate_weights, self.target_sd):
            if not (np.all(np.isfinite(weights)) and np.all(weights >= 0)):
                raise InputError(
                    "A weight or a standard deviation is negative or not finite.", hint="Give numbers of 0 or more."
                )


@record
class Motion:
    """A model's coordinates over time, as inverse kinematics found them: rad where ``rotational``, else m.

    A coordinate that no marker tells of is NaN in that frame, and ``status`` says so. ``residual_rms_m`` is the root
    mean square distance of the observed markers from the model's, unweighted. ``covariance`` is that of the
    coordinates of one frame, NaN where they are; where nobody needs more than ``sd``, their standard deviations, it is left
    out, for it is by far the largest array of a long trial.
    """

    coordinate_names: tuple[str, ...]
    rotational: Bool[np.ndarray, " coordinate"]
    times_s: Float[np.ndarray, " frame"]
    values: Float[np.ndarray, "frame coordinate"]
    status: UInt8[np.ndarray, " frame"]
    iterations: Int[np.ndarray, " frame"]
    residual_rms_m: Float[np.ndarray, " frame"]
    covariance: Float[np.ndarray, "frame coordinate coordinate"] | None = None
    sd: Float[np.ndarray, "frame coordinate"] | None = None

    def of(self, name: str) -> Float[np.ndarray, " frame"]:
        """Give the course of one coordinate by name."""
        return self.values[:, _index_of(name, self.coordinate_names, "coordinate")]


def _index_of(name: str, names: tuple[str, ...], what: str) -> int:
    if name not in names:
        raise InputError(f"There is no {what} named {name}.", hint=f"The model has: {', '.join(names)}.")
    return names.index(name)
