"""All constraints: as values and YAML, the same bits in a batch, and the same kernel in a plane as without them."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from flockenv.scene.yaml_io import dump_scene, load_scene
from tests.catalogue import CONSTRAINTS, ConstraintRow, constrained

every_constraint = pytest.mark.parametrize("row", CONSTRAINTS, ids=lambda row: row.name)


@every_constraint
def test_a_constraint_is_a_value_that_pickle_and_yaml_keep(row: ConstraintRow) -> None:
    scene = constrained(row)
    for copy in (pickle.loads(pickle.dumps(scene)), load_scene(dump_scene(scene))):
        assert copy == scene and copy.constraints == (row.constraint,)
        assert hash(copy.constraints[0]) == hash(row.constraint)


@every_constraint
def test_a_constraint_does_not_change_the_kernel_in_a_plane(row: ConstraintRow) -> None:
    scene = constrained(row)
    assert scene.parts == scene.model_copy(update={"constraints": ()}).parts  # all that a kernel depends on


@pytest.mark.slow
@every_constraint
def test_a_row_of_a_batch_has_the_bits_of_that_world_alone(row: ConstraintRow) -> None:
    scene = constrained(row)
    start = scene.start(0, worlds=3)
    push = np.array([0.0, 0.1, 0.3])[:, None, None] * np.isfinite(scene.body.mass)[:, None]
    start = start.with_motion(start.pos, start.vel + push)
    batch = scene.step(start, steps=20)
    free = scene.model_copy(update={"constraints": ()}).step(start, steps=20)
    for world in range(3):
        alone = scene.step(start.worlds([world]), steps=20)
        assert alone.digest == batch.worlds([world]).digest
        assert (alone.work == batch.work[world]).all()
        assert alone.digest != free.worlds([world]).digest
