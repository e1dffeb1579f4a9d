"""Density by counting and by Voronoi cells, the fundamental diagram, and its references."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flockenv.geometry.shapes.outlines import area
from flockenv.studies.measures import (
    JUELICH,
    classical_density,
    diagram,
    juelich_share,
    required_length,
    single_file_density,
    single_file_speed,
    speed_in_area,
    voronoi,
    voronoi_density,
    voronoi_speed,
    weidmann_deviation,
    weidmann_flow,
    weidmann_speed,
)
from flockenv.studies.measures.polygons import contains, rectangle

SQUARE = rectangle((0, 0), (10, 10))
NOTCHED = np.array([(0, 0), (10, 0), (10, 10), (6, 10), (6, 4), (4, 4), (4, 10), (0, 10)], float)  # 100 - 12 m^2


def lattice(spacing: float, high: float = 10.0) -> np.ndarray:
    x = np.arange(spacing / 2, high, spacing)
    return np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)


def hexagonal(spacing: float, high: float) -> np.ndarray:
    """Return points of a triangular lattice: each is midway between two of the next row."""
    rows = round(high / (spacing * math.sqrt(3) / 2) / 2) * 2
    step = high / rows
    x = np.arange(0, high, spacing) + spacing / 4
    return np.concatenate(
        [np.stack(np.broadcast_arrays((x + spacing / 2 * (r % 2)) % high, (r + 0.5) * step), -1) for r in range(rows)]
    )


# --- areas ------------------------------------------------------------------------------------------------------------


def test_the_voronoi_density_of_a_square_lattice_is_exact() -> None:
    """It is 1 / a^2; counting gives this only if the area ends between two rows."""
    pos = lattice(0.5)
    room = voronoi(pos, SQUARE, rectangle((3.1, 3.3), (6.2, 6.9)))
    assert room.cell == pytest.approx(np.full(400, 0.25), rel=1e-12)
    assert room.inside.sum() == pytest.approx(3.1 * 3.6, rel=1e-12)
    assert voronoi_density(room) == pytest.approx(4.0, rel=1e-12)
    assert classical_density(pos[None], rectangle((3, 3), (6, 6))) == pytest.approx([4.0])
    assert classical_density(pos[None], rectangle((3.2, 3.2), (6.2, 6.2))) == pytest.approx([4.0])
    assert classical_density(pos[None], rectangle((3.2, 3.2), (6.3, 6.3)))[0] != pytest.approx(4.0)


def test_the_cells_of_a_triangular_lattice_on_a_torus_are_equal() -> None:
    pos = hexagonal(0.5, 4.0)
    room = voronoi(pos, rectangle((0, 0), (4, 4)), period=(4.0, 4.0))
    assert room.cell == pytest.approx(np.full(len(pos), 16 / len(pos)), rel=1e-9)
    cut = voronoi(pos, rectangle((0, 0), (4, 4)))
    assert cut.cell.sum() == pytest.approx(16)
    assert cut.cell.std() > 0.01  # without a period cells at the edge are cut


@pytest.mark.parametrize(("walkable", "whole"), [(SQUARE, 100.0), (NOTCHED, 88.0), (NOTCHED[::-1], 88.0)])
@pytest.mark.parametrize("many", [1, 2, 3, 40])
def test_cells_divide_the_whole_walkable_area(walkable: np.ndarray, whole: float, many: int) -> None:
    pos = np.random.default_rng(many).uniform(0, 4, (many, 2))
    room = voronoi(pos, walkable)
    assert room.cell.sum() == pytest.approx(whole, rel=1e-12)
    assert (room.cell > 0).all()
    assert voronoi_density(room) == pytest.approx(many / whole)
    hole = rectangle((7, 1), (9, 2))
    assert voronoi(pos, walkable, holes=[hole]).cell.sum() == pytest.approx(whole - 2, rel=1e-12)


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), many=st.integers(1, 12))
def test_a_cell_has_the_area_of_the_places_nearest_to_its_agent(seed: int, many: int) -> None:
    """The areas are compared with counts of random places, in a notched square and on tori."""
    rng = np.random.default_rng(seed)
    pos = rng.uniform(0, 4, (many, 2))
    places = rng.uniform(0, 10, (10_000, 2))
    for walkable, period in ((NOTCHED, (0.0, 0.0)), (SQUARE, (10.0, 10.0)), (SQUARE, (10.0, 0.0))):
        offset = places[:, None] - pos
        wide = np.where(np.array(period) > 0, period, np.inf)
        offset -= np.array(period) * np.round(offset / wide)
        nearest = np.argmin((offset**2).sum(-1), axis=1)
        on = contains(walkable, places)
        share = np.bincount(nearest[on], minlength=many) / 100
        room = voronoi(pos, walkable, period=period)
        assert room.cell == pytest.approx(share, abs=5 * 0.5)  # five standard deviations of such a count
        assert room.cell.sum() == pytest.approx(area(walkable))


def test_agents_in_one_place_share_a_cell_and_agents_outside_have_none() -> None:
    room = voronoi([[2, 5], [2, 5], [7, 5], [20, 5]], SQUARE)
    assert room.cell == pytest.approx([22.5, 22.5, 55, math.nan], nan_ok=True)
    assert voronoi_density(room) == pytest.approx(0.03)
    empty = voronoi(np.zeros((0, 2)), SQUARE)
    assert voronoi_density(empty) == 0
    assert math.isnan(voronoi_speed(empty, np.zeros(0)))


def test_the_voronoi_speed_is_weighted_by_area() -> None:
    """One agent has 3/4 of the square and moves at 1 m/s, one has 1/4 and is at rest."""
    pos, vel = np.array([[5.0, 5.0], [10.0 - 1e-9, 5.0]]), np.array([[1.0, 0], [0, 0]])
    room = voronoi(pos, SQUARE)
    assert voronoi_speed(room, np.linalg.norm(vel, axis=1)) == pytest.approx(0.75)
    assert speed_in_area(pos[None], vel[None], SQUARE) == pytest.approx([0.5])
    assert speed_in_area(pos[None], vel[None], SQUARE, along=(-1, 1)) == pytest.approx([-math.sqrt(0.125)])
    assert np.isnan(speed_in_area(pos[None], vel[None], SQUARE, alive=np.zeros((1, 2)))).all()


@pytest.mark.parametrize(
    ("polygon", "message"),
    [
        ([(0, 0), (1, 1)], "at least three corners"),
        ([(0, 0), (1, 0), (math.nan, 1)], "all finite"),
        ([(0, 0), (1, 0), (2, 0)], "must enclose an area"),
        ([(0, 0), (1, 1), (1, 0), (0, 1)], "must not cross"),
    ],
)
def test_an_invalid_area_is_refused_in_one_line(polygon: list[tuple[float, float]], message: str) -> None:
    for call in (lambda: classical_density(np.zeros((1, 1, 2)), polygon), lambda: voronoi(np.zeros((1, 2)), polygon)):
        with pytest.raises(ValueError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"area = .*: must be convex"):
        voronoi(np.zeros((1, 2)), SQUARE, NOTCHED)
    with pytest.raises(ValueError, match="areas exist only in 2-D"):
        classical_density(np.zeros((1, 1, 3)), SQUARE)


def test_the_part_of_a_hole_outside_of_the_walkable_area_does_not_count() -> None:
    """One hole touches a diamond from outside, one is partly inside."""
    diamond = [(5, 0), (10, 5), (5, 10), (0, 5)]
    agent = [[5.0, 5.0]]
    assert voronoi(agent, diamond, holes=[rectangle((0, 0), (2, 2))]).cell == pytest.approx([50])
    half = rectangle((-1, 4), (2, 6))  # inside: a triangle of height 1 m and a strip of 1 m by 2 m
    room = voronoi(agent, diamond, holes=[half])
    assert room.cell == pytest.approx([50 - 1 - 2]) and room.area == pytest.approx(47)


def test_the_overlap_of_two_holes_is_subtracted_once() -> None:
    corner = [rectangle((0, 0), (6, 2)), rectangle((0, 0), (2, 6))]
    room = voronoi([[5.0, 5.0]], SQUARE, holes=corner)
    assert room.area == pytest.approx(100 - 12 - 12 + 4) and room.cell == pytest.approx([80])
    window = voronoi([[5.0, 5.0]], SQUARE, rectangle((1.5, 1.5), (2.5, 2.5)), corner)
    assert window.area == pytest.approx(0.25) and window.inside == pytest.approx([0.25])


def test_a_hole_on_a_torus_may_lie_across_the_seam() -> None:
    rng = np.random.default_rng(4)
    pos = rng.uniform(0, 10, (20, 2))
    found = []
    for move in (0.0, 5.0):
        walls = rectangle((3 + move, 3 + move), (7 + move, 7 + move)) - (10.0 if move else 0.0)
        room = voronoi((pos + move) % 10, SQUARE, holes=[walls], period=(10.0, 10.0))
        assert room.area == pytest.approx(84) and room.cell.sum() == pytest.approx(84)
        assert room.inside == pytest.approx(room.cell)
        found.append(room.cell)
    assert found[0] == pytest.approx(found[1])


# --- the fundamental diagram ------------------------------------------------------------------------------------------


def test_weidmann_speeds_are_those_of_the_table() -> None:
    assert weidmann_speed([0.5, 1, 2, 3, 4]) == pytest.approx([1.298, 1.058, 0.606, 0.331, 0.156], abs=5e-4)
    assert weidmann_speed([0, 5.4, 8]) == pytest.approx([1.34, 0, 0])
    rho = np.linspace(0, 5.4, 5401)
    most = int(np.argmax(weidmann_flow(rho)))
    assert (rho[most], weidmann_flow(rho)[most]) == pytest.approx((1.75, 1.225), abs=6e-3)
    with pytest.raises(ValueError, match="density = -1 per"):
        weidmann_speed(-1.0)


def test_single_file_speeds_are_those_of_seyfried() -> None:
    assert single_file_speed([1, 1.5, 2, 5]) == pytest.approx([0.604, 0.289, 0.132, 0], abs=5e-4)
    assert required_length(single_file_speed(1.5)) == pytest.approx(1 / 1.5)
    assert single_file_density([0.5, 9.5, 4.5], 10) == pytest.approx([1 / 4, 1, 1 / 5])
    assert single_file_density([3], 10) == pytest.approx([0.1])


def test_a_crowd_drawn_from_the_juelich_data_fits_it_and_is_below_weidmann() -> None:
    rng = np.random.default_rng(0)
    low, high, mean, spread = (np.repeat(column, 500) for column in np.array(JUELICH).T)
    rho, v = rng.uniform(low, high), rng.normal(mean, 0.5 * spread)
    assert juelich_share(rho, v) == 1
    assert juelich_share(rho, v + 0.3) == 0
    off = weidmann_deviation(rho, v)
    assert off.samples == 2500
    assert -0.25 < off.mean < -0.1  # speeds measured in corridors lie below the curve
    assert weidmann_deviation(rho, weidmann_speed(rho))[1:3] == pytest.approx((0, 0), abs=1e-12)
    assert weidmann_deviation(rho, weidmann_speed(rho) + 0.2).worst == pytest.approx(0.2, abs=0.01)
    assert math.isnan(juelich_share([0.1], [1.0]))
    assert weidmann_deviation([0.1], [1.0])[0] == 0


def test_samples_beyond_the_bounds_do_not_count() -> None:
    one = weidmann_deviation([0.55, 0.6], [1.0, 1.1], 0.5, 0.7)
    assert one.samples == 2 and one.worst == pytest.approx(1.05 - weidmann_speed([0.575])[0])
    far = weidmann_deviation([0.6, 0.95], [weidmann_speed([0.6])[0], 9.0], 0.5, 0.9)
    assert far.samples == 1 and far.worst == pytest.approx(0, abs=1e-12)
    with pytest.raises(ValueError, match=r"low = 2: must be at least 0 and below high = 1"):
        weidmann_deviation([0.5], [1.0], 2.0, 1.0)


def test_bins_of_the_fundamental_diagram_hold_samples_means_and_spreads() -> None:
    found = diagram([0.2, 0.7, 0.8, 0.9, 9.0], [1.3, 1.0, 0.8, math.nan, 1.0])
    assert [b.samples for b in found] == [1, 2, 0, 0, 0, 0, 0, 0]
    assert found[1][3:] == pytest.approx((0.75, 0.9, 0.1, (0.7 + 0.64) / 2))
    assert math.isnan(found[2].speed)
    with pytest.raises(ValueError, match="density has 1 samples, speed 2"):
        diagram([1], [1, 2])
