"""Rigid transforms as 4 × 4 matrices, named ``T_a_b``: it maps b's coordinates into a."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def transform(rotation: Float[np.ndarray, "3 3"], translation_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Compose a rigid transform of a rotation and the origin of b in a."""
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = rotation
    T_a_b[:3, 3] = translation_m
    return T_a_b


def inverse(T_a_b: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Give ``T_b_a``. NaN stays NaN."""
    T_b_a = np.zeros_like(T_a_b)
    rotation = T_a_b[..., :3, :3].swapaxes(-1, -2)
    T_b_a[..., :3, :3] = rotation
    T_b_a[..., :3, 3] = -(rotation @ T_a_b[..., :3, 3:])[..., 0]
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def apply(T_a_b: Float[np.ndarray, "4 4"], xyz_b_m: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Map points from b to a. NaN stays NaN."""
    return xyz_b_m @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def align(xyz_b_m: Float[np.ndarray, "point 3"], xyz_a_m: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "4 4"]:
    """Give ``T_a_b``, the rigid motion that brings points of b nearest to theirs in a, by least squares [Kabsch 1976].

    No value may be NaN, and the points may not lie on one line.
    """
    middle_a, middle_b = xyz_a_m.mean(axis=0), xyz_b_m.mean(axis=0)
    turn = Rotation.align_vectors(xyz_a_m - middle_a, xyz_b_m - middle_b)[0].as_matrix()
    return transform(turn, middle_a - turn @ middle_b)


def rotation_about_y(angle_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rotate about the lab's vertical axis by the right-hand rule: positive turns +Z towards +X."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
