"""Write coloured surfaces as PLY and GLB, one part or a whole body in a pose."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from gonio.records import Mesh

Posed = dict[str, tuple[Mesh, Float[np.ndarray, "4 4"]]]
"""Parts by name: the surface in the part's frame, and where that frame is."""

MATTE: dict[str, Any] = {"name": "matte", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
"""Without a material, glTF takes the surface for bare metal, which most viewers show black."""


def write_ply(path: Path, parts: Posed) -> None:
    """Write the parts as one PLY, posed; metres, Y up, colours as sRGB."""
    posed = []
    for mesh, T in parts.values():
        one = _mesh(mesh, mesh.rgb)
        one.apply_transform(T)
        posed.append(one)
    trimesh.util.concatenate(posed).export(str(path), file_type="ply")


def write_glb(path: Path, parts: Posed) -> None:
    """Write the parts as one GLB with a node each, named after it; metres, Y up, colours linear as glTF wants them."""
    scene = trimesh.Scene()
    for name, (mesh, T) in parts.items():
        scene.add_geometry(_mesh(mesh, _linear(mesh.rgb)), node_name=name, geom_name=name, transform=T)
    scene.export(str(path), file_type="glb", include_normals=True, tree_postprocessor=_matte)


def _mesh(mesh: Mesh, rgb: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        mesh.xyz_m, mesh.faces, vertex_normals=mesh.normals, vertex_colors=rgb, process=False, validate=False
    )


def _linear(rgb: np.ndarray) -> np.ndarray:
    """Undo sRGB's curve (IEC 61966-2-1)."""
    share = rgb / 255.0
    return np.rint(255 * np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)).astype(np.uint8)


def _matte(tree: dict[str, Any]) -> None:
    tree["materials"] = [MATTE]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
