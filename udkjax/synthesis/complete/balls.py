"""Ball arithmetic: arrays of real numbers with radii that enclose all rounding errors.

A ball has a midpoint and a radius. Midpoints have the longest floating-point type of the processor, or are exact fractions; each
operation adds a bound of its rounding error to the radius. Radii, in float64, are rounded up by INFLATION, which exceeds the
rounding errors of all operations of a certificate.
"""

from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

LONG_DOUBLE = np.longdouble
ROUNDING = float(np.finfo(LONG_DOUBLE).eps)  # twice the largest relative error of one operation on midpoints
INFLATION = 1.0 + 1e-10  # factor of a radius in each operation; covers about 1e6 roundings of float64
UNDERFLOW_BOUND = float(np.finfo(float).tiny)  # bound of the error by underflow


class Ball(NamedTuple):
    """Numbers between mid - rad and mid + rad."""

    mid: np.ndarray
    rad: np.ndarray

    __array_ufunc__ = None  # arrays defer to the operators of balls

    @classmethod
    def of(cls, x: Any, rad: Any = 0.0) -> "Ball":
        """Return balls with midpoints x and radii `rad`."""
        mid = np.asarray(x, LONG_DOUBLE)
        return cls(mid, np.broadcast_to(np.asarray(rad, float), mid.shape))

    @classmethod
    def fractions(cls, x: Any) -> "Ball":
        """Return numbers as exact balls, whose midpoints are fractions."""
        x = np.asarray(x, LONG_DOUBLE)
        high = x.astype(float)
        low = (x - high).astype(float)
        exact = [Fraction(a) + Fraction(b) for a, b in zip(high.ravel().tolist(), low.ravel().tolist(), strict=True)]
        mid = np.empty(x.shape, object)
        mid[...] = np.array(exact, object).reshape(x.shape)
        return cls(mid, np.zeros(x.shape))

    def __add__(self, other: Any) -> "Ball":  # pyright: ignore[reportIncompatibleMethodOverride]
        b = self._like(other)
        mid = self.mid + b.mid
        return Ball(mid, _up(self.rad + b.rad + _rounding(mid)))

    __radd__ = __add__

    def __neg__(self) -> "Ball":
        return Ball(-self.mid, self.rad)

    def __sub__(self, other: Any) -> "Ball":
        return self + -self._like(other)

    def __rsub__(self, other: Any) -> "Ball":
        return self._like(other) - self

    def __mul__(self, other: Any) -> "Ball":  # pyright: ignore[reportIncompatibleMethodOverride]
        b = self._like(other)
        mid, size, b_size = self.mid * b.mid, _size(self.mid), _size(b.mid)
        return Ball(mid, _up(size * b.rad + b_size * self.rad + self.rad * b.rad + _rounding(mid)))

    __rmul__ = __mul__  # pyright: ignore[reportAssignmentType]

    def __truediv__(self, other: Any) -> "Ball":
        """Return the quotient; its radius is infinite where the divisor may be zero."""
        b = self._like(other)
        least = _size(b.mid) / INFLATION - b.rad
        with np.errstate(divide="ignore", invalid="ignore"):
            mid = self.mid / b.mid
            rad = _up((self.rad + _size(mid) * b.rad) / least + ROUNDING * _size(mid))
        return Ball(np.where(least > 0, mid, LONG_DOUBLE(0)), np.where(least > 0, rad, np.inf))

    def _like(self, x: Any) -> "Ball":
        """Return x as balls; numbers become balls whose midpoints have the type of those of `self`."""
        if isinstance(x, Ball):
            return x
        return Ball.fractions(x) if self.mid.dtype == object else Ball.of(x)

    def part(self, index: Any) -> "Ball":
        """Return the balls that an index of arrays selects."""
        return Ball(self.mid[index], self.rad[index])

    @property
    def largest(self) -> np.ndarray:
        """The largest modulus of the numbers in each ball, in float64."""
        return _up(_size(self.mid) + self.rad)

    @property
    def least(self) -> np.ndarray:
        """The smallest modulus of the numbers in each ball, in float64; zero or less if the ball contains zero."""
        return (_size(self.mid) / INFLATION - self.rad) / INFLATION

    def overlaps(self, other: "Ball") -> np.ndarray:
        """Return a mask of the entries whose balls may overlap."""
        return ~((self - other).least > 0)


class ComplexBall(NamedTuple):
    """Complex numbers with balls as real and imaginary parts."""

    re: Ball
    im: Ball

    def __add__(self, other: "ComplexBall") -> "ComplexBall":  # pyright: ignore[reportIncompatibleMethodOverride]
        return ComplexBall(self.re + other.re, self.im + other.im)

    def __sub__(self, other: "ComplexBall") -> "ComplexBall":
        return ComplexBall(self.re - other.re, self.im - other.im)

    def __mul__(self, other: "ComplexBall") -> "ComplexBall":  # pyright: ignore[reportIncompatibleMethodOverride]
        return ComplexBall(self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re)

    def __truediv__(self, other: "ComplexBall") -> "ComplexBall":
        size = other.re * other.re + other.im * other.im
        product = self * ComplexBall(other.re, -other.im)
        return ComplexBall(product.re / size, product.im / size)

    def part(self, index: Any) -> "ComplexBall":
        """Return the balls that an index of arrays selects."""
        return ComplexBall(self.re.part(index), self.im.part(index))

    def overlaps(self, other: "ComplexBall") -> np.ndarray:
        """Return a mask of the entries whose balls may overlap."""
        return self.re.overlaps(other.re) & self.im.overlaps(other.im)

    def distance(self, z: np.ndarray) -> np.ndarray:
        """Return the largest distance between the numbers of each ball and complex numbers."""
        return np.hypot((self.re - np.real(z)).largest, (self.im - np.imag(z)).largest) * INFLATION


def _rounding(x: np.ndarray) -> np.ndarray | float:
    return 0.0 if x.dtype == object else ROUNDING * _size(x)


def _size(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(x), float) * INFLATION


def _up(x: np.ndarray) -> np.ndarray:
    return x * INFLATION + UNDERFLOW_BOUND
