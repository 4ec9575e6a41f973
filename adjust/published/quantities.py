"""Rotations and vectors in the paper's notation: degrees, millimetres, Euler order 2-1-3."""

from dataclasses import dataclass

import numpy as np

from adjust.model.survey import FloatArray
from adjust.spatial.rotation_forms import euler_from_matrix


@dataclass(frozen=True, eq=False)
class PaperRotation:
    """``C_a^b``: the matrix that takes coordinates in a to coordinates in b (``b_from_a``).

    sigma_deg: (3,) about the axes x, y, z of the frame a. For a small rotation these are the sigmas of its Euler
    angles.
    """

    name: str
    matrix: FloatArray
    sigma_deg: FloatArray

    @property
    def angles_deg(self) -> FloatArray:
        """Euler angles (phi, theta, psi) of equation 9, phi within a quarter turn.

        A camera that looks along the body's y axis stands at phi = 90 deg, where theta and psi turn about one axis: its
        sigmas have no counterpart in Euler angles. Raises SurveyError where they are not defined at all.
        """
        return np.degrees(euler_from_matrix(self.matrix, "213"))


@dataclass(frozen=True, eq=False)
class PaperVector:
    """``r_ij^k``: from the origin of i to that of j, in the axes of k; (3,) mm. nan: a component by definition."""

    name: str
    value_mm: FloatArray
    sigma_mm: FloatArray
