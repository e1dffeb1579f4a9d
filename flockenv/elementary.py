"""The exponential and the angle of a vector as polynomials, for lanes side by side: libm's are calls, one by one.

In float64 `exp` is within 4e-16 of the exact value relative to it and `atan2` within 4e-16 rad; in float32 within
5e-7 (relative, for |x| < 10; the rounding of x itself counts more beyond) and 3e-7 rad. tests/test_social.py holds
them to that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.extending import intrinsic

from flockenv.kernels import law, like

__all__ = ["atan2", "exp"]

LARGEST = {types.float32: 87.0, types.float64: 708.0}
"""The x, on either side of 0, up to which e^x is a normal number."""


def _power_of_two(typing_context: Any, k: Any) -> Any:
    """Return 2^k for a whole number k, as long as that is a normal number: k is put where the exponent lies."""
    if k not in (types.float32, types.float64):
        return None
    whole, shift, bias, magic = (
        (ir.IntType(64), 52, 1023, 1.5 * 2**52) if k == types.float64 else (ir.IntType(32), 23, 127, 1.5 * 2**23)
    )

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        real = arguments[0].type
        # added to such a number, a whole one stands in its last bits, as two's complement
        bits = builder.bitcast(builder.fadd(arguments[0], ir.Constant(real, magic)), whole)
        exponent = builder.shl(bits, ir.Constant(whole, shift))
        return builder.bitcast(builder.add(exponent, ir.Constant(whole, bias << shift)), real)

    return k(k), generate


_two_to: Any = intrinsic(_power_of_two)


def _largest(typing_context: Any, x: Any) -> Any:
    """Return up to which number e^x is a normal number of x's precision."""
    if x not in LARGEST:
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.get_constant(signature.return_type, LARGEST[signature.return_type])

    return x(x), generate


_limit_of: Any = intrinsic(_largest)


@law
def exp(x: float) -> float:
    """Return e^x; 0 where it is below the least normal number, and the same largest number for whatever is beyond.

    e^x = 2^k e^r with |r| <= ln 2 / 2, and Taylor's polynomial of degree 13 for e^r.
    """
    most = _limit_of(x)
    y = most if x > most else x  # a choice that leaves NaN as it is
    y = -most if y < -most else y
    k = np.floor(y * like(x, 1.4426950408889634) + like(x, 0.5))
    # ln 2 in two parts, of which the first has so few digits that k times it is exact
    r = (y - k * like(x, 0.693359375)) + k * like(x, 2.12194440054690583e-4)
    p = like(x, 1 / 6227020800)
    p = p * r + like(x, 1 / 479001600)
    p = p * r + like(x, 1 / 39916800)
    p = p * r + like(x, 1 / 3628800)
    p = p * r + like(x, 1 / 362880)
    p = p * r + like(x, 1 / 40320)
    p = p * r + like(x, 1 / 5040)
    p = p * r + like(x, 1 / 720)
    p = p * r + like(x, 1 / 120)
    p = p * r + like(x, 1 / 24)
    p = p * r + like(x, 1 / 6)
    p = p * r + like(x, 1 / 2)
    p = p * r + like(x, 1.0)
    p = p * r + like(x, 1.0)
    return like(x, 0.0) if x < -most else p * _two_to(k)


@law
def _arc(x: float) -> float:
    """Return atan(x) for |x| <= sqrt(2) - 1: a polynomial through Chebyshev's points."""
    z = x * x
    p = like(z, -0.0178023957270003)
    p = p * z + like(z, 0.037962548861582394)
    p = p * z + like(z, -0.050349971284847)
    p = p * z + like(z, 0.058468552048483134)
    p = p * z + like(z, -0.06662948677965316)
    p = p * z + like(z, 0.07692045058165399)
    p = p * z + like(z, -0.09090896793877758)
    p = p * z + like(z, 0.11111110744394381)
    p = p * z + like(z, -0.1428571427923969)
    p = p * z + like(z, 0.19999999999940782)
    p = p * z + like(z, -0.3333333333333312)
    p = p * z + like(z, 1.0)
    return x * p


@law
def atan2(y: float, x: float) -> float:
    """Return the angle of (x, y) from the x axis, in (-pi, pi]; 0 of the vector 0."""
    o, e = like(x, 0.0), like(x, 1.0)
    wide, high = abs(x), abs(y)
    steep = high > wide
    long, short = (high, wide) if steep else (wide, high)
    share = short / long if long > o else o
    late = share > like(x, 0.41421356237309503)
    turned = (share - e) / (share + e) if late else share
    angle = _arc(turned) + (like(x, 0.7853981633974483) if late else o)
    angle = like(x, 1.5707963267948966) - angle if steep else angle
    angle = like(x, 3.141592653589793) - angle if x < o else angle
    return -angle if y < o else angle
