"""The scenes of the cases as files: `flockenv validate "rimea 12" --preset moussaid_2009 --scenes configs/crowds`.

They are the scenes of the trials, except that a trial mixes two groups that in a file begin in halves of a corridor.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from flockenv.core.atomic_files import new_folder, replace_file
from flockenv.scene.yaml_io import dump_scene
from flockenv.studies.trial_log import Case
from flockenv.studies.validation import alone, corridors, doors
from flockenv.studies.validation.quiet import ignore_contact_warnings
from flockenv.studies.validation.walk import Scenes

__all__ = ["SCENES", "write_scenes"]

SCENES: Scenes = {**alone.SCENES, **corridors.SCENES, **doors.SCENES, "nist 5.2": doors.SCENES["nist 5.1"]}
"""Builders of scenes from a preset's name, by case and by the variant of the scene."""


def write_scenes(folder: Path, cases: Sequence[Case], presets: Sequence[str], force: bool = False) -> list[Path]:
    """Write the scenes of some cases with some presets, a YAML file each; of several presets a folder each.

    Returns their paths. ValueError, before anything is written, if one is there already and `force` is not given.
    """
    todo = [
        (
            _scene_path(folder, presets, name) / f"{'_'.join([*case.name.split(), *which.split()])}.yaml",
            case,
            name,
            built,
        )
        for name in presets
        for case in cases
        if case.runs_under(name)
        for which, built in SCENES[case.name].items()
    ]
    there = [path for path, *_ in todo if path.exists()]
    if there and not force:
        raise ValueError(f"--scenes: {there[0].name} exists already in {there[0].parent}; --force overwrites it")
    for path, case, name, built in todo:
        with ignore_contact_warnings():
            text = dump_scene(built(name), [name], brief=True)
        with new_folder(path.parent), replace_file(path) as file:
            file.write(f"{_file_head(case, path)}{text}".encode())
    return [path for path, *_ in todo]


def _scene_path(folder: Path, presets: Sequence[str], name: str) -> Path:
    return folder / name if len(presets) > 1 else folder


def _file_head(case: Case, path: Path) -> str:
    """Return the head of a file: the bound of the case, and commands to run and see it."""
    about = f"# {case.name}: {case.title}; demanded: {case.bound}."
    return f"{about}\n#   flockenv render {path.name} --duration 30 --out {path.stem}.gif\n"
