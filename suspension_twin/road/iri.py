# SPDX-License-Identifier: Apache-2.0
"""International Roughness Index of a longitudinal profile (ASTM E1926, the "golden car").

The golden car is a quarter car of four numbers by its sprung mass: tyre rate 653 s⁻², suspension
rate 63.3 s⁻², damping 6 s⁻¹, unsprung mass 0.15, at 80 km/h. It filters the slope of the profile;
the index is the mean absolute rate of its suspension per metre of road (Sayers, Transp. Res. Rec.
1501 (1995) 1). The slope is constant between two points, for which the solution is exact.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter

from suspension_twin.arrays import Floats
from suspension_twin.errors import InputError

__all__ = ["golden_car_step", "iri", "iri_along"]

_TYRE, _SPRING, _DAMPING, _UNSPRUNG = 653.0, 63.3, 6.0, 0.15
_SPEED = 80.0 / 3.6  # m/s
_BASE = 0.25  # m of the moving average, the contact of a tyre
_START = 11.0  # m over which the first slope is taken


def _matrices() -> tuple[Floats, Floats]:
    """State matrix and input vector: sprung height and rate, unsprung height and rate; input a height."""
    k, c, u = _SPRING, _DAMPING, _UNSPRUNG
    a = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-k, -c, k, c],
            [0.0, 0.0, 0.0, 1.0],
            [k / u, c / u, -(_TYRE + k) / u, -c / u],
        ]
    )
    return a, np.array([0.0, 0.0, 0.0, _TYRE / u])


def golden_car_step(step: float) -> tuple[Floats, Floats]:
    """Transition matrix (4, 4) and input vector (4,) of the golden car over ``step`` m of road at 80 km/h."""
    a, b = _matrices()
    matrix: Floats = expm(a * step / _SPEED)
    vector: Floats = np.asarray(np.linalg.solve(a, (matrix - np.eye(4)) @ b), dtype=np.float64)
    return matrix, vector


def iri(z: ArrayLike, step: float) -> float:
    """International Roughness Index of one wheel path.

    Parameters
    ----------
    z : (n,) array
        Heights in m, evenly spaced; missing ones are bridged.
    step : float
        Their distance in m.

    Returns
    -------
    float
        m/m; multiply by 1000 for the usual m/km.

    Raises
    ------
    InputError
        The profile is shorter than 11 m, or coarser than 0.3 m, at which the standard ends.

    Examples
    --------
    >>> import numpy as np
    >>> iri(0.01 * np.arange(400), 0.25)  # a slope alone is no roughness
    0.0
    """
    return float(np.mean(iri_along(z, step)))


def iri_along(z: ArrayLike, step: float) -> Floats:
    """What each interval of a profile adds to its index: (n - 1,) m/m, as :func:`iri`, whose mean it is."""
    profile = np.asarray(z, dtype=np.float64)
    good = np.isfinite(profile)
    if profile.ndim != 1 or good.sum() < 2 or (profile.size - 1) * step < _START:
        raise InputError("road", "IRI", f"needs {_START:g} m of profile or more")
    if not 0.0 < step <= 0.3:
        raise InputError("road", "IRI", f"needs a point every 0.3 m or closer, not every {step:g} m")
    at = np.arange(profile.size)
    profile = np.interp(at, at[good], profile[good])
    slope = np.diff(profile) / step
    # The first slope goes on before the start, so that a long grade is no event there.
    first = float(profile[round(_START / step)] - profile[0]) / (step * round(_START / step))
    width = round(_BASE / step)
    if width > 1:
        slope = uniform_filter1d(slope, width, mode="nearest")
    # Along its eigenvectors the car is four filters of the first order.
    values, vectors = np.linalg.eig(_matrices()[0])
    inverse = np.linalg.inv(vectors)
    pole = np.exp(values * step / _SPEED)
    gain = (pole - 1.0) / values * (inverse @ _matrices()[1])
    rate = np.zeros(slope.size, dtype=np.complex128)
    # On an endless grade the two heights follow the slope and the two rates are 0: what is filtered is the rest.
    for i in range(4):
        modal = lfilter([gain[i]], [1.0, -pole[i]], slope - first)
        rate += (vectors[0, i] - vectors[2, i]) * modal
    # By linearity the grade itself moves nothing. Rounding of a level profile is no roughness.
    result: Floats = np.abs(rate.real)
    return np.where(result < 1e-12, 0.0, result)
