"""The page of a validation, as Markdown: the cases and their methods, the table, the results."""

from __future__ import annotations

from collections.abc import Sequence

from flockenv.scene.presets import PRESETS
from flockenv.studies.trial_log import Results

__all__ = ["page"]

INTRODUCTION = """# Validation of crowd models

This page runs published pedestrian models ([presets](../flockenv/scene/presets.py)) in the flat scenes of RiMEA, NIST
TN 1822 and JuPedSim's tests. Parameters are the published ones and were fixed before these numbers were seen. If a
model misses a bound, the table shows by how much.

* `flockenv validate --out docs/crowds.md --force` writes this page, the numbers beside it and the pictures.
* `flockenv validate "rimea 12" --preset helbing_2000` computes one cell.
* The scenes are in [configs/crowds](../configs/crowds), with the preset of 2000. `--preset moussaid_2009 --scenes
  FOLDER` writes them with another preset.

These settings are ours, not the models':

* Paths to goals are computed on a grid around all walls (`way`, with a clearance of .3 m).
* Walls do not hide people (`occluded: false`, the presets' default; `true` takes 20 times as long).
* Desired speeds are Weidmann's N(1.34, .26) m/s unless a case has others. Masses and radii are those of each preset.
* The step is .02 s, for the preset of 2011 .05 s, for that of 2000 .005 s, because of its friction at an overlap of
  6 cm. It is .0025 s if people hurry, and .001 s if bodies overlap at the start.
* Walls are solid. Models without bodies get the elastic wall of 2000 (k = 1.2e5 kg/s^2); otherwise a crowd is pushed
  through the walls of 2009.
* Steps, solid walls and the sizes of some rooms were chosen after a first look; no value of a preset was.
* The remaining people count as stuck if none of them left for 60 s.
* Walls are lines without thickness; people whose centre passed to the other side "went through".

An empty cell was not tried. Times in s were measured on a machine with other work.
"""

PICTURES = {
    "fundamental_diagram": "Speed over density in a periodic corridor: dots are areas of 4 x 4 m, lines are means.",
    "bottleneck": "Flow through a passage by its width, with three experiments.",
    "lanes": "People walking right (orange) and left (blue), and their paths in the seconds before.",
    "faster_is_slower": "Time to empty a room, by desired speed: medians and quartiles.",
}

REMARKS = {
    "rimea 4": "The forces of 2000 have a range of 8 cm: people walk freely until bodies touch, and then jam. In the "
    "preset of 1995 neighbours behind have half the weight of those ahead, so a dense crowd is pushed backwards.",
    "rimea 12": "J is measured in the middle of the passage, from the first to the last of 150, medians of three runs. "
    "Both jambs push a body between them, with 2 kN at a touch in the model of 2000: a body .7 m across hardly passes "
    ".8 m. In 2009 people have no bodies, and come closer than bodies can: flows are 1.5 times the measured ones. "
    "Without solid walls flows agreed with the data, because people went through the walls. 2011 with d_max = 2 m, "
    "the paper's value for evacuations, also stops at .8 m.",
    "rimea 15": "The last to arrive decides: its desired speed is .46 m/s.",
    "rimea 16": "RiMEA's envelope is not in our sources; the line is Seyfried's, d = .36 + 1.06 v.",
    "nist 3.1": "Doors are .9 m wide; RiMEA 12 shows which models they stop. Stuck people count as not having left.",
    "rimea 9": "The last of 1000 decides: a single stuck person makes it a miss without a number. The time at which "
    "95 % are out is also given, and decides nothing.",
    "lanes": "The null is a permutation test of every run: directions are permuted among the same people.",
    "bursts": "Crossings until the last of the side that finishes first; the null is a coin with as many heads.",
    "faster is slower": "Steps of .0025 s: at .005 s and 3 m/s bodies are thrown through walls, and the room is empty "
    "after 16 s. At 5 m/s this also happens in some runs at .0025 s, which make the lower quartile of 6 s. In steps of "
    ".001 s six runs at 5 m/s took 179 to 222 s, and one body went through a wall.",
}
"""Remarks on cases, below their numbers."""


def page(results: Results, pictures: str, drawn: Sequence[str]) -> str:
    """Return the page; `drawn` are the names of the pictures in the folder `pictures` beside it."""
    lines = [INTRODUCTION, "## Table", ""]
    names = [preset.replace("_", " ") for preset in results.unders]
    lines += _table(["case", "", "bound", *names], results.rows(3))
    lines += ["", *(f"* {verdict}: {text}." for verdict, text in results.legend()), ""]
    for name in drawn:
        lines += [f"![{name.replace('_', ' ')}]({pictures}/{name}.png)", "", PICTURES.get(name, ""), ""]
    lines += ["## Results by case", ""]
    for case in results.cases:
        found = [f for f in results.findings if f.case == case]
        lines += [f"### {case}: {found[0].title}", "", f"Bound: {found[0].bound}.", ""]
        lines += [REMARKS[case], ""] if case in REMARKS else []
        lines += _table(["preset", "value", "", "s"], [
            [f.under, f.cell(3), f.note, f"{f.seconds:.0f}"] for f in found
        ])  # fmt: skip
        lines.append("")
    lines += ["## Presets", ""]
    lines += _table(["preset", "source"], [[name, PRESETS[name].source] for name in results.unders])
    return "\n".join(lines) + "\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [
        "| " + " | ".join(row) + " |" for row in (header, ["---"] * len(header), *(map(_cell, row) for row in rows))
    ]


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
