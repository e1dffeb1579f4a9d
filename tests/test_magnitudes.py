"""Numbers are refused in one line if squares or products of three of them would overflow or vanish."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest

from flockenv.core.magnitudes import BOUNDS
from flockenv.model.distribution import Spread
from flockenv.model.spawn import Spawn
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import ConfigError, load_scene

SCENE = """
dimension: 2
space: {{kind: plane}}
groups: [{{count: 3, {group}spawn: {{low: [0, 0], high: [1, 1]{spawn}}}}}]
dt: {dt}
dtype: {dtype}
{more}
"""


def scene(group: str = "", spawn: str = "", dt: str = "0.01", dtype: str = "float64", more: str = "") -> Scene:
    return load_scene(SCENE.format(group=group, spawn=spawn, dt=dt, dtype=dtype, more=more))


REFUSED = [
    ({"group": "desired_speed: {mean: 1, sd: 1.7e+308}, "}, "desired_speed: sd = 1.7e+308"),
    ({"group": "mass: 5.0e-324, ", "more": "constraints: [{kind: collisions}]"}, "mass = 4.94066e-324"),
    ({"group": "mass: {low: 1.0, high: 1.0e+300}, "}, "mass: high = 1e+300"),
    ({"group": "max_speed: 1.0e+200, "}, "max_speed = 1e+200"),
    ({"spawn": ", speed: [0, 1.0e+200]"}, "speed[1] = 1e+200"),
    ({"dt": "1.0e-300"}, "dt = 1e-300"),
    ({"more": "obstacles: [{kind: wall, vertices: [[0, -1], [1.0e+300, -1]]}]"}, "vertices[1][0] = 1e+300"),
    ({"more": "obstacles: [{kind: circle, centre: [5, 5], radius: 1.0e-200}]"}, "radius = 1e-200"),
    ({"more": "effects: [{kind: tether, centre: [0, 0], stiffness: 1.0e+160}]"}, "stiffness = 1e+160"),
    ({"more": "effects: [{kind: separation, weight: 1.0e+160, radius: 1}]"}, "weight = 1e+160"),
    ({"group": "mass: 1.0e+20, ", "dtype": "float32"}, "groups[0].mass = 1e+20: float32"),
    ({"group": "mass: {low: 1.0e-25, high: 1.0}, ", "dtype": "float32"}, "groups[0].mass.low = 1e-25: float32"),
    ({"more": "effects: [{kind: drag, rate: 1.0e+30}]", "dtype": "float32"}, "rate = 1e+30"),
]  # fmt: skip


@pytest.mark.parametrize(("given", "message"), REFUSED)
def test_numbers_out_of_range_are_refused_in_one_line(given: dict[str, str], message: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ConfigError) as error:
            scene(**given)
    assert message in str(error.value) and "computes with numbers from" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("make", [lambda x: Group(count=1, mass=x), lambda x: Spread(low=0.0, high=x)])
@pytest.mark.parametrize("number", [1e103, 1e-155, 5e-324, 1.7e308])
def test_records_made_in_python_are_refused_if_out_of_range(make: Any, number: float) -> None:
    with pytest.raises(ValueError, match="computes with numbers from 1e-154 to 1e\\+102"):
        make(number)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_products_of_three_and_squares_are_finite_and_not_zero_within_the_bounds(precision: str) -> None:
    least, most = (np.dtype(precision).type(bound) for bound in BOUNDS[precision])
    assert np.isfinite(most * most * most) and np.isfinite(1 / (least * least))
    assert 10 * float(most) > float(np.finfo(precision).max) ** (1 / 3) and float(least) ** 2 > 0


def test_large_and_small_numbers_within_the_bounds_are_accepted() -> None:
    Group(count=1, mass=1e-30, radius=0.0, max_speed=3e8)
    Spawn(low=(-1e12, 0.0), high=(1e25, 0.0))
    Spread(mean=0.0, sd=0.0)


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("number", [1e300, -1e155, math.inf, math.nan])
def test_with_motion_refuses_numbers_that_cannot_be_squared(number: float, which: int) -> None:
    state = scene().start(0)
    motion = [np.zeros((1, 3, 2)), np.zeros((1, 3, 2))]
    motion[which][0, 2, 1] = number
    with pytest.raises(ValueError, match=rf"{('pos', 'vel')[which]} contains .* at \(world, agent, axis\) \(0, 2, 1\)"):
        state.with_motion(*motion)


def test_with_motion_applies_the_bounds_of_the_precision() -> None:
    far = np.full((1, 3, 2), 1e20)
    assert scene().start(0).with_motion(far, far).pos[0, 0, 0] == 1e20
    with pytest.raises(ValueError, match=r"pos contains 1e\+20 .*float32 computes with at most 1e\+19"):
        scene(dtype="float32").start(0).with_motion(far, far)
