"""Camera poses from files: rigid motions in OpenCV's axes, as float64 4×4 matrices.

Functions that take a place raise FormatError for values that are not a rigid motion; how far a camera may be is checked
by `Camera`, whose errors the package's readers give the file's name.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import MAX_ROTATION_ERROR, rigid_motion
from aaplug.io.values import Entry, Place

OPENCV_FROM_OPENGL = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)  # of the columns of camera-to-world rotations


def pose(motion: Float[Tensor, "_ 4"], place: Place, field: str, opengl: bool = False) -> Float[Tensor, "4 4"]:
    """The rigid motion nearest to `motion`, of which three rows count.

    opengl: it is camera-to-world with OpenGL's axes of the camera (x right, y up, z backward).
    """
    rotation = motion[:3, :3] * (OPENCV_FROM_OPENGL if opengl else 1.0)
    error = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
    if not error <= MAX_ROTATION_ERROR:
        off = f"R·Rᵀ is {error:.2g} off the identity, {MAX_ROTATION_ERROR:g} allowed"
        raise place.error(f"{field} should be a rotation: {off}")
    if torch.linalg.det(rotation) <= 0:
        raise place.error(f"{field} should be a rotation, but it mirrors (its determinant is -1)")
    left, _, right = torch.linalg.svd(rotation)
    return rigid_motion(left @ right, motion[:3, 3])


def inverse(motion: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """The inverse of a rigid motion."""
    back = motion[:3, :3].T.contiguous()  # its layout decides how products are rounded
    return rigid_motion(back, -back @ motion[:3, 3])


def rigid(entry: Entry, field: str, opengl: bool = False) -> Float[Tensor, "4 4"]:
    """The `pose` of a field that holds a 4×4 matrix, whose last row is 0 0 0 1."""
    motion = entry.matrix(field, 4, 4)
    right = torch.allclose(motion[3], torch.eye(4, dtype=torch.float64)[3])
    entry.place.expect(right, f"{field}'s last row", "0 0 0 1", motion[3].tolist())
    return pose(motion, entry.place, field, opengl)
