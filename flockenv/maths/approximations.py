"""Rounding, exp and atan2 as polynomials, which vectorise over SIMD lanes.

The functions of libm are scalar calls; the rounding instruction costs two operations per register, and three after a
multiplication.

In float64 the relative error of `exp` is below 1e-14 and the error of `atan2` below 5e-16 rad; in float32 5e-7 (for
|x| < 10; beyond, the rounding of x itself dominates) and 3e-7 rad. tests/test_social.py checks these bounds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.extending import overload

from flockenv.jit.decorators import OPTIONS, law, like
from flockenv.jit.intrinsics import intrinsic_or_python

__all__ = ["atan2", "exp", "round_half_even"]

LARGEST = {types.float32: 87.0, types.float64: 708.0}
"""Largest |x| for which e^x is a normal number."""


def _ones(x: Any) -> float:
    """Return a number whose unit in the last place is 1: the sum with x has the rounded x in its low bits."""
    return like(x, 1.5 * 2**23 if isinstance(x, np.float32) else 1.5 * 2**52)


@overload(_ones, jit_options=OPTIONS)
def _ones_of(x):  # type: ignore[no-untyped-def]  # numba compares signatures, annotations included
    ones = 1.5 * 2**23 if x == types.float32 else 1.5 * 2**52
    return lambda x: like(x, ones)


@law
def round_half_even(x: float) -> float:
    """Return x rounded to the nearest integer, ties to even: a faster np.rint.

    The result is exact for |x| < 2^22 in float32, 2^51 in float64; beyond, it may be off by one.
    """
    return (x + _ones(x)) - _ones(x)


def _power_of_two(typing_context: Any, far: Any) -> Any:
    """Return 2^k, if that is a normal number, for `far` = `_ones` + k with an integer k.

    k is in the low bits of `far`, in two's complement, and is shifted to the exponent.
    """
    if far not in (types.float32, types.float64):
        return None
    whole, shift, bias = (ir.IntType(64), 52, 1023) if far == types.float64 else (ir.IntType(32), 23, 127)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        exponent = builder.shl(builder.bitcast(arguments[0], whole), ir.Constant(whole, shift))
        return builder.bitcast(builder.add(exponent, ir.Constant(whole, bias << shift)), arguments[0].type)

    return far(far), generate


_two_to: Any = intrinsic_or_python(_power_of_two, lambda far: type(far)(2.0 ** float(far - _ones(far))))


def _largest(typing_context: Any, x: Any) -> Any:
    """Return the largest x for which e^x is a normal number in the precision of x."""
    if x not in LARGEST:
        return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.get_constant(signature.return_type, LARGEST[signature.return_type])

    return x(x), generate


_limit_of: Any = intrinsic_or_python(_largest, lambda x: like(x, 87.0 if isinstance(x, np.float32) else 708.0))


@law
def exp(x: float) -> float:
    """Return e^x; 0 below the smallest normal number, and constant for x above `LARGEST`.

    e^x = 2^k e^r with |r| <= ln 2 / 2; e^r is Taylor's polynomial of degree 11.
    """
    most = _limit_of(x)
    y = most if x > most else x  # a selection that keeps NaN
    y = -most if y < -most else y
    far = y * like(x, 1.4426950408889634) + _ones(x)
    k = far - _ones(x)
    # ln 2 in two parts; the first has few enough digits that its product with k is exact
    r = (y - k * like(x, 0.693359375)) + k * like(x, 2.12194440054690583e-4)
    # Estrin's scheme instead of Horner's: a dependency chain half as long
    r2 = r * r
    r4 = r2 * r2
    low = (like(x, 1.0) + r) + (like(x, 1 / 2) + like(x, 1 / 6) * r) * r2
    middle = (like(x, 1 / 24) + like(x, 1 / 120) * r) + (like(x, 1 / 720) + like(x, 1 / 5040) * r) * r2
    high = (like(x, 1 / 40320) + like(x, 1 / 362880) * r) + (like(x, 1 / 3628800) + like(x, 1 / 39916800) * r) * r2
    p = low + (middle + high * r4) * r4
    return like(x, 0.0) if x < -most else p * _two_to(far)


@law
def _arc(x: float) -> float:
    """Return atan(x) for |x| <= sqrt(2) - 1, by a polynomial that interpolates at Chebyshev nodes."""
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
    """Return the angle of (x, y) from the x axis, in (-pi, pi]; 0 for the zero vector."""
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
