"""With NUMBA_DISABLE_JIT=1 everything runs in plain Python, for a debugger, with the same results up to rounding."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.plain_python import ROOT, TIES, cases, ended


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_plain_python_gives_the_same_results_for_every_effect_method_and_task(tmp_path: Path) -> None:
    file = tmp_path / "ended.npz"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    subprocess.run([sys.executable, "-m", "tests.plain_python", str(file)], cwd=ROOT, env=environment, check=True)
    found, off = np.load(file), {}
    for name, case in cases():
        expected = ended(case)
        scale = max(float(np.abs(expected[np.isfinite(expected)]).max()), 1.0)
        tolerance = 1e-9 if getattr(case, "dtype", "float32") == "float64" else 1e-4
        if name not in TIES and not np.allclose(found[name], expected, rtol=0, atol=tolerance * scale, equal_nan=True):
            off[name] = float(np.nanmax(np.abs(found[name] - expected)))
    assert not off
