"""Rigid transforms as 4 × 4 matrices, named ``T_a_b``: it maps b's coordinates into a."""

import numpy as np
from jaxtyping import Float


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


def rotation_about_y(angle_rad: float) -> Float[np.ndarray, "3 3"]:
    """Rotate about the lab's vertical axis by the right-hand rule: positive turns +Z towards +X."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
