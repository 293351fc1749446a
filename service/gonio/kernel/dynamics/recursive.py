"""Recursive Newton-Euler: the generalized forces that a motion needs, with couplings and external wrenches.

Outwards over the tree go the nodes' velocities and accelerations, inwards the forces that their bodies need [Featherstone
2008, ch. 5], all in the lab's frame. The tree has one force a node; coordinates that drive several nodes, through the
coupling q_full = f(q), get their share of each by the chain rule::

    v̇_node = f' q̇        v̈_node = f' q̈ + f'' q̇²        τ_coordinate = Σ f' τ_node

Constraint forces do no work, so what comes out satisfies dE/dt = Σ τ q̇ + power of the external wrenches, for coupled
rotations too.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit

from gonio.errors import InputError
from gonio.kernel.body.tree import COORDINATE_POSE, NODE_POSE, Array, Tree, couple_coordinates, flatten, pose_nodes
from gonio.kernel.parallel import over_blocks
from gonio.records import REVOLUTE, BodyModel, record

_BLOCK = 256  # frames that one thread takes at a time: handing a block over costs as much as ten frames

NODE_MOTION = np.dtype(
    [
        ("omega", "f8", 3),  # of the node, rad/s
        ("alpha", "f8", 3),
        ("velocity", "f8", 3),  # of its origin, m/s
        ("acceleration", "f8", 3),
        ("force", "f8", 3),  # what its bodies, and all outwards of it, need; N
        ("moment", "f8", 3),  # the same about the lab's origin; Nm
    ],
    align=True,
)
BODY = np.dtype(
    [("node", "i8"), ("mass", "f8"), ("com_node", "f8", 3), ("inertia_node", "f8", (3, 3))], align=True
)  # in the node's frame; inertia about the centre of mass


WHOLE = np.dtype(
    [
        ("com", "f8", 3),
        ("momentum", "f8", 3),
        ("angular", "f8", 3),  # momentum of rotation about the centre of mass
        ("force", "f8", 3),  # needed from outside, gravity apart
        ("moment", "f8", 3),  # the same about the lab's origin
        ("energy", "f8"),
    ],
    align=True,
)


class Pushed(NamedTuple):
    """What pushes from outside, for compiled code."""

    bodies: Array  # (wrench,), the number of the body
    wrenches: Array  # (frame, wrench, 6): force, moment about the lab's origin; NaN is nothing


class Inertia(NamedTuple):
    """The bodies and gravity, for compiled code."""

    bodies: Array  # (body,) BODY
    gravity: Array  # (3,)


@record
class Wrench:
    """What pushes on one body from outside: force in the lab, and moment about the lab's origin.

    NaN means: nothing there; it counts as zero.
    """

    body: str
    force_n: Float[np.ndarray, "frame 3"]
    moment_nm: Float[np.ndarray, "frame 3"]


@record
class Dynamics:
    """The forces behind a motion, and the whole body's momentum; vectors are in the lab.

    ``forces`` are the generalized forces of the coordinates (N for slides, Nm for turns): of the joints, and for the root's
    coordinates the residual that nothing provides. A locked coordinate has the force that its lock exerts; a dependent one
    has 0, its share is in the coordinate that drives it. ``powers_w`` are those forces times the coordinates' rates: what
    each joint gives (+) or takes.

    ``momentum_ns`` is the whole body's linear momentum, ``angular_momentum_nms`` that of rotation about its centre of mass.
    ``net_force_n`` and ``net_moment_nm`` (about the lab's origin) are what the motion needs from outside in all, gravity
    apart: the rate of the momentum is the net force plus the weight, the rate of the angular momentum is
    ``net_moment_com_nm``. ``energy_j`` is kinetic plus potential (0 where the centre of mass is level with the origin).
    """

    coordinate_names: tuple[str, ...]
    forces: Float[np.ndarray, "frame coordinate"]
    powers_w: Float[np.ndarray, "frame coordinate"]
    com_lab_m: Float[np.ndarray, "frame 3"]
    momentum_ns: Float[np.ndarray, "frame 3"]
    angular_momentum_nms: Float[np.ndarray, "frame 3"]
    net_force_n: Float[np.ndarray, "frame 3"]
    net_moment_nm: Float[np.ndarray, "frame 3"]
    energy_j: Float[np.ndarray, " frame"]

    def of(self, name: str) -> Float[np.ndarray, " frame"]:
        """Give one coordinate's generalized force over time.

        Raises:
            InputError: there is no such coordinate.
        """
        if name not in self.coordinate_names:
            raise InputError(
                f"There is no coordinate named {name}.", hint=f"The model has: {', '.join(self.coordinate_names)}."
            )
        return self.forces[:, self.coordinate_names.index(name)]

    @property
    def net_moment_com_nm(self) -> Float[np.ndarray, "frame 3"]:
        """What the motion needs from outside about the body's centre of mass: the rate of its angular momentum."""
        return self.net_moment_nm - np.cross(self.com_lab_m, self.net_force_n)


def wrench_at_point(
    body: str,
    force_n: Float[np.ndarray, "frame 3"],
    point_lab_m: Float[np.ndarray, "frame 3"],
    free_moment_nm: Float[np.ndarray, "frame 3"] | float = 0.0,
) -> Wrench:
    """Make a wrench of a force at a point of the lab (a centre of pressure) and a free moment."""
    return Wrench(body=body, force_n=force_n, moment_nm=np.cross(point_lab_m, force_n) + free_moment_nm)


def solve_dynamics(
    model: BodyModel,
    q: Float[np.ndarray, "frame coordinate"],
    velocity: Float[np.ndarray, "frame coordinate"],
    acceleration: Float[np.ndarray, "frame coordinate"],
    wrenches: tuple[Wrench, ...] = (),
) -> Dynamics:
    """Find the generalized forces of a motion.

    Args:
        model: The body.
        q: The coordinates, rad and m; dependent ones are computed from those that drive them.
        velocity: Their rates.
        acceleration: The rates' rates.
        wrenches: What pushes from outside.

    Returns:
        The forces; what a NaN of the frame takes part in is NaN.

    Raises:
        InputError: a wrench on a body that the model lacks, or of another length than the motion; a motion that does not have
            one column for each coordinate.
    """
    if not q.shape == velocity.shape == acceleration.shape or q.shape[1:] != (len(model.coordinates.names),):
        raise InputError(
            f"The model has {len(model.coordinates.names)} coordinates, the motion has the shapes {q.shape}, "
            f"{velocity.shape} and {acceleration.shape}.",
            hint="Give positions, rates and accelerations of the same frames, one column for each coordinate.",
        )
    frames = len(q)
    tree, inertia, pushed = flatten(model), _inertia(model), _collect(model, wrenches, frames)
    forces, whole = np.zeros(q.shape), np.zeros(frames, dtype=WHOLE)
    values, rates, rates2 = np.array(q, dtype=float, order="C"), _read_only(velocity), _read_only(acceleration)

    def solve(start: int, stop: int) -> None:
        _solve_frames(tree, inertia, start, stop, values, rates, rates2, pushed, forces, whole)

    over_blocks(solve, frames, _BLOCK)
    return Dynamics(
        coordinate_names=model.coordinates.names,
        forces=forces,
        powers_w=forces * velocity,
        com_lab_m=whole["com"],
        momentum_ns=whole["momentum"],
        angular_momentum_nms=whole["angular"],
        net_force_n=whole["force"],
        net_moment_nm=whole["moment"],
        energy_j=whole["energy"],
    )


def _collect(model: BodyModel, wrenches: tuple[Wrench, ...], frames: int) -> Pushed:
    stacked = np.empty((frames, len(wrenches), 6))
    for index, wrench in enumerate(wrenches):
        if len(wrench.force_n) != frames:
            raise InputError(
                f"The wrench on {wrench.body} has {len(wrench.force_n)} frames, the motion {frames}.",
                hint="Resample the forces to the motion's times.",
            )
        stacked[:, index, :3], stacked[:, index, 3:] = wrench.force_n, wrench.moment_nm
    return Pushed(np.array([model.bodies.index(wrench.body) for wrench in wrenches], dtype=int), stacked)


def _read_only(values: Float[np.ndarray, "frame coordinate"]) -> Float[np.ndarray, "frame coordinate"]:
    """Give a view that compiled code may only read: one signature for whoever made the array, and no copy."""
    view = np.ascontiguousarray(values, dtype=float).view()
    view.flags.writeable = False
    return view


def _inertia(model: BodyModel) -> Inertia:
    bodies = np.empty(len(model.bodies.names), dtype=BODY)
    R, p = model.bodies.T_node_body[:, :3, :3], model.bodies.T_node_body[:, :3, 3]
    bodies["node"], bodies["mass"] = model.bodies.node, model.bodies.mass_kg
    bodies["com_node"] = np.einsum("bij,bj->bi", R, model.bodies.com_body_m) + p
    bodies["inertia_node"] = R @ model.bodies.inertia_body_kgm2 @ R.transpose(0, 2, 1)
    return Inertia(bodies, model.gravity_m_s2.copy())


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_frames(  # noqa: PLR0913 - what it fills is passed in
    tree: Tree,
    inertia: Inertia,
    start: int,
    stop: int,
    q: Array,
    velocity: Array,
    acceleration: Array,
    pushed: Pushed,
    forces: Array,  # (frame, coordinate)
    whole: Array,  # (frame,) WHOLE, zeros
) -> None:
    coordinates = np.zeros(len(tree.couplings), dtype=COORDINATE_POSE)
    nodes = np.zeros(len(tree.nodes), dtype=NODE_POSE)
    motion = np.zeros(len(tree.nodes), dtype=NODE_MOTION)
    work = np.empty((7, 3))  # scratch: an array made anew for each body would cost as much as its mechanics
    for frame in range(start, stop):
        couple_coordinates(tree, q[frame], coordinates)
        pose_nodes(tree, q[frame], coordinates, nodes)
        _move_outwards(tree, nodes, velocity[frame], acceleration[frame], motion, work)
        _load_bodies(inertia, nodes, motion, whole[frame], work)
        _push_bodies(inertia, pushed.bodies, pushed.wrenches[frame], motion)
        _gather_inwards(tree, nodes, motion, forces[frame])


@njit(cache=True, error_model="numpy")
def _move_outwards(tree: Tree, nodes: Array, velocity: Array, acceleration: Array, motion: Array, work: Array) -> None:
    """Fill the nodes' velocities and accelerations, and clear their forces."""
    arm, turned = work[0], work[1]
    for index in range(len(tree.nodes)):
        given, node, here = tree.nodes[index], nodes[index], motion[index]
        rate = rate2 = 0.0
        if given.driver >= 0:
            rate = node.first * velocity[given.driver]
            rate2 = node.first * acceleration[given.driver] + node.second * velocity[given.driver] ** 2
        for i in range(3):
            here.force[i] = here.moment[i] = 0.0
            here.omega[i] = here.alpha[i] = here.velocity[i] = here.acceleration[i] = 0.0
        if given.parent >= 0:
            parent = motion[given.parent]
            for i in range(3):
                arm[i] = node.p_lab_node[i] - nodes[given.parent].p_lab_node[i]
                here.omega[i], here.alpha[i] = parent.omega[i], parent.alpha[i]
            _cross(parent.omega, arm, turned)
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                here.velocity[i] = parent.velocity[i] + turned[i]
                here.acceleration[i] = parent.acceleration[i]
                here.acceleration[i] += parent.alpha[j] * arm[k] - parent.alpha[k] * arm[j]
                here.acceleration[i] += parent.omega[j] * turned[k] - parent.omega[k] * turned[j]
        # The node's own motion; its axis is fixed in the parent, so it turns with it.
        _cross(here.omega, node.axis_lab, turned)
        if given.kind == REVOLUTE:
            for i in range(3):
                here.alpha[i] += node.axis_lab[i] * rate2 + turned[i] * rate
                here.omega[i] += node.axis_lab[i] * rate
        else:
            for i in range(3):
                here.acceleration[i] += node.axis_lab[i] * rate2 + 2.0 * turned[i] * rate
                here.velocity[i] += node.axis_lab[i] * rate


@njit(cache=True, error_model="numpy")
def _load_bodies(inertia: Inertia, nodes: Array, motion: Array, whole: Array, work: Array) -> None:
    """Give each node the force that its bodies need, and sum up the whole body."""
    place, carried, force, spin, moment = work[0], work[1], work[2], work[3], work[4]
    mass = 0.0
    for index in range(len(inertia.bodies)):
        body = inertia.bodies[index]
        node, here = nodes[body.node], motion[body.node]
        whole.energy += _need_force(body, node, here, inertia.gravity, place, carried, force, work)
        whole.energy += _need_moment(body, node, here, spin, moment, work)
        mass += body.mass
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            about_lab = moment[i] + place[j] * force[k] - place[k] * force[j]
            whole.com[i] += body.mass * place[i]
            whole.momentum[i] += carried[i]
            whole.angular[i] += spin[i] + place[j] * carried[k] - place[k] * carried[j]
            whole.force[i] += force[i]
            whole.moment[i] += about_lab
            here.force[i] += force[i]
            here.moment[i] += about_lab
    for i in range(3):
        whole.com[i] /= mass
    _cross(whole.com, whole.momentum, spin)
    for i in range(3):  # from the lab's origin to the centre of mass
        whole.angular[i] -= spin[i]


@njit(cache=True, error_model="numpy")
def _push_bodies(inertia: Inertia, pushed: Array, wrenches: Array, motion: Array) -> None:
    """Take what pushes from outside off what the bodies' nodes need."""
    for index in range(len(pushed)):
        here, wrench = motion[inertia.bodies[pushed[index]].node], wrenches[index]
        for i in range(3):
            here.force[i] -= 0.0 if np.isnan(wrench[i]) else wrench[i]
            here.moment[i] -= 0.0 if np.isnan(wrench[3 + i]) else wrench[3 + i]


@njit(cache=True, error_model="numpy")
def _need_force(
    body: Array, node: Array, here: Array, gravity: Array, place: Array, carried: Array, force: Array, work: Array
) -> float:
    """Fill a body's centre of mass, its momentum and the force it needs, m (a − g); give its energy, rotation apart."""
    arm, turned = work[5], work[6]
    _turn(node.R_lab_node, body.com_node, arm)
    _cross(here.omega, arm, turned)
    energy = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        place[i] = node.p_lab_node[i] + arm[i]
        velocity = here.velocity[i] + turned[i]
        acceleration = here.acceleration[i] + here.alpha[j] * arm[k] - here.alpha[k] * arm[j]
        acceleration += here.omega[j] * turned[k] - here.omega[k] * turned[j]
        carried[i] = body.mass * velocity
        force[i] = body.mass * (acceleration - gravity[i])
        energy += body.mass * (0.5 * velocity**2 - gravity[i] * place[i])
    return energy


@njit(cache=True, error_model="numpy")
def _need_moment(body: Array, node: Array, here: Array, spin: Array, moment: Array, work: Array) -> float:
    """Fill a body's momentum of rotation and the moment that it needs, about its centre of mass; give its energy of rotation.

    By Euler's equation, I α + ω × I ω: the products with I in the node's frame, where the inertia stays the same.
    """
    own, turned = work[5], work[6]
    _turn_back(node.R_lab_node, here.omega, own)
    _turn(body.inertia_node, own, turned)
    _turn(node.R_lab_node, turned, spin)
    energy = 0.0
    for i in range(3):
        energy += 0.5 * own[i] * turned[i]
    _turn_back(node.R_lab_node, here.alpha, own)
    _turn(body.inertia_node, own, turned)
    _turn(node.R_lab_node, turned, moment)
    for i in range(3):  # ω × I ω is the same vector in either frame
        j, k = (i + 1) % 3, (i + 2) % 3
        moment[i] += here.omega[j] * spin[k] - here.omega[k] * spin[j]
    return energy


@njit(cache=True, error_model="numpy")
def _gather_inwards(tree: Tree, nodes: Array, motion: Array, forces: Array) -> None:
    """Hand the forces inwards and project each node's on what it is free to do."""
    forces[:] = 0.0
    for index in range(len(tree.nodes) - 1, -1, -1):
        given, node, here = tree.nodes[index], nodes[index], motion[index]
        if given.driver >= 0:
            along = 0.0
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                if given.kind == REVOLUTE:
                    about = here.moment[i] - node.p_lab_node[j] * here.force[k] + node.p_lab_node[k] * here.force[j]
                    along += node.axis_lab[i] * about
                else:
                    along += node.axis_lab[i] * here.force[i]
            forces[given.driver] += node.first * along
        if given.parent >= 0:
            parent = motion[given.parent]
            for i in range(3):
                parent.force[i] += here.force[i]
                parent.moment[i] += here.moment[i]


@njit(cache=True, error_model="numpy")
def _cross(a: Array, b: Array, product: Array) -> None:
    product[0] = a[1] * b[2] - a[2] * b[1]
    product[1] = a[2] * b[0] - a[0] * b[2]
    product[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy")
def _turn(R: Array, a: Array, turned: Array) -> None:
    for i in range(3):
        turned[i] = R[i, 0] * a[0] + R[i, 1] * a[1] + R[i, 2] * a[2]


@njit(cache=True, error_model="numpy")
def _turn_back(R: Array, a: Array, turned: Array) -> None:
    for i in range(3):
        turned[i] = R[0, i] * a[0] + R[1, i] * a[1] + R[2, i] * a[2]
