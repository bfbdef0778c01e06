"""Exceptions of the mechanics, and checks of their parameters.

Every exception is a :class:`MechanicsError`, a ``ValueError`` whose message gives the quantity, its
value and the violated limit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray


class MechanicsError(ValueError):
    """Base class: the mechanics cannot process a body, a parameter or a displacement."""


class InvalidBodyError(MechanicsError):
    """A body that cannot exist, for example with negative mass or a nonconvex polygon."""


class InvalidParameterError(MechanicsError):
    """A number that is not finite or is outside its range."""


class UnreachableDisplacementError(MechanicsError):
    """A displacement that no single tap can produce, such as one with too much rotation for its
    distance."""


def positive(
    name: str, value: float, unit: str = "", error: type[MechanicsError] = InvalidParameterError
) -> float:
    """Return ``value`` as a float if it is finite and above zero; raise ``error`` otherwise."""
    number = _number(name, value, error)
    if not 0.0 < number < math.inf:
        raise error(f"{name} is {_with_unit(number, unit)}; it must be finite and above 0.")
    return number


def fraction(name: str, value: float) -> float:
    """Return ``value`` as a float if it is in [0, 1]; else raise :class:`InvalidParameterError`."""
    number = _number(name, value, InvalidParameterError)
    if not 0.0 <= number <= 1.0:
        raise InvalidParameterError(f"{name} is {number!r}; it must lie from 0 to 1.")
    return number


def not_negative(name: str, value: float, unit: str = "") -> float:
    """Return ``value`` as a float if it is finite and 0 or more; raise an exception otherwise."""
    number = _number(name, value, InvalidParameterError)
    if not 0.0 <= number < math.inf:
        raise InvalidParameterError(f"{name} is {_with_unit(number, unit)}; it must be 0 or more.")
    return number


def finite(
    name: str,
    values: ArrayLike,
    unit: str = "",
    error: type[MechanicsError] = InvalidParameterError,
) -> NDArray[np.float64]:
    """Return ``values`` as a float array if all are finite; raise ``error`` otherwise."""
    array = np.asarray(values, dtype=float)
    wrong = ~np.isfinite(array)
    if wrong.any():
        value = float(array[wrong].flat[0])
        raise error(f"{name} holds {_with_unit(value, unit)}; every value must be a finite number.")
    return array


def _number(name: str, value: float, error: type[MechanicsError]) -> float:
    try:
        return float(value)
    except (TypeError, ValueError) as problem:
        raise error(f"{name} is {value!r}; it must be a number.") from problem


def _with_unit(value: float, unit: str) -> str:
    return f"{value!r} {unit}" if unit else repr(value)
