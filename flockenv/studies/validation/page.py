"""The page of a validation, as Markdown: the cases and their methods, the table, the results."""

from __future__ import annotations

from collections.abc import Sequence

from flockenv.scene.presets import PRESETS
from flockenv.studies.trial_log import Results

__all__ = ["page"]

INTRODUCTION = """# Crowds, validated

Models of pedestrians by name ([presets](../flockenv/scene/presets.py)), in the scenes of RiMEA, NIST TN 1822 and
JuPedSim's tests, as far as they are flat. Parameters are the published ones and were fixed before these numbers were
seen; where a model misses, the table shows by how much. `flockenv validate --out docs/crowds.md --force` makes this
page, the numbers beside it and the pictures; `flockenv validate "rimea 12" --preset helbing_2000` is one cell. The
scenes are in [configs/crowds](../configs/crowds), with the preset of 2000; `--preset moussaid_2009 --scenes FOLDER`
writes others.

What is ours: paths to goals are found on a grid around all walls (`way`, .3 m clear of them). Walls do not hide
people (`occluded: false`, the presets' default; `true` takes 20 times as long). Desired speeds are Weidmann's
N(1.34, .26) m/s unless a case has others; masses and radii are a preset's own. One step is .02 s, of the preset of
2011 .05 s, of 2000 .005 s (its friction over 6 cm of two bodies' overlap; .0025 s where
people hurry, .001 s where bodies lie in each other from the start). Walls are solid: models without bodies are given
the elastic wall of 2000 (k = 1.2e5 kg/s^2), or a crowd is pushed through what 2009 has for walls. Steps, solid walls,
and the sizes of some rooms were chosen after a first look; no preset's value was. People count as stuck if none came
out for 60 s. Walls are lines without thickness; people whose centre passed to the other side "went through". An
empty cell was not tried. Seconds are of a machine with other work.
"""

PICTURES = {
    "fundamental_diagram": "Speed over density in a corridor without ends: dots are 4 x 4 m of it, lines are means.",
    "bottleneck": "Flow through a passage by its width, beside three experiments.",
    "lanes": "People walking right (orange) and left (blue), and their paths in the seconds before.",
    "faster_is_slower": "The time that a room takes to empty, by desired speed: medians, quartiles.",
}

REMARKS = {
    "rimea 4": "The forces of 2000 reach 8 cm: people are free until bodies touch, and jam then. In the preset of 1995 "
    "neighbours behind count half of those ahead, so a dense crowd is pushed backwards.",
    "rimea 12": "J is of the middle of the passage, from the first to the last of 150, medians of three runs. Both "
    "jambs push a body in between, with 2 kN where one of 2000 touches: a body .7 m across hardly passes .8 m. "
    "In 2009 people have no bodies, and come closer than bodies can: flows are half as large again as measured. "
    "Without solid walls they lay on the data, because people went through the walls. 2011 with d_max = 2 m, as the "
    "paper has it for evacuations, also stops at .8 m.",
    "rimea 15": "The last to arrive decides: its desired speed is .46 m/s.",
    "rimea 16": "RiMEA's envelope is not in our sources; the line is Seyfried's, d = .36 + 1.06 v.",
    "nist 3.1": "Doors of .9 m: see RiMEA 12 for models that they stop. Those that are stuck count as not having left.",
    "rimea 9": "The last of 1000 decides: a single person that is stuck makes it a miss without a number. The "
    "time at which 95 % are out is also given, and decides nothing.",
    "lanes": "The null is a permutation test of every run: directions are dealt out anew among the same people.",
    "bursts": "Crossings until the last of whichever side is done first; the null is a coin with as many heads.",
    "faster is slower": "Steps of .0025 s: at .005 s and 3 m/s bodies are thrown through walls, and the room is empty "
    "after 16 s. At 5 m/s that happens in some runs at .0025 s, too: the lower quartile, 6 s, is theirs. In steps of "
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
    lines += ["## What came of each", ""]
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
