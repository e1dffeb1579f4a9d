"""Colours and shapes that pictures and replays share."""

from __future__ import annotations

from typing import Final

__all__ = ["ARROW", "BODY_DISC", "BOND", "DART", "DART_REACH", "JUMP", "PAPER", "POINT", "ROLE_COLOURS", "mix", "rgb"]

#: role -> (colour on a light, on a dark background), after the palette of Okabe and Ito, whose colours can be
#: distinguished with any colour vision (jfly.uni-koeln.de/color).
ROLE_COLOURS: Final[dict[str, tuple[str, str]]] = {
    "pursuer": ("#d55e00", "#f0803c"),
    "evader": ("#0072b2", "#4fb0e8"),
    "learner": ("#e08a00", "#f2ae3d"),
    "learner 2": ("#8a4fa3", "#c08ad6"),
    "flockmate": ("#3b9bd6", "#6cbcf0"),
    "agent": ("#52637a", "#a5b3c6"),
    "agent 2": ("#b4568f", "#e08fc0"),
    "agent 3": ("#8c7a00", "#d9c63a"),
    "agent 4": ("#1f8a8a", "#5cc7c7"),
}

#: Opacity of paths, which have the colour of goals.
WAY: Final = 0.18

#: part of the picture -> (colour in the light, in the dark theme)
PAPER: Final[dict[str, tuple[str, str]]] = {
    "page": ("#f3f5f8", "#0e1218"),
    "paper": ("#ffffff", "#161c25"),
    "grid": ("#eef1f5", "#1e2631"),
    "edge": ("#c3cbd6", "#3a4657"),
    "ink": ("#1d2633", "#e6ebf2"),
    "faint": ("#626e7f", "#8e9bad"),
    "stone": ("#aab3c0", "#4a586b"),
    "rim": ("#8b96a6", "#66768c"),
    "goal": ("#009e73", "#2cc79a"),
}

#: Corners of the dart that shows an agent, x forward, in units of its reach (from its middle to its tip).
DART: Final = ((1.0, 0.0), (-0.78, 0.66), (-0.42, 0.0), (-0.78, -0.66))

#: Least reach of a dart, as a share of the picture's width, so that headings of small bodies can be read.
DART_REACH: Final = 0.0135

#: A body of at least this share of its dart's reach is drawn as a disc under the dart; a smaller one, which the dart
#: would hide, as a dark dot on it.
BODY_DISC: Final = 0.4

#: Width of a bond's line, and least radius of the dots at its ends, as a share of the picture's width.
BOND: Final = 0.0022

#: Least radius of agents drawn as points, as a share of the picture's width.
POINT: Final = 0.0022

#: Reach of a metaball, in units of its size: two of one size melt if their centres are within 4.6 sizes.
METABALL: Final = 4.0

#: Corners of the arrow that shows a heading, x along it, in units of its length.
ARROW: Final = ((0.0, 0.035), (0.7, 0.05), (0.66, 0.16), (1.0, 0.0), (0.66, -0.16), (0.7, -0.05), (0.0, -0.035))

#: No line joins two positions of an agent that are farther apart than this share of the world: it has crossed the edge
#: of a torus, or was born again.
JUMP: Final = 0.25


def rgb(colour: str) -> tuple[int, int, int]:
    """Return the colour "#rrggbb" as three numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def mix(colour: str, ground: str, share: float) -> tuple[int, int, int]:
    """Return the mixture of `colour`, with a share from 0 to 1, and `ground`."""
    r, g, b = (round(share * top + (1.0 - share) * below) for top, below in zip(rgb(colour), rgb(ground), strict=True))
    return r, g, b
