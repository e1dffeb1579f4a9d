"""Tables of trajectories, and PedPy as the oracle of density and flow."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flockenv.cli.main import main
from flockenv.studies.measures.density import classical_density, voronoi, voronoi_density
from flockenv.studies.measures.throughput import crossings, flow
from flockenv.studies.trajectory_table import frame_rate, table_of, write_csv, write_parquet

RATE, ROOM = 10.0, ((0.0, 0.0), (20.0, 0.0), (20.0, 6.0), (0.0, 6.0))


def walkers(instants: int = 120, agents: int = 25, dtype: str = "float64", **change: Any) -> Any:
    """Return agents that walk to the right at different speeds and sway, as a trajectory of 0.1 s steps."""
    rng = np.random.default_rng(5)
    time = np.arange(instants)[:, None] / RATE
    x = rng.uniform(0.5, 6, agents) + rng.uniform(0.6, 1.1, agents) * time
    y = rng.uniform(1.5, 4.5, agents) + 0.4 * np.sin(time + rng.uniform(0, 6, agents))
    fields = {
        "scene": SimpleNamespace(dt=0.05), "step": 2 * np.arange(instants), "identity": None,
        "pos": np.stack([x, y], axis=-1).astype(dtype), "alive": np.ones((instants, agents), bool),
    }  # fmt: skip
    return SimpleNamespace(**{**fields, **change})


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_numbers_of_a_csv_read_back_exactly(dtype: str, tmp_path: Path) -> None:
    run = walkers(4, 3, dtype)
    write_csv(run, tmp_path / "a.csv")
    found = rows(tmp_path / "a.csv")
    assert list(found[0]) == ["id", "frame", "x", "y"] and len(found) == 12
    assert [(int(row["frame"]), int(row["id"])) for row in found] == [(t, n) for t in range(4) for n in range(3)]
    pos = np.array([[row["x"], row["y"]] for row in found]).astype(dtype).reshape(4, 3, 2)
    np.testing.assert_array_equal(pos, run.pos)
    assert frame_rate(run) == pytest.approx(RATE)


def test_rows_are_of_living_agents_by_their_number_at_equal_intervals() -> None:
    alive = np.array([[True, False], [True, True], [False, True], [True, True]])
    identity = np.array([[0, 1], [0, 2], [0, 2], [3, 2]])
    run = walkers(4, 2, alive=alive, identity=identity, step=np.array([0, 2, 4, 5]))
    table = table_of(run)
    assert list(zip(table["frame"].tolist(), table["id"].tolist(), strict=True)) == [(0, 0), (1, 0), (1, 2), (2, 2)]
    assert table["x"].tolist() == [run.pos[0, 0, 0], run.pos[1, 0, 0], run.pos[1, 1, 0], run.pos[2, 1, 0]]
    assert list(table_of(walkers(2, 2, pos=np.zeros((2, 2, 3))))) == ["id", "frame", "x", "y", "z"]


def test_the_command_writes_a_table_and_its_frame_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = "space: {kind: torus, size: [9, 9]}\ngroups: [{count: 4}]\neffects: [{kind: drag, rate: 0.5}]\ndt: 0.01\n"
    Path("tiny.yaml").write_text(scene)
    assert main(["run", "tiny.yaml", "--duration", "0.1", "--every", "0.02", "--out", "a.csv"]) == 0
    assert len(rows(Path("a.csv"))) == 6 * 4
    assert json.loads(Path("a.json").read_text())["frame_rate"] == pytest.approx(50)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert main(["run", "tiny.yaml", "--out", "b.parquet"]) == 2
    assert "pip install 'flockenv[parquet]'" in capsys.readouterr().err and not Path("b.parquet").exists()


@pytest.mark.slow  # .ci/run installs pyarrow after the quick tests
def test_a_parquet_file_has_the_same_table(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    run = walkers(5, 3)
    write_parquet(run, tmp_path / "a.parquet")
    found = parquet.read_table(tmp_path / "a.parquet")
    for name, column in table_of(run).items():
        np.testing.assert_array_equal(found[name].to_numpy(), column)
    assert float(found.schema.metadata[b"frame_rate"]) == pytest.approx(RATE)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return the walkers as PedPy reads them from a CSV."""
    pedpy, pandas = pytest.importorskip("pedpy"), pytest.importorskip("pandas")
    path = tmp_path_factory.mktemp("pedpy") / "walk.csv"
    write_csv(walkers(), path)
    return pedpy.TrajectoryData(pandas.read_csv(path), RATE)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_densities_are_those_of_pedpy(seen: Any) -> None:
    pedpy, run, area = pytest.importorskip("pedpy"), walkers(), ((6.0, 1.0), (11.0, 1.0), (11.0, 5.0), (6.0, 5.0))
    measured = pedpy.MeasurementArea(area)
    classical = pedpy.compute_classic_density(traj_data=seen, measurement_area=measured)["density"]
    ours = classical_density(run.pos, area)
    assert len(np.unique(ours)) > 4
    np.testing.assert_allclose(ours, classical, rtol=1e-12)
    inside = (run.pos[..., 0] < 20).all(axis=1)  # PedPy takes no one outside the walkable area
    frames = np.flatnonzero(inside)[:80:8]
    cells = pedpy.compute_individual_voronoi_polygons(traj_data=seen, walkable_area=pedpy.WalkableArea(ROOM))
    theirs, _ = pedpy.compute_voronoi_density(individual_voronoi_data=cells, measurement_area=measured)
    theirs = theirs.reset_index().set_index("frame")["density"]  # in PedPy 1.3 frames are the index already
    for frame in frames:
        assert voronoi_density(voronoi(run.pos[frame], ROOM, area)) == pytest.approx(theirs[frame], rel=1e-9)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_passages_and_flow_are_those_of_pedpy(seen: Any) -> None:
    pedpy, run, ends = pytest.importorskip("pedpy"), walkers(), ((9.0, 0.0), (9.0, 6.0))
    passed, frames = pedpy.compute_n_t(traj_data=seen, measurement_line=pedpy.MeasurementLine(ends))
    found = crossings(np.arange(len(run.pos)) / RATE, run.pos, ends)
    assert len(found.time) > 10 and (found.sign == found.sign[0]).all()
    first = dict(zip(frames["id"], frames["frame"], strict=True))
    ours = dict(zip(found.agent.tolist(), np.ceil(found.time * RATE).astype(int).tolist(), strict=True))
    assert ours.keys() == first.keys()
    assert all(abs(ours[agent] - first[agent]) <= 1 for agent in ours), "PedPy counts whole frames"
    assert passed["cumulative_pedestrians"].iloc[-1] == len(found.time)
    rate = flow(found, 6.0, len(run.pos) / RATE)
    span = (frames["frame"].max() - frames["frame"].min()) / RATE
    assert abs(rate.passing) == pytest.approx((len(frames) - 1) / span, rel=2 / RATE / span + 0.01)
