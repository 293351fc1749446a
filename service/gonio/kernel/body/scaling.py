"""Scaling: a generic body model made to fit one person.

A *measurement* compares distances between pairs of markers as they were seen with the same distances in the model's
default pose; its ratio scales the bodies that it lists, along the axes that it lists. That is how OpenSim's ScaleTool
works.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from gonio.errors import CaptureError, InputError
from gonio.kernel.body.forward import marker_positions
from gonio.records import GROUND, PRISMATIC, Bodies, BodyModel, Functions, JointTree, Markers, Measurement

Method = Literal["ratio", "least_squares"]
Average = Literal["median", "mean"]


def measure_scale_factors(
    model: BodyModel,
    measurements: tuple[Measurement, ...],
    xyz_lab_m: Float[np.ndarray, "frame marker 3"],
    *,
    method: Method = "ratio",
    average: Average = "median",
    symmetric: bool = True,
) -> Float[np.ndarray, "body 3"]:
    """Find each body's scale factors from a trial, standing or moving.

    Args:
        model: The generic model; the markers of the measurements are among its markers.
        measurements: What to measure; a later one overrides an earlier one on the same body and axis.
        xyz_lab_m: Where the model's markers were seen, NaN where not.
        method: ``ratio``: the mean over the pairs of seen / model distance, OpenSim's way. ``least_squares``: the
            factor s that minimises Σ weight · (seen − s · model)², which trusts long distances more than short ones.
        average: How a pair's distance is taken over the frames in which both were seen: the median, which single wild
            frames don't move, or OpenSim's mean.
        symmetric: Pool measurements of the same name, such as those of the left and the right thigh.

    Returns:
        Factors along the body's own axes; 1 where nothing was measured.

    Raises:
        InputError: a measurement names a marker or body that the model lacks.
        CaptureError: a pair of markers was never seen together.
    """
    positions = marker_positions(model, model.coordinates.default[None])[0]
    groups: dict[str, list[Measurement]] = {}
    for number, measurement in enumerate(measurements):
        groups.setdefault(measurement.name if symmetric else f"{number}", []).append(measurement)
    factors = np.ones((len(model.bodies.names), 3))
    for group in groups.values():
        pairs = [pair for measurement in group for pair in measurement.pairs]
        seen, own = _distances(model, pairs, xyz_lab_m, positions, average)
        if method == "ratio":
            factor = float(np.mean(seen / own))
        else:
            weights = np.concatenate([np.full(len(m.pairs), m.weight) for m in group])
            factor = float(np.sum(weights * seen * own) / np.sum(weights * own**2))
        for measurement in group:
            for body in measurement.bodies:
                factors[model.bodies.index(body), ["XYZ".index(axis) for axis in measurement.axes]] = factor
    return factors


def _distances(
    model: BodyModel,
    pairs: list[tuple[str, str]],
    xyz_lab_m: Float[np.ndarray, "frame marker 3"],
    positions: Float[np.ndarray, "marker 3"],
    average: Average,
) -> tuple[Float[np.ndarray, " pair"], Float[np.ndarray, " pair"]]:
    """Give the pairs' distances as seen, averaged over the frames, and in the model, metres."""
    over_frames = np.nanmedian if average == "median" else np.nanmean
    seen, own = np.empty(len(pairs)), np.empty(len(pairs))
    for row, (name, other) in enumerate(pairs):
        a, b = model.markers.index(name), model.markers.index(other)
        apart = np.linalg.norm(xyz_lab_m[:, a] - xyz_lab_m[:, b], axis=-1)
        if not np.any(np.isfinite(apart)):
            raise CaptureError(
                f"{name} and {other} are never seen in the same frame, but the body is scaled by their distance.",
                hint="Film the person standing in view of all cameras for a second, or leave this measurement out.",
                code="scaling-pair-missing",
            )
        seen[row], own[row] = over_frames(apart), np.linalg.norm(positions[a] - positions[b])
        if own[row] < 1e-6:
            raise InputError(f"{name} and {other} are one point in the model.", hint="Measure between two points.")
    return seen, own


def scale_model(
    model: BodyModel,
    factors: Float[np.ndarray, "body 3"],
    *,
    mass_kg: float | None = None,
    keep_shares: bool = True,
) -> BodyModel:
    """Scale a model's geometry, and its masses to the person's.

    Lengths scale body by body: joints, centres of mass and markers with the body they are fixed in, and a joint's
    coupled slides (the knee's) with its parent body, as in OpenSim. Inertias become those of the stretched mass
    distribution: m L² for equal factors, as in OpenSim, and for unequal ones exact too, since the second moments
    ∫ρ x xᵀ transform as S (∫ρ x xᵀ) S (OpenSim takes the body for a cylinder then).

    Args:
        model: The generic model.
        factors: Scale factors along each body's own axes, positive.
        mass_kg: The person's mass; None keeps the model's.
        keep_shares: Keep the bodies' shares in the mass; else they change with the volumes.

    Returns:
        The scaled model.

    Raises:
        InputError: a factor that is not positive and finite, or an impossible mass.
    """
    if not (np.all(np.isfinite(factors)) and np.all(factors > 0)):
        raise InputError("A scale factor is not positive.", hint="Check the measured distances.")
    if mass_kg is not None and not 0 < mass_kg < np.inf:
        raise InputError(f"A body mass of {mass_kg} kg is impossible.", hint="Give the person's mass in kilograms.")
    masses = model.bodies.mass_kg if keep_shares else model.bodies.mass_kg * factors.prod(axis=1)
    masses = masses * ((model.mass_kg if mass_kg is None else mass_kg) / masses.sum())
    return replace(
        model,
        joints=_scale_joints(model, factors),
        functions=_scale_slides(model, factors),
        bodies=_scale_bodies(model.bodies, factors, masses),
        markers=_scale_markers(model.markers, factors),
    )


def _scale_joints(model: BodyModel, factors: Float[np.ndarray, "body 3"]) -> JointTree:
    """Scale the placement of the nodes: their translation, turned into the parent body's axes and back."""
    placement = model.joints.T_parent_node.copy()
    for node, body in enumerate(model.joints.parent_body):
        if body != GROUND:
            R_node_body = model.bodies.T_node_body[body, :3, :3]
            placement[node, :3, 3] = R_node_body @ (factors[body] * (R_node_body.T @ placement[node, :3, 3]))
    return replace(model.joints, T_parent_node=placement)


def scaled_slides(model: BodyModel) -> list[int]:
    """List the nodes that slide by a length of their parent body, which grows with it.

    A slide by a coordinate itself (value = coordinate) is in metres already and stays.
    """
    joints, functions = model.joints, model.functions
    identity = np.zeros(functions.coefficients.shape[1])
    identity[1:2] = 1.0
    found: list[int] = []
    for node in np.flatnonzero(joints.kind == PRISMATIC).tolist():
        if joints.function[node] < 0:
            continue
        itself = joints.coordinate[node] >= 0 and np.array_equal(
            functions.coefficients[functions.pieces_of(joints.function[node])], identity[None]
        )
        if joints.parent_body[node] != GROUND and not itself:
            found.append(node)
    return found


def _scale_slides(model: BodyModel, factors: Float[np.ndarray, "body 3"]) -> Functions:
    """Scale the coupled slides."""
    joints, coefficients = model.joints, model.functions.coefficients.copy()
    for node in scaled_slides(model):
        pieces = model.functions.pieces_of(joints.function[node])
        coefficients[pieces] *= joints.axis[node] ** 2 @ factors[joints.parent_body[node]]
    return replace(model.functions, coefficients=coefficients)


def _scale_bodies(
    bodies: Bodies, factors: Float[np.ndarray, "body 3"], masses_kg: Float[np.ndarray, " body"]
) -> Bodies:
    has_mass = bodies.mass_kg > 0
    mass_ratio = np.divide(masses_kg, bodies.mass_kg, out=np.zeros(len(masses_kg)), where=has_mass)
    R_node_body = bodies.T_node_body[:, :3, :3]
    T_node_body = bodies.T_node_body.copy()
    in_body = np.einsum("bji,bj->bi", R_node_body, T_node_body[:, :3, 3])
    T_node_body[:, :3, 3] = np.einsum("bij,bj->bi", R_node_body, factors * in_body)
    half_trace = np.trace(bodies.inertia_body_kgm2, axis1=1, axis2=2)[:, None, None] / 2
    stretch = factors[:, :, None] * factors[:, None, :]
    second_moment = (half_trace * np.eye(3) - bodies.inertia_body_kgm2) * stretch
    inertia = np.trace(second_moment, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second_moment
    return replace(
        bodies,
        T_node_body=T_node_body,
        mass_kg=masses_kg,
        com_body_m=bodies.com_body_m * factors,
        inertia_body_kgm2=inertia * mass_ratio[:, None, None],
    )


def _scale_markers(markers: Markers, factors: Float[np.ndarray, "body 3"]) -> Markers:
    on_body = markers.body != GROUND
    location = markers.location_body_m.copy()
    location[on_body] *= factors[markers.body[on_body]]
    return replace(markers, location_body_m=location)
